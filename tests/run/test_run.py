"""Runs from end to end: every shipped system, every file written and read back, interruption, the
commands."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import MDAnalysis as mda
import numba
import numpy as np
import pytest
from MDAnalysis.lib.formats.libmdaxdr import XTCFile
from support.common import MOLECULES, ROOT, built, observe, shaken, small_scene
from support.processes import process, wait_until

import rigidmd
from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.assemble.describe import describe
from rigidmd.assemble.time_step import error_of_step
from rigidmd.commands.arguments import COMMANDS
from rigidmd.commands.cli import main
from rigidmd.compile.cache import CacheIndex
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import NOW, REMOVED, State
from rigidmd.core.statistics import mean_and_error
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.engines.external import compare_at
from rigidmd.engines.samples import COLUMNS, Sample, Samples
from rigidmd.engines.system import System
from rigidmd.errors import OutputError, RigidMDWarning, SceneError, SimulationError
from rigidmd.figures import style
from rigidmd.figures.body import FIGURES
from rigidmd.forces.neighbors.lists import BUILDS
from rigidmd.io import progress, run_files
from rigidmd.io.run_files import columns
from rigidmd.run import Every, Observer, Simulation, molecular, run_together
from rigidmd.run.minimise import minimise
from rigidmd.run.molecular import MolecularRecord, MolecularRun
from rigidmd.run.report import summary_text
from rigidmd.run.summary import summarise
from rigidmd.scene import MolecularScene, Scene
from rigidmd.units import BOLTZMANN, FEMTOSECOND, KJ_PER_MOL


@pytest.mark.filterwarnings(
    "ignore:frames are not evenly spaced"
)  # its few steps end between two frames
@pytest.mark.parametrize("path", MOLECULES, ids=lambda path: path.stem)
def test_every_system_runs_a_few_steps(path, tmp_path):
    assert path.read_text().startswith("# ")
    scene = Scene.read(path)
    stages = rigidmd.resolve(scene).stages
    moving = [k for k, stage in enumerate(stages) if not stage.is_minimisation]
    short = {f"stages.{k}.duration_ps": 8 * stages[k].step for k in moving} | {
        "output.log_interval_ps": 0.004,
        "output.trajectory_interval_ps": 0.008,
    }
    results = Simulation(Scene.read(path, short), tmp_path / "out").run()
    assert results.state.position.shape == (len(results.system.model.species), 3)
    for k, stage in enumerate(results.summary["stages"]):
        assert stage["steps"] == (8 if k in moving else 0)
        assert np.isfinite(stage["potential_kJ_mol_per_molecule"])
    last, system = results.system.scene.stages[-1], results.system
    step_error = error_of_step(system.species, 300.0, last.scheme, last.step_fs)
    assert (
        np.ptp(results["conserved"][results["stage"] == len(scene.stages) - 1])
        < max(1e-3, 0.15 * step_error) * np.abs(results["kinetic"]).max()
    )
    names = {
        file.name
        for file in (tmp_path / "out").iterdir()
        if not file.name.startswith(("input_", "."))
    }
    assert names == {
        "scene.toml",
        "summary.json",
        "log.csv",
        "trajectory.xtc",
        "topology.gro",
        "final.npz",
        "energy.png",
        "checkpoint.npz",
        "checkpoint_previous.npz",
        *(["pressure_tensor.csv"] if scene.output.pressure_tensor_interval_ps else []),
    }
    universe = results.universe()
    assert universe.atoms.n_atoms == len(results.system.sites.name)


def test_the_resolved_scene_runs_again_to_the_same_bits(tmp_path):
    short = {"stages.0.duration_ps": 0.02}
    first = Simulation(
        Scene.read(ROOT / "systems" / "water_from_structure.toml", short), tmp_path / "a"
    ).run()
    scene = Scene.read(tmp_path / "a" / "scene.toml")
    assert scene.forces.cutoff_A == 9.0
    again = Simulation(scene, tmp_path / "b").run()
    for a, b in zip(first.state, again.state, strict=True):
        assert a.tobytes() == b.tobytes()


def test_the_final_state_starts_another_run(tmp_path):
    stages = [{"duration_ps": 0.02}]
    first = Simulation(
        small_scene({"spce": 20, "argon": 3}, 18.5, stages=stages), tmp_path / "a"
    ).run()
    scene = small_scene(
        {"spce": 20, "argon": 3},
        None,
        tmp_path / "a",
        stages=stages,
        box={},
        structure={"file": "final.npz", "velocities": True},
        start={},
    )
    system = build(scene)
    for name in State._fields[:4]:
        assert getattr(first.state, name).tobytes() == getattr(system.state, name).tobytes()
    assert not system.state.time.any()  # a run of its own
    assert system.space == first.system.space


@pytest.mark.parametrize(
    "name", ["t.xtc", "t.trr", "t.gsd", "t.traj", "t.dcd", "t.nc", "t.xyz", "t.pdb"]
)
@pytest.mark.parametrize("topology", ["topology.gro", "topology.pdb"])
def test_trajectories_hold_positions_box_time_and_velocities(name, topology, tmp_path):
    lengths, angles = [20.0, 21.0, 22.0], [80.0, 100.0, 75.0]
    scene = small_scene(
        {"tip4p2005": 6, "nitrogen": 4},
        None,
        stages=[{"duration_ps": 0.04}],
        box={"lengths_A": lengths, "angles_deg": angles},
        output={
            "trajectory": name,
            "trajectory_interval_ps": 0.01,
            "topology": topology,
            "positions": "unwrapped",
        },
    )
    seen = []

    def observe(moment):
        system = simulation.system
        seen.append((moment.time, moment.site_positions, system.site_velocities(moment.state)))

    simulation = Simulation(scene, tmp_path / "out", observers=[Every(0.01, observe)])
    universe = simulation.run().universe()
    assert len(universe.trajectory) == len(seen) == 5
    exact = {".xtc": 6e-3, ".pdb": 6e-4, ".xyz": 6e-5}.get(name[1:], 1e-4)
    for frame, (moment, positions, velocities) in zip(universe.trajectory, seen, strict=True):
        assert frame.positions == pytest.approx(positions, abs=exact)
        assert frame.time == moment
        assert frame.dt == 0.01
        if name != "t.xyz":
            assert frame.dimensions == pytest.approx([*lengths, *angles], abs=2e-3)
        assert frame.has_velocities == (name in ("t.trr", "t.gsd", "t.traj", "t.nc"))
        if frame.has_velocities:
            assert frame.velocities == pytest.approx(velocities, abs=1e-3)
    text = (tmp_path / "out" / name).read_bytes()
    if name == "t.xyz":
        import ase.io

        frames = ase.io.read(tmp_path / "out" / name, index=":", format="extxyz")
        assert frames[2].cell.cellpar() == pytest.approx([*lengths, *angles])
        assert frames[2].info["Time"] == pytest.approx(0.02)
    if name == "t.pdb":
        assert b"TIME 0.020000 PS" in text
    trajectory = universe.trajectory
    assert (trajectory.dt, trajectory.totaltime, trajectory[3].time) == (0.01, 0.04, seen[3][0])
    copy = universe.copy().trajectory
    assert [frame.time for frame in copy[::2]] == [moment for moment, _, _ in seen[::2]]
    if name[1:] not in (
        ".xyz",
        ".pdb",
        ".gsd",
        ".traj",
    ):  # what MDAnalysis reads from the file alone
        alone = mda.Universe(
            str(tmp_path / "out" / topology), str(tmp_path / "out" / name)
        ).trajectory
        assert [frame.time for frame in alone] == pytest.approx(
            [moment for moment, _, _ in seen], abs=1e-5
        )
    assert list(universe.atoms.names[:4]) == ["OW", "HW1", "HW2", "MW"]
    assert universe.residues.n_residues == 10


@pytest.mark.parametrize("angles", [[90.0, 90.0, 90.0], [80.0, 75.0, 100.0]])
def test_wrapped_molecules_are_whole_and_inside(angles, tmp_path):
    box = {"lengths_A": 20.0, "angles_deg": angles}
    simulation = Simulation(
        small_scene({"spce": 30}, None, box=box, output={"trajectory": "t.trr"})
    )
    system, state = simulation.system, simulation.state.copy()
    state.position[:] += 300.0
    x = system.site_positions(state, wrapped=True).reshape(30, 3, 3)
    centre = np.einsum("s,nsk->nk", system.species[0].masses, x) / system.species[0].mass
    part = centre @ np.linalg.inv(simulation.scene.box.cell)
    assert (part >= -1e-9).all()
    assert (part < 1 + 1e-9).all()
    moved = (centre - state.position) @ np.linalg.inv(simulation.scene.box.cell)
    assert moved == pytest.approx(np.rint(moved), abs=1e-9)
    assert np.linalg.norm(x[:, 1] - x[:, 0], axis=1) == pytest.approx(np.ones(30))


def test_log_and_summary(tmp_path):
    scene = small_scene(
        {"spce": 20}, 18.5, stages=[{"duration_ps": 0.05}], output={"log_interval_ps": 0.01}
    )
    results = Simulation(scene, tmp_path / "out").run()
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == tuple(columns(tensor=False).values())
    assert [float(row["Time (ps)"]) for row in rows] == pytest.approx(
        [0, 0.01, 0.02, 0.03, 0.04, 0.05]
    )
    for row, sample in zip(rows, results.samples.rows, strict=True):
        total = float(row["Potential Energy (kJ/mole)"]) + float(row["Kinetic Energy (kJ/mole)"])
        assert float(row["Total Energy (kJ/mole)"]) == pytest.approx(total)
        assert float(row["Temperature (K)"]) == pytest.approx(sample.temperature)
        assert float(row["Box Volume (nm^3)"]) == pytest.approx(1.85**3)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["degrees_of_freedom"] == 57 + 60
    assert summary["stages"][0]["steps"] == 25
    energy, n, time = results["energy"], 20, results["time"]
    gradient = np.polyfit(time, energy, 1)[0]
    stage = summary["stages"][0]
    assert stage["drift_kJ_mol_ns_per_molecule"] == pytest.approx(
        gradient * 1000 / n, rel=1e-6, abs=1e-9
    )
    thermal = 0.0083144626 * stage["temperature_K"] * 117
    assert stage["drift_kT_ns_per_degree_of_freedom"] == pytest.approx(
        gradient * 1000 / thermal, rel=1e-6, abs=1e-9
    )


@pytest.mark.parametrize(
    ("counts", "edge"),
    [({"argon": 1}, 20.0), ({"argon": 1}, None), ({"nitrogen": 1}, 20.0), ({"spce": 2}, 18.1)],
)
@pytest.mark.parametrize("ensemble", ["nve", "nvt"])
def test_the_smallest_systems(counts, edge, ensemble, tmp_path):
    stage = {"ensemble": ensemble, "duration_ps": 0.02} | (
        {"temperature_K": 300.0} if ensemble == "nvt" else {}
    )
    results = Simulation(small_scene(counts, edge, stages=[stage]), tmp_path / "out").run()
    text = summary_text(results.summary)
    assert "20 steps" in text or "10 steps" in text
    assert np.isfinite(results["energy"]).all()
    if counts == {"argon": 1}:  # no total momentum: nothing is left to be warm
        assert results.summary["degrees_of_freedom"] == 0
        assert results.summary["stages"][0]["temperature_K"] is None


def test_a_simulation_runs_twice_alike_and_keeps_true_times():
    stages = [{"duration_ps": 0.06}, {"duration_ps": 0.06, "timestep_fs": 3.0}]
    simulation = Simulation(
        small_scene({"spce": 20}, 18.5, stages=stages, output={"trajectory_interval_ps": 0.02})
    )
    first = simulation.run()
    kept = first.state.copy()
    second = simulation.run()
    for a, b, c in zip(first.state, kept, second.state, strict=True):
        assert a.tobytes() == b.tobytes() == c.tobytes()
    with pytest.warns(UserWarning, match=r"not evenly spaced \(0.02 to 0.021 ps\)"):
        trajectory = first.universe().trajectory
    times = [frame.time for frame in trajectory]
    assert times == pytest.approx(
        [0, 0.02, 0.04, 0.06, 0.081, 0.102]
    )  # 20 fs are seven steps of 3 fs
    assert trajectory.dt == pytest.approx(0.02)
    assert trajectory.totaltime == pytest.approx(0.102)


ASKED = {
    "log_interval_ps": 0.01,
    "trajectory_interval_ps": 0.05,
    "pressure_tensor_interval_ps": 0.002,
}


@pytest.mark.parametrize("speed", [0.4, 1.0])
def test_the_energy_of_a_removed_momentum_is_in_the_summary(speed):
    """P²/2M of what is removed, as a positive number; only where something is removed is there a
    sentence."""
    stages = [{"duration_ps": 0.04, "timestep_fs": 4.0}, {"duration_ps": 0.04, "timestep_fs": 4.0}]
    sections = {
        "stages": stages,
        "run": {"remove_momentum_interval_ps": 0.031},
        "output": {"trajectory": False},
    }
    simulation = Simulation(small_scene({"argon": 20}, 20.0, **sections), warn=str)
    system, state = simulation.system, simulation.state.copy()
    state.velocity[:] += [speed, -0.5 * speed, 0.2]
    simulation.start_from(state)
    mass = system.model.mass[system.model.species]
    momentum = mass @ state.velocity
    removed = simulation.run().summary["momentum_removed"]
    assert removed["energy_kJ_mol"] == pytest.approx(
        momentum @ momentum / (2 * mass.sum()) / KJ_PER_MOL, rel=1e-9
    )
    assert any("remove_momentum_interval_ps" in note for note in system.notes)
    for thermostat in ("langevin", "hybrid_monte_carlo"):
        stage = {
            "ensemble": "nvt",
            "temperature_K": 90.0,
            "thermostat": thermostat,
            "duration_ps": 0.04,
            "timestep_fs": 4.0,
        }
        scene = small_scene({"argon": 20}, 20.0, **sections | {"stages": [stage]})
        assert not any("remove_momentum_interval_ps" in note for note in scene.rounded_times())
        assert "total momentum: removed" not in describe(scene)


def test_intervals_that_are_not_whole_steps_are_noted():
    stages = [
        {"duration_ps": 0.016, "timestep_fs": 4.0},
        {"duration_ps": 0.05, "timestep_fs": 2.0},
        {
            "ensemble": "npt",
            "temperature_K": 90.0,
            "pressure_bar": 1.0,
            "duration_ps": 0.022,
            "timestep_fs": 4.0,
            "barostat_interval_ps": 0.03,
        },
    ]
    sections = {"stages": stages, "output": ASKED, "run": {"remove_momentum_interval_ps": 1.001}}
    scene = small_scene({"argon": 20}, 20.0, **sections)
    assert scene.rounded_times() == [
        "output.log_interval_ps = 0.01 is not a whole number of steps of 4 fs (stages.0, stages.2): it is 0.008 ps",
        "output.trajectory_interval_ps = 0.05 is not a whole number of steps of 4 fs (stages.0, stages.2): it is 0.048 ps",
        "output.pressure_tensor_interval_ps = 0.002 is not a whole number of steps of 4 fs (stages.0, stages.2): "
        "it is 0.004 ps",
        "run.remove_momentum_interval_ps = 1.001 is not a whole number of steps of 4 fs (stages.0, stages.2): it is 1 ps",
        "run.remove_momentum_interval_ps = 1.001 is not a whole number of steps of 2 fs (stages.1): it is 1 ps",
        "stages.2.duration_ps = 0.022 is not a whole number of steps of 4 fs (stages.2): it is 0.024 ps",
        "stages.2.barostat_interval_ps = 0.03 is not a whole number of steps of 4 fs (stages.2): it is 0.032 ps",
    ]
    del stages[2]["barostat_interval_ps"]  # its default, 0.05 ps, is 12.5 steps
    notes = small_scene({"argon": 20}, 20.0, **sections).rounded_times()
    assert not any("barostat" in note for note in notes)
    run = Simulation(scene, warn=str)
    for note in scene.rounded_times():
        assert note in run._introduction()
        assert note in describe(scene)
    results = run.run()
    assert set(scene.rounded_times()) <= set(results.summary["notes"])
    times = [ts.time for ts in results.universe().trajectory]
    assert times[1] == pytest.approx(0.066)  # the first stage is shorter than the interval
    assert results["time"][:3] == pytest.approx([0.0, 0.008, 0.016])


@pytest.mark.parametrize(
    "thermostat", ["langevin", "andersen", "velocity_rescaling", "nose_hoover", None]
)
def test_one_point_molecule_runs_under_every_thermostat(thermostat):
    stage = {"duration_ps": 1.0} | (
        {"ensemble": "nvt", "temperature_K": 100.0, "thermostat": thermostat} if thermostat else {}
    )
    run = Simulation(
        small_scene({"argon": 1}, 20.0, stages=[stage], start={"temperature_K": 100.0}), warn=str
    )
    results = run.run()
    moves = thermostat in ("langevin", "andersen")
    assert results.summary["degrees_of_freedom"] == (3 if moves else 0)
    assert f"{3 if moves else 0} degrees of freedom" in run._introduction()
    assert any("no temperature is defined" in note for note in results.summary["notes"]) != moves
    told = results.summary["stages"][0]["temperature_K"]
    assert told > 0 if moves else told is None
    if moves:
        kinetic = 0.5 * 39.948 * (results.state.velocity**2).sum()
        assert results["temperature"][-1] == pytest.approx(2 * kinetic / (3 * BOLTZMANN), rel=0.05)


def free_flight(name, folder):
    """Two argon atoms far from each other in a large box, which cross its sides."""
    scene = small_scene(
        {"argon": 2},
        60.0,
        stages=[{"duration_ps": 20.0, "timestep_fs": 10.0}],
        start={"temperature_K": 3000.0},
        forces={"cutoff_A": 6.0},
        output={"trajectory": name, "trajectory_interval_ps": 0.1, "log_interval_ps": 10.0},
    )
    return Simulation(scene, folder).run()


@pytest.mark.parametrize("name", ["t.xtc", "t.trr", "t.dcd", "t.nc", "t.xyz", "t.pdb", "memory"])
def test_displacements_over_time_are_speeds(name, tmp_path):
    """What a diffusion coefficient rests on: times of frames, and positions that do not jump at the
    sides of the box."""
    results = free_flight(*(("t.xtc", None) if name == "memory" else (name, tmp_path / "out")))
    universe = results.universe()
    path = universe.trajectory.timeseries(order="fac")
    speed = np.diff(path, axis=0) / universe.trajectory.dt
    assert np.abs(path).max() > 60
    assert speed == pytest.approx(
        np.broadcast_to(results.state.velocity, speed.shape), abs=0.2
    )  # of some 10 Å/ps
    assert universe.trajectory.dt == pytest.approx(0.1)
    assert universe.trajectory.totaltime == pytest.approx(20)
    assert results.summary["positions"] == "unwrapped"
    assert "unwrapped: molecules follow continuous paths" in summary_text(results.summary)


def test_the_summary_says_when_positions_are_wrapped():
    scene = small_scene({"argon": 20}, 20.0, output={"positions": "wrapped"})
    assert "Displacements need unwrapped frames" in summary_text(Simulation(scene).run().summary)
    for without in (
        {"output": {"trajectory": False}},
        {"box": {"lengths_A": 20.0, "periodic": False}},
    ):
        assert "positions" not in summary_text(
            Simulation(small_scene({"argon": 20}, 20.0, **without)).run().summary
        )


def test_a_format_too_narrow_for_a_long_way_is_told(tmp_path):
    scene = small_scene(
        {"argon": 2}, 60.0, output={"trajectory": "t.pdb", "trajectory_interval_ps": 0.002}
    )
    simulation = Simulation(scene, tmp_path / "out")
    state = simulation.system.state.copy()
    state.velocity[:] = [[-1e6, 0, 0], [1e6, 0, 0]]
    simulation.start_from(state)
    with pytest.raises(
        SimulationError,
        match=r"beyond the -999.99 Å that .pdb .output.trajectory. can hold: use .nc or .trr or .xyz, output.pos",
    ):
        simulation.run()


def test_the_topology_is_the_first_frame_relief_included(tmp_path):
    short = {
        "stages.0.duration_ps": 0.004,
        "stages.1.duration_ps": 0.004,
        "output.positions": "unwrapped",
    }
    results = Simulation(
        Scene.read(ROOT / "systems" / "water_nitrogen.toml", short), tmp_path / "out"
    ).run()
    assert results.summary["overlap_removal_steps"] > 0
    universe = results.universe()
    first = mda.Universe(str(tmp_path / "out" / "topology.gro")).atoms.positions
    assert first == pytest.approx(universe.trajectory[0].positions, abs=0.011)
    assert main(["energy", str(ROOT / "systems" / "water_nitrogen.toml"), "--json"]) == 0


def argon(**more):
    return small_scene(
        {"argon": 20}, 25.0, stages=[{"duration_ps": 0.1}], output={"log_interval_ps": 0.01}, **more
    )


def test_energy_that_goes_with_the_total_momentum_is_booked():
    """Total momentum goes at steps that the row decides, and its energy into the ledger, whatever
    else acts."""
    system = build(argon())
    mass = float(system.model.mass[system.model.species].sum())
    state = system.state.copy()
    state.velocity[:, 0] += 0.1
    energy = observe(system, system.engine(), state).energy
    row, engine = SCHEMES["velocity_verlet"].with_momentum_removal(4), system.engine()
    for steps, left in ((3, 0.1), (1, 0.0), (3, 0.0)):
        engine.advance(state, row, 1e-3, int(state.step[NOW]) + steps)
        momentum = system.model.mass[system.model.species] @ state.velocity
        assert momentum == pytest.approx([left * mass, 0, 0], abs=1e-9 * mass)
    assert state.energy_ledger[REMOVED] == pytest.approx(-0.5 * mass * 0.1**2, rel=1e-9)
    seen = observe(system, engine, state)
    assert seen.energy - state.energy_ledger.sum() == pytest.approx(energy, rel=1e-5)


def test_a_drift_of_all_molecules_is_noted():
    simulation = Simulation(argon())
    state = simulation.system.state.copy()
    state.velocity[:, 0] += 0.5
    simulation.start_from(state)
    results = simulation.run()
    mass = float(results.system.model.mass[results.system.model.species].sum())
    said = next(note for note in results.summary["notes"] if "drift together" in note)
    assert (
        f"which adds {mass * 0.5**2 / (57 * BOLTZMANN):.2g} K to T_trans; run.remove_momentum_interval_ps"
        in said
    )


MIE = {"energy": "4*e*((s/r)**14 - (s/r)**7)", "parameters": {"AR": {"e": 1.0, "s": 3.4}}}
SCREENED = {"energy": "a*exp(-r/2)/r", "parameters": {"AR": {"a": 5.0}}}


@pytest.mark.parametrize(
    ("counts", "cutoff", "entry", "words"),
    [
        ({"spce": 20}, 3.0, None, "3 Å is shorter than 3.55 Å"),
        ({"spce": 20}, 3.54, None, ""),  # WCA, rounded
        ({"spce": 20}, 7.0, None, ""),
        ({"argon": 10, "ccl4": 5}, 3.7, None, "shorter than 3.82 Å, where the energy of argon.AR"),
        ({"argon": 20}, 3.0, MIE, "mie: .* 3 Å is shorter than 3.7"),
        ({"argon": 20}, 3.9, MIE, ""),
        ({"argon": 20}, 3.0, SCREENED, ""),  # repels everywhere
    ],
)
def test_a_cutoff_within_the_minimum_of_an_energy_is_noted(counts, cutoff, entry, words):
    forces = {"cutoff_A": cutoff}
    if entry:
        forces = {
            "cutoff_A": 8.0,
            "lennard_jones": False,
            "custom": [entry | {"name": "mie", "cutoff_A": cutoff}],
        }
    scene = small_scene(counts, 20.0, forces=forces)
    found = [note for note in build(scene).notes if "has its minimum" in note]
    assert len(found) == bool(words) and all(re.search(words, note) for note in found)
    assert all(note in describe(scene) for note in found)


@pytest.mark.parametrize("density", [1.4, 1.95, 2.6])
@pytest.mark.parametrize(("gap", "agrees"), [(1e-7, True), (3e-4, False)])
def test_two_engines_agree_by_the_size_of_each_quantity(density, gap, agrees):
    """Also where the virial is many times the energies, or these cancel: dense, on a lattice,
    cold."""
    box, forces = {"density_g_cm3": density}, {"cutoff_A": 4.6, "truncation": "plain"}
    system = build(
        small_scene({"argon": 32}, None, box=box, forces=forces, start={"temperature_K": 1.0})
    )
    term = system.terms["lennard_jones"]
    other = term._replace(
        potential=term.potential._replace(
            c12=term.potential.c12 * (1 + gap), c6=term.potential.c6 * (1 - gap)
        )
    )
    here, there = (system.engine_of({"lennard_jones": each}, "double") for each in (term, other))
    state = shaken(system, 1, 0.05)[2]
    lines = compare_at(system, state, here, there)
    assert {line.name for line in lines if not line.agrees} == (
        set()
        if agrees
        else {"lennard jones", "potential energy", "rms force on a molecule", "virial"}
    )


def summarised(
    stage, counts=None, momentum=0.0, truncation="switch", seed=1, before=(), after=(), **made
):
    """The summary of made-up samples of one stage: values (n,) of columns; others are still or
    noise. The stages before and after it have one sample each."""
    rng, n = np.random.default_rng(seed), len(next(iter(made.values())))
    given = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "duration_ps": 0.05 * n,
        "timestep_fs": 4.0,
    } | stage
    scene = small_scene(
        counts or {"spce": 40},
        16.0,
        stages=[*before, given, *after],
        forces={"cutoff_A": 7.9, "truncation": truncation},
    )
    system, made_stage = build(scene), len(before)
    state = system.state.copy()
    mass = float(system.model.mass[system.model.species].sum())
    state.velocity[:] = [momentum * np.sqrt(BOLTZMANN * 300.0 / mass), 0.0, 0.0]
    rows = Samples([one.label for one in scene.stages])
    samples = [(k, None) for k in range(made_stage)]
    samples += [(made_stage, k) for k in range(n)]
    samples += [(k, None) for k in range(made_stage + 1, len(scene.stages))]
    for k, (of_stage, index) in enumerate(samples):
        plain = {name: 300.0 + rng.standard_normal() for name in COLUMNS if "temperature" in name}
        own = {} if index is None else {name: float(made[name][index]) for name in made}
        row = (
            dict.fromkeys(COLUMNS, 0.0)
            | plain
            | {"stage_name": "", "step": k, "stage": of_stage, "kinetic": 100.0}
        )
        rows.append(
            Sample(
                **row | {"time": 0.05 * k, "momentum": momentum, "orthogonality_error": 0.0} | own
            )
        )
    record = MolecularRecord()
    record.position.computing = [1.0] * len(scene.stages)
    return summarise(system, record, rows, state, 0.0, 1.0, interrupted=False)


def noted(*given, **made):
    """Notes on the stage, or on a common drift, of the summary of made-up samples."""
    return [
        note
        for note in summarised(*given, **made)["notes"]
        if "stages.0" in note or "together" in note
    ]


KEPT = {"thermostat": "velocity_rescaling"}


def test_means_are_over_the_equilibrated_part():
    """An energy that relaxes in 5 ps, of 20; the temperature differs there."""
    rng, time = np.random.default_rng(5), 0.05 * np.arange(400)
    relaxing = np.exp(-time / 1.0)
    potential = -1600 + 400 * relaxing + 10 * rng.standard_normal(400)
    found = summarised(
        KEPT, potential=potential, temperature=300 + 80 * relaxing + rng.standard_normal(400)
    )
    stage = found["stages"][0]
    begin = stage["equilibrated_from_ps"]
    assert 2.5 < begin < 8
    assert stage["means_over"] == f"the last {19.95 - begin:.4g} of 19.95 ps"
    own = time > begin - 1e-9
    of_potential = (
        stage["potential_kJ_mol_per_molecule"],
        stage["potential_error_kJ_mol_per_molecule"],
    )
    assert of_potential == pytest.approx(mean_and_error(potential[own] / 40), rel=1e-9)
    assert abs(stage["temperature_K"] - 300) < 4 * stage["temperature_error_K"] < 1
    assert stage["temperature_translation_error_K"] == pytest.approx(
        1 / np.sqrt(own.sum()), rel=0.5
    )
    text = summary_text(found | {"scene": "made up"})
    assert f"means           over {stage['means_over']}" in text
    assert "K, set point 300 K" in text
    assert re.search(r"T_trans [\d.]+ ± [\d.]+, T_rot [\d.]+ ± [\d.]+ K\n", text)
    assert re.search(r"potential +-39.\d+ ± 0.0\d+ kJ/mol per molecule", text)


@pytest.mark.parametrize(
    ("given", "potential", "words", "begins"),
    [
        (KEPT, np.linspace(0.0, 1.0, 39), "all 1.9 ps, too short to detect equilibration", None),
        (KEPT, np.zeros(100), "all 4.95 ps", 0.0),
        (KEPT, np.linspace(0.0, 1e3, 100), "all 4.95 ps, not yet steady", 0.0),
        (
            KEPT,
            8 * np.exp(-np.arange(100) / 8) + 1.4 * abs(np.arange(100) % 28 / 14 - 1),
            "all 4.95 ps, perhaps not yet steady",
            0.0,
        ),
        (
            KEPT | {"temperature_K": [300.0, 200.0]},
            np.linspace(0.0, 1e3, 100),
            "all 4.95 ps, in which the set point changes",
            0.0,
        ),
    ],
)
def test_the_part_of_means_is_said(given, potential, words, begins):
    stage = summarised(given, potential=potential)["stages"][0]
    assert stage["means_over"] == words
    assert stage["equilibrated_from_ps"] == (None if begins is None else pytest.approx(begins))


@pytest.mark.parametrize(
    ("slope", "noise", "verdict"),
    [
        (0.0, 1e-3, r"not significant, [012].\d standard errors$"),
        (1e-3, 1e-3, r"significant, \d+.\d standard errors, but small$"),
        (10.0, 1e-3, r"significant, \d+.\d standard errors, and large$"),
    ],
)
def test_a_drift_has_a_verdict(slope, noise, verdict):
    """The limit is 0.001 kT per degree of freedom: 0.6 kJ/mol for 40 waters in 20 ps, 0.03
    kJ/mol/ps."""
    drift = slope * 0.05 * np.arange(400) + noise * np.random.default_rng(3).standard_normal(400)
    found = summarised(KEPT, drift=drift, temperature=np.full(400, 300.0))
    assert re.match(verdict, found["stages"][0]["drift_verdict"])
    assert f"(conserved energy): {found['stages'][0]['drift_verdict']}" in summary_text(
        found | {"scene": "made up"}
    )
    assert summarised(KEPT, drift=drift[:10])["stages"][0]["drift_verdict"] is None


@pytest.mark.parametrize(
    ("off", "spread", "hint"),
    [
        (-0.5, 3.0, ""),
        (-50.0, 3.0, ", less than this: equilibrate longer"),
        (30.0, 20.0, None),  # more than a canonical ensemble has: sampling hides the scatter
    ],
)
def test_constant_energy_after_a_thermostat_explains_its_temperature(off, spread, hint):
    """Temperatures of 40 argon atoms, with 117 degrees of freedom, scatter by 2 T²/117 less their
    variance at constant energy."""
    warm = {"ensemble": "npt", "temperature_K": [80.0, 100.0], "pressure_bar": 10.0}
    nve = {"ensemble": "nve", "temperature_K": None}
    noise = np.random.default_rng(2).standard_normal(400)
    series = 100.0 + off + spread * (noise - noise.mean()) / noise.std()
    found = summarised(
        nve,
        {"argon": 40},
        before=[warm | {"duration_ps": 0.5}],
        after=[{"ensemble": "nve", "duration_ps": 0.1}],
        temperature=series,
    )
    one, two, three = found["stages"]
    assert one["set_temperature_K"] == (80.0, 100.0) and "temperature_scatter_K" not in one
    assert "temperature_scatter_K" not in three  # nothing was drawn at its start
    assert two["temperature_before_K"] == 100.0
    text = summary_text(found | {"scene": "made up"})
    assert "set point 80 to 100 K" in text and "set point 10 bar" in text
    if hint is None:
        assert two["temperature_scatter_K"] is None and "from the 100 K before" not in text
        return
    level, variance = 100.0 + off, spread**2
    scatter = np.sqrt(2 * level**2 / 117 - variance)
    assert two["temperature_scatter_K"] == pytest.approx(scatter, rel=1e-9)
    assert (
        f"{off:+.2g} K from the 100 K before: an NVE stage keeps the energy at its start. Such"
        f" temperatures scatter by {scatter:.2g} K{hint}\n" in text
    )


@pytest.mark.soak
def test_temperatures_at_constant_energy_scatter_as_estimated():
    stages = [
        {"ensemble": "nvt", "temperature_K": 100.0, "duration_ps": 15.0, "timestep_fs": 5.0},
        {"duration_ps": 20.0, "timestep_fs": 5.0},
    ]
    sections = {
        "stages": stages,
        "output": {"trajectory": False, "log_interval_ps": 0.05},
        "forces": {"cutoff_A": 8.0},
    }
    runs = [
        Simulation(small_scene({"argon": 100}, 17.5, seed=seed, **sections), warn=str)
        for seed in range(1, 41)
    ]
    found = [results.summary["stages"][1] for results in run_together(runs) if results]
    measured = np.std([stage["temperature_K"] for stage in found], ddof=1)
    estimated = np.sqrt(np.mean([(stage["temperature_scatter_K"] or 0.0) ** 2 for stage in found]))
    assert measured == pytest.approx(estimated, rel=3 / np.sqrt(2 * 39))


@pytest.mark.parametrize(
    "thermostat", ["langevin", "andersen", "velocity_rescaling", "nose_hoover", None]
)
@pytest.mark.parametrize("momentum", [0.0, 0.5, 3.0, 12.0])  # sqrt(M kT) is thermal
def test_a_thermal_momentum_is_noted_where_it_is_conserved(thermostat, momentum):
    stage = {"thermostat": thermostat} if thermostat else {"ensemble": "nve", "temperature_K": None}
    told = noted(
        {"timestep_fs": 2.0} | stage, {"argon": 40}, momentum, temperature=np.full(40, 300.0)
    )
    if thermostat in ("langevin", "andersen"):
        assert [("thermal motion has" in note, "adds" in note) for note in told] == [
            (True, False)
        ] * (momentum > 10)
    else:
        assert ["which adds" in note for note in told] == [True] * (momentum > 0)


@pytest.mark.parametrize(
    ("apart", "spread", "n", "has_note"),
    [
        (7.0, 0.1, 400, True),
        (2.0, 0.1, 400, False),  # certain, and small
        (7.0, 60.0, 400, False),  # large, and not certain
        (7.0, 0.1, 30, False),  # few samples
    ],
)
def test_a_difference_of_temperatures_that_sampling_does_not_explain_has_a_note(
    apart, spread, n, has_note
):
    noise = np.random.default_rng(1).standard_normal((3, n)) * spread
    notes = noted(
        KEPT,
        temperature=300 + noise[0],
        temperature_translation=300 + apart / 2 + noise[1],
        temperature_rotation=300 - apart / 2 + noise[2],
    )
    assert len(notes) == has_note
    for note in notes:
        assert re.search(
            r"T_trans is 303.\d K and T_rot 296.\d K, a difference of 7 ± .* Try", note
        )


@pytest.mark.parametrize(
    ("excess", "integrator", "n", "words"),
    [
        (5.5, "velocity_verlet", 400, "the step of 4 fs leaves the molecules 5.5 K too hot"),
        (-5.5, "velocity_verlet", 400, "5.5 K too cold"),
        (1.4, "velocity_verlet", 400, ""),  # 0.5 %
        (5.5, "velocity_verlet", 30, ""),  # too few samples in its half
        (-5.5, "baoab", 400, ""),  # whose thermostat acts elsewhere
    ],
)
def test_a_thermostat_at_the_ends_of_steps_that_leaves_another_temperature_has_a_note(
    excess, integrator, n, words
):
    noise = np.random.default_rng(1).standard_normal(n)
    per_square = 2 / 12 * (4 * FEMTOSECOND) ** 2 / (6 * 40 - 3) / BOLTZMANN * KJ_PER_MOL
    notes = noted(
        KEPT | {"integrator": integrator},
        temperature=300 + noise,
        force_squares=(excess + noise / 10) / per_square,
    )
    assert len(notes) == bool(words)
    for note in notes:
        assert words in note and "Try timestep_fs = 2, or integrator = 'baoab'" in note


def test_points_have_one_temperature():
    noise = np.random.default_rng(0).standard_normal(200)
    points = {
        "temperature_rotation": np.full(200, np.nan),
        "temperature_translation": 310 + noise,
        "temperature": 310 + noise,
    }
    assert noted(KEPT, {"argon": 40}, **points) == []


@pytest.mark.parametrize(
    ("thermostat", "freedom"), [("langevin", 6 * 40), ("velocity_rescaling", 6 * 40 - 3)]
)
def test_a_drift_is_told_in_the_thermal_energy_of_the_degrees_of_freedom_of_its_stage(
    thermostat, freedom
):
    """A thermostat that changes the total momentum has three more."""
    time = 0.05 * np.arange(400)
    summary = summarised(
        {"thermostat": thermostat}, time=time, drift=0.7 * time, temperature=np.full(400, 300.0)
    )
    (stage,) = summary["stages"]
    assert stage["drift_kJ_mol_ns_per_molecule"] == pytest.approx(700 / 40)
    expected = 700 * KJ_PER_MOL / (BOLTZMANN * 300 * freedom)
    assert stage["drift_kT_ns_per_degree_of_freedom"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("rate", "n", "interval", "noise", "told"),
    [
        (1.0, 400, 0.05, 0.01, True),  # kT/ns over 20 ps
        (1.0, 50, 0.004, 1e-6, False),  # over 0.2 ps, as clear as can be: 2e-4 kT in all
        (0.05, 400, 0.05, 1e-4, False),  # small
        (1.0, 400, 0.05, 100.0, False),  # noise
        (1.0, 20, 0.5, 0.0, False),  # few samples
        (20.0, 100, 0.05, 0.01, True),
    ],
)
@pytest.mark.parametrize("ensemble", ["nve", "nvt"])
def test_a_drift_is_noted_where_it_is_certain_and_has_added_up(
    rate, n, interval, noise, told, ensemble
):
    time = interval * np.arange(n)
    slope = rate / 1000 * BOLTZMANN / KJ_PER_MOL * 300 * (6 * 40 - 3)  # kJ/mol/ps
    drift = slope * time + noise * np.random.default_rng(2).standard_normal(n)
    stage = KEPT if ensemble == "nvt" else {"ensemble": "nve", "temperature_K": None}
    found = noted(stage, time=time, drift=drift)
    assert len(found) == told
    if told:
        assert re.search(r"drifts by \+[\d.]+ ± [\d.e-]+ kT/ns per degree of freedom", found[0])
        assert "Try a shorter timestep_fs than 4 or truncation = 'smooth_switch'" in found[0]
        assert ("thermostat hides" in found[0]) == (ensemble == "nvt")
        assert "smooth" not in noted(stage, truncation="smooth_switch", time=time, drift=drift)[0]


def test_a_run_prints_each_note_once(tmp_path, capsys):
    """The values of the introduction and warnings are not repeated; the summary has all."""
    scene = {"watch.move": False, "stages.0.timestep_fs": 40.0, "stages.0.duration_ps": 0.4}
    text = "[box]\nlengths_A = 20\n[[molecules]]\nmodel = 'argon'\ncount = 20\n[start]\ntemperature_K = 90\n"
    text += "[[stages]]\nensemble = 'nve'\n[forces]\ncutoff_A = 3.0\n[output]\nfigures = false\n"
    (tmp_path / "s.toml").write_text(text)
    options = [f"--set={key}={str(value).lower()}" for key, value in scene.items()]
    assert main(["run", str(tmp_path / "s.toml"), *options, "-o", str(tmp_path / "out")]) == 0
    said = "".join(capsys.readouterr())
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["notes"]
    assert any("its minimum" in note for note in notes)
    assert [said.count(note) for note in notes] == [1] * len(notes)


def test_warnings_reach_whoever_calls_from_python():
    plain = {
        "run.timestep_s": 0.3,
        "run.duration_s": 0.9,
        "run.integrator": "velocity_verlet",
        "watch.energy": False,
    }
    scene = Scene.read(ROOT / "systems" / "heavy_top_3.toml", plain)
    with pytest.warns(
        RigidMDWarning, match=r"timestep_s = 0.3 is longer than what is stable"
    ) as caught:
        Simulation(scene).run()
    assert caught[0].filename == __file__


def test_when_total_momentum_is_taken_out():
    pme = {"electrostatics": "pme", "cutoff_A": 9.0}
    frozen = [{"model": "spce", "count": 2}, {"model": "argon", "count": 2, "frozen": True}]
    assert rigidmd.resolve(argon()).run.remove_momentum_interval_ps is False
    assert rigidmd.resolve(argon(forces=pme)).run.remove_momentum_interval_ps == 1.0
    assert (
        rigidmd.resolve(
            argon(forces=pme | {"electrostatics": "ewald"})
        ).run.remove_momentum_interval_ps
        is False
    )
    assert (
        rigidmd.resolve(
            argon(forces=pme, run={"remove_momentum_interval_ps": False})
        ).run.remove_momentum_interval_ps
        is False
    )
    assert (
        rigidmd.resolve(
            small_scene({}, 25.0, molecules=frozen, forces=pme)
        ).run.remove_momentum_interval_ps
        is False
    )
    assert rigidmd.resolve(small_scene({"argon": 3}, None)).run.remove_momentum_interval_ps is False
    nvt = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 1.0}
    for thermostat, removed in [
        ("velocity_rescaling", 1.0),
        ("nose_hoover", 1.0),
        ("langevin", False),
        ("andersen", False),
    ]:
        scene = small_scene({"argon": 20}, 25.0, stages=[nvt | {"thermostat": thermostat}])
        assert rigidmd.resolve(scene).run.remove_momentum_interval_ps == removed
    with pytest.raises(SceneError, match="total momentum is not conserved with frozen molecules"):
        small_scene({}, 25.0, molecules=frozen, run={"remove_momentum_interval_ps": 0.1})
    text = describe(argon(run={"remove_momentum_interval_ps": 0.2}))
    assert "total momentum: removed every 0.2 ps" in text
    assert "run.remove_momentum_interval_ps is false" in describe(
        argon(run={"remove_momentum_interval_ps": False})
    )


DECIDED = {
    "reaction_field": {"cutoff_A", "switch_start_A"},
    "ewald": {
        "cutoff_A",
        "switch_start_A",
        "ewald_alpha_per_A",
        "ewald_k_radius_per_A",
        "ewald_truncation",
    },
    "pme": {
        "cutoff_A",
        "switch_start_A",
        "ewald_alpha_per_A",
        "pme_grid",
        "pme_order",
        "ewald_truncation",
    },
}


@pytest.mark.parametrize(
    "electrostatics", ["reaction_field", pytest.param("ewald", marks=pytest.mark.soak), "pme"]
)
def test_the_scene_that_a_run_writes_holds_every_number_it_used(electrostatics, tmp_path):
    """And runs again to the same bits, though nothing is left for it to decide."""
    forces = {"electrostatics": electrostatics} | (
        {} if electrostatics == "reaction_field" else {"ewald_accuracy": 1e-3}
    )
    stages = [{"duration_ps": 0.01, "ensemble": "nvt", "temperature_K": 300.0}]
    scene = small_scene({"spce": 30}, 18.5, forces=forces, start={}, stages=stages)
    first = Simulation(scene, tmp_path / "out").run()
    again = Scene.read(tmp_path / "out" / "scene.toml")
    assert DECIDED[electrostatics] <= again.forces.model_fields_set
    assert "ewald_accuracy" not in again.forces.model_fields_set
    assert again.start.temperature_K == 300.0
    assert again.forces.skin_A == 1.9
    assert rigidmd.resolve(scene) == first.system.scene
    assert again.model_dump() == first.system.scene.model_dump()
    repeated = Simulation(again).run()
    for one, other in zip(first.state, repeated.state, strict=True):
        assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize("electrostatics", [*DECIDED, "damped_shifted_force", "none"])
@pytest.mark.parametrize("angles", [(90.0, 90.0, 90.0), (80.0, 75.0, 85.0)])
def test_a_resolved_scene_has_every_number_and_resolves_to_itself(electrostatics, angles):
    box = {"lengths_A": [22.0, 23.0, 24.0], "angles_deg": angles}
    scene = small_scene({"spce": 30}, None, box=box, forces={"electrostatics": electrostatics})
    resolved = rigidmd.resolve(scene)
    assert rigidmd.resolve(resolved) == resolved != scene
    for key in {"skin_A", *DECIDED.get(electrostatics, DECIDED["reaction_field"])}:
        assert getattr(resolved.forces, key) is not None, key
    assert resolved.forces.ewald_accuracy is None  # what follows from it is there
    assert resolved.run.remove_momentum_interval_ps == (1.0 if electrostatics == "pme" else False)
    assert resolved.start.temperature_K == 300.0
    assert resolved.output.velocities is False
    again = MolecularScene.model_validate(resolved.model_dump(exclude_none=True))
    assert rigidmd.resolve(again) == again


def test_without_a_box_there_is_no_cut_off_to_decide():
    resolved = rigidmd.resolve(small_scene({"spce": 3}, None))
    assert resolved.forces.cutoff_A is resolved.forces.switch_start_A is None


def test_a_cell_that_leans_too_much_leaves_only_the_grid_open():
    """The keys of a scene count along its own edges; the engine has others."""
    box = {"lengths_A": [24.0, 24.0, 24.0], "angles_deg": [60.0, 60.0, 45.0]}
    forces = {"electrostatics": "pme", "cutoff_A": 8.0}
    scene = small_scene({"spce": 30}, None, box=box, forces=forces)
    resolved = rigidmd.resolve(scene)
    assert rigidmd.resolve(resolved) == resolved
    assert resolved.forces.pme_grid is None
    first, again = (build(each).terms["coulomb_reciprocal"] for each in (scene, resolved))
    assert (resolved.forces.ewald_accuracy, resolved.forces.pme_order) == (5e-5, first.order)
    assert (first.grid, first.order) == (again.grid, again.order)
    even = rigidmd.resolve(
        small_scene({"spce": 30}, None, box=box, forces=forces | {"pme_grid": [60, 60, 60]})
    )
    assert (even.forces.pme_grid, even.forces.ewald_accuracy) == ((60, 60, 60), None)


def test_faults_of_all_tables_are_said_at_once():
    molecules = [{"model": "spce", "count": 3, "frozen": "2-9"}]
    scene = small_scene(
        {}, 17.0, molecules=molecules, forces={"electrostatics": "pme", "ewald_alpha_per_A": 2.0}
    )
    with pytest.raises(SceneError) as error:
        build(scene)
    assert [fault.partition(":")[0].partition(" =")[0] for fault in error.value.errors] == [
        "molecules.0.frozen",
        "forces.cutoff_A",
        "forces.ewald_alpha_per_A",
    ]
    assert "(the default)" in str(error.value)


def test_an_accuracy_that_cannot_be_had_is_called_the_default():
    forces = {"electrostatics": "pme", "cutoff_A": 6.0, "ewald_alpha_per_A": 1.3}
    with pytest.raises(
        SceneError, match=r"ewald_accuracy = 5e-05 \(the default\) cannot be reached"
    ):
        build(small_scene({"spce": 30}, 18.5, forces=forces | {"pme_grid": [8, 8, 8]}))


def test_input_files_of_one_name_are_kept_apart(tmp_path):
    model = (ROOT / "rigidmd" / "models" / "argon.toml").read_text()
    for name, mass in (("aa", "39.948"), ("bb", "83.798")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mol.toml").write_text(
            model.replace("39.948", mass).replace('name = "argon"', f'name = "{name}"')
        )
    data = small_scene({"argon": 1}, 25.0).model_dump()
    data["molecules"] = [{"file": f"{name}/mol.toml", "count": 10} for name in ("aa", "bb")]
    first = Simulation(Scene.from_dict(data, tmp_path), tmp_path / "out").run()
    again = Simulation(Scene.read(tmp_path / "out" / "scene.toml")).run()
    assert [m.mass for m in again.system.species] == [39.948, 83.798]
    assert first.state.position.tobytes() == again.state.position.tobytes()


@pytest.mark.filterwarnings("ignore:Reload offsets")  # MDAnalysis reads a file that has grown since
@pytest.mark.parametrize("name", ["t.xtc", "t.trr", "t.gsd", "t.pdb", "t.xyz", "t.nc", "t.dcd"])
def test_every_frame_is_on_the_disk_at_once(name, tmp_path):
    """What a kill would leave: the file is read back while the run still holds it open."""
    seen = []

    def observe(moment):
        if moment.step and moment.step % 4 == 0:
            universe = mda.Universe(
                str(tmp_path / "out" / "topology.gro"), str(tmp_path / "out" / name)
            )
            seen.append(sum(1 for _ in universe.trajectory))

    scene = small_scene(
        {"argon": 300},
        40.0,
        stages=[{"duration_ps": 0.04}],
        output={"trajectory": name, "trajectory_interval_ps": 0.008},
    )
    Simulation(scene, tmp_path / "out", observers=[Every(0.008, observe)]).run()
    assert seen == [2, 3, 4, 5, 6]


@pytest.mark.parametrize("box", [{"lengths_A": [20, 21, 22], "angles_deg": [80, 75, 70]}, None])
def test_frames_of_xtc_are_those_that_mdanalysis_writes(box, tmp_path):
    scene = {
        "molecules": [{"model": "spce", "count": 30 if box else 1}],
        "stages": [{"duration_ps": 0.04}],
    }
    structure = {"box": {"periodic": False}, "structure": {"file": "one.xyz"}}
    scene |= {"box": box, "forces": {"cutoff_A": 7.0}} if box else structure
    (tmp_path / "one.xyz").write_text("3\n\nO 0 0 0\nH 0.8 0.6 0\nH -0.8 0.6 0\n")
    scene |= {
        "name": "cell",
        "output": {"trajectory_interval_ps": 0.008},
        "start": {"temperature_K": 300},
    }
    scene = Scene.from_dict(scene, tmp_path)
    Simulation(scene, tmp_path / "out").run()
    own, other = tmp_path / "out" / "trajectory.xtc", tmp_path / "other.xtc"
    Simulation(scene).run().universe().atoms.write(str(other), frames="all")
    with XTCFile(str(own)) as found, XTCFile(str(other)) as expected:
        frames = list(zip(found, expected, strict=True))
        assert len(frames) == 6
        for frame, its in frames:
            assert (frame.x == its.x).all() and frame.prec == its.prec
            assert frame.time == its.time
            assert frame.box == pytest.approx(its.box, abs=1e-6)


def test_lines_of_the_log_are_written_together_but_soon(tmp_path, monkeypatch):
    now = 0.0
    monkeypatch.setattr(run_files.clock, "monotonic", lambda: now)
    path, samples = (
        tmp_path / "log.csv",
        Simulation(small_scene({"argon": 5}, 30.0)).run().samples.rows,
    )
    file = run_files.Log(path, tensor=False)

    def lines():
        return len(path.read_text().splitlines()) - 1

    assert lines() == 0
    for k in range(60):  # the first at once, then the lines of half a second
        now = 0.01 * k
        file.write(samples[0])
        assert lines() == (1 if k < 50 else 51)
    for now, written in (
        (5.0, 61),
        (5.01, 61),
        (5.1, 63),
        (5.2, 64),
        (5.21, 64),
    ):  # rare lines do not wait
        file.write(samples[0])
        assert lines() == written, now
    assert file.kept[0] == path.stat().st_size
    assert lines() == 65
    file.write(samples[0])
    file.close()
    assert lines() == 66


@pytest.mark.filterwarnings(
    "ignore:frames are not evenly spaced"
)  # its few steps end between two frames
def test_from_python_in_five_lines():
    scene = rigidmd.Scene.read(
        ROOT / "systems" / "nitrogen.toml",
        {
            "stages.0.duration_ps": 0.02,
            "stages.1.duration_ps": 0.02,
            "output.trajectory_interval_ps": 0.01,
        },
    )
    temperatures = []
    watch = rigidmd.Every(0.02, lambda moment: temperatures.append(moment.observation.temperature))
    results = rigidmd.Simulation(scene, observers=[watch]).run()
    assert results["temperature"][0] == pytest.approx(temperatures[0])
    assert len(results.universe().trajectory) == 5
    with pytest.raises(KeyError, match="temperature_rotation"):
        results["T"]


def arrays_of(moment):
    """All arrays that a moment gives."""
    seen = moment.observation
    lazy = [getattr(seen, name, None) for name in ("force", "torque_body")]  # of molecules
    given = [moment.site_positions, *moment.state, *seen, *lazy]
    return [part for part in given if isinstance(part, np.ndarray)]


def test_what_an_observer_keeps_does_not_change(scene_of_both):
    kept, copies = [], []

    def observe(moment):
        kept.append(arrays_of(moment))
        copies.append([part.copy() for part in kept[-1]])

    Simulation(scene_of_both[1], observers=Every(0.002, observe), warn=str).run()
    assert len(kept) > 2
    for now, then in zip(kept, copies, strict=True):
        for array, copy in zip(now, then, strict=True):
            assert array.tobytes() == copy.tobytes()
    assert any(
        not np.array_equal(first, last) for first, last in zip(copies[0], copies[-1], strict=True)
    )


def test_results_are_a_mapping_of_their_columns(scene_of_both):
    results = Simulation(scene_of_both[1], warn=str).run()
    assert "energy" in results
    assert "enthalpy" not in results
    assert list(results) == list(results.units)
    assert all(len(results[name]) == len(results.samples) for name in results)


def test_observers_cannot_write_to_the_state():
    def meddle(moment):
        moment.state.position[:] = 0

    with pytest.raises(ValueError, match="read-only"):
        Simulation(
            small_scene({"argon": 10}, 20.0), observers=[Every(0.002, meddle)], warn=str
        ).run()


@contextmanager
def running(tmp_path, lines):
    """A long argon run in another process, once its log has this many lines: (process, its
    folder)."""
    scene, out = str(ROOT / "systems" / "argon.toml"), tmp_path / "out"
    arguments = ["run", scene, "-o", str(out), "--set", "stages.0.duration_ps=1000"]
    command = [sys.executable, "-m", "rigidmd", *arguments]
    log, pipe = out / "log.csv", subprocess.PIPE
    with process(command, stdout=pipe, stderr=pipe, text=True) as run:
        wait_until(lambda: log.exists() and log.read_text().count("\n") > lines, run)
        yield run, out


def frames_in(folder):
    """Frames of a trajectory that can be read to the end."""
    universe = mda.Universe(str(folder / "topology.gro"), str(folder / "trajectory.xtc"))
    return sum(1 for _ in universe.trajectory)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_stops_with_a_summary_and_its_code(number, code, tmp_path):
    """Ctrl-C, and what a batch system sends when time is up: maybe more than once."""
    with running(tmp_path, 3) as (run, folder):
        run.send_signal(number)
        if number == signal.SIGTERM:
            run.send_signal(number)
        out, err = run.communicate()
    assert run.returncode == code
    assert "interrupted" in out
    assert "Traceback" not in err
    assert json.loads((folder / "summary.json").read_text())["interrupted"]
    assert (folder / "final.npz").exists()
    assert frames_in(folder) >= 1


def test_compiling_is_announced_without_a_terminal(tmp_path, monkeypatch, capsys):
    """A run that waits for the compiler states so, once."""
    prepare = MolecularRun.prepare
    index = CacheIndex(str(tmp_path), "kernel", 0)

    def compile_first(run):
        for n in (1, 2):
            assert index.load(((numba.types.UniTuple(numba.types.float64, n),), ())) is None
        prepare(run)

    monkeypatch.setattr(MolecularRun, "prepare", compile_first)
    scene = [str(ROOT / "systems" / "argon.toml"), "--set", "stages.0.duration_ps=0.01"]
    assert main(["run", *scene, "-o", str(tmp_path / "out")]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert len([line for line in lines if "compiling (" in line]) == 1


def test_a_signal_of_the_program_s_own_is_left_to_it():
    caught = []

    def kill(moment):
        if moment.step == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    stages = [{"duration_ps": 0.02}]
    before = signal.signal(signal.SIGTERM, lambda number, frame: caught.append(number))
    try:
        results = Simulation(
            small_scene({"argon": 10}, 20.0, stages=stages), observers=[Every(0.002, kill)]
        ).run()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert caught == [signal.SIGTERM]
    assert not results.interrupted
    results = Simulation(
        small_scene({"argon": 10}, 20.0, stages=stages), observers=[Every(0.002, kill)]
    ).run()
    assert (results.interrupted, results.signal, results["step"][-1]) == (True, signal.SIGTERM, 4)
    assert results["time"][-1] == results.state.time[0]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.skipif(
    not Path("/proc/self/status").is_file(), reason="only Linux shows handlers in C"
)
def test_handlers_of_signals_in_c_are_left_to_the_program(tmp_path):
    """Python names no handler for what `faulthandler` registers, and its own would replace it."""
    program = """
