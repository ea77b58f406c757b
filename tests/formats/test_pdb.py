"""Files of type .pdb."""

import numpy as np
import pytest
from support.common import small_scene
from support.structures import (
    TOLERANCE,
    Truth,
    as_g96,
    cryst1,
    pdb,
    read,
    same_molecules,
    unreadable,
)

from rigidmd.assemble.build import build
from rigidmd.assemble.structure import read_structure
from rigidmd.io.trajectory_file import write_topology


@pytest.mark.parametrize(("numbers", "codes"), [((5, 5), "AB"), ((5, 5), " A"), ((7, 8), "  ")])
def test_insertion_codes_separate_the_residues_of_a_pdb(numbers, codes, tmp_path):
    """Two waters of one number, as of a hydrate: residues, not bonding distances, are the
    molecules."""
    truth = Truth(["spce"] * 2, 5)
    labels = [f"{number:4d}{code}" for number, code in zip(numbers, codes, strict=True)]
    lines = truth.pdb(number=lambda k: f"{k:4d}").splitlines()
    for k, label in enumerate(labels):
        lines = [
            line[:22] + label + line[27:] if line[22:26] == f"{k:4d}" else line for line in lines
        ]
    found = read(tmp_path, "\n".join(lines), "a.pdb")
    same_molecules(found, truth, 0.002)
    assert found.notes == ()
    assert found.number.tolist() == list(numbers)


@pytest.mark.parametrize(
    ("group", "is_reported"), [("P 1", False), ("P1", False), ("", False), ("P 21 21 21", True)]
)
def test_the_space_group_of_a_pdb_is_reported(group, is_reported, tmp_path):
    truth = Truth(["spce"] * 2, 5)
    text = pdb(truth.atoms(), cryst1(truth.cell).removesuffix(" P 1") + f" {group:<11}{1:4d}")
    found = read(tmp_path, text, "a.pdb")
    note = "line 1: the space group P 21 21 21 is not applied: its atoms were taken as all atoms of the cell"
    assert found.notes == ((note,) if is_reported else ())


def test_a_truncated_pdb_is_reported(tmp_path):
    """Cut between two molecules it is a whole file of fewer, but for its end."""
    system = build(small_scene({"spce": 8}, 20.0))
    write_topology(tmp_path / "whole.pdb", system, system.state, wrapped=True)
    lines = (tmp_path / "whole.pdb").read_text().splitlines(keepends=True)
    last = max(k for k, line in enumerate(lines) if line.startswith(("ATOM", "HETATM")))
    (tmp_path / "cut.pdb").write_text("".join(lines[: last - 5]))
    told = {
        name: read_structure(tmp_path / name, system.species, None, True, TOLERANCE, None)
        for name in ("whole.pdb", "cut.pdb")
    }
    assert [len(found.position) for found in told.values()] == [8, 6]
    assert not any("truncated" in note for note in told["whole.pdb"].notes)
    assert any(
        "it ends with an atom, without END: is it truncated?" in note
        for note in told["cut.pdb"].notes
    )


def test_long_pdbs_whose_numbers_run_out(tmp_path):
    truth = Truth(["spce"] * 8, 13)
    text = truth.pdb(number=lambda k: f"A{k:03d}")  # hybrid-36
    same_molecules(read(tmp_path, text, "a.pdb"), truth, 0.002)
    text = truth.pdb(number=lambda k: f"   {k // 2}")  # two of each number, in two chains
    lines = [
        line.replace(" A   ", " B   ") if (k - 1) % 6 < 3 else line
        for k, line in enumerate(text.splitlines())
    ]
    assert read(tmp_path, "\n".join(lines) + "\n", "c.pdb").notes == ()
    text = truth.pdb(number=lambda k: "****")  # GROMACS and others beyond 9999
    same_molecules(read(tmp_path, text, "b.pdb"), truth, 0.002)


def wide_pdb(atoms, cell, serial, shift) -> str:
    """A .pdb whose numbers are as wide as printf makes them. serial: of the first atom; shift:
    Å."""
    lines = [cryst1(cell)]
    for i, (name, element, k, x, _) in enumerate(atoms):
        number = serial + i if isinstance(serial, int) else serial
        place = "".join(f"{c:8.3f}" for c in x + shift)
        lines.append(
            f"HETATM{number:>5}  {name:<3} HOH A{k + 9998:>4}    {place}  1.00  0.00          {element:>2}"
        )
    return "\n".join([*lines, "END"]) + "\n"


