"""Structure files as people have them: read rightly, or rejected with one clear message."""

import bz2
import codecs
import dataclasses
import gzip
import io
import lzma
import re
from collections.abc import Sequence
from math import inf
from pathlib import Path

import ase
import ase.build
import ase.io
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.common import built, small_scene

from rigidmd.assemble.build import build
from rigidmd.assemble.plausibility import molecule_warnings
from rigidmd.assemble.species import species_of
from rigidmd.assemble.start import close_pairs, every_site
from rigidmd.assemble.structure import read_structure
from rigidmd.core.state_file import write_state
from rigidmd.errors import SceneError, StructureError
from rigidmd.formats.atoms import element_of, element_of_mass
from rigidmd.formats.cells import (
    basis_of,
    describe_basis,
    least_skewed_cell,
    nearest_images,
    pairs_within,
    reduced_cell,
    standard_rotation,
)
from rigidmd.io.structure_file import read_atoms, read_geometry
from rigidmd.io.trajectory_file import TrajectoryFile, write_topology
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene import Scene
from rigidmd.scene.models import Molecule, Site, load_model, molecule, with_masses
from rigidmd.scene.species import Box
from rigidmd.units import GRAM_PER_CM3

TOLERANCE = 0.15


def chiral() -> Molecule:
    """CHFClBr, left-handed; its mirror image must not be taken for it."""
    corners = {"H": (1, 1, 1), "F": (1, -1, -1), "Cl": (-1, 1, -1), "Br": (-1, -1, 1)}
    lengths, masses = (
        {"H": 1.09, "F": 1.36, "Cl": 1.76, "Br": 1.94},
        {"H": 1.0, "F": 19.0, "Cl": 35.4, "Br": 79.9},
    )
    sites = [Site(name="C", element="C", mass_u=12.0, position_A=(0.0, 0.0, 0.0))]
    for e, corner in corners.items():
        place = tuple(float(lengths[e] * x / np.sqrt(3)) for x in corner)
        sites.append(Site(name=e.upper(), element=e, mass_u=masses[e], position_A=place))
    return molecule("halothane", tuple(sites), residue_names=("HAL",))


def tetrachloromethane() -> Molecule:
    """Half of the orders of its chlorines have all distances right and are mirror images."""
    corners = 1.766 / np.sqrt(3) * np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)])
    sites = [
        Site(name=f"CL{k}", element="Cl", mass_u=35.45, position_A=tuple(map(float, x)))
        for k, x in enumerate(corners)
    ]
    carbon = Site(name="C", element="C", mass_u=12.011, position_A=(0.0, 0.0, 0.0))
    return molecule("tetrachloromethane", (carbon, *sites), residue_names=("CCL4",))


def benzene() -> Molecule:
    """Twelve atoms of two kinds: 518,400 orders, 12 of which fit."""
    sites = []
    for e, radius, mass in (("C", 1.397, 12.011), ("H", 2.483, 1.008)):
        for k in range(6):
            place = (
                radius * float(np.cos(k * np.pi / 3)),
                radius * float(np.sin(k * np.pi / 3)),
                0.0,
            )
            sites.append(Site(name=f"{e}{k + 1}", element=e, mass_u=mass, position_A=place))
    return molecule("benzene", tuple(sites), residue_names=("BNZ",))


def ion(element: str, mass: float) -> Molecule:
    return molecule(
        element, (Site(name=element, element=element, mass_u=mass, position_A=(0.0, 0.0, 0.0)),)
    )


SPECIES = {
    "sodium": ion("Na", 22.99),
    "chloride": ion("Cl", 35.45),
    "spce": load_model("spce"),
    "tip4p2005": load_model("tip4p2005"),
    "nitrogen": load_model("nitrogen"),
    "argon": load_model("argon"),
    "chiral": chiral(),
    "benzene": benzene(),
    "tetrachloromethane": tetrachloromethane(),
}


class Truth:
    """Molecules that are known: on a lattice so wide that none touch, rotated at random."""

    def __init__(
        self, kinds: Sequence[str | Molecule], seed: int = 0, edges=(14.0, 15.0, 16.0), cell=None
    ):
        rng = np.random.default_rng(seed)
        self.species = [SPECIES[kind] if isinstance(kind, str) else kind for kind in kinds]
        self.cell = np.diag(edges) if cell is None else np.array(cell)
        side = int(np.ceil(np.cbrt(len(kinds))))
        grid = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), -1).reshape(-1, 3)[
            : len(kinds)
        ]
        self.centre = ((grid + 0.1 * rng.random(grid.shape)) / side) @ self.cell
        self.rotation = random_rotations(rng, len(kinds))
        self.velocity = rng.standard_normal((len(kinds), 3))
        self.omega = 5 * rng.standard_normal((len(kinds), 3))  # lab
        for k, m in enumerate(
            self.species
        ):  # a linear body does not rotate about its axis, a point not at all
            body = self.rotation[k].T @ self.omega[k]
            self.omega[k] = self.rotation[k] @ (body * (m.inertia > 0))

    def atoms(self, massless=True):
        """(name, element, molecule, position, velocity) of every site, molecules whole."""
        return [
            (
                m.site_names[s],
                m.elements[s],
                k,
                self.centre[k] + (arm := self.rotation[k] @ m.positions_body[s]),
                self.velocity[k] + np.cross(self.omega[k], arm),
            )
            for k, m in enumerate(self.species)
            for s in range(len(m.masses))
            if massless or m.masses[s] > 0
        ]

    def angular_momentum_body(self):
        return np.array(
            [
                m.inertia * (q.T @ w)
                for m, q, w in zip(self.species, self.rotation, self.omega, strict=True)
            ]
        )


def same_molecules(found, truth: Truth, species: list[Molecule], error: float, cell=None):
    """Every molecule is found once, all sites of all kinds in place modulo the lattice. Returns the
    pairing."""
    cell = truth.cell if cell is None else cell

    def apart(a, b):
        step = (a - b) @ np.linalg.inv(cell)
        return np.linalg.norm((step - np.round(step)) @ cell, axis=-1)

    assert len(found.species) == len(truth.species)
    distance = apart(found.position[:, None], truth.centre)
    partner = distance.argmin(axis=1)
    assert sorted(partner) == list(range(len(truth.species)))
    for n, k in enumerate(partner):
        model, true = species[found.species[n]], truth.species[k]
        assert model.name == true.name
        sites = found.position[n] + model.positions_body @ found.rotation[n].T
        there = truth.centre[k] + true.positions_body @ truth.rotation[k].T
        for s, element in enumerate(model.elements):
            like = [i for i, e in enumerate(true.elements) if e == element]
            assert apart(sites[s], there[like]).min() <= error, (model.name, model.site_names[s])
    return partner


def gro(
    atoms, box, digits=3, velocities=False, names=None, residues=True, residue_names=None
) -> str:
    """A .gro of (name, element, molecule, position in Å, velocity in Å/ps); box as its last line,
    nm."""
    width = digits + 5
    lines = ["t", str(len(atoms))]
    for i, (name, _, k, x, v) in enumerate(atoms):
        called = (names or {}).get(name, name)
        number = (k + 1) % 100000 if residues else 1
        residue = (residue_names or {}).get(k, "SOL" if residues else "")
        line = f"{number:5d}{residue:<5}{called:>5}{(i + 1) % 100000:5d}" + "".join(
            f"{c / 10:{width}.{digits}f}" for c in x
        )
        if velocities:
            line += "".join(f"{c / 10:{width}.{digits + 1}f}" for c in v)
        lines.append(line)
    return "\n".join([*lines, box]) + "\n"


def box_of(cell) -> str:
    return " ".join(f"{x / 10:.6f}" for x in np.diag(cell))


def pdb(atoms, cryst, names=None, element_column=True, number=None, residue="HOH") -> str:
    lines = [cryst] if cryst else []
    for i, (name, element, k, x, _) in enumerate(atoms):
        called = (names or {}).get(name, name)
        label = f" {called:<3}" if len(called) < 4 else called
        serial = number(k) if number else f"{(k + 1) % 10000:4d}"
        tail = f"          {element.upper() if element != 'X' else '':>2}" if element_column else ""
        lines.append(
            f"HETATM{(i + 1) % 100000:5d} {label} {residue:>3} A{serial}    {x[0]:8.3f}{x[1]:8.3f}{x[2]:8.3f}"
            f"  1.00  0.00{tail}"
        )
    return "\n".join([*lines, "END"]) + "\n"


def cryst1(cell) -> str:
    return (
        "CRYST1"
        + "".join(f"{x:9.3f}" for x in np.diag(cell))
        + "".join(f"{a:7.2f}" for a in (90, 90, 90))
        + " P 1"
    )


def xyz(atoms, cell, names=None) -> str:
    """Extended .xyz, a name or else the element in the first column."""
    lattice = (
        f'Lattice="{" ".join(f"{x:.12f}" for x in np.ravel(cell))}"' if cell is not None else ""
    )
    rows = [
        f"{names[name] if names else element} {x[0]:.10f} {x[1]:.10f} {x[2]:.10f}"
        for name, element, _, x, _ in atoms
    ]
    return "\n".join([str(len(rows)), lattice, *rows]) + "\n"


def wrapped(atoms, cell):
    """Every atom inside the cell, molecules split."""

    def wrap(x):
        f = x @ np.linalg.inv(cell)
        return (f - np.floor(f)) @ cell

    return [(name, e, k, wrap(x), v) for name, e, k, x, v in atoms]


def read(
    tmp_path: Path, text: str, name: str, species=("spce",), cell=None, periodic=True, **options
):
    (tmp_path / name).write_text(text)
    models = [SPECIES[s] if isinstance(s, str) else s for s in species]
    return read_structure(tmp_path / name, models, cell, periodic, TOLERANCE, **options)


# outside data

WATER, HEAVY_BOX = 18.0154, 1.66053906660  # u; g/cm³ of 1 u/Å³


def density(count, mass, volume):
    return count * mass * HEAVY_BOX / volume


ICE_IH_VOLUME = 7.82**2 * 7.36 * np.sqrt(3) / 2
# file, model, scene's box, count, g/cm³, rms and largest distance from the template in Å, note; or
# a message
REFERENCE = [
    (
        "structures/spc216.gro",
        "spce",
        None,
        216,
        density(216, WATER, 18.6206**3),
        0.0038,
        0.0116,
        "",
    ),
    (
        "structures/spc216.gro",
        "tip4p2005",
        None,
        216,
        1.0008,
        0.0492,
        0.0675,
        "216 sites without mass are missing in the file",
    ),
    (
        "structures/tip4p.gro",
        "tip4p2005",
        None,
        216,
        density(216, WATER, 18.6824**3),
        0.0040,
        0.0109,
        "",
    ),
    (
        "structures/tip4p.gro",
        "spce",
        None,
        216,
        0.9909,
        0.0492,
        0.0685,
        "216 sites without mass (MW) are in no model",
    ),
    (
        "structures/openmm_spce_box.pdb",
        "spce",
        None,
        895,
        density(895, WATER, 30.0**3),
        0.0004,
        0.0013,
        "",
    ),
    (
        "structures/openmm_tip3p_box.pdb",
        "tip3p",
        None,
        895,
        density(895, WATER, 30.0**3),
        0.0004,
        0.0013,
        "",
    ),
    (
        "structures/genice_ice1h_tip4p_seed42.gro",
        "tip4p2005",
        None,
        192,
        density(192, WATER, 23.4685163 * 14.7071453 * 18.0730370),
        0.0040,
        0.0111,
        "",
    ),
    (
        "structures/genice_ice1h_tip4p_seed42.gro",
        "spce",
        None,
        192,
        0.9208,
        0.0488,
        0.0682,
        "(MW) are in no model",
    ),
    (
        "structures/chemfiles_water_297_frame1.pdb",
        "spce",
        None,
        99,
        density(99, WATER, 15.0**3),
        0.0490,
        0.0608,
        "",
    ),
    ("structures/chemfiles_water_297_frame1.pdb", "tip3p", None, 99, 0.8775, 0.0004, 0.0013, ""),
    (
        "structures/N2_alpha_nitrogen.cif",
        "nitrogen",
        None,
        4,
        density(4, 28.0134, 5.644**3),
        0.0171,
        0.0171,
        "24 symmetry operations in the file",
    ),
    (
        "structures/ice_XI_like_8water_P1.cif",
        "spce",
        None,
        8,
        density(8, WATER, 4.452382 * 7.70757 * 7.278858),
        0.0244,
        0.0332,
        "x,y,z is the only symmetry operation",
    ),
    (
        "structures/H2O_ice_Ih.cif",
        "tip4p2005",
        None,
        12,
        density(12, WATER, ICE_IH_VOLUME),
        0.0843,
        0.1305,
        "built from",
    ),
    # All its hydrogens are there (an ordered model of 1933), 0.82 Å from their oxygens.
    (
        "structures/H2O_ice_Ih.cif",
        "tip4p2005",
        inf,
        12,
        density(12, WATER, ICE_IH_VOLUME),
        0.0843,
        0.1305,
        "built from",
    ),
    (
        "structures/H2O_ice_Ih.cif",
        "spce",
        inf,
        "is not spce: an atom is 0.173 Å from the rigid template",
    ),
    ("awkward/two_water_gro.gro", "spce", None, 2, density(2, WATER, 100.0**3), 0.0041, 0.0063, ""),
    (
        "awkward/two_water_gro_nonames.gro",
        "spce",
        None,
        2,
        5.983e-5,
        0.0041,
        0.0063,
        "A, B1, B2 are not elements",
    ),
    (
        "awkward/two_water_gro_widebox.gro",
        "spce",
        None,
        2,
        density(2, WATER, 76.4092 * 79.1768 * 73.1922),
        0.0041,
        0.0063,
        "",
    ),
    ("awkward/short-cryst1.pdb", "spce", None, 3, density(3, WATER, 15.0**3), 0.0489, 0.0601, ""),
    (
        "awkward/water4_tinker.arc",
        "spce",
        None,
        "ASE, which reads this format, ends with RuntimeError",
    ),
    (
        "awkward/water_spc_99_chem.cssr",
        "spce",
        None,
        "its format is unknown to ASE; there are .cif .data .ent .extxyz .g96 ",
    ),
    ("awkward/triclinic-1.lmp", "spce", None, "holds no atoms"),
    ("awkward/missing_atomname.gro", "spce", None, "has atoms named (no name)"),
    ("awkward/missing_atomname.gro", "argon", None, "has atoms named (no name)"),
]


@pytest.mark.parametrize(
    "case", REFERENCE, ids=lambda case: f"{Path(case[0]).name}-{case[1]}-{case[2]}"
)
def test_reference_files(reference, case):
    file, model, edge, *expected = case
    cell = None if edge in (None, inf) else edge * np.eye(3)
    model = load_model(model)

    def found():
        return read_structure(reference / file, [model], cell, edge != inf, TOLERANCE)

    if isinstance(expected[0], str):
        with pytest.raises(StructureError) as refusal:
            found()
        assert expected[0] in str(refusal.value)
        return
    count, density_there, rms, largest, note = expected
    found = found()
    assert len(found.species) == count
    if edge == inf:  # the file's cell served only to make molecules whole
        assert found.cell is None
    else:
        per_volume = count * model.mass / np.linalg.det(found.cell) / GRAM_PER_CM3
        assert per_volume == pytest.approx(density_there, rel=2e-4)
    assert found.residual_rms == pytest.approx(rms, abs=1e-4)
    assert found.residual_max == pytest.approx(largest, abs=1e-4)
    assert any(note in said for said in found.notes) if note else not found.notes


def test_the_table_names_every_reference_file(reference):
    there = {
        f"{folder}/{p.name}"
        for folder in ("structures", "awkward")
        for p in (reference / folder).iterdir()
    }
    assert there == {case[0] for case in REFERENCE}


# the same molecules in every disguise

