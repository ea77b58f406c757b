"""rigidmd and ASE: scenes of atoms, atoms of runs, a calculator, trajectories."""

import contextlib
import pickle
import subprocess
import sys
import tomllib
import warnings
from importlib.metadata import EntryPoint

import ase.io
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators import acn, tip3p, tip4p
from ase.calculators.fd import calculate_numerical_forces
from ase.constraints import FixAtoms, FixBondLengths
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from support.ase_models import SAME_COULOMB, ase_sites
from support.common import ROOT, small_scene
from support.scenes import FORTY_WATERS, forty_waters
from support.stops import contents, same_after_stops, stopped_at

import rigidmd
from rigidmd import BodyScene, MolecularScene, Scene, Simulation
from rigidmd.ase import TABLES, WITHOUT_ENERGIES, RigidMD
from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.errors import OutputError, RigidMDError, RigidMDWarning, SceneError, StructureError
from rigidmd.formats.through_ase import EV, TrajFile, TrajReader
from rigidmd.io.trajectory import read_frames
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run import Every
from rigidmd.run.atom_forces import _transfer_matrices
from rigidmd.scene.models import load_model
from rigidmd.units import FEMTOSECOND, KJ_PER_MOL

FORCES = FORTY_WATERS["forces"]
NVE = {"duration_ps": 0.06, "timestep_fs": 2.0}
OUTPUT = {"log_interval_ps": 0.02, "trajectory_interval_ps": 0.02, "figures": False}


@pytest.fixture(scope="module")
def results():
    """A run of 40 waters without files."""
    return Simulation(Scene.from_dict(forty_waters(NVE, output=OUTPUT))).run()


@pytest.fixture(scope="module")
def waters(results) -> Atoms:
    """Its last state."""
    return results.atoms()


def cluster(model: str, n: int, seed: int = 1) -> Atoms:
    """Molecules without a box, far enough from each other."""
    return rigidmd.atoms_of(small_scene({model: n}, None, seed=seed))


def same_state(first, second) -> None:
    """Positions, rotations and momenta agree to rounding."""
    for name in ("position", "rotation", "velocity", "angular_momentum_body", "cell"):
        one, other = getattr(first, name), getattr(second, name)
        if name != "cell" or np.isfinite(one).all():
            assert np.abs(one - other).max(initial=0.0) <= 4e-14 * max(
                1.0, np.abs(one).max(initial=0.0)
            ), name


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
    """Massless sites, united atoms, points, linear molecules, in a slanted cell; from memory and
    from ASE's files."""
    box = {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 100.0, 75.0]}
    system = build(small_scene(counts, None, box=box))
    atoms = rigidmd.atoms_of(system.scene)
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
        assert np.sort(rigidmd.atoms_of(system.scene).positions, axis=0) == pytest.approx(
            np.sort(atoms.positions, axis=0), abs=1e-6
        )
        assert any("largest 0.0000 Å" in note for note in system.notes)


def test_a_scene_holds_its_atoms(waters, tmp_path):
    """No file is needed; a run in a folder has one, and repeats to the bit."""
    made = rigidmd.scene_from_atoms(
        waters, ["spce"], forces=FORCES, stages=[NVE], output=OUTPUT, seed=3, name="mine"
    )
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
    assert made != rigidmd.scene_from_atoms(
        waters[:-3], ["spce"], forces=FORCES, stages=[NVE], output=OUTPUT, seed=3, name="mine"
    )


def test_a_run_of_held_atoms_goes_on(waters, tmp_path):
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


def test_what_a_scene_of_atoms_is_without_being_told():
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
        rigidmd.resolve(Scene.read(tmp_path / "run" / "scene.toml")).molecules[0].file
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
def test_atoms_that_cannot_be_used_are_told(what, said):
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
def test_settings_that_cannot_be_used_are_told(settings, said):
    with pytest.raises(SceneError, match=said):
        rigidmd.scene_from_atoms(**{"atoms": molecule("H2O"), "models": ["spce"]} | settings)


