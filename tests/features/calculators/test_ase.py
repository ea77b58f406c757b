"""Scenes of ASE's atoms, and atoms of runs."""

import pickle
import tomllib

import ase.io
import numpy as np
import pytest
from ase import Atoms
from ase.build import molecule
from ase.constraints import FixAtoms, FixBondLengths
from support.ase_atoms import FORCES, NVE, OUTPUT, same_state
from support.common import ROOT, small_scene
from support.stops import contents, stopped_at

import rigidmd
from rigidmd import MolecularScene, Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.errors import RigidMDError, RigidMDWarning, SceneError, StructureError
from rigidmd.features.calculators.calculator import RigidMD
from rigidmd.formats.through_ase import EV
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run import Every
from rigidmd.scene.models import load_model
from rigidmd.units import KJ_PER_MOL


def test_atoms_of_a_run_are_its_scene_again(results, waters):
    found = build(rigidmd.scene_from_atoms(waters, "spce", forces=FORCES))
    same_state(results.state, found.state)
    assert found.freedom == results.system.freedom
    assert any("largest 0.0000 Å" in note for note in found.notes)


@pytest.mark.parametrize(
    "counts",
    [
        {"tip4p2005": 4, "nitrogen": 3, "argon": 2},
        {"tip5p": 3, "ethane_trappe": 3},
        {"acetonitrile_trappe": 4, "hf_jorgensen": 3},
    ],
)
def test_any_molecules_come_back(counts, tmp_path):
    """Massless sites, united atoms, points, linear molecules, in a triclinic cell; from memory and
    from ASE's files."""
    box = {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 100.0, 75.0]}
    system = build(small_scene(counts, None, box=box))
    atoms = rigidmd.to_atoms(system.scene)
    assert len(atoms) == (system.sites.mass > 0).sum()
    assert atoms.get_masses().sum() == pytest.approx(system.sites.mass.sum())
    settings = {"forces": {"cutoff_A": 9.0}, "stages": [NVE]}
    files = [tmp_path / name for name in ("a.traj", "a.extxyz")]
    for path in files:
        ase.io.write(path, atoms)
    for found in (atoms, *map(ase.io.read, files)):
        again = build(rigidmd.scene_from_atoms(found, list(counts), **settings))
        assert [m.name for m in again.species] == list(counts)
        assert (again.model.species == system.model.species).all()
        digits = (
            2e-8 if "atomtypes" in found.arrays and found is not atoms else 1e-12
        )  # those of .extxyz
        assert (
            np.abs(again.site_positions(again.state) - system.site_positions(system.state)).max()
            < digits
        )
        turning = system.model.inertia[system.model.species].all(axis=1)
        assert (
            np.abs((again.state.rotation - system.state.rotation)[turning]).max(initial=0.0)
            < 10 * digits
        )


@pytest.mark.parametrize("formula", ["SF6", "C6H6", "CH3CN", "isobutane"])
def test_sites_of_a_geometry_share_names(formula, tmp_path):
    """Atoms of ASE have no names but their elements: as template, as .cif, and as atoms, in any
    order."""
    octahedron = 1.56 * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
    one = Atoms(formula, octahedron) if formula == "SF6" else molecule(formula)
    ase.io.write(tmp_path / "m.xyz", one, plain=True)
    species = {
        "file": str(tmp_path / "m.xyz"),
        "sites": [{"name": e, "charge_e": 0.0} for e in set(one.symbols)],
    }
    rng, atoms = np.random.default_rng(3), Atoms(cell=[20, 20, 40], pbc=True)
    for k, turn in enumerate(random_rotations(rng, 3)):
        order = rng.permutation(len(one))
        atoms += Atoms(one.symbols[order], one.positions[order] @ turn.T + [10, 10, 10 + 10 * k])
    ase.io.write(tmp_path / "crystal.cif", atoms)
    for found in (atoms, ase.io.read(tmp_path / "crystal.cif")):
        system = build(rigidmd.scene_from_atoms(found, [species], forces={"cutoff_A": 6.0}))
        assert len(system.state.position) == 3
        assert np.sort(rigidmd.to_atoms(system.scene).positions, axis=0) == pytest.approx(
            np.sort(atoms.positions, axis=0), abs=1e-6
        )
        assert any("largest 0.0000 Å" in note for note in system.notes)