NAMES = [
    {"OW": "OW", "HW1": "HW1", "HW2": "HW2", "MW": "MW"},
    {"OW": "O", "HW1": "H1", "HW2": "H2", "MW": "M"},
    {"OW": "OH2", "HW1": "H1", "HW2": "H2", "MW": "EPW"},
    {"OW": "O", "HW1": "H", "HW2": "H", "MW": "EP"},
    {"OW": "Ow", "HW1": "1HW", "HW2": "2HW", "MW": "LP1"},
    {"OW": "OT", "HW1": "HT", "HW2": "HT", "MW": "X"},
    {"OW": "O1", "HW1": "HO1", "HW2": "HO2", "MW": "DUM"},
    {"OW": "OH2", "HW1": "H1", "HW2": "H2", "MW": "OM"},
]


@pytest.mark.parametrize("names", NAMES, ids=lambda names: "-".join(names.values()))
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
@pytest.mark.parametrize(
    ("there", "wanted"), [("spce", "spce"), ("tip4p2005", "tip4p2005"), ("tip4p2005", "spce")]
)
def test_names_of_water(names, ending, there, wanted, tmp_path):
    truth = Truth([there] * 8)
    atoms = truth.atoms()
    if ending == "gro":
        text, error = gro(atoms, box_of(truth.cell), names=names), 0.02
    elif ending == "pdb":
        text, error = pdb(atoms, cryst1(truth.cell), names, element_column=False), 0.002
    else:
        text, error = xyz(atoms, truth.cell, names), 1e-8
    found = read(tmp_path, text, f"a.{ending}", (wanted,))
    if there == wanted:
        same_molecules(found, truth, [SPECIES[wanted]], error)
        assert found.notes == ()
    else:
        assert len(found.species) == 8
        assert any("8 sites without mass" in note and "left out" in note for note in found.notes)


def without_massless(truth):
    return truth.atoms(massless=False)


def hydrogens_first(truth):
    return sorted(truth.atoms(massless=False), key=lambda atom: (atom[2], atom[1] != "H"))


def oxygens_of_all_first(truth):
    return sorted(truth.atoms(massless=False), key=lambda atom: (atom[1] != "O", atom[0]))


def between_the_oxygens(truth):
    return sorted(
        truth.atoms(massless=False), key=lambda atom: (atom[2], "HW1 OW HW2".index(atom[0]))
    )


@pytest.mark.parametrize(
    "order", [without_massless, hydrogens_first, oxygens_of_all_first, between_the_oxygens]
)
@pytest.mark.parametrize("split", [False, True])
@pytest.mark.parametrize("ending", ["gro", "gro without residues", "pdb", "xyz", "cif"])
def test_order_of_atoms(order, split, ending, tmp_path):
    truth = Truth(["tip4p2005"] * 9, 1)
    atoms = order(truth)
    if split:
        atoms = wrapped(atoms, truth.cell)
    species, error = [SPECIES["tip4p2005"]], 1e-7
    if ending == "xyz":
        text = xyz(atoms, truth.cell)
    elif ending == "pdb":
        text, error = pdb(atoms, cryst1(truth.cell)), 0.002
    elif ending == "cif":
        plain = ase.Atoms([a[1] for a in atoms], [a[3] for a in atoms], cell=truth.cell, pbc=True)
        ase.io.write(tmp_path / "b.cif", plain)
        text = (tmp_path / "b.cif").read_text()
    else:
        text = gro(atoms, box_of(truth.cell), digits=9, residues=ending == "gro")
    found = read(tmp_path, text, f"a.{ending.split()[0]}", species)
    same_molecules(found, truth, species, error)
    assert any(
        "9 sites without mass are missing in the file (tip4p2005): built" in note
        for note in found.notes
    )
    if order is oxygens_of_all_first and ending in ("gro", "pdb"):
        assert any("found by bonding distance" in note for note in found.notes)


def test_names_begin_with_an_element_of_the_scene_if_they_can():
    water = frozenset({"O", "H"})
    names = {
        "OW": "O",
        "HO": "H",
        "1HW": "H",
        "M": "X",
        "MW": "X",
        "CL": "Cl",
        "B1": "B",
        "": "",
        "17": "",
    }
    assert {name: element_of(name, water) for name in names} == names
    assert element_of("Na", frozenset("N")) == "Na"  # nobody writes a nitrogen so
    assert element_of("NA", frozenset({"N", "Na"})) == "Na"
    assert element_of("CA", frozenset("C")) == "C"


@pytest.mark.parametrize("form", ["xyz", "cif"])
def test_names_in_capitals_in_a_column_of_elements(form, tmp_path):
    """HO is hydrogen in a scene with water, and holmium in none."""
    truth = Truth(["spce"] * 3, 5)
    rows = [(n, {"H": "HO"}.get(e, e), k, x, v) for n, e, k, x, v in truth.atoms()]
    text = xyz(rows, truth.cell)
    if form == "cif":
        inverse = np.linalg.inv(truth.cell)
        edges = [
            f"_cell_length_{x} {edge}" for x, edge in zip("abc", np.diag(truth.cell), strict=True)
        ]
        edges += [f"_cell_angle_{x} 90" for x in ("alpha", "beta", "gamma")]
        columns = [f"_atom_site_{c}" for c in ("type_symbol", "fract_x", "fract_y", "fract_z")]
        lines = [f"{e} {' '.join(f'{u:.9f}' for u in x @ inverse)}" for _, e, _, x, _ in rows]
        text = "\n".join(["data_x", *edges, "loop_", *columns, *lines, ""])
    found = read(tmp_path, text, f"a.{form}")
    same_molecules(found, truth, [SPECIES["spce"]], 1e-5)
    assert any("were read: HO as a name of H" in note for note in found.notes)


@pytest.mark.parametrize("file", ["a.gro", "a.g96"])
@pytest.mark.parametrize("edge", [12000.0, 999999.0, 1.5e6])
def test_boxes_that_fill_their_columns(file, edge, tmp_path):
    """As GROMACS writes them, ten or fifteen characters to a number and no space between."""
    truth = Truth(["spce"] * 3, 5)
    cell = np.diag([edge, edge + 7.0, edge + 9.0])
    rows = truth.atoms()
    box = "".join(f"{x / 10:10.5f}" for x in np.diag(cell))
    atoms = [(name, x) for name, _, _, x, _ in rows]
    text = gro(rows, box) if file == "a.gro" else as_g96(atoms, cell)
    found = read(tmp_path, text, file)
    assert found.cell == pytest.approx(cell)
    assert len(found.species) == 3


def test_columns_of_a_gro_that_are_too_narrow(tmp_path):
    """Coordinates from 100,000 Å on move the following ones; velocities are three or none."""
    row = "    1ARG     Ar    1{}\n"
    head, box = "x\n    2\n" + row.format("   1.000   2.000   3.000"), "  30.0  30.0  30.0\n"
    for columns in ("10000.00012345.67810000.000", "10000.000   2.000   3.000"):
        with pytest.raises(StructureError, match=r"line 4: expected an atom of a \.gro with coord"):
            read(tmp_path, head + row.format(columns) + box, "a.gro", ["argon"])
    for columns in ("  1.0000", "  1.0000  2.0000"):
        text = head + row.format("   4.000   5.000   6.000" + columns) + box
        with pytest.raises(StructureError, match="line 4: expected three velocities or none"):
            read(tmp_path, text, "a.gro", ["argon"])


@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_ions_among_waters(ending, tmp_path):
    truth = Truth(["spce", "sodium", "chloride", "spce", "chloride"], 2)
    upper = {"Na": "NA", "Cl": "CL"} | {name: name for name in ("OW", "HW1", "HW2")}
    species = [SPECIES[name] for name in ("spce", "sodium", "chloride", "nitrogen")]
    text = {
        "gro": gro(
            truth.atoms(),
            box_of(truth.cell),
            names=upper,
            residue_names={1: "NA", 2: "CL", 4: "CL"},
        ),
        "pdb": pdb(truth.atoms(), cryst1(truth.cell), upper, residue="MIX"),
        "xyz": xyz(oxygens_of_all_first(truth), truth.cell),
    }
    same_molecules(read(tmp_path, text[ending], f"a.{ending}", species), truth, species, 0.02)


def alike_by_name(molecule: Molecule, naming: str) -> Molecule:
    """The molecule with names that some of its sites share."""
    names = {
        "elements": molecule.elements,
        "hydrogens": [
            f"{e}{k}" if e not in ("H", "Cl") else e for k, e in enumerate(molecule.elements)
        ],
        "one": ["A"] * len(molecule.elements),
    }[naming]
    return dataclasses.replace(molecule, site_names=tuple(names))


@pytest.mark.parametrize("naming", ["elements", "hydrogens", "one"])
@pytest.mark.parametrize("order", ["as in the template", "shuffled within", "shuffled"])
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_sites_that_share_names(naming, order, ending, tmp_path):
    """Names decide only where they are unique; elements and geometry decide among the rest."""
    species = [
        alike_by_name(SPECIES[k], naming)
        for k in ("benzene", "tip4p2005", "tetrachloromethane", "chiral")
    ]
    truth = Truth(3 * species, 21, edges=(27.0, 28.0, 29.0))
    atoms, rng = truth.atoms(order == "as in the template"), np.random.default_rng(2)
    if order == "shuffled":
        rng.shuffle(atoms)
    elif order == "shuffled within":
        atoms = [
            atoms[i] for i in sorted(range(len(atoms)), key=lambda i: (atoms[i][2], rng.random()))
        ]
    called = {m.name: m.residue_names[0][:4] for m in species}
    if ending == "gro":  # only names give the element here
        if naming == "one":
            atoms = [(e, e, *rest) for _, e, *rest in atoms]
        residues = {k: called[m.name] for k, m in enumerate(truth.species)}
        text, error = gro(atoms, box_of(truth.cell), 6, residue_names=residues), 2e-5
    elif ending == "pdb":
        text, error = pdb(atoms, cryst1(truth.cell), residue="MIX"), 2e-3
    else:
        text, error = xyz(atoms, truth.cell), 1e-8
    same_molecules(read(tmp_path, text, f"a.{ending}", species), truth, species, error)


@pytest.mark.parametrize("named", ["A", "B"])
def test_a_unique_name_decides_between_sites_that_look_alike(named, tmp_path):
    """Whichever of the two ends of a symmetric molecule has the name of the charged end."""
    x = {"A": 1.16, "B": -1.16}
    sites = [
        Site(name=n, element="O", mass_u=16.0, position_A=(at, 0.0, 0.0)) for n, at in x.items()
    ]
    sites += [
        Site(name="C", element="C", mass_u=12.0, position_A=(0.0, y, 0.0)) for y in (0.7, -0.7)
    ]
    other = "B" if named == "A" else "A"
    rows = [("C", 5, 5.7, 5), (named, 6.16, 5, 5), ("C", 5, 4.3, 5), (other, 3.84, 5, 5)]
    atoms = [(name, "", 0, np.array(place, float), None) for name, *place in rows]
    found = read(
        tmp_path,
        gro(atoms, "2 2 2", 6),
        "a.gro",
        [molecule("m", tuple(sites), residue_names=("SOL",))],
    )
    assert found.residual_max < 1e-4
    model = molecule("m", tuple(sites))
    a = found.position[0] + found.rotation[0] @ model.positions_body[model.site_names.index("A")]
    assert a == pytest.approx([6.16 if named == "A" else 3.84, 5, 5], abs=1e-4)


@pytest.mark.parametrize(
    "pair", [("isobutane", "trans-butane"), ("CH3CH2OH", "CH3OCH3"), ("left", "right")]
)
def test_isomers_and_mirror_images_among_each_other(pair, tmp_path):
    """For one composition, without names but the elements, every molecule in an order of its own."""

    def isomer(name):
        known = ase.build.molecule("isobutane" if name in ("left", "right") else name)
        if name in ("left", "right"):  # a twist makes it chiral
            x, _, z = known.positions.T
            known.positions[:, :2] += 0.35 * np.sin(np.stack([1.3 * z, 1.3 * z + x], axis=1))
            known.positions[:, 0] *= 1 if name == "left" else -1
        columns = zip(
            known.symbols, known.get_masses().tolist(), known.positions.tolist(), strict=True
        )
        sites = tuple(
            Site(name=e, element=e, mass_u=m, position_A=(x, y, z)) for e, m, (x, y, z) in columns
        )
        return molecule(name, sites)

    species = [isomer(name) for name in pair]
    truth = Truth(30 * species, 22, edges=(30.0, 31.0, 32.0))
    rng = np.random.default_rng(4)
    atoms = sorted(truth.atoms(), key=lambda atom: (atom[2], rng.random()))
    found = read(tmp_path, xyz(atoms, truth.cell), "a.xyz", species)
    assert found.species.tolist() == 30 * [0, 1]
    same_molecules(found, truth, species, 1e-8)


def test_the_deviation_of_sites_that_share_names_is_that_of_their_best_order(tmp_path):
    truth = Truth([alike_by_name(SPECIES["benzene"], "elements")] * 2)
    atoms = [
        (n, e, k, x + ([0.5, 0, 0] if i == 11 else 0), v)
        for i, (n, e, k, x, v) in enumerate(truth.atoms())
    ]
    text = gro(atoms[::-1], box_of(truth.cell), residue_names={0: "BNZ", 1: "BNZ"})
    with pytest.raises(
        StructureError,
        match=r"molecule 2 .* is not benzene: an atom is 0\.[34]\d\d Å from the rigid",
    ):
        read(tmp_path, text, "a.gro", truth.species[:1])


def united_propene(names=("CH3", "CH", "CH2"), **values) -> Molecule:
    """CH3-CH=CH2 of united atoms, three of one element, whose ends differ by 0.2 Å. values: of the
    second end"""
    angle = np.radians(124.0)
    places = (
        (1.54, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (1.33 * float(np.cos(angle)), 1.33 * float(np.sin(angle)), 0.0),
    )
    epsilons = (98.0, 47.0, values.pop("epsilon_K", 85.0))
    masses = (15.035, 13.019, values.pop("mass_u", 14.027))
    sites = [
        Site(name=name, element="C", mass_u=m, position_A=x, sigma_A=3.7, epsilon_K=e)
        for name, m, x, e in zip(names, masses, values.pop("places", places), epsilons, strict=True)
    ]
    return molecule("propene", tuple(sites), residue_names=("PPE",))


@pytest.mark.parametrize("names", [("CH3", "CH", "CH2"), ("C", "C", "C")])
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2), (1, 2, 0)])
@pytest.mark.parametrize("digits", [10, 3])
def test_the_best_order_is_taken(names, order, digits, tmp_path):
    """In all orders of the atoms the molecules are the same, in the digits of a .gro too."""
    kind = united_propene(names)
    truth = Truth([kind] * 6, 31)
    atoms = truth.atoms()
    atoms = [
        ("C", "C", k, x.round(digits), v)
        for first in range(0, 18, 3)
        for i in order
        for _, _, k, x, v in [atoms[first + i]]
    ]
    found = read(tmp_path, xyz(atoms, truth.cell), "a.xyz", [kind])
    partner = same_molecules(found, truth, [kind], 2 * 10.0**-digits)
    ends = found.position[:, None] + np.einsum("nij,sj->nsi", found.rotation, kind.positions_body)
    there = truth.centre[:, None] + np.einsum("nij,sj->nsi", truth.rotation, kind.positions_body)
    assert np.abs(ends - there[partner]).max() < 5 * 10.0**-digits  # each site at its own position
    assert found.notes == ()


