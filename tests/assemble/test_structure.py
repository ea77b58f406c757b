"""The start of a run from a structure file: reference files, boxes, velocities, states of other runs."""

import dataclasses
from math import inf
from pathlib import Path

import ase
import ase.build
import ase.io
import numpy as np
import pytest
from support.common import ROOT, refused, small_scene
from support.structures import (
    NAMES,
    ROUND_CELLS,
    SPECIES,
    TOLERANCE,
    WATERS,
    Truth,
    cif,
    cryst1,
    gro,
    lammps,
    pdb,
    read,
    same_molecules,
    unreadable,
    wrapped,
    xyz,
)

from rigidmd.assemble.build import build
from rigidmd.assemble.structure import read_structure
from rigidmd.core.state_file import write_state
from rigidmd.errors import SceneError, StructureError
from rigidmd.io.trajectory_file import TrajectoryFile, write_topology
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model
from rigidmd.units import GRAM_PER_CM3

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


def test_a_rotated_cell_rotates_velocities_too(tmp_path):
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
    partner = same_molecules(found, truth, 1e-6, species)
    assert found.velocity == pytest.approx(truth.velocity[partner], abs=1e-5)
    lab = np.einsum("nij,nj->ni", found.rotation, found.angular_momentum_body)
    true = np.einsum("nij,nj->ni", truth.rotation, truth.angular_momentum_body())[partner]
    assert lab == pytest.approx(true, abs=1e-4)


def test_what_was_made_of_a_cell_is_reported(tmp_path):
    truth = Truth(["spce"] * 4, 5)
    text = xyz(truth.wrapped(), truth.cell * [[1], [1], [-1]])
    assert any("left-handed: -c replaces c" in note for note in read(tmp_path, text, "a.xyz").notes)
    nearly = truth.cell.copy()
    nearly[2, 0] = 1e-5 * nearly[2, 2]
    told = read(tmp_path, xyz(truth.wrapped(), nearly), "b.xyz").notes
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


def test_a_cell_with_space_for_a_cutoff_is_found(tmp_path):
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


@pytest.mark.parametrize("kind", ROUND_CELLS)
@pytest.mark.parametrize("edge", [16.0, 18.4217])
def test_round_boxes_keep_their_cells_in_all_formats(kind, edge, tmp_path):
    """Whatever digits a file has: lengths and angles to 0.01 degrees, vectors to 3, 5 or 8
    digits."""
    cell = edge * np.array(ROUND_CELLS[kind])
    truth = Truth(["spce"] * 4, 6, cell=cell)
    plain = truth.ase()
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
        same_molecules(found, truth, 0.03)


def standard_turn(seed):
    """A rotation drawn at random."""
    return random_rotations(np.random.default_rng(seed), 1)[0]


def pair_distances(position, cell):
    """Sorted distances of nearest images in a cell that tilts little."""
    i, j = np.triu_indices(len(position), 1)
    d = (position[i] - position[j]) @ np.linalg.inv(cell)
    return np.sort(np.linalg.norm((d - np.rint(d)) @ cell, axis=1))


def test_velocities_of_some_atoms(tmp_path):
    truth = Truth(["tip4p2005"] * 5, 9)

    def lines(drop):
        text = truth.gro(velocities=True).splitlines()
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
    unreadable(
        r"occupied only partly \(H1 0.5\): the crystal is disordered", tmp_path, cif(0.5), "ice.cif"
    )


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
    unreadable(r"has no box.*give \[box\] lengths_A, or periodic = false", tmp_path, text, "a.gro")
    found = read(tmp_path, text, "a.gro", cell=np.diag([14.0, 15.0, 16.0]))
    same_molecules(found, truth, 0.02)
    assert found.notes == ((note,) if note else ())
    assert read(tmp_path, text, "a.gro", periodic=False).cell is None


def test_placeholder_boxes(tmp_path):
    truth = Truth(["spce"] * 3, 14)
    text = pdb(truth.atoms(), cryst1(np.eye(3)))
    unreadable(r"has no box .its cell, a cube of 1 Å, stands for none", tmp_path, text, "a.pdb")
    same_molecules(read(tmp_path, text, "a.pdb", cell=np.diag([14.0, 15.0, 16.0])), truth, 0.002)