@pytest.mark.parametrize("serial", [1, 99_998, 999_998, "A0000", "186a0", "*****", ""])
@pytest.mark.parametrize("shift", [0.0, 9_990.0, -995.0, [0.0, 99_990.0, -9_995.0]])
def test_pdbs_with_wide_numbers(serial, shift, tmp_path):
    truth = Truth(["spce"] * 8, 27, edges=(4000.0, 4000.0, 4000.0))
    truth.centre /= 100
    text = wide_pdb(truth.atoms(), truth.cell, serial, shift)
    found = read(tmp_path, text, "a.pdb")
    truth.centre = truth.centre + shift
    same_molecules(found, truth, 0.002)
    assert list(found.number) == list(range(9998, 10006))


def test_coordinates_of_a_pdb_that_are_not_in_columns(tmp_path):
    truth = Truth(["spce"] * 2)
    rows = [
        f"ATOM  {i:5d}  {n:<3} SOL A{k + 1:4d} {x[0]:.6f} {x[1]:.6f} {x[2]:.6f}"
        for i, (n, _, k, x, _) in enumerate(truth.atoms())
    ]
    same_molecules(
        read(tmp_path, "\n".join([cryst1(truth.cell), *rows, "END"]), "a.pdb"), truth, 1e-5
    )
    stars = truth.pdb().replace(f"{truth.atoms()[0][3][0]:8.3f}", "********")
    unreadable(
        r"line 2: expected an atom of a .pdb with coordinates in columns 31 to 54, found",
        tmp_path,
        stars,
        "b.pdb",
    )


@pytest.mark.parametrize(
    "box",
    [
        "CRYST1    0.000    0.000    0.000   0.00   0.00   0.00 P 1           1",
        "CRYST1    0.000    0.000    0.000  90.00  90.00  90.00 P 1           1",
        "CRYST1      nan      nan      nan    nan    nan    nan P 1           1",
        "CRYST1 0 0 0 0 0 0",
        "CRYST1   14.000   15.000   16.000   0.00   0.00   0.00",
        "CRYST1   14.000   15.000   16.000  10.00  20.00  90.00",
        "CRYST1   14.000   15.000",
        "CRYST1",
    ],
)
def test_a_cryst1_that_is_not_a_box(box, tmp_path):
    truth = Truth(["spce"] * 3, 14)
    text = pdb(truth.atoms(), box)
    same_molecules(read(tmp_path, text, "a.pdb", cell=truth.cell), truth, 0.002)
    assert read(tmp_path, text, "a.pdb", periodic=False).cell is None
    unreadable(r"has no box \(.*(CRYST1|no volume).*give \[box\]", tmp_path, text, "a.pdb")


@pytest.mark.parametrize(
    "box",
    [
        "CRYST1 14.0 15.0 16.0 90 90 90",
        "CRYST114.000015.000016.000090.000090.000090.0000",
        "CRYST1 14 15 16 90 90 90 P 1 1",
    ],
)
def test_a_cryst1_in_free_format(box, tmp_path):
    truth = Truth(["spce"] * 3, 14)
    if "114.0" in box:  # columns run together
        box = "CRYST110000.00010000.00010000.000  90.00  90.00  90.00"
        truth.cell = 10000.0 * np.eye(3)
    found = read(tmp_path, pdb(truth.atoms(), box), "a.pdb")
    same_molecules(found, truth, 0.002)
    assert found.cell == pytest.approx(truth.cell)


def test_what_pdb_and_g96_state_and_what_is_not_used(tmp_path):
    pdb = "ATOM      1  Ar  AR      1       1.000   1.000   1.000  1.00  0.00          {:>2}\nEND\n"
    options = {"cell": np.diag([9.0] * 3)}
    found = read(tmp_path, pdb.format("QZ"), "a.pdb", ["argon"], **options)
    assert "symbols in columns 77 and 78, QZ, are not elements" in "; ".join(found.notes)
    assert not read(tmp_path, pdb.format("AR"), "a.pdb", ["argon"], **options).notes
    g96 = as_g96([("Ar", [1.0, 1.0, 1.0])], np.diag([9.0] * 3))
    assert not read(tmp_path, g96, "a.g96", ["argon"]).notes
    found = read(tmp_path, g96.replace("BOX", "GENBOX"), "a.g96", ["argon"], **options)
    assert "its blocks GENBOX are not used" in found.notes