def test_orders_are_the_best_of_all(tmp_path):
    """Molecules that are bent, in random orders of the atoms: no order of those of one element fits
    better."""
    from itertools import permutations, product

    rng = np.random.default_rng(5)
    for name in ("CH3CH2OH", "C3H4_C2v", "CH3NO2", "NH3", "CH4", "C4H4O"):
        known = ase.build.molecule(name)
        columns = zip(
            known.symbols, known.get_masses().tolist(), known.positions.tolist(), strict=True
        )
        kind = molecule(
            name,
            tuple(Site(name=e, element=e, mass_u=m, position_A=tuple(x)) for e, m, x in columns),
        )
        elements = np.array(kind.elements)
        parts = [np.flatnonzero(elements == e) for e in dict.fromkeys(kind.elements)]
        for width in (0.02, 0.04):
            truth = Truth([kind], int(rng.integers(1000)))
            atoms = [
                (n, e, k, x + width * rng.standard_normal(3), v) for n, e, k, x, v in truth.atoms()
            ]
            rng.shuffle(atoms)
            points = np.array(
                [x for *_, x, _ in sorted(atoms, key=lambda atom: kind.elements.index(atom[1]))]
            )
            least = np.inf
            template = np.concatenate(parts)
            body, masses = kind.positions_body[template], kind.masses[template]
            for orders in product(*(permutations(range(len(part))) for part in parts)):
                first = np.cumsum([0, *(len(part) for part in parts)])
                order = np.concatenate(
                    [f + np.array(o) for f, o in zip(first[:-1], orders, strict=True)]
                )
                at = points[order] - masses @ points[order] / masses.sum()
                u, _, vt = np.linalg.svd((masses[:, None] * at).T @ body)
                u[:, 2] *= np.linalg.det(u @ vt)
                least = min(least, np.sqrt(((at - body @ (u @ vt).T) ** 2).sum(axis=1).mean()))
            found = read(tmp_path, xyz(atoms, truth.cell), "a.xyz", [kind])
            assert found.residual_rms <= 1.2 * least + 1e-4 * kind.radius, (name, width)


def test_orders_that_fit_equally_well_are_named(tmp_path):
    """Ends of one distance: where their parameters differ, the file decides by its order, and a
    note names it."""
    places = ((1.4, 0.0, 0.0), (0.0, 0.0, 0.0), (-0.7, 1.4 * np.sqrt(0.75), 0.0))
    for values, noted in (
        ({"epsilon_K": 98.0, "mass_u": 15.035}, False),
        ({"mass_u": 15.035}, True),
    ):
        kind = united_propene(("A", "B", "C"), places=places, **values)
        truth = Truth([kind] * 4, 32)
        for order in ((0, 1, 2), (2, 1, 0)):
            atoms = truth.atoms()
            atoms = [("C", "C", *atoms[first + i][2:]) for first in range(0, 12, 3) for i in order]
            found = read(tmp_path, xyz(atoms, truth.cell), "a.xyz", [kind])
            assert found.residual_max < 1e-6
            ends = found.position + found.rotation @ kind.positions_body[0]
            assert (
                ends == pytest.approx(np.array([x for *_, x, _ in atoms[::3]]), abs=1e-6)
                or not noted
            )
            wanted = "4 molecules of propene: two orders of its atoms, in which different sites are exchanged"
            assert any(note.startswith(wanted) for note in found.notes) == noted
    named = [(n, "C", k, x, v) for n, _, k, x, v in truth.atoms()]
    text = gro(named, box_of(truth.cell), 6, residue_names=dict.fromkeys(range(4), "PPE"))
    assert read(tmp_path, text, "a.gro", [kind]).notes == ()  # names decide


def test_names_that_fit_less_well_than_elements_are_noted(tmp_path):
    """Another program has numbered the atoms in the other direction."""
    kind = united_propene(("C1", "C2", "C3"))
    truth = Truth([kind] * 4, 33)
    atoms = [
        ({"C1": "C3", "C2": "C2", "C3": "C1"}[n], e, k, x, v) for n, e, k, x, v in truth.atoms()
    ]
    text = gro(atoms, box_of(truth.cell), 6, residue_names=dict.fromkeys(range(4), "PPE"))
    found = read(tmp_path, text, "a.gro", [kind])
    assert any(
        re.search(
            r"fits propene with 0\.1\d\d Å .rms., and another order of atoms with 0\.000 Å", n
        )
        for n in found.notes
    )


# a property: nothing that leaves the molecules what they are changes what is read


@settings(
    max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    kinds=st.lists(
        st.sampled_from(
            ["spce", "tip4p2005", "nitrogen", "argon", "chiral", "benzene", "tetrachloromethane"]
        ),
        min_size=1,
        max_size=8,
    ),
    seed=st.integers(0, 2**31),
    slant=st.booleans(),
    mirrored=st.booleans(),
)
def test_turned_shifted_wrapped_and_shuffled_atoms_are_the_same_molecules(
    kinds, seed, slant, mirrored, tmp_path
):
    kinds = [
        kind if kind != "tip4p2005" or "spce" not in kinds else "spce" for kind in kinds
    ]  # those two observation alike
    rng = np.random.default_rng(seed)
    cell = np.diag([17.0, 19.0, 21.0]) + (np.tril(rng.uniform(-8, 8, (3, 3)), -1) if slant else 0.0)
    truth = Truth(kinds, seed, cell=cell)
    rotation = random_rotations(rng, 1)[0]
    shift = rng.uniform(-50, 50, 3)
    atoms = [
        (name, e, k, (x + shift + rng.integers(-3, 4, 3) @ cell) @ rotation.T, v)
        for name, e, k, x, v in truth.atoms(False)
    ]
    rng.shuffle(atoms)
    written = cell @ rotation.T * ([[1], [1], [-1]] if mirrored else 1)
    species = [SPECIES[kind] for kind in sorted(set(kinds))]
    found = read(tmp_path, xyz(atoms, written), "a.xyz", species, periodic=not slant)
    truth.centre = truth.centre + shift
    same_molecules(found, truth, species, 1e-6)
    assert any("was rotated" in note for note in found.notes)
    if not slant:
        assert found.cell == pytest.approx(cell)


def test_a_turned_cell_turns_velocities_too(tmp_path):
    truth = Truth(["spce", "nitrogen", "argon", "tip4p2005"], 3)
    species = [SPECIES[name] for name in ("nitrogen", "argon", "spce")]
    truth.species[3] = SPECIES["spce"]
    rotation = random_rotations(np.random.default_rng(5), 1)[0]
    atoms = truth.atoms()
    plain = ase.Atoms(
        [a[1] for a in atoms],
        [rotation @ a[3] for a in atoms],
        cell=truth.cell @ rotation.T,
        pbc=True,
    )
    plain.set_velocities([rotation @ a[4] / 98.22694788464063 for a in atoms])
    ase.io.write(tmp_path / "a.extxyz", plain)
    found = read(tmp_path, (tmp_path / "a.extxyz").read_text(), "b.extxyz", species)
    partner = same_molecules(found, truth, species, 1e-6)
    assert found.velocity == pytest.approx(truth.velocity[partner], abs=1e-5)
    lab = np.einsum("nij,nj->ni", found.rotation, found.angular_momentum_body)
    true = np.einsum("nij,nj->ni", truth.rotation, truth.angular_momentum_body())[partner]
    assert lab == pytest.approx(true, abs=1e-4)


def test_the_standard_orientation_keeps_the_lattice():
    rng = np.random.default_rng(0)
    for _ in range(50):
        cell = rng.standard_normal((3, 3))
        turned, rotation = standard_rotation(cell)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert np.array_equal(turned, np.tril(turned))
        assert (np.diag(turned) > 0).all()
        whole = turned @ np.linalg.inv(cell @ rotation.T)  # of old vectors in new ones
        assert whole == pytest.approx(np.diag([1, 1, np.sign(np.linalg.det(cell))]))
    same, rotation = standard_rotation(np.diag([3.0, 4.0, 5.0]))
    assert np.array_equal(same, np.diag([3.0, 4.0, 5.0]))
    assert np.array_equal(rotation, np.eye(3))


@pytest.mark.parametrize(
    ("angles", "told"),
    [
        ((90.0, 60.0, 90.0), ""),  # 36 cos 60° is 18.000000000000004
        ((60.0, 60.0, 60.0), ""),
        ((90.0, 59.995, 90.0), ""),  # 60.00 as files print it
        ((90.0, 120.0, 90.0), ""),
        ((90.0, 59.0, 90.0), "c' = c - a"),
        ((90.0, 120.5, 90.0), "c' = c + a"),
        ((60.0, 59.0, 58.0), "b' = b - a, c' = c - a"),
        ((25.0, 30.0, 30.0), "b' = b - a, c' = c - b"),
    ],
)
def test_a_cell_leans_by_half_an_edge_as_far_as_files_tell(angles, told):
    cell = Box(lengths_A=36.0, angles_deg=angles).cell
    other = reduced_cell(cell)
    basis = basis_of(other, cell)
    assert describe_basis(basis) == told
    assert np.array_equal(other, cell) == (not told)
    assert basis @ cell == pytest.approx(other, abs=1e-12)
    assert abs(np.linalg.det(basis)) == pytest.approx(1)
    assert (np.abs(other - np.diag(np.diag(other))) <= 0.5005 * np.diag(other)).all()


def test_what_was_made_of_a_cell_is_said(tmp_path):
    truth = Truth(["spce"] * 4, 5)
    text = xyz(wrapped(truth.atoms(), truth.cell), truth.cell * [[1], [1], [-1]])
    assert any("left-handed: -c replaces c" in note for note in read(tmp_path, text, "a.xyz").notes)
    nearly = truth.cell.copy()
    nearly[2, 0] = 1e-5 * nearly[2, 2]
    told = read(tmp_path, xyz(wrapped(truth.atoms(), truth.cell), nearly), "b.xyz").notes
    assert told == ("its angles of 90, 89.99943, 90° were set to right angles",)


def test_the_box_of_a_scene_and_that_of_its_own_last_state_are_one(tmp_path):
    """The state has the box as it was described again. The scene still has its own words for it."""
    box = {"lengths_A": 24.0, "angles_deg": [90.0, 59.0, 90.0]}
    system = build(small_scene({"argon": 4}, None, box=box))
    assert any(
        "box: its lattice is given by the cell with edges 24.0000, 24.0000, 23.63" in n
        for n in system.notes
    )
    write_state(tmp_path / "final.npz", system.saved(system.state))
    data = {
        "box": box,
        "structure": {"file": "final.npz"},
        "molecules": [{"model": "argon"}],
        "start": {"temperature_K": 90.0},
        "stages": [{"duration_ps": 1.0}],
    }
    again = build(Scene.from_dict(data, tmp_path))
    assert not any("box of the scene is used" in note for note in again.notes)
    assert any(
        "the scene's box: its lattice is given by" in note and "c' = c - a" in note
        for note in again.notes
    )


@pytest.mark.parametrize(("numbers", "codes"), [((5, 5), "AB"), ((5, 5), " A"), ((7, 8), "  ")])
def test_insertion_codes_separate_the_residues_of_a_pdb(numbers, codes, tmp_path):
    """Two waters of one number, as of a hydrate: residues, not bonding distances, are the
    molecules."""
    truth = Truth(["spce"] * 2, 5)
    labels = [f"{number:4d}{code}" for number, code in zip(numbers, codes, strict=True)]
    lines = pdb(truth.atoms(), cryst1(truth.cell), number=lambda k: f"{k:4d}").splitlines()
    for k, label in enumerate(labels):
        lines = [
            line[:22] + label + line[27:] if line[22:26] == f"{k:4d}" else line for line in lines
        ]
    found = read(tmp_path, "\n".join(lines), "a.pdb")
    same_molecules(found, truth, [SPECIES["spce"]], 0.002)
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


def test_a_pdb_that_is_cut_off_says_so(tmp_path):
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


def test_a_state_is_not_taken_for_one_of_another_model_of_that_name(tmp_path):
    """Masses, moments and number of sites show, and whether there are rotations."""
    system = build(small_scene({"tip4p2005": 8}, 20.0))
    write_state(tmp_path / "water.npz", system.saved(system.state))

    def read_as(other, name="water.npz"):
        species = dataclasses.replace(
            build(small_scene({other: 8}, 20.0)).species[0], name="tip4p2005"
        )
        return read_structure(tmp_path / name, [species], None, True, TOLERANCE, None)

    assert len(read_as("tip4p2005").position) == 8
    with pytest.raises(
        StructureError,
        match=r"holds another tip4p2005 than the scene \(.*number of sites: 4, here 3",
    ):
        read_as("spce")
    with pytest.raises(StructureError, match=r"mass, u: 18.0154, here 39.948"):
        read_as("argon")
    saved = system.saved(system.state)
    points = system.state._replace(
        rotation=np.zeros((0, 3, 3)), angular_momentum_body=np.zeros((0, 3))
    )
    write_state(tmp_path / "points.npz", saved._replace(state=points, models=None))
    with pytest.raises(StructureError, match="has no rotations, but tip4p2005 can rotate"):
        read_as("tip4p2005", "points.npz")


def test_molecules_of_a_slanted_cell_are_made_whole(tmp_path):
    cell = [[12.0, 0, 0], [9.0, 11.0, 0], [-8.0, 7.0, 12.0]]
    truth = Truth(["spce"] * 8, 6, cell=cell)
    text = xyz(wrapped(truth.atoms(), truth.cell), truth.cell)
    same_molecules(read(tmp_path, text, "a.xyz", periodic=False), truth, [SPECIES["spce"]], 1e-6)
    atoms = wrapped(truth.atoms(), truth.cell)
    plain = ase.Atoms([a[1] for a in atoms], [a[3] for a in atoms], cell=truth.cell, pbc=True)
    for name in ("b.gro", "b.cif", "b.lmp"):
        ase.io.write(
            tmp_path / name,
            plain,
            **({"format": "lammps-data", "masses": True} if name == "b.lmp" else {}),
        )
        found = read(tmp_path, (tmp_path / name).read_text(), name, periodic=False)
        assert found.residual_max < 0.02
        same_molecules(found, truth, [SPECIES["spce"]], 0.02)
    leaning = read(
        tmp_path, text, "a.xyz"
    )  # c lies on top of b: the same lattice by a cell that tilts less
    assert leaning.cell == pytest.approx(
        np.array([[12.0, 0, 0], [-3.0, 11.0, 0], [-5.0, -4.0, 12.0]])
    )
    assert any(
        "its lattice is given by the cell with edges 12.0000, 11.4018, 13.6015" in n
        for n in leaning.notes
    )
    same_molecules(leaning, truth, [SPECIES["spce"]], 1e-6)


def test_a_cell_with_room_for_a_cut_off_is_found(tmp_path):
    """c of this cell stands 2 Å high, yet the lattice is that of a cube: rotated, the box is upright
    and has workspace."""
    cell = 14.0 * np.array([[1.0, 0, 0], [2.0, 1.0, 0], [7.0, 6.0, 1.0]]) @ standard_turn(3).T
    truth = Truth(["spce"] * 8, 6, edges=(14.0, 14.0, 14.0))
    turned = [(n, e, k, x @ standard_turn(3).T, v) for n, e, k, x, v in truth.atoms()]
    found = read(tmp_path, xyz(wrapped(turned, cell), cell), "a.xyz")
    assert found.cell == pytest.approx(14.0 * np.eye(3), abs=1e-6)
    assert pair_distances(found.position, found.cell) == pytest.approx(
        pair_distances(truth.centre, truth.cell), abs=1e-6
    )


ROOTS = np.sqrt([0.5, 0.75, 1 / 12, 2 / 3, 8 / 9, 2 / 9])
#: Cells of rhombic dodecahedra and truncated octahedra, as programs write them, of edge 1.
ROUND_CELLS = {
    "dodecahedron, xy-square": [[1, 0, 0], [0, 1, 0], [0.5, 0.5, ROOTS[0]]],
    "dodecahedron, xy-hexagon": [[1, 0, 0], [0.5, ROOTS[1], 0], [0.5, ROOTS[2], ROOTS[3]]],
    "octahedron": [[1, 0, 0], [1 / 3, ROOTS[4], 0], [-1 / 3, ROOTS[5], ROOTS[3]]],
    "octahedron of Amber": [[1, 0, 0], [-1 / 3, ROOTS[4], 0], [-1 / 3, -ROOTS[5], ROOTS[3]]],
}


