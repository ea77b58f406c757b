"""Runs of molecules from end to end: every shipped system, the files of a run, runs that repeat to the same bits."""

import numpy as np
import pytest
from support.common import MOLECULES, ROOT, argon, observe, same_bits, small_scene

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.assemble.time_step import error_of_step
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import NOW, REMOVED, State
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDWarning
from rigidmd.forces.neighbors.lists import BUILDS
from rigidmd.run import Simulation
from rigidmd.run.report import summary_text
from rigidmd.scene import Scene
from rigidmd.units import BOLTZMANN


@pytest.mark.filterwarnings(
    "ignore:frames are not evenly spaced"
)  # its few steps end between two frames
@pytest.mark.parametrize("path", MOLECULES, ids=lambda path: path.stem)
def test_every_system_runs_a_few_steps(path, tmp_path):
    assert path.read_text().startswith("# ")
    scene = Scene.read(path)
    stages = rigidmd.with_defaults(scene).stages
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
    assert same_bits(first.state, again.state)


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


def test_energy_that_goes_with_the_total_momentum_is_accounted_for():
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


def test_warnings_reach_those_who_call_from_python():
    plain = {
        "run.timestep_s": 0.3,
        "run.duration_s": 0.9,
        "run.integrator": "velocity_verlet",
        "watch.energy": False,
    }
    scene = Scene.read(ROOT / "systems" / "heavy_top_3.toml", plain)
    with pytest.warns(RigidMDWarning, match=r"timestep_s = 0.3 is unstable") as caught:
        Simulation(scene).run()
    assert caught[0].filename == __file__


def test_input_files_of_one_name_are_kept_separate(tmp_path):
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


def test_two_intervals_of_the_log_end_in_the_same_bits(tmp_path):
    ends = []
    for interval in (0.01, 0.025):
        scene = small_scene(
            {"spce": 40},
            20.0,
            precision="mixed",
            stages=[{"duration_ps": 0.2}],
            output={"log_interval_ps": interval},
        )
        ends.append(rigidmd.Simulation(scene, tmp_path / str(interval)).run().state)
    assert all(np.array_equal(a, b) for a, b in zip(*ends, strict=True))


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