def test_energies_do_not_depend_on_the_atoms_before():
    """Two ends of a molecule exchange positions, which the earlier assignment of atoms fits within the
    tolerance."""
    angle, charges = np.radians(124.0), (0.2, -0.3, 0.1)
    x = np.array(
        [(1.54, 0.0, 0.0), (0.0, 0.0, 0.0), (1.33 * np.cos(angle), 1.33 * np.sin(angle), 0.0)]
    )
    sites = [
        {
            "name": name,
            "element": "C",
            "mass_u": mass,
            "position_A": at,
            "charge_e": q,
            "sigma_A": 3.7,
            "epsilon_K": 90.0,
        }
        for name, mass, at, q in zip(
            ("A", "B", "C"), (15.0, 13.0, 14.0), x.tolist(), charges, strict=True
        )
    ]
    pair = ase.Atoms("C6", [*x, *(x @ [[0, 1, 0], [0, 0, 1], [1, 0, 0]] + [0.0, 3.0, 4.5])])
    exchanged = pair[[2, 1, 0, 5, 4, 3]]
    calc = RigidMD([{"name": "propene", "sites": sites}])
    energy = calc.get_potential_energy(pair)
    forces = calc.get_forces(pair)
    assert calc.get_potential_energy(exchanged) == pytest.approx(energy, rel=1e-9)
    assert calc.get_forces(exchanged) == pytest.approx(forces[[2, 1, 0, 5, 4, 3]], abs=1e-9)
    bent = pair.copy()  # continuously
    for _ in range(4):
        bent.positions[0, 2] += 0.02
        calc.get_potential_energy(bent)
    assert calc.get_potential_energy(bent) == RigidMD(
        [{"name": "propene", "sites": sites}]
    ).get_potential_energy(bent)


def test_two_models_that_fit_are_not_chosen_from():
    with pytest.raises(StructureError, match="may be spce or tip3p: give them residue_names"):
        build(rigidmd.scene_from_atoms(molecule("H2O"), ["spce", "tip3p"]))


def test_frames_of_a_run(results):
    atoms, frames = results.atoms(), results.atoms(":")
    assert [frame.info["time_ps"] for frame in frames] == pytest.approx([0.0, 0.02, 0.04, 0.06])
    assert len(results.atoms(slice(1, 3))) == len(results.atoms("1:3")) == 2
    assert (
        results.atoms("-2").info["time_ps"]
        == results.atoms(2).info["time_ps"]
        == frames[2].info["time_ps"]
    )
    for frame, energy in zip(frames, results["potential"], strict=True):
        assert frame.get_potential_energy() * EV / KJ_PER_MOL == pytest.approx(energy, rel=1e-12)
    assert (results.atoms(-1).positions == atoms.positions).all()
    kinetic = atoms.get_kinetic_energy() * EV / KJ_PER_MOL
    assert kinetic == pytest.approx(
        results["kinetic"][-1], rel=2e-8
    )  # ASE's u and eV are of CODATA 2014
    state, model = results.state, results.system.model
    mass = model.mass[model.species]
    squares = mass @ (state.velocity**2).sum(axis=1)
    # the log's kinetic energy of constant energy has no time-step error
    force = results.system.engine().evaluate(state)[0].force
    dt = results.system.scene.stages[-1].timestep_fs * FEMTOSECOND
    squares += dt**2 / 6 * ((force**2).sum(axis=1) / mass).sum()
    ideal = squares / (3 * state.volume)
    # the log's pressure contains the total momentum, which is zero
    ideal *= len(model.species) / (len(model.species) - 1)
    pressure = (ideal / EV - atoms.get_stress()[:3].mean()) / units.bar
    assert pressure == pytest.approx(results["pressure_bar"][-1], rel=1e-7)
    with pytest.raises(IndexError, match="frame 4 is out of range: this run has 4"):
        results.atoms(4)
    for wrong in (1.5, "first", "1:2:3:4", "::0", ""):
        with pytest.raises(ValueError, match="must be a number, a slice or a text"):
            results.atoms(wrong)
    body = Simulation(Scene.read(ROOT / "systems" / "dropped_stone.toml")).run()
    assert isinstance(body.system.scene, BodyScene)
    with pytest.raises(ValueError, match="a single body, which has no atoms"):
        body.atoms()