@pytest.mark.parametrize("kind", ROUND_CELLS)
@pytest.mark.parametrize("edge", [16.0, 18.4217])
def test_round_boxes_keep_their_cells_in_all_formats(kind, edge, tmp_path):
    """Whatever digits a file has: lengths and angles to 0.01 degrees, vectors to 3, 5 or 8
    digits."""
    cell = edge * np.array(ROUND_CELLS[kind])
    truth = Truth(["spce"] * 4, 6, cell=cell)
    plain = ase.Atoms(
        [a[1] for a in truth.atoms()], [a[3] for a in truth.atoms()], cell=cell, pbc=True
    )
    ase.io.write(tmp_path / "a.pdb", plain)
    texts = {"a.pdb": (tmp_path / "a.pdb").read_text()}
    for digits in (3, 5, 8):
        (a, _, _), (bx, by, _), (cx, cy, cz) = (cell / 10).round(digits)
        box = " ".join(f"{x:.{digits}f}" for x in (a, by, cz, 0, 0, bx, 0, cx, cy))
        texts[f"{digits}.gro"] = gro(truth.atoms(), box, 6)
        texts[f"{digits}.xyz"] = xyz(truth.atoms(), cell.round(digits))
    texts["single.xyz"] = xyz(truth.atoms(), cell.astype(np.float32))
    for name, text in texts.items():
        found = read(tmp_path, text, name)
        assert found.cell == pytest.approx(cell, abs=0.01), name
        assert found.basis == pytest.approx(np.eye(3)), name
        assert not any("rotated" in note for note in found.notes), name
        same_molecules(found, truth, [SPECIES["spce"]], 0.03)


@pytest.mark.parametrize("kind", ROUND_CELLS)
def test_another_cell_of_a_lattice_does_not_depend_on_digits(kind):
    """Cells with long edges are replaced by one of many that are equally good, always by the same
    one."""
    rng, edges = np.random.default_rng(7), 16.0 * np.array(ROUND_CELLS[kind])
    for _ in range(15):
        basis = np.eye(3, dtype=int)
        for _ in range(4):
            i, j = rng.permutation(3)[:2]
            basis[i] += rng.integers(-2, 3) * basis[j]
        cell, _ = standard_rotation(basis @ edges)
        wanted, turned = least_skewed_cell(cell)
        assert np.diag(wanted).min() >= 0.7 * 16.0
        for _ in range(4):
            rounded = cell + 5e-5 * np.tril(rng.uniform(-1, 1, (3, 3)))
            found, rotation = least_skewed_cell(rounded)
            assert found == pytest.approx(wanted, abs=0.02)
            assert rotation == pytest.approx(turned, abs=0.01)


def standard_turn(seed):
    """A rotation drawn at random."""
    return random_rotations(np.random.default_rng(seed), 1)[0]


def pair_distances(position, cell):
    """Sorted distances of nearest images in a cell that tilts little."""
    i, j = np.triu_indices(len(position), 1)
    d = (position[i] - position[j]) @ np.linalg.inv(cell)
    return np.sort(np.linalg.norm((d - np.rint(d)) @ cell, axis=1))


def test_residuals_are_those_of_the_best_fit(tmp_path):
    from scipy.spatial.transform import Rotation

    truth = Truth(["spce", "nitrogen", "argon", "benzene", "spce"], 21)
    species = [SPECIES[name] for name in ("spce", "nitrogen", "argon", "benzene")]
    rng = np.random.default_rng(1)
    atoms = [
        (name, e, k, x + 0.02 * rng.standard_normal(3), v) for name, e, k, x, v in truth.atoms()
    ]
    found = read(tmp_path, xyz(wrapped(atoms, truth.cell), truth.cell), "a.xyz", species)
    squares = []
    for k, m in enumerate(truth.species):
        points = np.array([x for _, _, owner, x, _ in atoms if owner == k])
        points = points - m.masses @ points / m.mass
        if len(points) > 2:
            rotation, _ = Rotation.align_vectors(points, m.positions_body, weights=m.masses)
            points = rotation.inv().apply(points)
        else:  # along the axis, which SciPy finds not unique
            points = m.positions_body * np.linalg.norm(points[0]) / max(m.radius, 1e-9)
        squares += list(((points - m.positions_body) ** 2).sum(axis=1))
    assert found.residual_rms == pytest.approx(np.sqrt(np.mean(squares)))
    assert found.residual_max == pytest.approx(np.sqrt(np.max(squares)))


def test_a_mirror_image_is_another_molecule(tmp_path):
    truth = Truth(["chiral"] * 4, 7)
    mirrored = [(name, e, k, x * [-1, 1, 1], v) for name, e, k, x, v in truth.atoms()]
    with pytest.raises(
        StructureError,
        match=r"molecule 1 \(atoms 1 to 5, by bonding distance\) is not halothane: an atom is .* mirror image of halothane",
    ):
        read(tmp_path, xyz(mirrored, truth.cell), "a.xyz", ["chiral"])
    image = dataclasses.replace(
        SPECIES["chiral"],
        name="other_hand",
        positions_body=SPECIES["chiral"].positions_body * [-1, 1, 1],
    )
    found = read(
        tmp_path, xyz(mirrored[:5] + truth.atoms()[5:], truth.cell), "a.xyz", ["chiral", image]
    )
    assert found.species.tolist() == [1, 0, 0, 0]


def test_a_mirror_image_within_the_tolerance_is_noted(tmp_path):
    """A molecule that is barely chiral: half of a racemic crystal fits, and less well than its
    mirror image does."""
    sites = [
        Site(name=e, element=e, mass_u=m, position_A=x)
        for e, m, x in (
            ("C", 12.0, (0.0, 0.0, 0.0)),
            ("O", 16.0, (1.5, 0.0, 0.0)),
            ("N", 14.0, (-0.5, 1.4, 0.0)),
            ("F", 19.0, (-0.5, -1.4, 0.25)),
        )
    ]
    kind = molecule("nearly_flat", tuple(sites))
    truth = Truth([kind] * 4, 34)
    atoms = [(n, e, k, x * ([-1, 1, 1] if k == 2 else 1), v) for n, e, k, x, v in truth.atoms()]
    found = read(tmp_path, xyz(atoms, truth.cell), "a.xyz", [kind])
    assert found.residual_max > 0.05
    assert any(
        re.search(r"fits nearly_flat with 0\.\d+ Å .rms., and its mirror image with 0\.000 Å", n)
        for n in found.notes
    )
    assert read(tmp_path, xyz(truth.atoms(), truth.cell), "a.xyz", [kind]).notes == ()


def test_hydrogen_bonds_are_none_of_the_bonds_of_larger_atoms(tmp_path):
    """Waters 1.8 Å from each other, in a scene that has bonds of 1.94 Å between other elements."""
    rows = [("O", 0, 0, 0), ("H", 1, 0, 0), ("H", -1 / 3, 0.9428, 0)]
    rows += [("O", 2.8, 0, 0), ("H", 3.3774, 0.8165, 0), ("H", 3.3774, -0.8165, 0)]
    atoms = [("", e, 0, np.array([x, y, z]), None) for e, x, y, z in rows]
    atoms += [(name, e, k, x + 8, v) for name, e, k, x, v in Truth(["chiral"]).atoms()]
    found = read(tmp_path, xyz(atoms, np.diag([20.0] * 3)), "a.xyz", ["spce", "chiral"])
    assert found.species.tolist() == [0, 0, 1]


def test_pairs_within_a_radius_in_any_cell():
    rng = np.random.default_rng(0)
    for _ in range(20):
        cell = np.tril(rng.uniform(-10, 10, (3, 3)), -1) + np.diag(rng.uniform(6, 12, 3))
        points = rng.random((15, 3)) @ cell
        radius = rng.uniform(2, 4)
        images = np.stack(np.meshgrid(*[np.arange(-10, 11)] * 3), -1).reshape(-1, 3) @ cell
        step = points[:, None] - points
        wanted = {
            (i, j)
            for i in range(15)
            for j in range(i)
            if np.linalg.norm(step[i, j] + images, axis=1).min() <= radius
        }
        assert 0 < len(wanted) < 105
        i, j, step = pairs_within(points + rng.integers(-5, 6, (15, 3)) @ cell, cell, radius)
        assert {(max(a, b), min(a, b)) for a, b in zip(i, j, strict=True) if a != b} == wanted
        assert np.linalg.norm(step, axis=1).max(initial=0.0) <= radius
        images = (step - points[j] + points[i]) @ np.linalg.inv(cell)
        assert images == pytest.approx(np.round(images), abs=1e-9)


def test_nearest_images_in_any_cell():
    """Also in a cell whose edges lie so near to each other that rounded fractions give another
    image."""
    rng = np.random.default_rng(1)
    images = np.stack(np.meshgrid(*[np.arange(-25, 26)] * 3), -1).reshape(-1, 3)
    for cell in (
        np.diag([4.0, 5.0, 6.0]),
        [[10.0, 0, 0], [9.9, 2.0, 0], [3.0, 1.5, 7.0]],
        [[5.0, 0, 0], [4.0, 5.0, 0], [-8.0, 7.0, 5.0]],
    ):
        vectors = rng.uniform(-12, 12, (10, 3))
        shortest = np.linalg.norm(vectors[:, None] + images @ np.array(cell), axis=2).min(axis=1)
        found = nearest_images(vectors, np.array(cell))
        assert np.linalg.norm(found, axis=1) == pytest.approx(shortest)
        whole = (found - vectors) @ np.linalg.inv(cell)
        assert whole == pytest.approx(np.round(whole), abs=1e-9)


@pytest.mark.parametrize(
    "counts",
    [{"spce": 40}, {"spce": 30, "argon": 15}, {"benzene_trappe": 15}, {"hf_jorgensen": 40}],
)
def test_close_sites_are_those_of_all_pairs(counts):
    """Benzene is larger than its sites: there all sites are searched, of water those of molecules
    that are close."""
    system, _, state = built(counts, 14.0, 1, spread=1.2, forces={"cutoff_A": 6.0})
    wanted = (0.9, every_site), (2.4, lambda m: np.flatnonzero(m.epsilon > 0))
    at, owner = system.site_positions(state), system.sites.molecule
    repels = system.of_sites(lambda m: m.epsilon > 0)
    step = at[:, None] - at
    apart = np.linalg.norm(step - 14.0 * np.rint(step / 14.0), axis=2)
    close = (apart <= 0.9) | (apart <= 2.4) & (repels & repels[:, None])
    close &= np.triu(owner != owner[:, None])
    found = close_pairs(system, state, *wanted)
    assert len(found) > 5
    assert [pair[:2] for pair in found] == [tuple(pair) for pair in np.argwhere(close).tolist()]
    assert [pair[2] for pair in found] == pytest.approx(apart[close].tolist())


def rod(*labels: str, length=1.3) -> Molecule:
    """A straight chain of atoms."""
    masses = {"C": 12.011, "N": 14.007, "O": 15.999, "H": 1.008}
    sites = [
        Site(name=f"{e}{k}", element=e, mass_u=masses[e], position_A=(length * k, 0.0, 0.0))
        for k, e in enumerate(labels, 1)
    ]
    return molecule("rod", tuple(sites), residue_names=("ROD",))


#: Unit cells that are shorter than half of their molecules: upright, and with edges that tilt on
#: each other.
SHORT_CELLS = {
    "upright": [[7.0, 0, 0], [0, 5.0, 0], [0, 0, 6.0]],
    "leaning": [[5.0, 0, 0], [3.0, 6.0, 0], [-4.0, 5.0, 7.0]],
}


@pytest.mark.parametrize("cell", SHORT_CELLS)
@pytest.mark.parametrize("ending", ["xyz", "gro", "gro without residues", "cif"])
@pytest.mark.parametrize("shuffled", [False, True])
def test_molecules_longer_than_the_cell(cell, ending, shuffled, tmp_path):
    """They pass through faces more than once; no two of their atoms are nearest images but
    neighbours."""
    rng, cell = np.random.default_rng(3), np.array(SHORT_CELLS[cell])
    kind = rod("N", "C", "C", "C", "C", "O")
    for seed in range(
        100
    ):  # an orientation in which its atoms keep a distance from those of its images
        truth = Truth([kind], seed, cell=cell)
        at = np.array([x for *_, x, _ in truth.atoms()])
        images = np.stack(np.meshgrid(*[np.arange(-3, 4)] * 3), -1).reshape(-1, 3)
        images = images[(images != 0).any(axis=1)] @ cell
        if np.linalg.norm(at[:, None, None] - at[None, :, None] + images, axis=-1).min() > 2.2:
            break
    assert np.linalg.norm(at[-1] - at[0]) > np.linalg.norm(cell, axis=1).min()
    atoms = wrapped(truth.atoms(), cell)
    if shuffled:
        rng.shuffle(atoms)
    text, error = xyz(atoms, cell), 1e-6
    if ending == "cif":
        plain = ase.Atoms([a[1] for a in atoms], [a[3] for a in atoms], cell=cell, pbc=True)
        ase.io.write(tmp_path / "b.cif", plain)
        text, error = (tmp_path / "b.cif").read_text(), 1e-4
    elif ending.startswith("gro"):
        (a, _, _), (bx, by, _), (cx, cy, cz) = cell / 10
        box = " ".join(f"{x:.9f}" for x in (a, by, cz, 0, 0, bx, 0, cx, cy))
        text = gro(atoms, box, 9, residues="without" not in ending, residue_names={0: "ROD"})
    found = read(tmp_path, text, f"a.{ending.split()[0]}", [kind], repeat=(3, 3, 3))
    assert len(found.species) == 27
    assert found.residual_max < error
    one = read(tmp_path, text, f"a.{ending.split()[0]}", [kind], periodic=False)
    same_molecules(one, truth, [kind], 10 * error)


@pytest.mark.parametrize("elements", ["CC", "CCO"])
def test_polymers_are_no_molecules(elements, tmp_path):
    """A chain of which the cell has one repeat unit, whose atoms fit a template."""
    kind = rod(*elements)
    cell = np.diag([1.3 * len(elements), 8.0, 9.0])
    rows = [("", e, 0, np.array([1.3 * k + 0.4, 2.0, 3.0]), None) for k, e in enumerate(elements)]
    with pytest.raises(
        StructureError, match=r"molecule 1 .*\(C2( O)?\) is bonded to its own image .* a polymer"
    ):
        read(tmp_path, xyz(rows, cell), "a.xyz", [kind])
    cell[0, 0] += 2.0  # molecules in a row
    assert len(read(tmp_path, xyz(rows, cell), "a.xyz", [kind]).species) == 1


# formats


def test_further_digits_and_velocities_of_a_gro(tmp_path):
    truth = Truth(["tip4p2005"] * 5, 8)
    species = [SPECIES["tip4p2005"]]
    for digits, error in ((3, 0.02), (6, 2e-5), (9, 2e-8)):
        found = read(
            tmp_path,
            gro(truth.atoms(), box_of(truth.cell), digits, velocities=True),
            "a.gro",
            species,
        )
        same_molecules(found, truth, species, error)
        assert found.velocity == pytest.approx(truth.velocity, abs=2 * error)
        # of inertia below 3 u Å² and arms below 1 Å
        assert found.angular_momentum_body == pytest.approx(
            truth.angular_momentum_body(), abs=40 * error
        )


def test_velocities_of_some_atoms(tmp_path):
    truth = Truth(["tip4p2005"] * 5, 9)

    def lines(drop):
        text = gro(truth.atoms(), box_of(truth.cell), velocities=True).splitlines()
        return "\n".join(line[:44] if drop(line) else line for line in text) + "\n"

    found = read(
        tmp_path, lines(lambda line: "MW" in line), "a.gro", ["tip4p2005"]
    )  # they follow from the others
    assert found.velocity == pytest.approx(truth.velocity, abs=0.02)
    text = lines(lambda line: "2SOL    HW1" in line)
    found = read(tmp_path, text, "b.gro", ["tip4p2005"])
    assert found.velocity is None
    assert found.notes == (
        "1 of its atoms have no velocity (the first is atom 6): no velocity is used",
    )
    data = small_scene({"tip4p2005": 5}, None).model_dump(exclude={"start"}) | {
        "box": {},
        "structure": {"file": "b.gro", "velocities": True},
        "forces": {"cutoff_A": 5.0},
    }
    with pytest.raises(
        StructureError, match=r"lacks velocities for some atoms; 1 of its .*the first is atom 6"
    ):
        build(Scene.from_dict(data, tmp_path))