def test_a_scene_holds_its_atoms(waters, tmp_path):
    """No file is needed; a run in a folder has one, and repeats to the bit."""
    tables = {"forces": FORCES, "precision": "double", "stages": [NVE], "output": OUTPUT}
    made = rigidmd.scene_from_atoms(waters, ["spce"], **tables, seed=3, name="mine")
    assert isinstance(made, MolecularScene)
    assert made.seed == 3
    assert made.name == "mine"
    first = Simulation(made, tmp_path / "a").run()
    assert (tmp_path / "a" / "input_structure_atoms.xyz").is_file()
    read = Scene.read(tmp_path / "a" / "scene.toml")
    again = Simulation(read, tmp_path / "b").run()
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    for key in ("scene_sha256", "input_sha256"):
        assert first.summary[key] == again.summary[key]
    in_memory = Simulation(pickle.loads(pickle.dumps(made))).run()
    assert in_memory.state.position.tobytes() == first.state.position.tobytes()
    assert cli.main(["compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    assert made != rigidmd.scene_from_atoms(waters[:-3], ["spce"], **tables, seed=3, name="mine")


def test_a_run_of_held_atoms_continues(waters, tmp_path):
    made = rigidmd.scene_from_atoms(waters, ["spce"], forces=FORCES, stages=[NVE], output=OUTPUT)
    looks = Every(0.001, lambda moment: None)
    Simulation(made, tmp_path / "whole", observers=looks).run()
    Simulation(made, tmp_path / "parts", observers=stopped_at({13})).run()
    assert (
        Simulation(made, tmp_path / "parts", observers=[looks], resume=True).run().interrupted
        is False
    )
    assert contents(tmp_path / "whole") == contents(tmp_path / "parts")
    other = waters.copy()
    other.positions[0, 0] += 1e-12
    moved = rigidmd.scene_from_atoms(other, ["spce"], forces=FORCES, stages=[NVE], output=OUTPUT)
    with pytest.raises(RigidMDError, match=r"the file of structure\.file has changed"):
        Simulation(moved, tmp_path / "parts", resume=True).run()


def test_what_a_scene_of_atoms_is_without_being_set():
    water = molecule("H2O")
    still = rigidmd.scene_from_atoms(water, "spce")
    assert still.stages[0].ensemble == "minimise"
    assert not still.box.periodic
    assert any("largest 0.0558 Å" in note for note in build(still).notes)
    water.set_momenta(np.full((3, 3), 0.1))
    moving = rigidmd.scene_from_atoms(water, "spce")
    assert (moving.stages[0].ensemble, moving.stages[0].duration_ps) == ("nve", 1.0)
    assert moving.structure.velocities
    drawn = rigidmd.scene_from_atoms(water, "spce", start={"temperature_K": 300.0})
    assert not drawn.structure.velocities
    assert drawn.stages[0].ensemble == "nve"
    given = rigidmd.scene_from_atoms(
        water, "spce", stages=[{"ensemble": "nvt", "temperature_K": 300, "duration_ps": 10}]
    )
    assert given.stages[0].ensemble == "nvt"
    assert given.structure.velocities
    water.set_constraint([FixBondLengths([(0, 1)]), FixAtoms([0])])
    with pytest.warns(RigidMDWarning, match=r"are ignored \(FixAtoms\)"):
        rigidmd.scene_from_atoms(water, "spce")


def test_models_may_be_files_and_tables(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text((ROOT / "rigidmd" / "models" / "tip3p.toml").read_text())
    from_file = rigidmd.scene_from_atoms(molecule("H2O"), ["mine.toml"])
    heavy = rigidmd.scene_from_atoms(
        molecule("H2O"), [{"model": "tip3p", "masses_u": {"H": 2.014}}]
    )
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    light = load_model("tip3p").mass
    assert build(from_file).species[0].mass == light
    (tmp_path / "run").mkdir()
    Simulation(from_file)._write_scene(tmp_path / "run")
    (tmp_path / "mine.toml").unlink()
    assert (
        rigidmd.with_defaults(Scene.read(tmp_path / "run" / "scene.toml")).molecules[0].file
        == "input_0_mine.toml"
    )
    assert build(heavy).species[0].mass == pytest.approx(light + 2 * (2.014 - 1.008))


def broken(what: str) -> Atoms:
    """Two waters in a box that are not fit for use."""
    atoms = molecule("H2O") + molecule("H2O")
    atoms.positions[3:] += 3.0
    atoms.set_cell([20.0] * 3)
    atoms.pbc = True
    match what:
        case "nan":
            atoms.positions[4, 1] = np.nan
        case "inf":
            atoms.set_momenta(np.full((6, 3), np.inf))
        case "mixed":
            atoms.pbc = [True, True, False]
        case "flat":
            atoms.cell[2] = 0.0
        case "nan cell":
            atoms.cell[2, 2] = np.nan
        case "empty":
            atoms = atoms[:0]
        case "missing":
            atoms = atoms[:5]
        case "other":
            atoms.symbols[0] = "S"
        case "bent":
            atoms.positions[1] += 0.4
    return atoms


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("nan", r"atoms\[4\] has a position that is not a finite number"),
        ("inf", r"atoms\[0\] has a momentum that is not a finite number"),
        ("mixed", "they are periodic along a, b only: set pbc along all three axes or none"),
        (
            "flat",
            "they are periodic, but their cell is invalid: with its edges of 20, 20, 0 Å it is 0 Å thick",
        ),
        ("nan cell", "it has an edge that is not a finite number"),
        ("empty", "there are no atoms"),
        (
            "missing",
            r"molecule 2 \(atoms 4 to 5, by bonding distance\) has atoms O H, expected spce \(O H2\)",
        ),
        ("other", r"has atoms named S, which are in no molecule of the scene: spce \(O H2\)"),
        ("bent", r"molecule 1 .* is not spce: an atom is .* Å from the rigid template"),
    ],
)
def test_atoms_that_cannot_be_used_are_reported(what, said):
    atoms = broken(what)
    for use in (
        lambda: build(rigidmd.scene_from_atoms(atoms, "spce")),
        lambda: RigidMD("spce").get_potential_energy(atoms),
    ):
        with pytest.raises((SceneError, StructureError), match=f"^atoms: .*{said}"):
            use()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"models": ["spcee"]}, r"unknown model 'spcee'; did you mean spce\?"),
        ({"models": ["nowhere.toml"]}, "there is no such file"),
        ({"models": []}, "molecules: has 0 entries"),
        ({"models": [3]}, "must be a text in quotes"),
        ({"force": {}}, r"force: unknown key; did you mean forces\?"),
        ({"forces": 3}, "forces: is 3, must be a table"),
        ({"start": 3}, "start is a int, must be a dictionary"),
        ({"structure": {"file": "x.gro"}}, r"structure\.file is given by the atoms"),
        ({"molecules": []}, "molecules is given by the atoms and models"),
        (
            {"atoms": [molecule("H2O")]},
            "are of the type list, must be one ase.Atoms. ase.io.read returns a list",
        ),
        ({"stages": [{"duration_ps": 1.0}]}, r"start\.temperature_K is missing"),
    ],
)
def test_settings_that_cannot_be_used_are_reported(settings, said):
    with pytest.raises(SceneError, match=said):
        rigidmd.scene_from_atoms(**{"atoms": molecule("H2O"), "models": ["spce"]} | settings)