def held_rigid(n: int) -> FixBondLengths:
    """All distances within n waters."""
    return FixBondLengths(
        [(3 * m + i, 3 * m + j) for m in range(n) for i, j in ((0, 1), (0, 2), (1, 2))]
    )


@pytest.mark.parametrize(("model", "theirs"), [("tip3p", tip3p.TIP3P), ("tip4p", tip4p.TIP4P)])
def test_energies_and_forces_are_those_of_ase(model, theirs):
    """Without a box and cutoff: to rounding with ASE's constants, to the difference of constants
    with ours."""
    atoms = cluster(model, 6)
    other = atoms.copy()
    other.calc = theirs(rc=1e4)
    for entry, energy, force in ((ase_sites(model), 1e-12, 1e-11), (model, 5e-3, 1e-4)):
        atoms.set_constraint()
        other.set_constraint()
        atoms.calc = RigidMD([entry], atom_forces="sites")
        scale = np.abs(other.get_forces()).max()
        assert atoms.get_potential_energy() == pytest.approx(
            other.get_potential_energy(), rel=energy
        )
        if (
            model == "tip3p"
        ):  # the forces of each atom; ASE spreads those of M in another way with the same totals
            assert np.abs(atoms.get_forces() - other.get_forces()).max() < force * scale
        by_molecule = (atoms.get_forces() - other.get_forces()).reshape(6, 3, 3).sum(axis=1)
        assert np.abs(by_molecule).max() < force * scale
        atoms.set_constraint(held_rigid(6))
        other.set_constraint(held_rigid(6))
        close = max(force * scale, 1e-12)  # that of FixBondLengths itself
        assert np.abs(atoms.get_forces() - other.get_forces()).max() < close
        rigid = atoms.copy()
        rigid.set_constraint()
        rigid.calc = RigidMD([entry])
        assert np.abs(rigid.get_forces() - other.get_forces()).max() < close


def test_forces_are_the_gradient_of_the_energy():
    """For rigid and of bent molecules; they add up to the load on each molecule, in both forms."""
    atoms = cluster("tip4p", 4)
    rng = np.random.default_rng(4)
    for bend in (0.0, 0.02):
        atoms.positions += bend * rng.standard_normal(atoms.positions.shape)
        atoms.calc = RigidMD("tip4p", bend=0.14)
        numerical = calculate_numerical_forces(atoms, eps=1e-3)
        assert np.abs(atoms.get_forces() - numerical).max() < 1e-5 * np.abs(numerical).max()


@pytest.mark.parametrize("model", ["tip4p", "tip5p"])
def test_both_forms_have_the_force_and_torque_of_each_molecule(model):
    atoms = cluster(model, 4)
    for form in ("gradient", "sites"):
        atoms.calc = RigidMD(model, atom_forces=form)
        forces = atoms.get_forces() * EV
        placed = atoms.calc._fit_atoms(atoms)
        load, _ = placed.assembly.engine.evaluate(placed.state)
        torque = np.einsum("nij,nj->ni", placed.state.rotation, load.torque_body)
        arm = atoms.positions.reshape(4, 3, 3) - placed.state.position[:, None]
        assert (
            np.abs(forces.reshape(4, 3, 3).sum(axis=1) - load.force).max()
            < 1e-12 * np.abs(load.force).max()
        )
        found = np.cross(arm, forces.reshape(4, 3, 3)).sum(axis=1)
        assert np.abs(found - torque).max() < 1e-12 * np.abs(torque).max()