@pytest.mark.parametrize("column", ["vel", "velo", "velocity", "velocities"])
def test_velocities_in_a_column_without_units_are_not_used(column, tmp_path):
    truth = Truth(["argon"] * 2)
    text = xyz(truth.atoms(), truth.cell).splitlines()
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


def frames_of(ending, truths):
    if ending == "gro":
        return "".join(gro(t.atoms(), box_of(t.cell)) for t in truths)
    if ending == "xyz":
        return "".join(xyz(t.atoms(), t.cell, NAMES[0]) for t in truths)
    models = [f"MODEL {k}\n{pdb(t.atoms(), '')}TER\nENDMDL\n" for k, t in enumerate(truths, 1)]
    return cryst1(truths[0].cell) + "\n" + "".join(models) + "END\n"


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb"])
def test_one_of_several_frames(ending, tmp_path):
    truths = [Truth(["spce"] * n, n) for n in (2, 3, 4)]
    text = frames_of(ending, truths)
    for frame, truth in ((1, truths[0]), (2, truths[1]), (-1, truths[2])):
        found = read(tmp_path, text, f"a.{ending}", frame=frame)
        same_molecules(found, truth, [SPECIES["spce"]], 0.02)
        assert np.diag(found.cell) == pytest.approx(np.diag(truth.cell), abs=2e-3)
    with pytest.raises(
        StructureError,
        match=r"holds 3 structures.*select one by structure.frame .1 to 3, -1 for the last",
    ):
        read(tmp_path, text, f"a.{ending}")
    with pytest.raises(
        StructureError, match=r"structure.frame is 4: it holds 3, 1 is the first and -1 the last"
    ):
        read(tmp_path, text, f"a.{ending}", frame=4)
    one = read(
        tmp_path, frames_of(ending, truths[:1]), f"b.{ending}"
    )  # a single MODEL is not a choice
    assert len(one.species) == 2


def lammps(truth, first_line, velocity_unit, molecule_ids=True) -> str:
    """A data file; velocity_unit in Å/ps."""
    atoms = truth.atoms()
    edges = np.diag(truth.cell)
    lines = [first_line, "", f"{len(atoms)} atoms", "3 atom types", ""]
    lines += [f"0 {x:.9f} {axis}lo {axis}hi" for x, axis in zip(edges, "xyz", strict=True)]
    lines += ["", "Masses", "", "1 15.9994", "2 1.008", "3 39.948", "", "Atoms # full", ""]
    types = {"O": 1, "H": 2, "Ar": 3, "X": 3}
    lines += [
        f"{i} {k + 1 if molecule_ids else 0} {types[e]} 0.0 {x[0]:.10f} {x[1]:.10f} {x[2]:.10f}"
        for i, (_, e, k, x, _) in enumerate(atoms, 1)
    ]
    lines += ["", "Velocities", ""]
    lines += [
        f"{i} " + " ".join(f"{c / velocity_unit:.12f}" for c in v)
        for i, (*_, v) in enumerate(atoms, 1)
    ]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("molecule_ids", [True, False])
@pytest.mark.parametrize(
    ("units", "velocity_unit"), [("real", 1000.0), ("metal", 1.0), (None, 1.0)]
)
def test_lammps_data(units, velocity_unit, molecule_ids, tmp_path):
    truth = Truth(["spce", "argon", "spce"], 12)
    species = [SPECIES["argon"], SPECIES["spce"]]
    first = "LAMMPS data file via write_data, version 1, timestep = 0" + (
        f", units = {units}" if units else ""
    )
    found = read(tmp_path, lammps(truth, first, velocity_unit, molecule_ids), "a.data", species)
    partner = same_molecules(found, truth, species, 1e-7)
    if units:
        assert found.velocity == pytest.approx(truth.velocity[partner], rel=1e-5)
    else:
        assert found.velocity is None
        assert any("does not name its units" in note for note in found.notes)


#: Å, u and Å/ps in the units of LAMMPS.
SCALES = {
    "si": (1e-10, 1.66053907e-27, 100.0),
    "cgs": (1e-8, 1.66053907e-24, 1e4),
    "electron": (1 / 0.529177211, 1.0, 1.95163e-3),
    "micro": (1e-4, 1.66053907e-12, 100.0),
    "nano": (0.1, 1.66053907e-6, 100.0),
    "Metal": (1.0, 1.0, 1.0),
}


@pytest.mark.parametrize("units", SCALES)
@pytest.mark.parametrize("form", ["data", "dump"])
def test_units_of_lammps(units, form, tmp_path):
    """Lengths, masses (from which elements follow) and velocities of each system of units."""
    length, mass, speed = SCALES[units]
    lines = [
        f"{k} 1 {' '.join(f'{x:.9e}' for x in length * np.array([k, 2.0, 3.0]))}" for k in (1, 2)
    ]
    edge = f"0 {8 * length:.9e}"
    if form == "data":
        text = (
            f"made by me, units = {units}\n\n2 atoms\n1 atom types\n"
            + "".join(f"{edge} {x}lo {x}hi\n" for x in "xyz")
            + f"\nMasses\n\n1 {39.948 * mass:.9e}\n\nAtoms # atomic\n\n"
            + "\n".join(lines)
            + f"\n\nVelocities\n\n1 {speed:.9e} 0 0\n2 {speed:.9e} 0 0\n"
        )
    else:
        bounds = f"ITEM: BOX BOUNDS pp pp pp\n{edge}\n{edge}\n{edge}\n"
        text = (
            f"ITEM: UNITS\n{units}\nITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n2\n{bounds}"
            "ITEM: ATOMS id type x y z mass vx vy vz\n"
            + "".join(f"{line} {39.948 * mass:.9e} {speed:.9e} 0 0\n" for line in lines)
        )
    path = tmp_path / ("a.data" if form == "data" else "a.lammpstrj")
    path.write_text(text)
    found = read_atoms(path)
    assert found.position == pytest.approx(np.array([[1.0, 2, 3], [2, 2, 3]]), rel=1e-6)
    assert found.cell == pytest.approx(8 * np.eye(3), rel=1e-6)
    assert found.masses == pytest.approx([39.948, 39.948], rel=1e-6)
    assert found.elements == ["Ar", "Ar"]
    assert found.velocity == pytest.approx(np.array([[1.0, 0, 0]] * 2), rel=1e-5)


@pytest.mark.parametrize("units", ["lj", "LJ", "furlong", ""])
def test_unknown_units_of_lammps_are_refused(units, tmp_path):
    truth = Truth(["spce", "argon", "spce"], 12)
    path = tmp_path / "a.data"
    path.write_text(lammps(truth, f"LAMMPS data file, units = {units}", 1.0))
    says = "units of sigma.*convert it to real" if units.lower() == "lj" else "expected real, metal"
    with pytest.raises(StructureError, match=f"line 1: its units are '{units}'.*{says}"):
        read_atoms(path)
    path.write_text(lammps(truth, "a melt of six repeat units, from units made by hand", 1.0))
    assert "its velocities are not used" in " ".join(read_atoms(path).notes)
    dump = tmp_path / "a.lammpstrj"
    water = Truth(["tip4p2005"] * 2, 12)
    dump.write_text(dump_of(water, "id element x y z", units=units or " "))
    with pytest.raises(StructureError, match=f"line 2: its units are '{units}'.*{says}"):
        read_atoms(dump)


def repartitioned(truth, labels=("", ""), section="") -> str:
    """Data of waters with mass moved from oxygen to hydrogen, as for long time steps."""
    text = (
        lammps(truth, "x, units = real", 1.0)
        .replace("3 atom types", "2 atom types")
        .replace("3 39.948\n", "")
    )
    words = [f" # {label}" if label else "" for label in labels]
    text = text.replace("1 15.9994", f"1 9.9994{words[0]}").replace(
        "2 1.008", f"2 4.00794{words[1]}"
    )
    return text.replace("Masses", f"{section}Masses")


def test_lammps_atom_types_by_name(tmp_path):
    truth = Truth(["spce"] * 4, 12)
    text = repartitioned(truth)
    with pytest.raises(
        StructureError,
        match=r"atom types 1 \(9.9994 u\), 2 \(4.00794 u\) have masses .* \(1.008, 15.9994 u\): .*structure.atom_types",
    ):
        read(tmp_path, text, "a.data")
    ways = [
        (text, {"1": "O", "2": "H"}),
        (text, {"1": "OW", "2": "HW1"}),
        (
            text.replace("2 4.00794\n", "2 4.00794 # He\n"),
            {"1": "O", "2": "H"},
        ),  # the scene counts for more
        (repartitioned(truth, ("O", "H")), None),
        (repartitioned(truth, ("OW", "HW2")), None),
        (repartitioned(truth, section="Atom Type Labels\n\n1 OW\n2 HW1\n\n"), None),
    ]
    helium = ion("He", 4.0026)  # weighs as much as this hydrogen, and counts for less than its name
    begun = repartitioned(
        truth, ("Oxygen", "HW")
    )  # names that only begin like elements count for less than masses
    for file, atom_types, others in [(*way, [helium]) for way in ways] + [(begun, None, [])]:
        found = read(tmp_path, file, "a.data", ["spce", *others], atom_types=atom_types)
        same_molecules(found, truth, [SPECIES["spce"]], 1e-6)
        assert any(
            "masses of the scene are used, not the masses in the file" in note
            for note in found.notes
        )
    found = read(tmp_path, text.replace("9.9994", "15.9994").replace("4.00794", "1.008"), "a.data")
    assert not any("masses" in note for note in found.notes)
    heavy = with_masses(SPECIES["spce"], {"O": 9.9994, "H": 4.00794})
    assert (
        len(read(tmp_path, text, "a.data", [heavy]).species) == 4
    )  # or by masses that the scene has too


def test_the_element_of_a_site_counts_for_more_than_that_of_its_file(tmp_path):
    """A united atom weighs as much as oxygen does."""
    lines = [
        "x",
        "",
        "1 atoms",
        "1 atom types",
        "",
        "Masses",
        "",
        "1 16.043",
        "",
        "Atoms # atomic",
        "",
        "1 1 0.0 0.0 0.0",
    ]
    (tmp_path / "methane.data").write_text("\n".join(lines) + "\n")
    site = {"name": "1", "sigma_A": 3.73, "epsilon_K": 148.0}
    for entry, element in ((site, "O"), (site | {"element": "C"}, "C")):
        molecules = [{"file": "methane.data", "sites": [entry], "count": 5}]
        assert build(small_scene({}, 20.0, tmp_path, molecules=molecules)).species[0].elements == (
            element,
        )


def test_lammps_atom_types_without_masses_and_with_massless_sites(tmp_path):
    truth = Truth(["tip4p2005", "argon", "tip4p2005"], 12)
    text = lammps(truth, "x, units = real", 1.0).replace("3 atom types", "4 atom types")
    begin, end = text.index("Masses"), text.index("Atoms #")
    text = text[:begin] + text[end:]
    numbers = {"O": 1, "H": 2, "X": 3, "Ar": 4}
    for i, (_, element, *_) in enumerate(truth.atoms(), 1):
        text = re.sub(
            rf"^({i} \d+) \d+ 0.0 ", rf"\1 {numbers[element]} 0.0 ", text, flags=re.MULTILINE
        )
    with pytest.raises(
        StructureError, match=r"no section Masses.*name its atom types by structure.atom_types"
    ):
        read(tmp_path, text, "a.data", ["tip4p2005", "argon"])
    for massless in ("MW", "X"):
        atom_types = {"1": "O", "2": "H", "3": massless, "4": "Ar"}
        found = read(tmp_path, text, "a.data", ["tip4p2005", "argon"], atom_types=atom_types)
        same_molecules(found, truth, [SPECIES["tip4p2005"], SPECIES["argon"]], 1e-6)


@pytest.mark.parametrize(
    ("atom_types", "message"),
    [
        ({"1": "O"}, r"structure.atom_types has no name for type 2"),
        (
            {"1": "O", "2": "H", "7": "H", "OW": "O"},
            r"structure.atom_types: unknown type 7, OW; there are 1, 2",
        ),
        (
            {"1": "O", "2": "hw1"},
            r"structure.atom_types.2 = 'hw1' is not a site or element .* there are OW, HW1, HW2, O, H; did you mean HW1\?",
        ),
        ({"1": "H", "2": "O"}, r"molecule 1 .* has atoms H O2, expected spce \(O H2\)"),
    ],
)
def test_atom_types_that_do_not_fit_the_file(atom_types, message, tmp_path):
    with pytest.raises(StructureError, match=message):
        read(tmp_path, repartitioned(WATERS), "a.data", atom_types=atom_types)


def test_atom_types_of_a_scene(tmp_path):
    (tmp_path / "a.data").write_text(repartitioned(Truth(["spce"] * 8, 5)))
    structure = {"file": "a.data", "atom_types": {"1": "O", "2": "H"}}
    scene = small_scene(
        {},
        None,
        tmp_path,
        molecules=[{"model": "spce"}],
        box={},
        structure=structure,
        forces={"cutoff_A": 6.0},
    )
    assert len(build(scene).model.species) == 8


@pytest.mark.parametrize(
    ("mass", "element"),
    [
        (1.008, "H"),
        (2.014, "D"),
        (3.016, "T"),
        (4.0026, "He"),
        (15.9994, "O"),
        (15.035, ""),
        (9.9994, ""),
        (22.99, "Na"),
    ],
)
def test_elements_by_mass(mass, element):
    """What weighs as nothing does, a united atom for one, is not a element."""
    assert element_of_mass(mass) == element


def test_lammps_sites_of_almost_no_mass(tmp_path):
    truth = Truth(["tip4p2005"] * 3, 12)
    text = lammps(truth, "x, units = real", 1.0).replace("3 39.948", "3 1e-10")
    found = read(tmp_path, text, "a.data", ["tip4p2005"])
    same_molecules(found, truth, [SPECIES["tip4p2005"]], 1e-6)
    assert found.notes == ()


def test_long_pdbs_whose_numbers_run_out(tmp_path):
    truth = Truth(["spce"] * 8, 13)
    text = pdb(truth.atoms(), cryst1(truth.cell), number=lambda k: f"A{k:03d}")  # hybrid-36
    same_molecules(read(tmp_path, text, "a.pdb"), truth, [SPECIES["spce"]], 0.002)
    text = pdb(
        truth.atoms(), cryst1(truth.cell), number=lambda k: f"   {k // 2}"
    )  # two of each number, in two chains
    lines = [
        line.replace(" A   ", " B   ") if (k - 1) % 6 < 3 else line
        for k, line in enumerate(text.splitlines())
    ]
    assert read(tmp_path, "\n".join(lines) + "\n", "c.pdb").notes == ()
    text = pdb(
        truth.atoms(), cryst1(truth.cell), number=lambda k: "****"
    )  # GROMACS and others beyond 9999
    same_molecules(read(tmp_path, text, "b.pdb"), truth, [SPECIES["spce"]], 0.002)