def test_the_scene_may_want_another_box_than_the_file(tmp_path):
    truth = Truth(["spce"] * 8, 15)
    text = truth.gro(truth.wrapped(), 9)
    found = read(tmp_path, text, "a.gro", cell=30 * np.eye(3))
    assert found.residual_max < 1e-6  # whole by the file's box, not the scene's
    assert found.notes == ("the box of the scene is used, not the box of the file",)
    assert np.diag(found.cell) == pytest.approx(30)


def test_a_slab_has_no_box_of_its_own(tmp_path):
    truth = Truth(["spce"] * 2)
    text = truth.xyz().replace('Lattice="', 'pbc="T T F" Lattice="')
    unreadable(r"has no box .its cell is periodic along a, b only", tmp_path, text, "a.xyz")


@pytest.mark.parametrize(("unit", "angstrom"), [("nm", 10.0), ("bohr", 0.529177210903)])
def test_coordinates_in_other_units(unit, angstrom, tmp_path):
    truth = Truth(["spce"] * 8, 16)
    atoms = [(name, e, k, x / angstrom, v) for name, e, k, x, v in truth.atoms()]
    unreadable(
        f"seem to be in {unit}, not in Å", tmp_path, xyz(atoms, truth.cell / angstrom), "a.xyz"
    )


def test_nothing_is_printed_or_warned(tmp_path, capsys, recwarn):
    truth = Truth(["tip4p2005"] * 3, 19)
    for ending, text in {
        "pdb": truth.pdb(element_column=False),
        "xyz": truth.xyz(names=NAMES[0]),
        "data": lammps(WATERS, "x", 1.0),
    }.items():
        read(tmp_path, text, f"a.{ending}", ["tip4p2005"])
    assert capsys.readouterr() == ("", "")
    assert not recwarn.list


def structure_scene(tmp_path, text, name="start.gro", extra="", models=("spce",)):
    (tmp_path / name).write_text(text)
    species = "".join(f'[[molecules]]\nmodel = "{model}"\n' for model in models)
    return f'{species}{extra}[structure]\nfile = "{name}"\n[forces]\ncutoff_A = 5.0\n[start]\ntemperature_K = 300\n[[stages]]\nduration_ps = 0.01\n'


WATER216 = (ROOT / "systems" / "structures" / "water216.gro").read_text()


def lines_changed(change):
    lines = WATER216.splitlines()
    change(lines)
    return "\n".join(lines) + "\n"


def truncate(lines):
    del lines[400:]


def rename(lines):
    lines[2:5] = [
        line.replace("SOL", "ETH").replace("OW", "C1").replace("HW1", "C2") for line in lines[2:5]
    ]


def overlap(lines):
    shift = lines[2][20:44]
    lines[5] = lines[5][:20] + shift + lines[5][44:]
    for k in (1, 2):
        lines[5 + k] = lines[5 + k][:20] + lines[2 + k][20:44] + lines[5 + k][44:]


def bend(lines):
    lines[3] = lines[3][:20] + "   5.000   5.000   5.000" + lines[3][44:]


def wild_velocity(lines):
    lines[10] = lines[10][:44] + "     nan  0.0000  0.0000"


def nonsense(lines):
    lines[10] = lines[10][:20] + "     nan   0.000   0.000" + lines[10][44:]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (truncate, ["promises 648 atoms", "truncated"]),
        (rename, ["molecule 1", "'ETH'", "C2 H", "expected spce (O H2)"]),
        (overlap, ["molecules 1 and 2 overlap"]),
        (bend, ["molecule 1", "is not spce", "from the rigid template"]),
        (wild_velocity, ["atom 9", "a velocity that is not a finite number"]),
        (nonsense, ["atom 9", "not a finite number"]),
    ],
)
def test_a_bad_structure_file(change, expected, capsys, tmp_path):
    message = refused(capsys, tmp_path, structure_scene(tmp_path, lines_changed(change)))
    for part in ["start.gro", *expected]:
        assert part in message