@pytest.mark.parametrize("model", ["tip4p", "tip5p", "nitrogen_trappe", "opc"])
def test_a_force_on_a_massless_site_is_spread_with_its_torque(model):
    found = load_model(model)
    heavy = found.positions_body[found.masses > 0]
    force = np.array([0.3, -1.1, 0.7])
    for site in np.flatnonzero(found.masses == 0):
        spread = _transfer_matrices(found, int(site)) @ force
        assert spread.sum(axis=0) == pytest.approx(force, abs=1e-12)
        torque = np.cross(found.positions_body[site], force)
        assert np.cross(heavy, spread).sum(axis=0) == pytest.approx(torque, abs=1e-12)
    if model == "tip4p":  # M is 0.15 Å from O along the bisector, H 0.5859 Å
        share = 0.15 / 0.585882276618295 / 2
        assert _transfer_matrices(found, 3)[:, 0, 0] == pytest.approx(
            [1 - 2 * share, share, share], abs=1e-12
        )


def strained(atoms: Atoms, strain: np.ndarray) -> float:
    """The energy after a strain (3, 3) that moves centres of mass and rotates nothing."""
    placed = atoms.calc._fit_atoms(atoms)
    system, other = placed.assembly.system, atoms.copy()
    owner = system.sites.molecule[system.sites.mass > 0]
    centre = placed.state.position @ placed.rotation
    other.set_cell(atoms.cell.array @ (np.eye(3) + strain))
    other.positions[placed.assembly.order] = (
        placed.atoms @ placed.rotation + (centre @ strain)[owner]
    )
    other.calc = atoms.calc
    return other.get_potential_energy()


def check_stress(atoms: Atoms) -> None:
    """The stress against differences of the energy."""
    found, step = atoms.get_stress(voigt=False), 1e-4
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
        strain = np.zeros((3, 3))
        strain[i, j] += step / 2
        strain[j, i] += step / 2
        slope = (
            (strained(atoms, strain) - strained(atoms, -strain)) / (2 * step) / atoms.get_volume()
        )
        assert found[i, j] == pytest.approx(slope, abs=1e-5 * np.abs(found).max())


def turned(atoms: Atoms) -> Atoms:
    """The same, rotated in space, in a slanted left-handed cell of the same lattice."""
    found, turn = atoms.copy(), random_rotations(np.random.default_rng(3), 1)[0]
    a, b, c = atoms.cell.array
    found.set_cell(np.array([a, b + a, -c]) @ turn.T)
    found.positions = atoms.positions @ turn.T
    found.wrap()
    return found


def test_stress_and_any_cell(waters):
    settings = FORCES
    waters = waters.copy()
    waters.calc = RigidMD(["spce"], **settings)
    exact = waters.get_stress(voigt=False)
    check_stress(waters)
    other = turned(waters)
    other.calc = RigidMD(["spce"], **settings)
    turn = random_rotations(np.random.default_rng(3), 1)[0]
    assert other.get_potential_energy() == pytest.approx(waters.get_potential_energy(), rel=1e-12)
    assert np.abs(other.get_forces() - waters.get_forces() @ turn.T).max() < 1e-11
    assert np.abs(other.get_stress(voigt=False) - turn @ exact @ turn.T).max() < 1e-13
    check_stress(other)


def test_rigid_molecules_are_minimised(waters):
    atoms = cluster("tip4p", 4)
    atoms.calc = RigidMD("tip4p")
    before = atoms.get_potential_energy()
    found = atoms.calc.minimise(atoms, force_limit_kJ_mol_A=1e-3, torque_limit_kJ_mol=1e-3)
    assert found["converged"]
    assert atoms.get_potential_energy() < before - 0.5
    assert np.abs(atoms.get_forces()).max() < 1e-4
    assert atoms.calc.make_rigid(atoms) < 1e-12
    with pytest.raises(
        SceneError, match=r"stages\.0\.force_limit_kJ_mol_A: is -1, must be greater than 0"
    ):
        atoms.calc.minimise(atoms, force_limit_kJ_mol_A=-1)
    with pytest.warns(RigidMDWarning, match="has not converged after 1 iterations"):
        cold = cluster("tip4p", 4)
        RigidMD("tip4p").minimise(cold, most_iterations=1)
    boxed = turned(waters)
    boxed.set_momenta(np.zeros((120, 3)))
    boxed.calc = RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch")
    before = boxed.get_positions()
    volume, distances = boxed.get_volume(), boxed.get_all_distances(mic=True)
    with pytest.warns(RigidMDWarning, match="has not converged"):
        boxed.calc.minimise(boxed, pressure_bar=1000.0, most_iterations=8)
    assert boxed.get_volume() != volume
    moved = boxed.get_all_distances(mic=True)
    assert (
        np.abs(boxed.positions - before).max() < 2.0
    )  # each atom stays in its image, across the faces of the box
    within = np.kron(np.eye(40), np.ones((3, 3))) > 0
    assert np.abs(moved - distances)[within].max() < 1e-10
    assert np.abs(moved - distances).max() > 0.1