@pytest.mark.parametrize("ending", ["xyz", "pdb"])
def test_what_this_engine_writes_it_reads(ending, tmp_path):
    system = build(small_scene({"tip4p2005": 8}, 20.0))
    moved = system.state.copy()
    moved.position[:] += 1.0
    file = TrajectoryFile(tmp_path / f"t.{ending}", system, 1.0, velocities=False, wrapped=True)
    for k, state in enumerate((system.state, moved)):
        file.write(state, float(k), k)
    file.close()
    write_topology(tmp_path / "t.gro", system, moved, wrapped=True)
    write_state(tmp_path / "t.npz", system.saved(moved))
    for name, frame, error in (
        (f"t.{ending}", -1, 2e-3),
        ("t.gro", None, 0.02),
        ("t.npz", None, 0.0),
    ):
        found = read_structure(tmp_path / name, system.species, None, True, TOLERANCE, frame)
        step = found.position - moved.position
        assert np.abs(step - 20 * np.round(step / 20)).max() <= error
        assert np.diag(found.cell) == pytest.approx(20.0)


@pytest.mark.parametrize("there", ["H", "D"])
@pytest.mark.parametrize("wanted", ["H", "D"])
@pytest.mark.parametrize("ending", ["gro", "pdb", "xyz"])
def test_heavy_water_starts_like_light(there, wanted, ending, tmp_path):
    truth = Truth(["spce"] * 3, 20)
    atoms = [(name, e.replace("H", there), k, x, v) for name, e, k, x, v in truth.atoms()]
    text = {
        "gro": gro(atoms, box_of(truth.cell)),
        "pdb": pdb(atoms, cryst1(truth.cell)),
        "xyz": xyz(atoms, truth.cell),
    }
    sites = [
        Site(**site | {"element": site["element"].replace("H", wanted)})
        for site in SPECIES["spce"].sites()
    ]
    water = molecule("spce", tuple(sites), residue_names=("SOL", "HOH"))
    found = read(tmp_path, text[ending], f"a.{ending}", [water])
    assert found.residual_max < 0.02


def test_a_geometry_of_heavy_hydrogen_has_its_mass(tmp_path):
    (tmp_path / "a.xyz").write_text("3\n\nOW 0 0 0\nD 0.8 0.6 0\nM 0 0.1 0\n")
    atoms = read_geometry(tmp_path / "a.xyz")
    assert (atoms.names, atoms.elements) == (["OW", "D", "M"], ["O", "D", "X"])
    assert atoms.masses == pytest.approx([15.999, 2.0141, 0.0])


# crystals


def cif(occupancy=1.0) -> str:
    return f"""data_x
_cell_length_a 5.0
_cell_length_b 6.0
_cell_length_c 7.0
_cell_angle_alpha 90
_cell_angle_beta 90
_cell_angle_gamma 90
_symmetry_space_group_name_H-M 'P 1'
loop_
_atom_site_label
_atom_site_type_symbol
_atom_site_fract_x
_atom_site_fract_y
_atom_site_fract_z
_atom_site_occupancy
O1 O 0.9 0.5 0.5 1.0
H1 H 0.0633 0.5962 0.5 {occupancy}
H2 H 0.7367 0.5962 0.5 1.0
"""


def test_a_crystal_is_repeated_from_its_cell(tmp_path):
    one = read(tmp_path, cif(), "ice.cif")
    assert len(one.species) == 1
    many = read(tmp_path, cif(), "ice.cif", repeat=(4, 3, 2))
    assert np.diag(many.cell) == pytest.approx([20, 18, 14])
    assert len(many.species) == 24
    assert many.residual_rms == one.residual_rms
    step = many.position - one.position
    cells = step / [5, 6, 7]
    assert cells == pytest.approx(np.round(cells))
    assert len({tuple(c) for c in np.round(cells).astype(int)}) == 24
    data = small_scene({"spce": 24}, None).model_dump() | {
        "box": {},
        "structure": {"file": "ice.cif", "repeat": [4, 3, 2]},
        "forces": {"cutoff_A": 5.0},
    }
    system = build(Scene.from_dict(data, tmp_path))
    assert tuple(system.space) == pytest.approx((20, 18, 14))
    for box in ({"lengths_A": 20.0}, {"periodic": False}):
        with pytest.raises(SceneError, match=r"structure.repeat repeats the file's cell"):
            Scene.from_dict(data | {"box": box}, tmp_path)


def test_a_disordered_crystal_is_refused(tmp_path):
    with pytest.raises(
        StructureError, match=r"occupied only partly \(H1 0.5\): the crystal is disordered"
    ):
        read(tmp_path, cif(0.5), "ice.cif")


# boxes


@pytest.mark.parametrize(
    ("box", "note"),
    [
        ("   0.00000   0.00000   0.00000", ""),
        ("   1.00000   1.00000   0.00000", "its cell has no volume and is not used"),
    ],
)
def test_no_box(box, note, tmp_path):
    truth = Truth(["spce"] * 3, 14)
    text = gro(truth.atoms(), box)
    with pytest.raises(
        StructureError, match=r"has no box.*give \[box\] lengths_A, or periodic = false"
    ):
        read(tmp_path, text, "a.gro")
    found = read(tmp_path, text, "a.gro", cell=np.diag([14.0, 15.0, 16.0]))
    same_molecules(found, truth, [SPECIES["spce"]], 0.02)
    assert found.notes == ((note,) if note else ())
    assert read(tmp_path, text, "a.gro", periodic=False).cell is None


def test_placeholder_boxes(tmp_path):
    truth = Truth(["spce"] * 3, 14)
    text = pdb(truth.atoms(), cryst1(np.eye(3)))
    with pytest.raises(
        StructureError, match=r"has no box .its cell, a cube of 1 Å, stands for none"
    ):
        read(tmp_path, text, "a.pdb")
    same_molecules(
        read(tmp_path, text, "a.pdb", cell=np.diag([14.0, 15.0, 16.0])),
        truth,
        [SPECIES["spce"]],
        0.002,
    )


def test_the_scene_may_want_another_box_than_the_file(tmp_path):
    truth = Truth(["spce"] * 8, 15)
    text = gro(wrapped(truth.atoms(), truth.cell), box_of(truth.cell), 9)
    found = read(tmp_path, text, "a.gro", cell=30 * np.eye(3))
    assert found.residual_max < 1e-6  # whole by the file's box, not the scene's
    assert found.notes == ("the box of the scene is used, not the box of the file",)
    assert np.diag(found.cell) == pytest.approx(30)


def test_a_slab_has_no_box_of_its_own(tmp_path):
    truth = Truth(["spce"] * 2)
    text = xyz(truth.atoms(), truth.cell).replace('Lattice="', 'pbc="T T F" Lattice="')
    with pytest.raises(StructureError, match=r"has no box .its cell is periodic along a, b only"):
        read(tmp_path, text, "a.xyz")


# files of other programs


def data_of(
    truth,
    style="full",
    masses="1 15.9994\n2 1.008",
    types=("1", "2"),
    header="Atoms # STYLE\n",
    head="",
) -> str:
    """LAMMPS data of waters with these columns."""
    order = {
        "molecular": "{i} {m} {t} {x}",
        "charge": "{i} {t} {q} {x}",
        "atomic": "{i} {t} {x}",
        "full": "{i} {m} {t} {q} {x}",
        "hybrid full": "{i} {t} {x} {m} {q}",
        "sphere": "{i} {t} 1.0 1.0 {x}",
    }[style]
    rows = [
        order.format(
            i=i,
            m=k + 1,
            t=types[e == "H"],
            q=0.41 if e == "H" else -0.82,
            x=" ".join(f"{c:.10f}" for c in x),
        )
        for i, (_, e, k, x, _) in enumerate(truth.atoms(), 1)
    ]
    edges = "".join(
        f"0 {x:.9f} {axis}lo {axis}hi\n" for x, axis in zip(np.diag(truth.cell), "xyz", strict=True)
    )
    section = f"Masses\n\n{masses}\n\n" if masses else ""
    return (
        f"made by hand\n\n{head}{len(rows)} atoms\n2 atom types\n{edges}\n{section}{header.replace('STYLE', style)}"
        + "\n".join(rows)
        + "\n"
    )


WATER_DATA = Truth(["spce"] * 8, 23)
LABELS = ("OW", "HW")
DATA = {
    "no style, molecular": data_of(WATER_DATA, "molecular", header="Atoms\n\n"),
    "no style, charge": data_of(WATER_DATA, "charge", header="Atoms\n\n"),
    "no style, atomic": data_of(WATER_DATA, "atomic", header="Atoms\n\n"),
    "no empty line": data_of(WATER_DATA, "full", header="Atoms\n"),
    "columns as comment": data_of(WATER_DATA, header="Atoms  # id mol type q x y z\n\n"),
    "long names of columns": data_of(
        WATER_DATA, header="Atoms  # atom-ID molecule-ID atom-type q x y z\n\n"
    ),
    "upper case": data_of(WATER_DATA, header="Atoms # Full\n\n"),
    "hybrid": data_of(WATER_DATA, "hybrid full"),
    "sphere": data_of(WATER_DATA, "sphere"),
    "comments": data_of(WATER_DATA, head="# a comment\n")
    .replace("24 atoms", "24 atoms  # all of them")
    .replace("xlo xhi", "xlo xhi # Å"),
    "indented": "\n".join(f"  {line}" for line in data_of(WATER_DATA).splitlines()),
    "labels of masses": data_of(WATER_DATA, types=LABELS, masses="OW 15.9994\nHW 1.008"),
    "labels everywhere": data_of(
        WATER_DATA,
        types=LABELS,
        masses="OW 15.9994\nHW 1.008",
        header="Atom Type Labels\n\n1 OW\n2 HW\n\nAtoms # full\n\n",
    ),
    "labels of atoms": data_of(
        WATER_DATA, types=LABELS, header="Atom Type Labels\n\n1 OW\n2 HW\n\nAtoms # full\n\n"
    ),
    "labels without masses": data_of(WATER_DATA, types=LABELS, masses=""),
    "exponents": data_of(WATER_DATA).replace(".0000000000", "D+00"),
}


#: Tilts xy, xz, yz of LAMMPS' boxes: the extremes of the bounds of dumps are at different corners.
TILTS = [None, (3.0, -2.0, 4.0), (3.0, 2.0, 4.0), (-3.0, -2.0, -4.0), (-3.0, 5.0, -4.0)]


@pytest.mark.parametrize("case", DATA)
def test_lammps_data_as_people_write_it(case, tmp_path):
    names = ["a.data", "data.spce", "water.dat", "input_structure_data.spce", "a.data.gz"]
    name, content = names[list(DATA).index(case) % len(names)], DATA[case].encode()
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    found = read_structure(tmp_path / name, [SPECIES["spce"]], None, True, TOLERANCE)
    same_molecules(found, WATER_DATA, [SPECIES["spce"]], 1e-8)
    assert found.notes == ()


@pytest.mark.parametrize("tilts", TILTS[1:])
@pytest.mark.parametrize("bounds", [(0.0, 0.0, 0.0), (-5.0, 2.0, 31.0)])
@pytest.mark.parametrize("general", [False, True])
def test_tilted_boxes_of_lammps_data(tilts, bounds, general, tmp_path):
    """By bounds and tilts, or by three edges; split atoms are in the box."""
    xy, xz, yz = tilts
    truth = Truth(["spce"] * 8, 23, cell=[[15.0, 0, 0], [xy, 16.0, 0], [xz, yz, 17.0]])
    truth.centre += bounds
    text = data_of(truth)
    box = re.search(r"0 .* xlo xhi\n.*\n.* zlo zhi\n", text)[0]
    lines = [
        f"{low} {low + edge} {axis}lo {axis}hi\n"
        for low, edge, axis in zip(bounds, (15, 16, 17), "xyz", strict=True)
    ]
    lines.append(f"{xy} {xz} {yz} xy xz yz\n")
    if general:
        lines = [
            f"{' '.join(map(str, edge))} {name}vec\n"
            for edge, name in zip(truth.cell, "abc", strict=True)
        ]
    found = read(tmp_path, text.replace(box, "".join(lines)), "a.data")
    assert found.cell == pytest.approx(truth.cell)
    same_molecules(found, truth, [SPECIES["spce"]], 1e-7)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            data_of(WATER_DATA, "sphere", header="Atoms\n\n"),
            r"line 16: the meaning of the 7 columns .* 'Atoms # molecular'",
        ),
        (
            data_of(WATER_DATA, "molecular", header="Atoms # full\n\n"),
            r"line 16: an atom of style 'full' has 7 columns .*, found 6",
        ),
        (data_of(WATER_DATA).replace("24 atoms\n", ""), "has no line with the number of atoms"),
        (
            data_of(WATER_DATA).replace("24 atoms\n", "23 atoms\n"),
            "line 3 promises 23 atoms, the section Atoms has 24",
        ),
        (
            data_of(WATER_DATA).replace("2 1.008", "3 1.008"),
            "its section Masses has no mass of type 2",
        ),
        (
            data_of(WATER_DATA).replace("2 1.008", "2 light"),
            "line 12: expected a type and its mass, found 'light'",
        ),
        (data_of(WATER_DATA, masses=""), "has no section Masses"),
        (data_of(WATER_DATA) + "25 9 1\n", "line 3 promises 24 atoms, the section Atoms has 25"),
        (
            data_of(WATER_DATA, header="Atoms # bond\n\n"),
            "line 16: an atom of style 'bond' has 6 columns .*, found 7",
        ),
        (
            data_of(WATER_DATA).replace("\n3 1 2 ", "\n3 x 2 "),
            r"line 17: expected an atom .id mol type q x y z., found '3 x 2",
        ),
        (data_of(WATER_DATA).replace("xlo xhi", "xlo"), "a line 'LOW HIGH xlo xhi' is missing"),
    ],
)
def test_lammps_data_that_cannot_be_read_say_where(text, message, tmp_path):
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text, "a.data")


def test_images_of_lammps_atoms(tmp_path):
    """They are added along the edges: a molecule is whole by them as well."""
    truth = Truth(["spce"] * 8, 24, cell=[[15.0, 0, 0], [3.0, 16.0, 0], [-2.0, 4.0, 17.0]])
    lines = data_of(truth).replace("zlo zhi\n", "zlo zhi\n3.0 -2.0 4.0 xy xz yz\n").split("\n")
    first = lines.index("Atoms # full") + 1
    lines[first : first + 24] = [f"{line} 1 -2 3" for line in lines[first : first + 24]]
    found = read(tmp_path, "\n".join(lines), "a.data")
    assert found.cell == pytest.approx(truth.cell)
    partner = same_molecules(found, truth, [SPECIES["spce"]], 1e-7)
    assert found.position == pytest.approx(
        truth.centre[partner] + np.array([1, -2, 3]) @ truth.cell, abs=1e-6
    )


def dump_of(truth, columns, flags="pp pp pp", units="") -> str:
    """A dump with these columns, atoms in another order."""
    cell, types, rows = truth.cell, {"O": 1, "H": 2, "X": 3}, []
    for i, (_, e, k, x, v) in enumerate(truth.atoms(), 1):
        scaled = (x - [1, 2, 3]) @ np.linalg.inv(cell)
        values = {
            "id": i,
            "mol": k + 1,
            "type": types[e],
            "element": e,
            "typelabel": {"O": "OW", "H": "HW", "X": "MW"}[e],
            "label": {"O": "OW", "H": "HW", "X": "MW"}[e],
            "mass": {"O": 15.9994, "H": 1.008, "X": 1e-8}[e],
        }
        values |= dict(zip(("x", "y", "z"), x, strict=True)) | dict(
            zip(("xs", "ys", "zs"), scaled, strict=True)
        )
        values |= dict(zip(("xu", "yu", "zu"), x, strict=True)) | dict(
            zip(("vx", "vy", "vz"), v / 1000, strict=True)
        )
        rows.append(
            " ".join(
                f"{values[c]:.12g}" if isinstance(values[c], float) else str(values[c])
                for c in columns.split()
            )
        )
    xy, xz, yz = cell[1, 0], cell[2, 0], cell[2, 1]
    low, high = np.array([1.0, 2, 3]), np.array([1.0, 2, 3]) + np.diag(cell)
    low += np.array([min(0, xy, xz, xy + xz), min(0, yz), 0])
    high += np.array([max(0, xy, xz, xy + xz), max(0, yz), 0])
    slanted = bool(xy or xz or yz)
    bounds = "\n".join(
        f"{a:.12f} {b:.12f}" + (f" {t:.12f}" if slanted else "")
        for a, b, t in zip(low, high, (xy, xz, yz), strict=True)
    )
    head = (
        f"ITEM: UNITS\n{units}\n" if units else ""
    ) + f"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n{len(rows)}\n"
    box = f"ITEM: BOX BOUNDS {'xy xz yz ' if slanted else ''}{flags}\n{bounds}\n"
    return (
        head
        + box
        + f"ITEM: ATOMS {columns}\n"
        + "\n".join(rows[::-1] if "id" in columns else rows)
        + "\n"
    )


