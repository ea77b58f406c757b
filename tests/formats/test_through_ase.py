"""Formats that ASE reads."""

import ase
import ase.build
import ase.io
import numpy as np
import pytest
from support.structures import SPECIES, Truth, as_g96, as_gen, read, same_molecules, unreadable

from rigidmd.errors import StructureError
from rigidmd.io.structure_file import read_atoms


def as_dl_poly(rows, cell) -> str:
    edges = "\n".join("".join(f"{x:20.10f}" for x in edge) for edge in cell)
    atoms = "\n".join(
        f"{name:<8}{k:10d}\n{''.join(f'{x:20.10f}' for x in at)}"
        for k, (name, at) in enumerate(rows, 1)
    )
    return f"water\n         0         2\n{edges}\n{atoms}\n"


def as_poscar(rows, cell) -> str:
    edges = "\n".join(" ".join(map(str, edge)) for edge in cell)
    names, counts = " ".join(name for name, _ in rows), " ".join("1" for _ in rows)
    positions = "\n".join(" ".join(map(str, at)) for _, at in rows)
    return f"water\n1.0\n{edges}\n{names}\n{counts}\nCartesian\n{positions}\n"


def as_xsf(rows, cell) -> str:
    edges = "\n".join(" ".join(map(str, edge)) for edge in cell)
    atoms = "\n".join(f"{name} {x} {y} {z}" for name, (x, y, z) in rows)
    return f"CRYSTAL\nPRIMVEC\n{edges}\nPRIMCOORD\n{len(rows)} 1\n{atoms}\n"


FORMATS = {
    "a.gen": as_gen,
    "a.g96": as_g96,
    "CONFIG": as_dl_poly,
    "a.dlp4": as_dl_poly,
    "a.vasp": as_poscar,
    "a.xsf": as_xsf,
}


@pytest.mark.parametrize("massless", ["M", "MW", "EP", "Du", "Q", "L", "X", "IW"])
@pytest.mark.parametrize("file", FORMATS)
def test_massless_sites_in_formats_that_know_elements(file, massless, tmp_path):
    truth = Truth(["tip4p2005"] * 3, 40)
    names = {"OW": "O", "HW1": "H", "HW2": "H", "MW": massless}
    text = FORMATS[file](
        [(names[name], tuple(x)) for name, _, _, x, _ in truth.atoms()], truth.cell
    )
    same_molecules(read(tmp_path, text, file, ("tip4p2005",)), truth, 1e-4, ["tip4p2005"])


@pytest.mark.parametrize("file", FORMATS)
def test_deuterium_in_formats_that_know_elements(file, tmp_path):
    truth = Truth(["spce"] * 3, 41)
    text = FORMATS[file](
        [(e.replace("H", "D"), tuple(x)) for _, e, _, x, _ in truth.atoms()], truth.cell
    )
    same_molecules(read(tmp_path, text, file), truth, 1e-4)


@pytest.mark.parametrize("file", ["a.g96", "CONFIG", "conf"])
def test_ions_by_names_in_formats_of_force_fields(file, tmp_path):
    """NA is not a nitrogen, and CL no carbon."""
    truth = Truth(["sodium", "chloride", "spce", "sodium"], 42)
    rows = [(name.upper(), tuple(x)) for name, _, _, x, _ in truth.atoms()]
    text = FORMATS.get(file, as_g96)(rows, truth.cell)
    species = [SPECIES[name] for name in ("sodium", "chloride", "spce", "nitrogen")]
    same_molecules(read(tmp_path, text, file, species), truth, 1e-4, species)


def test_a_damaged_byte_of_a_traj_is_reported(tmp_path):
    """ASE looks at atomic numbers when their symbols are needed."""
    path = tmp_path / "a.traj"
    ase.io.write(path, ase.Atoms("Ar3", np.eye(3), cell=[9, 9, 9], pbc=True))
    content = bytearray(path.read_bytes())
    at = content.index(np.full(3, 18).tobytes())
    for byte, number in ((0, 200), (1, 1), (7, 0xFF)):
        path.write_bytes(bytes([*content[: at + byte], number, *content[at + byte + 1 :]]))
        with pytest.raises(StructureError, match="an atomic number is that of no element"):
            read_atoms(path)


def test_a_poscar_without_elements_names_the_line(tmp_path):
    text = "made by hand\n1.0\n9 0 0\n0 9 0\n0 0 9\n2\nDirect\n0 0 0\n.5 .5 .5\n"
    unreadable(
        "POSCAR: line 6: expected the symbols of its elements", tmp_path, text, "POSCAR", ["argon"]
    )
    assert len(read(tmp_path, text.replace("2\n", "Ar\n2\n", 1), "POSCAR", ["argon"]).species) == 2