def test_bent_molecules_are_told_once():
    atoms = molecule("H2O")
    atoms.calc = RigidMD("spce")
    with pytest.warns(
        RigidMDWarning, match=r"an atom is 0\.056 Å from its position in a rigid molecule, 6% of"
    ):
        atoms.get_potential_energy()
    atoms.rattle(0.001)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        atoms.get_potential_energy()
        assert 0.04 < atoms.calc.make_rigid(atoms) < 0.07
        assert atoms.get_distance(0, 1) == pytest.approx(1.0, abs=1e-12)
        fresh = RigidMD("spce")
        fresh.get_potential_energy(atoms)
    atoms.positions[1] += 0.3
    with pytest.raises(
        StructureError, match=r"is not spce(.|\n)*They matched before: keep the molecules rigid"
    ):
        atoms.get_potential_energy()
    atoms.positions[1] -= 0.3
    assert atoms.get_potential_energy() == pytest.approx(0.0, abs=1e-12)


def test_a_calculator_serves_other_atoms(waters):
    calc = RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch")
    pair = cluster("spce", 2)
    first = calc.get_potential_energy(pair)
    calc.get_potential_energy(waters)
    assert calc.get_potential_energy(pair) == pytest.approx(first, rel=1e-12)
    copied = pickle.loads(pickle.dumps(calc))
    assert copied.get_potential_energy(pair.copy()) == pytest.approx(first, rel=1e-12)
    assert "stress" not in calc.results
    larger = waters.copy()
    larger.set_cell(waters.cell.array * 1.5, scale_atoms=False)
    assert calc.get_potential_energy(larger) == pytest.approx(
        RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch").get_potential_energy(larger),
        rel=1e-12,
    )


def test_a_calculator_of_sites_that_share_names(waters):
    sites = [site | {"name": site["element"]} for site in load_model("spce").sites()]
    for atoms in (waters, waters[::-1]):
        energies = [
            RigidMD(models, **FORCES).get_potential_energy(atoms)
            for models in ("spce", [{"name": "w", "sites": sites}])
        ]
        assert energies[1] == pytest.approx(energies[0], rel=1e-12)


def test_a_scene_may_be_the_calculator(results, waters):
    atoms = waters.copy()
    atoms.calc = RigidMD(results.system.scene)
    assert atoms.get_potential_energy() == pytest.approx(waters.get_potential_energy(), rel=1e-12)
    with pytest.raises(SceneError, match="set by the scene"):
        RigidMD(results.system.scene, cutoff_A=5.0)
    with pytest.raises(SceneError, match="is of a single body"):
        RigidMD(Scene.read(ROOT / "systems" / "heavy_top_1.toml"))


@pytest.mark.parametrize("value", [0.0, 0.3, 0.7, 1.0])
def test_a_calculator_scales_the_species_of_coupling(value):
    molecules = [{"model": "spce", "count": 12}, {"model": "argon", "name": "solute", "count": 1}]
    scene = small_scene(
        {},
        15.0,
        molecules=molecules,
        forces={"cutoff_A": 6.0, "electrostatics": "pme"},
        coupling={"species": "solute", "lambda": value},
    )
    simulation = Simulation(scene)
    atoms = simulation.atoms()
    atoms.calc = RigidMD(scene)
    energy = atoms.get_potential_energy() * EV / KJ_PER_MOL
    assert energy == pytest.approx(simulation.observation.potential, rel=1e-6)