@pytest.mark.parametrize(
    "columns",
    [
        "id type x y z",
        "id mol type xs ys zs",
        "id element xu yu zu",
        "id type element mass x y z",
        "id type mass xs ys zs",
        "type x y z",
        "id type vx vy vz x y z",
        "id typelabel xs ys zs",
        "id type typelabel x y z",
        "id label xu yu zu",
    ],
)
@pytest.mark.parametrize("tilts", TILTS)
def test_lammps_dumps(columns, tilts, tmp_path):
    xy, xz, yz = tilts or (0.0, 0.0, 0.0)
    truth = Truth(["tip4p2005"] * 8, 25, cell=[[15.0, 0, 0], [xy, 16.0, 0], [xz, yz, 17.0]])
    second = Truth(["tip4p2005"] * 5, 26)
    path = tmp_path / ("a.lammpstrj.gz" if tilts is None else "dump.water")
    content = (dump_of(truth, columns, units="real") + dump_of(second, columns)).encode()
    path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    names = {"1": "O", "2": "H", "3": "MW"}
    told = not {"element", "mass", "label", "typelabel"} & set(columns.split())
    species = [SPECIES["tip4p2005"]]
    for frame, there in ((1, truth), (2, second)):
        found = read_structure(
            path, species, None, True, TOLERANCE, frame, atom_types=names if told else None
        )
        partner = same_molecules(found, there, species, 1e-6)
        assert found.cell == pytest.approx(there.cell, abs=1e-6)
        if "vx" in columns:
            assert found.velocity == pytest.approx(there.velocity[partner], abs=1e-6)
        assert not any("left out" in note or "missing" in note for note in found.notes)
    if told:
        with pytest.raises(StructureError, match=r"has only types of atoms.*structure.atom_types"):
            read_structure(path, species, None, True, TOLERANCE, 1)


@pytest.mark.parametrize(
    "columns", ["id typelabel x y z", "id type typelabel x y z", "id label x y z"]
)
def test_labels_of_a_dump_are_named_by_atom_types(columns, tmp_path):
    text = dump_of(WATER_DATA, columns).replace(" OW ", " water_O ").replace(" HW ", " +h ")
    with pytest.raises(
        StructureError,
        match=r"has atoms named .h, water_O, .* structure.atom_types gives them names",
    ):
        read(tmp_path, text, "a.dump")
    found = read(tmp_path, text, "a.dump", atom_types={"water_O": "O", "+h": "H"})
    same_molecules(found, WATER_DATA, [SPECIES["spce"]], 1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id type q"),
            "line 9: has no columns of coordinates",
        ),
        (
            ("ITEM: NUMBER OF ATOMS\n24", "ITEM: NUMBER OF ATOMS\n25"),
            "line 4 promises 25 atoms, 24 are there",
        ),
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id type x y z ix"),
            "line 10: expected 6 columns",
        ),
        (
            ("ITEM: ATOMS id type x y z", "ITEM: ATOMS id q x y z"),
            "line 9: has no column that names its atoms: type, typel",
        ),
        (
            ("ITEM: NUMBER OF ATOMS", "ITEM: NUMBER"),
            "line 1: expected ITEM: NUMBER OF ATOMS, BOX BOUNDS and ATOMS",
        ),
        (("pp pp pp", "pp pp ff"), "its cell is periodic along a, b only"),
    ],
)
def test_lammps_dumps_that_cannot_be_read_say_where(change, message, tmp_path):
    text = dump_of(WATER_DATA, "id type x y z")
    assert change[0] in text
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text.replace(*change), "a.lammpstrj", atom_types={"1": "O", "2": "H"})


def test_velocities_of_a_dump_without_units_are_not_used(tmp_path):
    found = read(tmp_path, dump_of(WATER_DATA, "id element x y z vx vy vz"), "a.dump")
    assert found.velocity is None
    assert found.notes == (
        "it does not name its units (dump_modify units yes): its velocities are not used",
    )


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
    same_molecules(found, truth, [SPECIES["spce"]], 0.002)
    assert list(found.number) == list(range(9998, 10006))


def test_coordinates_of_a_pdb_that_are_not_in_columns(tmp_path):
    truth = Truth(["spce"] * 2)
    rows = [
        f"ATOM  {i:5d}  {n:<3} SOL A{k + 1:4d} {x[0]:.6f} {x[1]:.6f} {x[2]:.6f}"
        for i, (n, _, k, x, _) in enumerate(truth.atoms())
    ]
    same_molecules(
        read(tmp_path, "\n".join([cryst1(truth.cell), *rows, "END"]), "a.pdb"),
        truth,
        [SPECIES["spce"]],
        1e-5,
    )
    stars = pdb(truth.atoms(), cryst1(truth.cell)).replace(
        f"{truth.atoms()[0][3][0]:8.3f}", "********"
    )
    with pytest.raises(
        StructureError,
        match=r"line 2: expected an atom of a .pdb with coordinates in columns 31 to 54, found",
    ):
        read(tmp_path, stars, "b.pdb")


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
def test_a_cryst1_that_is_no_box(box, tmp_path):
    truth = Truth(["spce"] * 3, 14)
    text = pdb(truth.atoms(), box)
    same_molecules(read(tmp_path, text, "a.pdb", cell=truth.cell), truth, [SPECIES["spce"]], 0.002)
    assert read(tmp_path, text, "a.pdb", periodic=False).cell is None
    with pytest.raises(StructureError, match=r"has no box \(.*(CRYST1|no volume).*give \[box\]"):
        read(tmp_path, text, "a.pdb")


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
    same_molecules(found, truth, [SPECIES["spce"]], 0.002)
    assert found.cell == pytest.approx(truth.cell)


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
    same_molecules(found, truth, [SPECIES["spce"]], 1e-6)
    (tmp_path / "a.xyz").write_text(
        spoiled("3\n\nO 0.0 0.0 0.0\nH 1.0 0.0 0.0\nH 0.0 1.0 0.0\n", how)
    )
    if how != "types":
        names, elements, *_ = read_geometry(tmp_path / "a.xyz")
        assert names == elements == ["O", "H", "H"]


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb"])
@pytest.mark.parametrize("gap", ["\n", "   \n\n"])
def test_frames_with_empty_lines_between_them(ending, gap, tmp_path):
    truths = [Truth(["spce"] * n, n) for n in (2, 3, 4)]
    text = gap + gap.join(frames_of(ending, [truth]) for truth in truths) + gap
    for frame in (1, 2, -1):
        found = read(tmp_path, text, f"a.{ending}", frame=frame)
        same_molecules(found, truths[frame - (frame > 0)], [SPECIES["spce"]], 0.02)
    with pytest.raises(StructureError, match=r"holds 3 structures"):
        read(tmp_path, text, f"a.{ending}")
    with pytest.raises(
        StructureError,
        match=r"line \d+: expected the number of atoms|is truncated|promises|no atoms",
    ):
        read(
            tmp_path,
            f"{text}nonsense\nnonsense\nnonsense\n" if ending != "pdb" else "nonsense",
            f"b.{ending}",
        )


def text_in(ending) -> str:
    truth = Truth(["spce"] * 4, 29)
    if ending == "cif":
        plain = ase.Atoms(
            [a[1] for a in truth.atoms()], [a[3] for a in truth.atoms()], cell=truth.cell, pbc=True
        )
        written = io.BytesIO()
        ase.io.write(written, plain, format="cif")
        return written.getvalue().decode()
    if ending == "data":
        return data_of(truth)
    if ending == "dump":
        return dump_of(truth, "id element x y z")
    if ending == "vasp":
        plain = ase.Atoms(
            [a[1] for a in truth.atoms()], [a[3] for a in truth.atoms()], cell=truth.cell, pbc=True
        )
        written = io.StringIO()
        ase.io.write(written, plain, format="vasp")
        return written.getvalue()
    return frames_of(ending, [truth])


@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb", "data", "dump", "cif", "vasp"])
@pytest.mark.parametrize("how", ["utf-8-sig", "utf-16", "utf-16-be", "crlf", "gz", "bz2", "xz"])
def test_marks_of_encodings_and_packed_files(ending, how, tmp_path):
    """They change nothing, and take no atom."""
    text = text_in(ending)
    plain = read(tmp_path, text, f"plain.{ending}", cell=np.diag([14.0, 15.0, 16.0]))
    pack = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}
    if how in pack:
        path, content = tmp_path / f"a.{ending}.{how}", pack[how](text.encode())
    elif how == "crlf":
        path, content = tmp_path / f"a.{ending}", text.replace("\n", "\r\n").encode()
    else:
        path, content = (
            tmp_path / f"a.{ending}",
            (codecs.BOM_UTF16_BE if how == "utf-16-be" else b"") + text.encode(how),
        )
    path.write_bytes(content)
    found = read_structure(path, [SPECIES["spce"]], np.diag([14.0, 15.0, 16.0]), True, TOLERANCE)
    assert found.position == pytest.approx(plain.position)
    assert len(found.species) == 4
    assert found.notes == plain.notes