def test_paths_of_a_scene_begin_at_its_folder_however_it_is_used(tmp_path, monkeypatch):
    """In another folder, a table of the same name has three times the energies."""
    r = np.arange(2.6, 10.0, 0.02)
    energy, folders = (
        4.0 * ((3.4 / r) ** 12 - (3.4 / r) ** 6),
        (tmp_path / "sub", tmp_path / "other"),
    )
    for folder, factor in zip(folders, (1, 3), strict=True):
        folder.mkdir()
        np.savetxt(folder / "t.csv", np.c_[r, factor * energy])
        (folder / "mine.toml").write_text((ROOT / "rigidmd" / "models" / "argon.toml").read_text())
    text = (
        '[box]\nlengths_A = 20.0\n[[molecules]]\nfile = "mine.toml"\ncount = 8\n[forces]\nlennard_jones = false\n'
        'cutoff_A = 9.0\n[[forces.custom]]\nname = "mine"\ntable = "t.csv"\n[start]\ntemperature_K = 90.0\n'
        "[[stages]]\nduration_ps = 0.004\n"
    )
    text = f'precision = "double"\n{text}'
    (folders[0] / "s.toml").write_text(text)
    atoms = Atoms("Ar2", positions=[[0, 0, 0], [0, 0, 3.8]], cell=[20] * 3, pbc=True)
    table = {
        "custom": [{"name": "mine", "table": "t.csv"}],
        "lennard_jones": False,
        "cutoff_A": 9.0,
    }
    monkeypatch.chdir(folders[0])
    scenes = [Scene.read("s.toml"), Scene.from_dict(tomllib.loads(text))]
    calculators = [RigidMD(scenes[0]), RigidMD("argon", **table)]
    from_atoms = rigidmd.scene_from_atoms(
        atoms, "mine.toml", forces=table, start={"temperature_K": 90.0}
    )
    expected = Simulation(scenes[0]).observation.potential
    monkeypatch.chdir(tmp_path)
    scenes += [Scene.read("sub/s.toml"), Scene.read("other/../sub/s.toml")]
    calculators += [RigidMD(scene) for scene in scenes[2:]]
    monkeypatch.chdir(folders[1])
    at_3_8 = 4.0 * ((3.4 / 3.8) ** 12 - (3.4 / 3.8) ** 6)
    at_9 = 4.0 * ((3.4 / 9) ** 12 - (3.4 / 9) ** 6)
    for calculator in calculators:
        atoms.calc = calculator
        found = atoms.get_potential_energy() * EV / KJ_PER_MOL
        assert found == pytest.approx(at_3_8 - at_9, rel=1e-4)
    for scene in scenes:
        assert Simulation(scene).observation.potential == pytest.approx(expected, rel=1e-12)
    assert Simulation(from_atoms).observation.potential == pytest.approx(at_3_8 - at_9, rel=1e-4)