def test_every_table_of_a_scene_is_used_by_a_calculator_or_has_no_energy():
    assert {*TABLES, *WITHOUT_ENERGIES} == {*MolecularScene.model_fields}


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        ({"cutof_A": 5.0}, r"unknown keyword cutof_A; did you mean cutoff_A\?"),
        ({"atom_forces": "all"}, "must be 'gradient' or 'sites'"),
        ({"bend": 0.5}, "must be 0 < bend <= tolerance < 1"),
    ],
)
def test_keywords_of_a_calculator_are_checked(keywords, said):
    with pytest.raises(SceneError, match=said):
        RigidMD("spce", **keywords)


def test_ase_moves_what_it_holds_rigid():
    """ASE's dynamics with ASE's constraints conserves the energy."""
    atoms = cluster("tip4p", 4)
    atoms.calc = RigidMD("tip4p")
    atoms.calc.minimise(atoms)
    atoms.set_constraint(held_rigid(4))
    thermalize_momenta(atoms, temperature_K=100, rng=np.random.default_rng(1))
    dynamics, energies = VelocityVerlet(atoms, 0.5 * units.fs), []
    dynamics.attach(lambda: energies.append(atoms.get_total_energy()))
    dynamics.run(20)
    assert np.ptp(energies) < 1e-3 * atoms.get_kinetic_energy()
    assert atoms.calc._fit_atoms(atoms).bent < 1e-10


@pytest.fixture(scope="module")
def traj(tmp_path_factory):
    """A run whose trajectory is ASE's: the folder, its results and the states of its frames."""
    folder, states, present = tmp_path_factory.mktemp("traj") / "run", [], []
    output = OUTPUT | {"trajectory": "trajectory.traj"}
    made = small_scene(
        {"tip4p2005": 4}, 14.0, forces=FORCES, stages=[{"duration_ps": 0.06}], output=output
    )
    seen = []

    def look(moment):
        states.append(moment.state.copy())
        present.append(simulation.atoms())
        seen.append(len(ase.io.read(folder / "trajectory.traj", ":")))  # what a kill would leave

    simulation = Simulation(made, folder, observers=[Every(0.02, look)])
    run = simulation.run()
    assert seen == [1, 2, 3, 4]
    return folder, run, states, present


def test_a_trajectory_of_ase_holds_every_digit(traj):
    folder, results, states, present = traj
    frames = ase.io.read(folder / "trajectory.traj", ":")
    system, heavy = results.system, results.system.sites.mass > 0
    assert str(frames[0].symbols) == "OH2OH2OH2OH2"
    for frame, other, state in zip(frames, results.atoms(":"), states, strict=True):
        assert frame.info["time_ps"] == state.time[0]
        assert (frame.positions == system.site_positions(state)[heavy]).all()
        assert (frame.positions == other.positions).all()
        assert np.abs(frame.get_velocities() - other.get_velocities()).max() < 1e-15
        assert frame.cell.array == pytest.approx(state.cell)
    with contextlib.closing(TrajReader(folder / "trajectory.traj")) as reader:
        positions, velocities, _ = reader.frame(2).sites
    assert (positions == system.site_positions(states[2])).all()
    assert np.abs(velocities - system.site_velocities(states[2])).max() < 1e-12
    assert np.abs(results.rotation[3] - states[3].rotation).max() < 1e-5
    assert all(
        (now.positions == frame.positions).all() for now, frame in zip(present, frames, strict=True)
    )
    again = build(rigidmd.scene_from_atoms(frames[3], "tip4p2005", forces=FORCES, stages=[NVE]))
    same_state(again.state, results.state)
    data = {"structure": {"file": "trajectory.traj", "velocities": True}, "stages": [NVE]}
    data |= {"molecules": [{"model": "tip4p2005"}], "forces": FORCES}
    same_state(build(Scene.from_dict(data, folder)).state, results.state)  # the last frame