def test_a_packed_file_that_is_damaged(tmp_path):
    for name, content in (
        ("a.xyz.gz", b"no gzip"),
        ("b.xyz.bz2", bz2.compress(b"3\n")[:-4]),
        ("c.xyz.xz", b"x"),
        ("d.xyz.gz", gzip.compress(GRO.encode())[:-9]),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(StructureError, match="cannot be unpacked"):
            read_structure(tmp_path / name, [SPECIES["spce"]], None, True, TOLERANCE)


@pytest.mark.parametrize("name", ["water", "water.dat", "water.txt", "water.foo", "conf.1"])
@pytest.mark.parametrize("ending", ["gro", "xyz", "pdb", "data", "dump"])
def test_a_format_is_known_by_how_a_file_begins(name, ending, tmp_path):
    found = read(tmp_path, text_in(ending), name, cell=np.diag([14.0, 15.0, 16.0]))
    assert len(found.species) == 4


@pytest.mark.parametrize(
    ("name", "model"),
    [
        ("SOD", "na_spce"),
        ("POT", "k_spce"),
        ("CES", "cs_spce"),
        ("CLA", "cl_spce"),
        ("LIT", "li_spce"),
    ],
)
@pytest.mark.parametrize("named", [False, True])
def test_ions_by_the_names_of_charmm(name, model, named, tmp_path):
    ion = load_model(model)
    truth = Truth(["spce", ion, "spce", ion], 30)
    if named:
        ion = dataclasses.replace(ion, residue_names=("ION",))
    rows = [(name if k % 2 else n, e, k, x, v) for n, e, k, x, v in truth.atoms()]
    text = gro(
        rows,
        box_of(truth.cell),
        6,
        residue_names={1: "ION" if named else name, 3: "ION" if named else name},
    )
    same_molecules(
        read(tmp_path, text, "a.gro", ["spce", ion]), truth, [SPECIES["spce"], ion], 1e-4
    )
    lines = pdb(rows, cryst1(truth.cell), element_column=False, residue=name).splitlines()
    lines = [
        line if name in line[12:16] else line.replace(f" {name} A", " SOL A") for line in lines
    ]
    same_molecules(
        read(tmp_path, "\n".join(lines), "a.pdb", ["spce", ion]),
        truth,
        [SPECIES["spce"], ion],
        2e-3,
    )


def test_an_atom_of_any_name_in_the_residue_of_a_point(tmp_path):
    bead = molecule(
        "bead", (Site(name="B1", mass_u=72.0, position_A=(0.0, 0.0, 0.0)),), residue_names=("W",)
    )
    truth = Truth([bead] * 3 + ["argon"], 31)
    rows = [("SC5" if k < 3 else n, e, k, x, v) for n, e, k, x, v in truth.atoms()]
    text = gro(rows, box_of(truth.cell), 6, residue_names={0: "W", 1: "W", 2: "W", 3: "AR"})
    found = read(tmp_path, text, "a.gro", [bead, "argon"])
    assert found.species.tolist() == [0, 0, 0, 1]


# sites without mass or element, and names, in formats that ASE reads


def as_gen(rows, cell) -> str:
    kinds = list(dict.fromkeys(name for name, _ in rows))
    lines = [
        f"{k} {kinds.index(name) + 1} {x} {y} {z}" for k, (name, (x, y, z)) in enumerate(rows, 1)
    ]
    edges = "\n".join(" ".join(map(str, edge)) for edge in cell)
    return "\n".join([f"{len(rows)} S", " ".join(kinds), *lines, "0 0 0", edges, ""])


def as_g96(rows, cell, velocity=None) -> str:
    def block(name, vectors):
        rows_of = [
            f"{1:5d} MIX   {atom:<5}{k + 1:7d}{''.join(f'{v:15.9f}' for v in vector)}"
            for k, ((atom, _), vector) in enumerate(zip(rows, vectors, strict=True))
        ]
        return "\n".join([name, *rows_of, "END"])

    parts = ["TITLE\nwater\nEND", block("POSITION", [np.array(x) / 10 for _, x in rows])]
    parts += [] if velocity is None else [block("VELOCITY", np.array(velocity) / 10)]
    return "\n".join([*parts, f"BOX\n{''.join(f'{x:15.9f}' for x in np.diag(cell) / 10)}\nEND\n"])


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
    same_molecules(read(tmp_path, text, file, ("tip4p2005",)), truth, [SPECIES["tip4p2005"]], 1e-4)


@pytest.mark.parametrize("file", FORMATS)
def test_deuterium_in_formats_that_know_elements(file, tmp_path):
    truth = Truth(["spce"] * 3, 41)
    text = FORMATS[file](
        [(e.replace("H", "D"), tuple(x)) for _, e, _, x, _ in truth.atoms()], truth.cell
    )
    same_molecules(read(tmp_path, text, file), truth, [SPECIES["spce"]], 1e-4)


@pytest.mark.parametrize("file", ["a.g96", "CONFIG", "conf"])
def test_ions_by_names_in_formats_of_force_fields(file, tmp_path):
    """NA is not a nitrogen, and CL no carbon."""
    truth = Truth(["sodium", "chloride", "spce", "sodium"], 42)
    rows = [(name.upper(), tuple(x)) for name, _, _, x, _ in truth.atoms()]
    text = FORMATS.get(file, as_g96)(rows, truth.cell)
    species = [SPECIES[name] for name in ("sodium", "chloride", "spce", "nitrogen")]
    same_molecules(read(tmp_path, text, file, species), truth, species, 1e-4)


def test_velocities_and_frames_of_g96(tmp_path):
    truths = [Truth(["spce"] * 3, seed) for seed in (43, 44)]
    texts = []
    for truth in truths:
        atoms = truth.atoms()
        rows = [(name, tuple(x)) for name, _, _, x, _ in atoms]
        texts.append(as_g96(rows, truth.cell, [v for *_, v in atoms]))
    text = texts[0] + "TIMESTEP\n 5 0.01\nEND\n" + texts[1].replace("TITLE\nwater\nEND\n", "")
    with pytest.raises(StructureError, match="holds 2 structures"):
        read(tmp_path, text, "a.g96")
    for frame, truth in ((1, truths[0]), (2, truths[1])):
        found = read(tmp_path, text, "a.g96", frame=frame)
        partner = same_molecules(found, truth, [SPECIES["spce"]], 1e-4)
        assert found.velocity == pytest.approx(truth.velocity[partner], abs=1e-4)
    for old, new, message in (
        ("BOX", "BOX\n1 2 3 4", "expected the box, 3 or 9 numbers"),
        (
            "    1 MIX   OW         1",
            "    1                   ",
            "expected residue number, residue name, atom name",
        ),
        ("END\nBOX", "BOX", "three numbers of VELOCITY from column 25"),
    ):
        with pytest.raises(StructureError, match=message):
            read(tmp_path, texts[0].replace(old, new), "a.g96")
    with pytest.raises(StructureError, match="its block POSITION has no END: truncated"):
        read(tmp_path, texts[0][: texts[0].index("END\nVEL")], "a.g96")
    with pytest.raises(
        StructureError,
        match="names an atom Zz, but ASE, which reads this format, knows elements only",
    ):
        read(tmp_path, as_gen([("Zz", (0, 0, 0))], np.diag([9.0] * 3)), "a.gen")


# damage


def cut(text, lines):
    return "\n".join(text.splitlines()[:lines]) + "\n"


WATERS = Truth(["spce"] * 4)
GRO = gro(WATERS.atoms(), box_of(WATERS.cell))
DAMAGED = {
    "cut.gro": (cut(GRO, 8), r"line 2 promises 12 atoms and a box, 5 are there: truncated\?"),
    "cut_in_line.gro": (
        cut(GRO, 13) + GRO.splitlines()[13][:30] + "\n1 1 1\n",
        r"line 14: expected an atom of a .gro",
    ),
    "no_number.gro": (
        GRO.replace("\n12\n", "\ntwelve\n"),
        r"line 2: expected the number of atoms, found 'twelve'",
    ),
    "too_few.gro": (
        GRO.replace("\n12\n", "\n11\n"),
        r"line 14: expected the box, 3 or 9 numbers .is the number of atoms right",
    ),
    "no_box.gro": (cut(GRO, 14), r"promises 12 atoms and a box, 11 are there"),
    "box.gro": (
        cut(GRO, 14) + "1.4 1.5\n",
        r"line 15: expected the box, 3 or 9 numbers .*found '1.4 1.5'",
    ),
    "nan.gro": (
        GRO.replace(GRO.splitlines()[4][20:28], "     nan"),
        r"atom 3 has a position that is not a finite",
    ),
    "nan_box.gro": (
        cut(GRO, 14) + "1.4 nan 1.4\n",
        r"its box has an edge that is not a finite number",
    ),
    "empty.gro": ("", "holds no atoms"),
    "cut.pdb": (
        cryst1(WATERS.cell) + "\nATOM      1  O   HOH A   1       1.000   2.0\n",
        "line 2: expected an atom of a .pdb",
    ),
    "edges_only.pdb": (
        "CRYST1   14.000   15.000   16.000\n" + pdb(WATERS.atoms(), ""),
        "line 1: CRYST1 needs three",
    ),
    "alternate.pdb": (
        "ATOM      1  O  AHOH A   1       1.000   2.000   3.000\nATOM      2  O  BHOH A   1       1.000   2.000   3.100\n",
        "alternate locations A, B",
    ),
    "empty.pdb": ("END\n", "holds no atoms"),
    "cut.xyz": (cut(xyz(WATERS.atoms(), WATERS.cell), 9), "line 1 promises 12 atoms, 7 are there"),
    "lattice.xyz": (
        '3\nLattice="9 0 0 0 9 0 0"\nO 0 0 0\nH 0 0 0\nH 0 0 0\n',
        "line 2: expected nine numbers of Lattice",
    ),
    "columns.xyz": (
        "1\nProperties=species:S:1:pos:R:3:vel:R:3\nO 0 0 0\n",
        "line 3: expected 7 columns, species:S:1",
    ),
    "decimals.xyz": (
        "1\n\nO 0,1 0,2 0,3\n",
        "line 3: expected an atom of an .xyz: name, x, y, z, found",
    ),
    "nameless.xyz": (
        '1\nLattice="9 0 0 0 9 0 0 0 9" Properties=pos:R:3\n0 0 0\n',
        "has no atoms with mass",
    ),
    "empty.cif": (" \n", "holds no atoms: it is empty"),
    "words.xyz": (
        "3\n\nO a b c\nH 0 0 0\nH 0 0 0\n",
        "line 3: expected an atom of an .xyz: .* found 'a b c'",
    ),
    "cut.data": (
        cut(lammps(WATERS, "x", 1.0), 24),
        r"line 3 promises 12 atoms, 7 are there: truncated\?",
    ),
    "no_masses.data": (lammps(WATERS, "x", 1.0).replace("Masses", "Madness"), "no section Masses"),
    "cut.cif": (cut(cif(), 8), "holds no atoms"),
    "cut_in_atoms.cif": (
        cif()[:-12],
        r"line 9: this is not valid CIF: Wrong number of values in loop _atom_site",
    ),
    "binary.gro": ("\x00\x01", "line 2: expected the number of atoms"),
    "strange.foo": ("x", "format is unknown to ASE"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_files_get_a_message(name, tmp_path):
    text, message = DAMAGED[name]
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text, name)


def test_titles_in_any_encoding(tmp_path):
    (tmp_path / "a.gro").write_bytes(GRO.replace("t\n", "Gefrierpunkt 0 °C\n", 1).encode("latin-1"))
    assert (
        len(read_structure(tmp_path / "a.gro", [SPECIES["spce"]], None, True, TOLERANCE).species)
        == 4
    )
    (tmp_path / "a.gro").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(StructureError, match="line 2: expected the number of atoms"):
        read_structure(tmp_path / "a.gro", [SPECIES["spce"]], None, True, TOLERANCE)


@pytest.mark.parametrize(("unit", "angstrom"), [("nm", 10.0), ("bohr", 0.529177210903)])
def test_coordinates_in_other_units(unit, angstrom, tmp_path):
    truth = Truth(["spce"] * 8, 16)
    atoms = [(name, e, k, x / angstrom, v) for name, e, k, x, v in truth.atoms()]
    with pytest.raises(StructureError, match=f"seem to be in {unit}, not in Å"):
        read(tmp_path, xyz(atoms, truth.cell / angstrom), "a.xyz")


def test_species_that_the_scene_lacks(tmp_path):
    truth = Truth(["spce", "nitrogen", "spce", "argon"], 17)
    with pytest.raises(
        StructureError,
        match=r"atoms named Ar, N, which are in no molecule of the scene: spce \(O H2\)",
    ):
        read(tmp_path, xyz(truth.atoms(), truth.cell), "a.xyz")
    text = gro(truth.atoms(), box_of(truth.cell), residue_names={1: "N2", 3: "AR"})
    with pytest.raises(
        StructureError,
        match=r"molecule 2 \(atoms 4 to 5, residue 'N2'\) has atoms N2, expected spce",
    ):
        read(tmp_path, text, "a.gro")


@pytest.mark.parametrize("file_model", ["spce", "tip4p2005"])
def test_of_two_species_the_one_that_fits_is_taken(file_model, tmp_path):
    """Both fit within the tolerance; the massless site is not in the file."""
    truth = Truth([file_model] * 3, 18)
    text = xyz(truth.atoms(massless=False), truth.cell)
    found = read(tmp_path, text, "a.xyz", ["spce", "tip4p2005"])
    same_molecules(found, truth, [SPECIES["spce"], SPECIES["tip4p2005"]], 1e-6)
    other = {"spce": "tip4p2005", "tip4p2005": "spce"}[file_model]
    assert (
        f"3 molecules taken for {file_model} and not {other}, which fits less well" in found.notes
    )


@pytest.mark.parametrize("stretch", [1.0, 1.03])
def test_like_species_need_residue_names(stretch, tmp_path):
    """Two models of one geometry, and a geometry between those of two models."""
    other = dataclasses.replace(SPECIES["tip4p2005"], name="tip4p_ice", residue_names=())
    species = (
        [SPECIES["tip4p2005"], other] if stretch == 1.0 else [SPECIES["spce"], SPECIES["tip4p2005"]]
    )
    truth = Truth(["tip4p2005"] * 3, 18)
    atoms = truth.atoms(massless=False)
    if stretch != 1.0:
        means = [
            0.5 * (a + b) for a, b in zip(*(m.positions_body[:3] for m in species), strict=True)
        ]
        atoms = [
            (n, e, k, truth.centre[k] + truth.rotation[k] @ means[i % 3], v)
            for i, (n, e, k, _, v) in enumerate(atoms)
        ]
    with pytest.raises(
        StructureError,
        match=r"molecule 1 .atoms 1 to 3, .* may be .* or .*: give them residue_names",
    ):
        read(tmp_path, xyz(atoms, truth.cell), "a.xyz", species)


def test_nothing_is_printed_or_warned(tmp_path, capsys, recwarn):
    truth = Truth(["tip4p2005"] * 3, 19)
    for ending, text in {
        "pdb": pdb(truth.atoms(), cryst1(truth.cell), element_column=False),
        "xyz": xyz(truth.atoms(), truth.cell, NAMES[0]),
        "data": lammps(WATERS, "x", 1.0),
    }.items():
        read(tmp_path, text, f"a.{ending}", ["tip4p2005"])
    assert capsys.readouterr() == ("", "")
    assert not recwarn.list


# molecules from files


def co2_in(form: str, decimals: int, bend: float, seed: int) -> str:
    """Carbon dioxide in any orientation, its carbon at this distance (Å) from the line of the
    oxygens, with these decimals of Å."""
    x = np.array([[-1.16, 0, 0], [0, bend, 0], [1.16, 0, 0]])
    x = x @ random_rotations(np.random.default_rng(seed), 1)[0].T + np.sqrt([2.0, 3.0, 5.0])
    atoms = list(zip("OCO", x, strict=True))
    if form == "gro":
        width = decimals + 6
        rows = [
            f"    1CO2  {e:>5}{k:5d}{''.join(f'{u / 10:{width}.{decimals + 1}f}' for u in p)}"
            for k, (e, p) in enumerate(atoms, 1)
        ]
        return "\n".join(["co2", "    3", *rows, "   5.0   5.0   5.0", ""])
    if form == "pdb":
        return (
            "".join(
                f"ATOM  {k:5d}  {e}   CO2     1    {''.join(f'{u:8.3f}' for u in p)}\n"
                for k, (e, p) in enumerate(atoms, 1)
            )
            + "END\n"
        )
    rows = [f"{e} {' '.join(f'{u:.{decimals}f}' for u in p)}" for e, p in atoms]
    if form == "mmcif":
        columns = ("type_symbol", "Cartn_x", "Cartn_y", "Cartn_z")
        return "\n".join(["data_x", "loop_", *(f"_atom_site.{c}" for c in columns), *rows, ""])
    if form == "data":
        rows = [f"{k} {'OC'.index(r[0]) + 1} {r[2:]}" for k, r in enumerate(rows, 1)]
        head = "units = real\n\n3 atoms\n2 atom types\n\nMasses\n\n1 15.999\n2 12.011\n\n"
        return "\n".join([head + "Atoms # atomic\n", *rows, ""])
    return "\n".join(["3", "co2", *rows, ""])


def species_in(tmp_path, text: str, form: str) -> Molecule:
    (tmp_path / f"co2.{form}").write_text(text)
    sites = [{"name": e, "sigma_A": 2.8, "epsilon_K": 30.0} for e in "CO"]
    molecules = [{"name": "co2", "file": f"co2.{form}", "count": 4, "sites": sites}]
    [kind] = species_of(small_scene({}, 30.0, tmp_path, molecules=molecules))
    return kind


@pytest.mark.parametrize(
    ("form", "decimals"),
    [
        *(("xyz", n) for n in (2, 3, 4, 5, 8)),
        *(("gro", 2), ("gro", 3), ("pdb", 3), ("mmcif", 3), ("data", 2), ("data", 3)),
    ],
)
def test_molecules_are_linear_up_to_the_decimals_of_their_file(form, decimals, tmp_path):
    kinds = [species_in(tmp_path, co2_in(form, decimals, 0.0, seed), form) for seed in range(5)]
    for kind in kinds:
        assert kind.kind == "linear"
        assert np.ptp(kind.positions_body[:, 0]) == pytest.approx(2.32, abs=2 * 10.0**-decimals)
    notes = " ".join(note for kind in kinds for note in kind.reading)
    assert (f"to the {10.0**-decimals:g} Å of its coordinates" in notes) == (decimals < 5)


@pytest.mark.parametrize(
    ("form", "decimals", "bend"),
    [("xyz", 2, 0.03), ("xyz", 3, 0.003), ("xyz", 4, 0.003), ("gro", 2, 0.03), ("pdb", 3, 0.003)],
)
def test_bent_molecules_stay_bent(form, decimals, bend, tmp_path):
    """Three times the unit of the last digit: the decimals of the file show it."""
    for seed in range(4):
        kind = species_in(tmp_path, co2_in(form, decimals, bend, seed), form)
        assert kind.kind == "asymmetric"
        assert not kind.reading
        assert any(
            "co2 is nearly linear: its atoms are" in text for text in molecule_warnings(kind)
        )
    with pytest.raises(SceneError, match=r"nothing resists its torque .* Put it on the line"):
        text = co2_in("xyz", 8, 0.0002, 1)
        species_in(tmp_path, text, "xyz")


def test_few_decimals_do_not_make_a_molecule_linear(tmp_path):
    """The unit of the last digit is near the size of the molecule."""
    kind = species_in(tmp_path, "3\n\nO -1.2 0.0 0.0\nC 0.0 0.1 0.0\nO 1.2 0.0 0.0\n", "xyz")
    assert kind.kind == "asymmetric"
    assert not any("nearly linear" in text for text in molecule_warnings(SPECIES["spce"]))


def test_a_damaged_byte_of_a_traj_is_told(tmp_path):
    """ASE looks at atomic numbers when their symbols are needed."""
    path = tmp_path / "a.traj"
    ase.io.write(path, ase.Atoms("Ar3", np.eye(3), cell=[9, 9, 9], pbc=True))
    content = bytearray(path.read_bytes())
    at = content.index(np.full(3, 18).tobytes())
    for byte, number in ((0, 200), (1, 1), (7, 0xFF)):
        path.write_bytes(bytes([*content[: at + byte], number, *content[at + byte + 1 :]]))
        with pytest.raises(StructureError, match="an atomic number is that of no element"):
            read_atoms(path)


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
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text, "a.xyz", ["argon"])


def test_a_poscar_without_elements_names_the_line(tmp_path):
    text = "made by hand\n1.0\n9 0 0\n0 9 0\n0 0 9\n2\nDirect\n0 0 0\n.5 .5 .5\n"
    with pytest.raises(
        StructureError, match="POSCAR: line 6: expected the symbols of its elements"
    ):
        read(tmp_path, text, "POSCAR", ["argon"])
    assert len(read(tmp_path, text.replace("2\n", "Ar\n2\n", 1), "POSCAR", ["argon"]).species) == 2


def test_a_column_that_a_dump_names_twice(tmp_path):
    truth = Truth(["tip4p2005"] * 2, 12)
    text = dump_of(truth, "id element x y z").replace("element x y z", "element x y z x id")
    with pytest.raises(StructureError, match="line 9: names the column id, x twice"):
        read(tmp_path, text, "a.lammpstrj", ["tip4p2005"])


# what a file states and what is not used


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
    with pytest.raises(StructureError, match="ASE reads 0 of its 1 structures: is the key Prop"):
        read(tmp_path, text, "a.xyz", ["argon"])


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


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            "Atom Type Labels\n\n1 O 5\n2 H\n\nMasses",
            "expected a type and its label, found '1 O 5'",
        ),
        ("Velocities\n\n77 1 0 0\n\nMasses", "expected the velocities of an atom of the file"),
    ],
)
def test_rows_of_lammps_data_that_belong_to_nothing(section, message, tmp_path):
    text = lammps(Truth(["spce", "argon"], 12), "x, units = real", 1.0)
    with pytest.raises(StructureError, match=message):
        read(tmp_path, text.replace("Masses", section, 1), "a.data", ["spce", "argon"])
