"""Files of type .xyz and .extxyz."""

import re

import numpy as np
import pytest
from support.structures import Truth, read, same_molecules, unreadable, xyz

from rigidmd.assemble.build import build
from rigidmd.errors import StructureError
from rigidmd.io.structure_file import read_geometry
from rigidmd.scene import Scene


@pytest.mark.parametrize("column", ["vel", "velo", "velocity", "velocities"])
def test_velocities_in_a_column_without_units_are_not_used(column, tmp_path):
    truth = Truth(["argon"] * 2)
    text = truth.xyz().splitlines()
    text[1] += f" Properties=species:S:1:pos:R:3:{column}:R:3"
    text[2:] = [line + " 1 2 3" for line in text[2:]]
    found = read(tmp_path, "\n".join(text) + "\n", "a.xyz", ["argon"])
    assert found.velocity is None
    note = f"its velocities in the column {column} have no units and are not used (ASE writes momenta instead)"
    assert found.notes == (note,)
    data = {
        "structure": {"file": "a.xyz", "velocities": True},
        "molecules": [{"model": "argon"}],
        "forces": {"cutoff_A": 5.0},
        "stages": [{"duration_ps": 1.0}],
    }
    with pytest.raises(
        StructureError,
        match=rf"lacks velocities for some atoms; its velocities in the column {column} have no",
    ):
        build(Scene.from_dict(data, tmp_path))


def spoiled(text, how):
    """An .xyz as other programs write it."""
    lines = text.splitlines()
    match how:
        case "atomic numbers":
            numbers = {"O": "8", "H": "1"}
            return "\n".join(
                " ".join(numbers.get(word, word) for word in line.split()) if k > 1 else line
                for k, line in enumerate(lines)
            )
        case "exponents":
            return "\n".join(
                re.sub(r"(\d\.\d+)(?=\s|$)", r"\1D+00", line) if k > 1 else line
                for k, line in enumerate(lines)
            )
        case "empty lines before":
            return "\n \n\n" + text
        case "empty lines after":
            return text + "\n  \n\n"
        case "tabs":
            return "\n".join(
                line.replace(" ", "\t") if k > 1 else line for k, line in enumerate(lines)
            )
        case "types":
            return "\n".join(
                line.replace("O", "1").replace("H", "2") if k > 1 else line
                for k, line in enumerate(lines)
            )
    return text


@pytest.mark.parametrize(
    "how",
    ["atomic numbers", "exponents", "empty lines before", "empty lines after", "tabs", "types"],
)
@pytest.mark.parametrize("extended", [False, True])
def test_xyz_of_other_programs(how, extended, tmp_path):
    truth = Truth(["spce"] * 8, 28)
    text = xyz(truth.atoms(), truth.cell if extended else None)
    if extended:
        text = text.replace("Lattice", "Properties=species:S:1:pos:R:3 Lattice")
    found = read(
        tmp_path,
        spoiled(text, how),
        "a.xyz",
        cell=truth.cell,
        atom_types={"1": "O", "2": "H"} if how == "types" else None,
    )
    same_molecules(found, truth, 1e-6)
    (tmp_path / "a.xyz").write_text(
        spoiled("3\n\nO 0.0 0.0 0.0\nH 1.0 0.0 0.0\nH 0.0 1.0 0.0\n", how)
    )
    if how != "types":
        names, elements, *_ = read_geometry(tmp_path / "a.xyz")
        assert names == elements == ["O", "H", "H"]


@pytest.mark.parametrize(
    ("properties", "row", "message"),
    [
        ("species:S:1:pos:R:3:masses:S:1", "Ar 1 1 1 x", "masses are of another type"),
        ("species:S:1:pos:R:3:masses:R:2", "Ar 1 1 1 4 4", "masses are of another type"),
        ("species:S:1:pos:R:3:momenta:R:1", "Ar 1 1 1 2", "momenta are of another type"),
        ("species:S:1:pos:R:3:atomtypes:S:2", "Ar 1 1 1 a b", "atomtypes are of another type"),
        ("pos:R:3:Z:I:1", "1 1 1 700", "an atomic number is that of no element"),
        ("species:S:1:pos:R:3 occupancy=0.5", "Ar 1 1 1", "occupancy is not a table"),
        ('species:S:1:pos:R:3 occupancy="1 2"', "Ar 1 1 1", "occupancy is not a table"),
    ],
)
def test_columns_of_extended_xyz_of_another_type(properties, row, message, tmp_path):
    text = f'1\nLattice="9 0 0 0 9 0 0 0 9" Properties={properties}\n{row}\n'
    unreadable(message, tmp_path, text, "a.xyz", ["argon"])


@pytest.mark.parametrize(
    ("comment", "row", "note"),
    [
        ("x", "Ar 1 1 1 0.1 0.2 0.3", "its columns after the first 4 are not used"),
        ("Properties=species:S:1:pos:R:3:mass:R:1", "Ar 1 1 1 5", "its columns mass are not used"),
        ("properties=pos:R:3:species:S:1:q:R:1", "1 1 1 Ar 5", "its columns q are not used"),
        ("Properties=species:S:1:pos:R:3:Vel:R:3", "Ar 1 1 1 5 6 7", "in the column Vel have no"),
        (
            "Properties=species:S:1:pos:R:3:residuenumbers:I:1",
            "Ar 1 1 1 5",
            "residues are not used",
        ),
        ('pbc="T T F"', "Ar 1 1 1", "its cell is periodic along a, b only and is not used"),
        ('PBC="T T F"', "Ar 1 1 1", "its cell is periodic along a, b only and is not used"),
        ("Properties=species:S:1:pos:R:3:forces:R:3", "Ar 1 1 1 5 6 7", ""),
    ],
)
def test_columns_and_keys_of_xyz(comment, row, note, tmp_path):
    """ASE knows keys in some letters only, and reads more columns than a start uses."""
    for lattice in ("Lattice", "lattice", "LATTICE"):
        text = f'1\n{lattice}="9 0 0 0 9 0 0 0 9" {comment}\n{row}\n'
        found = read(tmp_path, text, "a.xyz", ["argon"], np.diag([9.0] * 3))
        assert found.position == pytest.approx(np.ones((1, 3)))
        assert note in "; ".join(found.notes)
        assert bool(note) == bool(found.notes)


def test_properties_that_ase_does_not_read(tmp_path):
    text = "1\nProperties=species:\tS:1:pos:R:3\nAr 1 1 1\n"
    unreadable(
        "ASE reads 0 of its 1 structures: is the key Prop", tmp_path, text, "a.xyz", ["argon"]
    )