def test_ase_opens_it(traj, tmp_path):
    folder, results, *_ = traj
    command = [sys.executable, "-m", "ase", "gui", "--terminal", "-n", ":", "-g", "i,d(0,1),ekin"]
    told = subprocess.run(
        [*command, str(folder / "trajectory.traj")], capture_output=True, text=True, check=True
    )
    rows = np.array([line.split() for line in told.stdout.strip().splitlines()], float)
    assert rows[:, 1] == pytest.approx(0.9572, abs=1e-12)
    assert rows[-1, 2] == pytest.approx(results.atoms().get_kinetic_energy(), rel=1e-9)
    from ase.db import connect

    with connect(tmp_path / "runs.db") as base:
        for frame in results.atoms(":"):
            base.write(frame, time_ps=frame.info["time_ps"])
    assert [row.energy for row in base.select()] == pytest.approx(
        results["potential"] * KJ_PER_MOL / EV
    )
    ase.io.write(tmp_path / "all.traj", results.atoms(":"))
    assert ase.io.read(tmp_path / "all.traj", -1).get_stress() == pytest.approx(
        results.atoms().get_stress()
    )


@pytest.mark.parametrize("name", ["trajectory.xtc", "trajectory.trr", "trajectory.gsd"])
def test_ase_reads_a_run(name, tmp_path, monkeypatch):
    """By the entry point of pyproject.toml, as ASE does when it is imported."""
    ((group, names),) = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "entry-points"
    ].items()
    monkeypatch.delitem(
        ase.io.formats.ioformats, "rigidmd", raising=False
    )  # of an installed package
    (point,) = (EntryPoint(key, value, group) for key, value in names.items())
    assert (point.name, point.group) == ("rigidmd", "ase.ioformats")
    ase.io.formats.define_external_io_format(point)
    made = small_scene(
        {"tip4p2005": 4}, 14.0, forces=FORCES, stages=[NVE], output=OUTPUT | {"trajectory": name}
    )
    results = Simulation(made, tmp_path / "run").run()
    frames, expected = ase.io.read(tmp_path / "run" / name, ":"), results.atoms(":")
    assert len(frames) == len(expected) == 4
    assert ase.io.read(tmp_path / "run", format="rigidmd") == frames[-1]
    assert ase.io.read(tmp_path / "run" / name, 1) == frames[1]
    for frame, other in zip(frames, expected, strict=True):
        assert frame.info["time_ps"] == pytest.approx(other.info["time_ps"])
        assert frame.positions == pytest.approx(
            other.positions, abs=0.02 if name.endswith("xtc") else 1e-5
        )
        assert frame.has("momenta") == (name != "trajectory.xtc")
        assert frame.cell.array == pytest.approx(other.cell.array) and frame.pbc.all()
        assert (frame.get_masses() == other.get_masses()).all() and str(
            frame.symbols
        ) == "OH2OH2OH2OH2"
    Simulation(
        Scene.read(ROOT / "systems" / "heavy_top_1.toml", {"run.duration_s": 0.01}),
        tmp_path / "top",
    ).run()
    with pytest.raises(TypeError, match="a run of a single body"):
        ase.io.read(tmp_path / "top" / "trajectory.xtc")
    with pytest.raises(OutputError, match="is not the folder of a run"):
        ase.io.read(tmp_path, format="rigidmd")


def test_a_run_with_it_goes_on_to_the_same_bytes(tmp_path):
    output = FORTY_WATERS["output"] | {
        "trajectory": "trajectory.traj",
        "trajectory_interval_ps": 0.001,
    }
    same_after_stops(forty_waters(NVE | {"duration_ps": 0.1}, output=output), [3, 41, 43], tmp_path)