@pytest.mark.parametrize(("share", "code"), [(0.59, 2), (0.61, 0)])
def test_sites_overlap_within_six_tenths_of_their_diameter(share, code, printed, tmp_path):
    sigma = load_model("argon").sigma[0]
    (tmp_path / "two.xyz").write_text(
        f"2\n\nAr 5.0 5.0 5.0\nAr {5.0 + share * sigma:.9f} 5.0 5.0\n"
    )
    (tmp_path / "two.toml").write_text(
        "box.lengths_A = 20.0\nforces.cutoff_A = 8.0\nstructure.file = 'two.xyz'\n"
        "start.temperature_K = 90.0\n[[molecules]]\nmodel = 'argon'\n[[stages]]\nduration_ps = 0.01\n"
    )
    assert (
        "molecules 1 and 2 overlap" in printed("check", tmp_path / "two.toml", code=code).err
    ) == (code == 2)


def test_the_box_of_the_scene_counts_for_a_saved_state_too(tmp_path):
    Simulation(small_scene({"argon": 20}, 20.0), tmp_path / "out").run()
    for box, edge in (({}, 20.0), ({"lengths_A": 40.0}, 40.0), ({"periodic": False}, np.inf)):
        data = small_scene({"argon": 20}, 20.0).model_dump() | {
            "box": box,
            "structure": {"file": "final.npz"},
        }
        assert build(Scene.from_dict(data, tmp_path / "out")).space.x == edge
    with np.load(tmp_path / "out" / "final.npz") as saved:
        good = dict(saved)
    for key, value in {
        "species": good["species"] + 5,
        "velocity": good["velocity"][:3],
        "position": good["position"] * np.nan,
    }.items():
        np.savez(tmp_path / "out" / "final.npz", **good | {key: value})
        with pytest.raises(StructureError, match=f"{key}.*: damaged"):
            build(Scene.from_dict(data, tmp_path / "out"))


def test_points_from_a_file_fit_wherever_they_are(tmp_path):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3) * 5 + rng.random((64, 3))
    atoms = "".join(
        f"{k + 1:5d}AR      AR{k + 1:5d}{x[0] / 10:8.3f}{x[1] / 10:8.3f}{x[2] / 10:8.3f}\n"
        for k, x in enumerate(grid)
    )
    (tmp_path / "ar.gro").write_text(f"argon\n64\n{atoms}   2.00000   2.00000   2.00000\n")
    data = small_scene({"argon": 64}, None).model_dump() | {
        "box": {},
        "structure": {"file": "ar.gro"},
    }
    assert len(build(Scene.from_dict(data, tmp_path)).state.position) == 64


def test_structure_files_with_other_errors(capsys, tmp_path):
    assert "count is 200" in refused(
        capsys, tmp_path, structure_scene(tmp_path, WATER216, extra="count = 200\n")
    )
    assert "may be spce or spc:" in refused(
        capsys, tmp_path, structure_scene(tmp_path, WATER216, models=("spce", "spc"))
    )
    two = "1\n\nAr 0 0 0\n" * 2
    assert "holds 2 structures" in refused(
        capsys, tmp_path, structure_scene(tmp_path, two, "two.xyz", models=("argon",))
    )
    xyz = "3\n\nO 0 0 0\nH 0.8165 0.5774 0\nH -0.8165 0.5774 0\n"
    assert "has no box" in refused(capsys, tmp_path, structure_scene(tmp_path, xyz, "a.xyz"))
    text = (
        structure_scene(tmp_path, WATER216)
        .replace("[structure]", "[structure]\nvelocities = true")
        .replace("start.gro", "b.xyz")
        .replace("[start]\ntemperature_K = 300\n", "")
    )
    (tmp_path / "b.xyz").write_text(
        '3\nLattice="20 0 0 0 20 0 0 0 20"\nO 0 0 0\nH 0.8165 0.5774 0\nH -0.8165 0.5774 0\n'
    )
    assert "lacks velocities for some atoms" in refused(capsys, tmp_path, text)
    (tmp_path / "c.npz").write_bytes(b"not a zip file")
    assert "not a state that rigidmd wrote" in refused(
        capsys, tmp_path, text.replace("b.xyz", "c.npz")
    )