import faulthandler, os, signal, sys
import rigidmd
faulthandler.register(signal.SIGUSR1, sys.stdout)
scene = rigidmd.Scene.from_dict({
    "box": {"lengths_A": 20.0}, "molecules": [{"model": "argon", "count": 10}],
    "start": {"temperature_K": 90.0}, "stages": [{"duration_ps": 0.02}],
    "output": {"figures": False},
})
rigidmd.Simulation(scene, "run").run()
sys.stdout.flush()
os.kill(os.getpid(), signal.SIGUSR1)
"""
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "most recent call first" in ended.stdout


def test_off_a_terminal_lines_say_how_far_it_is(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(progress.clock, "monotonic", lambda: now[0])

    def wait(moment):
        now[0] += 20.0

    stages = [{"duration_ps": 0.02}]
    simulation = Simulation(
        small_scene({"argon": 10}, 20.0, stages=stages), observers=[Every(0.002, wait)]
    )
    simulation.run(progress=True)
    lines = [line for line in capsys.readouterr().err.splitlines() if "compiling" not in line]
    # of ten steps at 20 s each (one more before them): a line every 40 s
    assert lines[0] == "  0.004 of 0.02 ps, 0.0001 ps/s, 02:40 left"
    assert len(lines) == 5
    simulation.run()
    assert capsys.readouterr().err == ""


def test_the_time_left_is_of_the_steps_of_this_run(monkeypatch, capsys, tmp_path):
    now = [0.0]

    def wait(seconds):
        now[0] += seconds

    def slowly(*given):
        wait(1000.0)
        return minimise(*given)

    def lines(duration, **options):
        stages = [
            {"ensemble": "minimise", "most_iterations": 2},
            {"duration_ps": 0.02},
            {"duration_ps": duration},
        ]
        scene = small_scene({"argon": 10}, 20.0, stages=stages, output={"figures": False})
        looks = Every(0.002, lambda moment: wait(20.0))
        compiling = {"say": lambda sentence: wait(500.0)}
        run = Simulation(scene, tmp_path / "out", observers=looks, warn=str, **compiling, **options)
        run.run(progress=True)
        return [line for line in capsys.readouterr().err.splitlines() if "ps/s" in line]

    monkeypatch.setattr(progress.clock, "monotonic", lambda: now[0])
    monkeypatch.setattr(molecular, "minimise", slowly)
    first, *_, last = lines(0.02)
    assert first == "  0.004 of 0.04 ps, 0.0001 ps/s, 06:00 left"
    assert last == "  0.04 of 0.04 ps, 0.0001 ps/s, 00:00 left"
    assert lines(0.04, resume=True)[0] == "  0.044 of 0.06 ps, 0.0001 ps/s, 02:40 left"


@pytest.mark.parametrize("kind", ["lines", "terminal", "notebook"])
def test_every_bar_has_the_rate_of_what_it_has_seen(monkeypatch, capsys, kind):
    now, shown = [0.0], []
    monkeypatch.setattr(progress.clock, "monotonic", lambda: now[0])
    monkeypatch.setattr(progress, "in_notebook", lambda: kind == "notebook")
    monkeypatch.setattr(
        progress.DisplayArea,
        "show",
        lambda self, bundle, metadata=None: shown.append(bundle["text/plain"]),
    )
    monkeypatch.setattr(sys.stderr, "isatty", lambda: kind == "terminal", raising=False)
    with progress.progress_of(100.0, "ps", shown=True) as bar:
        for before in (70.0, 0.0):
            bar.skip(before)
            now[0] += 1000.0
            bar.unpause()
            for _ in range(2):
                now[0] += 40.0
                bar.update(4.0)
    err = capsys.readouterr().err
    if kind == "lines":
        assert err.splitlines()[0] == "  74 of 100 ps, 0.1 ps/s, 04:20 left"
        assert err.splitlines()[-1] == "  86 of 100 ps, 0.1 ps/s, 02:20 left"
    elif kind == "terminal":
        assert "74.0/100.0 ps [00:40<04:20]" in err
        assert "86.0/100.0 ps [02:40<02:20]" in err
    else:
        assert "74 %: 74 of 100 ps, 00:40, 04:20 left" in shown
        assert shown[-2:] == ["86 %: 86 of 100 ps, 02:40, 02:20 left", "86 %: 86 of 100 ps, 02:40"]


class Failing(Observer):
    """An observer whose method of this name fails, and a picture if it draws."""

    ends = True
    interval = 0.002

    def __init__(self, method, draws=False):
        self.draws = draws
        setattr(self, method, self.fail)

    def fail(self, *given):
        if not (isinstance(given[0], rigidmd.Moment) and given[0].step < 2):
            raise ValueError("it does not work")


class FailingTwice(Failing):
    """One whose file cannot be closed either."""

    def close(self):
        raise OutputError("the disk is full")


FILES_OF = {
    "argon": {
        "scene.toml",
        "topology.gro",
        "trajectory.xtc",
        "log.csv",
        "final.npz",
        "energy.png",
        "summary.json",
    },
    "top": {
        "scene.toml",
        "topology.pdb",
        "trajectory.xtc",
        "motion.csv",
        "motion.npz",
        "axis.png",
        "summary.json",
    },
}


@pytest.fixture(params=["argon", "top"])
def scene_of_both(request):
    if request.param == "argon":
        return "argon", small_scene(
            {"argon": 10},
            20.0,
            stages=[{"duration_ps": 0.01}],
            output={"log_interval_ps": 0.002, "figures": True},
        )
    changed = {"run.duration_s": 0.05, "output.npz": True, "output.interval_s": 0.001}
    return "top", Scene.read(ROOT / "systems" / "heavy_top_3.toml", changed)


@pytest.mark.parametrize("method", ["see", "end"])
def test_an_observer_that_fails_costs_no_file_of_another(tmp_path, scene_of_both, method):
    kind, scene = scene_of_both
    seen = []
    others = [Every(0.002, seen.append), Failing(method), Every(0.002, seen.append)]
    with pytest.warns(RigidMDWarning, match="Failing failed at .* it does not work"):
        run = Simulation(scene, tmp_path / "out", observers=others)
        with pytest.raises(ValueError, match="it does not work"):
            run.run()
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there >= FILES_OF[kind]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["interrupted"] == (method == "see")
    assert sum("Failing failed at" in note for note in summary["notes"]) == 1
    assert {Path(name).name for name in summary["files"]} <= there
    assert seen[-1].step == seen[-2].step  # also those after it saw the moment
    again = Simulation(
        scene, tmp_path / "out", observers=[Every(0.002, seen.append)] * 3, resume=True, warn=str
    )
    if method == "see" and kind == "argon":
        assert not again.run().interrupted


def test_an_error_is_not_hidden_by_those_that_follow_from_it(tmp_path, scene_of_both):
    run = Simulation(scene_of_both[1], tmp_path / "out", observers=[FailingTwice("see")], warn=str)
    with pytest.raises(ValueError, match="it does not work"):
        run.run()


def test_a_picture_that_fails_is_a_note(tmp_path, scene_of_both, monkeypatch):
    kind, scene = scene_of_both

    def fail(*given, **options):
        raise ValueError("ParseException: no mathematics")

    monkeypatch.setattr(style, "save_files", fail)
    pictures = [Failing("see", draws=True), Failing("end", draws=True)]
    notes = []
    results = Simulation(scene, tmp_path / "out", observers=pictures, warn=notes.append).run()
    assert not results.interrupted
    assert [note.split(" cannot be drawn: ValueError: ") for note in notes] == [
        ["Failing", "it does not work"],
        [
            {"argon": "energy.png"}.get(
                kind, ", ".join(f"{stem}.png, {stem}.svg" for stem in FIGURES)
            ),
            "ParseException: no mathematics",
        ],
        ["Failing", "it does not work"],
    ]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["notes"][-3:] == notes == results.summary["notes"][-3:]
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there >= {name for name in FILES_OF[kind] if not name.endswith(".png")}
    assert [path for path in results.files if not path.is_file()] == []


def test_one_figure_of_a_body_that_fails_leaves_the_others(tmp_path, monkeypatch):
    def fails_first(figure, stem, suffixes, write=style.save_files):
        if stem.name == "axis":
            raise ValueError("no axis")
        return write(figure, stem, suffixes)

    monkeypatch.setattr(style, "save_files", fails_first)
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.05, "output.interval_s": 0.001}
    )
    results = Simulation(scene, tmp_path / "out", warn=str).run()
    assert {path.name for path in results.files} >= {"angles.png", "omega.png", "summary.json"}
    assert "no axis" in results.summary["notes"][-1]


def test_a_name_in_a_figure_costs_no_summary(tmp_path):
    stages = [{"name": "$`$", "duration_ps": 0.01}]
    scene = small_scene({"argon": 10}, 20.0, stages=stages, output={"log_interval_ps": 0.002})
    Simulation(scene, tmp_path / "out", warn=str).run()
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["stages"][0]["name"] == "$`$"


def test_a_killed_run_leaves_a_readable_log_and_trajectory(tmp_path):
    with running(tmp_path, 100) as (_, folder):
        pass
    with (folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 99
    assert frames_in(folder) >= len(rows) // 10 - 1  # a frame every ten lines


def test_the_commands(capsys, tmp_path):
    water = str(ROOT / "systems" / "water.toml")
    assert main(["check", water]) == 0
    assert "1293 = 645 translation + 648 rotation" in capsys.readouterr().out
    assert main(["check", str(ROOT / "systems" / "argon.toml")]) == 0
    out = capsys.readouterr().out
    assert "charges: no site has one" in out
    assert "rotation and torques: every molecule is a point" in out
    assert main(["models"]) == 0
    assert "2.351" in capsys.readouterr().out  # the dipole of SPC/E
    assert main(["schema"]) == 0
    schema = json.loads(
        capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert "timestep_fs" in schema["$defs"]["Stage"]["properties"]
    assert (
        main(
            [
                "check",
                water,
                "--set",
                "stages.production.timestep_fs=4",
                "--set",
                "molecules.0.model=tip3p",
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "5000 steps of 4 fs" in out
    assert "216 tip3p" in out


def test_energy_of_the_dimer_in_every_unit(capsys):
    dimer = str(ROOT / "systems" / "water_dimer.toml")
    found = {}
    for unit in ("kJ/mol", "kcal/mol", "eV", "K"):
        assert main(["energy", dimer, "--json", "--unit", unit]) == 0
        found[unit] = json.loads(capsys.readouterr().out)
    assert found["kJ/mol"]["potential"] == pytest.approx(-30.124, abs=2e-3)
    assert found["kcal/mol"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 4.184)
    assert found["eV"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 96.48533212)
    assert found["K"]["potential"] == pytest.approx(
        found["kJ/mol"]["potential"] / 0.00831446261815324
    )
    assert found["kJ/mol"]["largest_force_per_A"] < 0.02  # a minimum, to the file's six digits
    assert main(["energy", dimer]) == 0
    assert "lennard jones" in capsys.readouterr().out


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import sys; from rigidmd.commands.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\nprint(sorted({'numba', 'numpy', 'ase', 'MDAnalysis', 'pydantic'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "example" in done.stdout


def test_adding_a_command_takes_one_file(tmp_path, monkeypatch, capsys):
    (tmp_path / "greet.py").write_text(
        "from rigidmd.commands.arguments import command\n\n"
        "def arguments(parser):\n    parser.add_argument('name', metavar='NAME', help='whom to greet')\n\n"
        "@command(5, 'greet someone', 'rigidmd greet Ada', arguments)\n"
        "def greet(options):\n    print(f'hello {options.name}')\n    return 3\n"
    )
    package = sys.modules["rigidmd.commands"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    assert listed.index("greet someone") < listed.index(
        "list the scenes"
    )  # position 5 is before all others
    assert main(["greet", "Ada"]) == 3
    assert capsys.readouterr().out == "hello Ada\n"
    with pytest.raises(SystemExit):
        main(["gret"])
    assert "did you mean greet?" in capsys.readouterr().err.replace("'", "")
    del COMMANDS["greet"], sys.modules["rigidmd.commands.greet"]


def test_version():
    command = [sys.executable, "-m", "rigidmd", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.strip() == f"rigidmd {rigidmd.__version__}"


def test_output_goes_to_runs_by_default(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    changes = ("stages.0.duration_ps=0.01", "stages.1.duration_ps=0.01", "output.figures=false")
    command = ["run", str(ROOT / "systems" / "argon.toml")]
    command += [part for change in changes for part in ("--set", change)]
    assert main(command) == 0
    assert (tmp_path / "runs" / "argon" / "summary.json").exists()
    printed = capsys.readouterr().out
    assert "argon: 500 molecules, 500 sites, 1497 degrees of freedom" in printed
    assert "results in runs/argon" in printed
    assert main(command) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0


NPT = {"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0}
ROWS = {
    "nve": {},
    "langevin": {"ensemble": "nvt", "temperature_K": 300.0, "thermostat": "langevin"},
    "nose_hoover": {"ensemble": "nvt", "temperature_K": 300.0, "thermostat": "nose_hoover"},
    "srkn_6": {"integrator": "srkn_6"},
    "pefrl": {"integrator": "pefrl"},  # it ends with a drift
    "chin_4a": {"integrator": "chin_4a"},
    "stochastic_cell": NPT,
    "monte_carlo": NPT | {"barostat": "monte_carlo"},
    "piston": {"ensemble": "nph", "pressure_bar": 1.0},
}


@pytest.mark.parametrize(
    ("name", "precision"),
    [(name, "double") for name in ROWS]
    + [pytest.param(name, "mixed", marks=pytest.mark.soak) for name in ROWS],
)
def test_a_look_takes_the_energies_of_the_last_step(name, precision, monkeypatch):
    """They are those of an evaluation, to the bit, and the run continues as if nobody had observed."""
    electrostatics = "pme" if precision == "double" else "reaction_field"
    forces = {"cutoff_A": 5.5, "electrostatics": electrostatics, "tail_correction": True}
    stage = {"duration_ps": 1.0} | ROWS[name]
    system, engine, start = built(
        {"spce": 20, "nitrogen": 12},
        12.0,
        3,
        spread=0.05,
        forces=forces,
        stages=[stage],
        precision=precision,
        fields={"electric_V_per_nm": [0.0, 0.0, 1.0], "electric_frequency_per_ps": 3.0},
    )
    row, other, evaluated = integrator_of_stage(system, 0), system.engine(), []
    looked, alone = engine.begin(start, row), other.begin(start, row)
    evaluate = Engine.evaluate
    monkeypatch.setattr(
        Engine, "evaluate", lambda self, state: evaluated.append(self) or evaluate(self, state)
    )
    for until in (7, 20, 21, 30):
        engine.advance(looked, row, 1e-3, until, observed=True)
        other.advance(alone, row, 1e-3, until)
        load, tallies = engine.evaluate_current(looked)
        assert all(np.array_equal(a, b) for a, b in zip(looked, alone, strict=True))
        expected, expected_tallies = other.evaluate_current(alone)
        assert all(np.array_equal(a, b) for a, b in zip(load, expected, strict=True))
        for term, tally in expected_tallies.items():
            assert tallies[term].energy == tally.energy
            assert np.array_equal(tallies[term].virial, tally.virial)
    if name not in ("pefrl", "chin_4a", "monte_carlo", "stochastic_cell"):
        assert engine not in evaluated
    assert other in evaluated


class Spring(rigidmd.Force):
    """A spring to the origin, which counts how often it is requested."""

    asked = 0

    def on_molecules(self, state):
        self.asked += 1
        return 0.5 * (state.position**2).sum(), -state.position


def test_a_look_asks_a_force_in_python_once():
    system = build(small_scene({"argon": 10}, 25.0).with_user_code([spring := Spring()]))
    engine, row = system.engine(), SCHEMES["velocity_verlet"]
    state = engine.begin(system.state, row)
    engine.advance(state, row, 1e-3, 5, observed=True)
    asked = spring.asked
    found = engine.evaluate_current(state)[1]["spring"].energy
    assert spring.asked == asked
    assert found == engine.evaluate(state)[1]["spring"].energy
    assert spring.asked == asked + 1


def test_a_look_at_another_state_is_an_evaluation():
    system, engine, start = built({"argon": 20}, 20.0, 3)
    row = SCHEMES["velocity_verlet"]
    moved, other = engine.begin(start, row), engine.begin(start, row)
    engine.advance(moved, row, 1e-3, 5, observed=True)
    other.position[:] += 0.1 * np.arange(20)[:, None]
    engine.advance(other, row, 1e-3, 0, observed=True)  # no step
    expected = system.engine().evaluate(other)[1]
    assert engine.evaluate_current(other)[1]["lennard_jones"].energy == pytest.approx(
        expected["lennard_jones"].energy, rel=1e-12
    )


def test_two_intervals_of_the_log_end_in_the_same_bits(tmp_path):
    ends = []
    for interval in (0.01, 0.025):
        scene = small_scene(
            {"nitrogen": 40},
            20.0,
            precision="mixed",
            stages=[{"duration_ps": 0.2}],
            output={"log_interval_ps": interval},
        )
        ends.append(rigidmd.Simulation(scene, tmp_path / str(interval)).run().state)
    assert all(np.array_equal(a, b) for a, b in zip(*ends, strict=True))


def test_a_look_at_a_state_that_was_changed_from_outside_is_anew():
    _, engine, state = built({"argon": 20}, 25.0)
    row = SCHEMES["velocity_verlet"]
    engine.advance(state, row, 1e-3, 5, observed=True)
    known = engine.evaluate_current(state)[1]["lennard_jones"].energy
    assert engine.evaluate_current(state.copy())[1]["lennard_jones"].energy == known
    state.position[0, 0] += 0.5
    engine.forget()
    assert engine.evaluate_current(state)[1]["lennard_jones"].energy != known


def test_the_lists_of_the_start_serve_the_first_stage(monkeypatch):
    """Two stages make two engines, each with lists of its own; the start makes none of its own."""
    made, engine_of = [], System.engine_of
    monkeypatch.setattr(
        System, "engine_of", lambda *given: made.append(engine_of(*given)) or made[-1]
    )
    stages = [{"duration_ps": 0.01}, {"duration_ps": 0.01}]
    simulation = Simulation(small_scene({"argon": 20}, 25.0, stages=stages))
    simulation.start_from(simulation.state)
    made.clear()
    simulation._part.reset()
    simulation.run()
    used = [engine for engine in made if engine.workspaces]
    assert len(used) == 2
    assert [int(engine.workspaces["lennard_jones"].pairs.counters[BUILDS]) for engine in used] == [
        1,
        1,
    ]