def test_a_damaged_one_is_told(traj, tmp_path):
    """Bytes changed anywhere: frames or a sentence, never anything else."""
    content = (traj[0] / "trajectory.traj").read_bytes()
    path, rng, sites = tmp_path / "t.traj", np.random.default_rng(5), len(traj[1].system.sites.name)
    told = 0
    for k in range(300):
        damaged = bytearray(content)
        for at in rng.integers(0, len(content) if k % 2 else 500, 3):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(content))] if k % 5 == 0 else damaged)
        try:
            read_frames(path, sites, 100)
        except OutputError as error:
            assert "\n" not in str(error)
            told += 1
    assert told > 100


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("shorter", "2 frames of"),
        ("changed", "its checksum is not that"),
        ("noise", "not a trajectory of ASE"),
    ],
)
def test_one_that_changed_is_not_gone_on_with(fault, said, traj, tmp_path):
    _, results, states, _ = traj
    path = tmp_path / "t.traj"
    file = TrajFile(path, results.system, True, False)
    for state in states[:3]:
        file.write(state, state.time[0], state.step[0])
        if state is states[1]:
            kept, content = file.kept, path.read_bytes()
    file.close()
    again = TrajFile(path, results.system, True, False, kept)
    again.cut()
    again.close()
    assert path.read_bytes() == content
    if fault == "shorter":
        short = TrajFile(path, results.system, True, False)
        short.write(states[0], 0.0, 0)
        short.close()
    elif fault == "changed":
        at = content.index(
            results.system.site_positions(states[1])[results.system.sites.mass > 0].tobytes()
        )
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    else:
        path.write_bytes(np.random.default_rng(1).bytes(5000))
    before = path.read_bytes()
    with pytest.raises(OutputError, match=said):
        TrajFile(path, results.system, True, False, kept)
    assert path.read_bytes() == before


@pytest.mark.soak
def test_acetonitrile_is_that_of_ase():
    sites = [
        {
            "name": name,
            "element": element,
            "mass_u": float(mass),
            "position_A": [x, 0.0, 0.0],
            "charge_e": charge * SAME_COULOMB,
            "sigma_A": sigma,
            "epsilon_kJ_mol": float(epsilon * EV / KJ_PER_MOL),
        }
        for name, element, mass, x, charge, sigma, epsilon in (
            ("Me", "C", acn.m_me, 0.0, acn.q_me, acn.sigma_me, acn.epsilon_me),
            ("C", "C", acn.m_c, acn.r_mec, acn.q_c, acn.sigma_c, acn.epsilon_c),
            ("N", "N", acn.m_n, acn.r_men, acn.q_n, acn.sigma_n, acn.epsilon_n),
        )
    ]
    data = {
        "molecules": [{"name": "acn", "sites": sites, "count": 4}],
        "box": {"lengths_A": 12.0, "periodic": False},
    }
    atoms = rigidmd.atoms_of(Scene.from_dict(data | {"stages": [{"ensemble": "minimise"}]}))
    other = atoms.copy()
    other.calc = acn.ACN(rc=1e4)
    atoms.calc = RigidMD([{"name": "acn", "sites": sites}], atom_forces="sites")
    assert atoms.get_potential_energy() == pytest.approx(other.get_potential_energy(), rel=1e-12)


@pytest.mark.soak
def test_pme_in_a_slanted_cell():
    counts = {"spce": 12, "nitrogen": 4, "argon": 3}
    box = {"lengths_A": [11.0, 12.0, 13.0], "angles_deg": [80.0, 100.0, 75.0]}
    atoms = turned(rigidmd.atoms_of(small_scene(counts, None, box=box, forces={"cutoff_A": 4.5})))
    keywords = {
        "cutoff_A": 4.5,
        "electrostatics": "pme",
        "truncation": "shift",
        "ewald_accuracy": 1e-6,
    }
    atoms.calc = RigidMD(list(counts), **keywords)
    check_stress(atoms)
    chosen = [0, 1, 2, 40, 44, 46]
    numerical = calculate_numerical_forces(atoms, eps=1e-3, iatoms=chosen)
    forces = atoms.get_forces()
    assert np.abs(forces[chosen] - numerical).max() < 1e-5 * np.abs(forces).max()
    plain = atoms.copy()
    plain.calc = RigidMD(
        list(counts),
        atom_forces="sites",
        **keywords | {"electrostatics": "ewald", "ewald_accuracy": 1e-8},
    )
    atoms.calc = RigidMD(list(counts), atom_forces="sites", **keywords)
    assert np.abs(plain.get_forces() - atoms.get_forces()).max() < 1e-3 * np.abs(forces).max()


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
