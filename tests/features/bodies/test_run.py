"""A run of a single body from end to end: the commands, every file written and read back,
interruption."""

import csv
import json
import subprocess
import sys

import MDAnalysis as mda
import numpy as np
import pytest
from matplotlib.layout_engine import ConstrainedLayoutEngine
from support.common import BODIES, ROOT, same_bits

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError, SimulationError, StructureError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.summary import title_of
from rigidmd.features.view.figures.picture import Picture
from rigidmd.io.scene_file import write_scene
from rigidmd.run import Every, Simulation
from rigidmd.run.record import read_record
from rigidmd.run.schedule import CheckpointSchedule
from rigidmd.scene import Scene

TOP = ROOT / "systems" / "heavy_top_3.toml"
SHORT = ["--set", "run.duration_s=0.05"]


def read(path):
    """motion.csv: the columns by their headers, of which the first word is the name."""
    with path.open() as file:
        rows = list(csv.reader(file))
    return dict(zip(rows[0], np.array(rows[1:], dtype=float).T, strict=True))


def test_a_run_leaves_what_it_promises(tmp_path, printed):
    folder = tmp_path / "top"
    command = ["run", str(TOP), "-o", str(folder), "--set", "output.npz=true", "-v", *SHORT]
    said = printed(*command).out
    for part in ("3 degrees of freedom", "L_z error", "orthogonality", "motion.csv", "axis.png"):
        assert part in said
    names = {
        path.name
        for path in folder.iterdir()
        if not path.name.startswith((".rigidmd", "checkpoint"))
    }
    figures = {
        f"{name}.{end}"
        for name in ("axis", "angles", "omega", "invariants")
        for end in ("png", "svg")
    }
    files = {
        "scene.toml",
        "motion.csv",
        "motion.npz",
        "summary.json",
        "topology.pdb",
        "trajectory.xtc",
    }
    assert names == figures | files
    assert (folder / "axis.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (folder / "axis.svg").read_bytes()[:1000]
    columns = read(folder / "motion.csv")
    wanted = [
        "time",
        "x",
        "y",
        "z",
        "vx",
        "vy",
        "vz",
        *(f"q{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)),
        "qw",
        "qx",
        "qy",
        "qz",
        "phi",
        "theta",
        "psi",
        "kinetic",
        "potential",
        "energy",
        "work",
    ]
    wanted += [f"{name}_body_{k}" for name in ("omega", "L") for k in (1, 2, 3)]
    wanted += [f"{name}_lab_{k}" for name in ("omega", "L") for k in "xyz"]
    assert set(wanted) <= {header.split()[0] for header in columns}
    assert {"energy_error", "L_z_error", "L_3_error", "orthogonality_error", "qw", "q23"} <= set(
        columns
    )
    assert {
        "time (s)",
        "x (m)",
        "vz (m/s)",
        "phi (rad)",
        "omega_lab_x (rad/s)",
        "L_body_3 (kg m^2/s)",
        "work (J)",
    } <= set(columns)
    # the same from Python, to the last bit
    scene = rigidmd.Scene.read(TOP, {"run.duration_s": 0.05})
    results = rigidmd.Simulation(scene).run()
    with np.load(folder / "motion.npz") as stored:
        assert set(stored) == {header.split()[0] for header in columns}
        for header, column in columns.items():
            name = header.split()[0]
            found = results[name]
            assert column.tobytes() == found.tobytes() == stored[name].tobytes(), name
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["steps"] == 100
    assert summary["largest_relative_error"]["energy"] < 1e-12
    # nothing is overwritten unasked
    assert main(["run", str(TOP), "-o", str(folder), *SHORT]) == 2
    assert main(["run", str(TOP), "-o", str(folder), "--force", *SHORT]) == 0
    # the resolved scene is the same run
    again = Simulation(Scene.read(folder / "scene.toml")).run()
    assert again["theta"].tobytes() == results["theta"].tobytes()


def test_a_motion_without_units_in_its_header_is_read_as_well(tmp_path, capsys, printed):
    """As earlier versions wrote it."""
    run = ["run", str(TOP), *SHORT, "--set", "output.figures=false", "-o"]
    assert main([*run, str(tmp_path / "new")]) == main([*run, str(tmp_path / "old")]) == 0
    path = tmp_path / "old" / "motion.csv"
    head, rest = path.read_text().split("\n", 1)
    names = [header.split()[0] for header in head.split(",")]
    path.write_text(",".join(["t", *names[1:]]) + "\n" + rest)
    new, old = (read_record(tmp_path / name) for name in ("new", "old"))
    assert list(old.columns) == list(new.columns)
    assert all(old.columns[name].tobytes() == new.columns[name].tobytes() for name in new.columns)
    capsys.readouterr()
    assert (
        "the runs are the same to the last bit"
        in printed("compare", tmp_path / "new", tmp_path / "old").out
    )
    assert main(["view", str(tmp_path / "old")]) == 0


def test_columns_agree_with_each_other():
    results = Simulation(
        Scene.read(
            ROOT / "systems" / "gyroscope_friction.toml",
            {"run.duration_s": 0.2, "output.interval_s": 1e-4},
        )
    ).run()
    q = np.stack([results[f"q{i}{j}"] for i in (1, 2, 3) for j in (1, 2, 3)], -1).reshape(-1, 3, 3)
    w = np.stack([results[f"omega_body_{k}"] for k in (1, 2, 3)], -1)
    x = np.stack([results[k] for k in "xyz"], -1)
    assert x == pytest.approx(0.04 * q[:, :, 2], abs=1e-15)
    speed = np.gradient(x, results["time"], axis=0, edge_order=2)
    assert (
        np.abs(speed - np.stack([results[f"v{k}"] for k in "xyz"], -1)).max()
        < 1e-4 * np.abs(speed).max()
    )
    lab = np.stack([results[f"omega_lab_{k}"] for k in "xyz"], -1)
    assert lab == pytest.approx(np.einsum("tij,tj->ti", q, w), abs=1e-12)
    assert results["L_body_3"] == pytest.approx(1.2e-4 * w[:, 2], rel=1e-14)
    assert results["kinetic"] == pytest.approx(0.5 * (w**2 @ results.system.inertia), rel=1e-13)
    assert results["potential"] == pytest.approx(0.15 * 9.81 * results["z"], abs=1e-15)
    quaternion = np.stack([results[k] for k in ("qw", "qx", "qy", "qz")], -1)
    assert np.abs(np.diff(quaternion, axis=0)).max() < 0.1  # its sign does not jump
    theta = np.arccos(q[:, 2, 2])
    assert results["theta"] == pytest.approx(theta, abs=1e-7)


@pytest.mark.parametrize("name", ["trajectory.xtc", "t.trr", "t.nc", "t.xyz", "t.pdb"])
def test_trajectories_show_the_body(name, tmp_path):
    scene = Scene.read(
        ROOT / "systems" / "body_in_fluid.toml",
        {
            "run.duration_s": 0.05,
            "output.interval_s": 0.01,
            "output.trajectory": name,
            "output.figures": False,
            "start.velocity_m_s": [0.3, 0.2, 0.1],
        },
    )
    results = Simulation(scene, tmp_path / "run").run()
    universe = mda.Universe(str(tmp_path / "run" / "topology.pdb"), str(tmp_path / "run" / name))
    assert len(universe.trajectory) == 6
    system = results.system
    assert system.scale == pytest.approx(10 / 0.2)  # the half-axis of 0.2 m is drawn with 10 Å
    for k, frame in enumerate(universe.trajectory):
        centre = np.array([results[c][k] for c in "xyz"]) * 50
        assert universe.atoms.positions.mean(axis=0) == pytest.approx(centre, abs=0.01)
        span = np.linalg.norm(universe.atoms.positions - centre, axis=1).max()
        assert span == pytest.approx(10, abs=0.02)
        if name in ("t.trr", "t.nc"):
            speed = np.array([results["v" + c][k] for c in "xyz"]) * 50
            assert frame.velocities.mean(axis=0) == pytest.approx(speed, abs=1e-3)
        if name not in ("t.xyz", "t.pdb"):
            assert frame.time == pytest.approx(0.01 * k, abs=1e-6)
    for universe in (
        results.universe(),
        Simulation(scene).run().universe(),
    ):  # a second as a picosecond
        trajectory = universe.trajectory
        assert [frame.time for frame in trajectory] == results["time"].tolist()
        assert (trajectory.dt, trajectory.totaltime) == (results["time"][1], results["time"][-1])
        speed = np.diff(trajectory.timeseries(order="fac").mean(axis=1), axis=0) / trajectory.dt
        known = np.stack([results[k] for k in ("vx", "vy", "vz")], axis=-1) * 50
        assert speed == pytest.approx(
            (known[1:] + known[:-1]) / 2, abs=1.0 if name == "trajectory.xtc" else 0.2
        )  # of some 20 Å/ps


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_check_describes_every_scene(path, printed):
    said = printed("check", path, "--verbose").out
    assert "degrees of freedom" in said
    assert "omitted:" in said
    assert "pair forces" in said


def test_an_observer_sees_the_body_and_an_interrupted_run_keeps_what_it_has(tmp_path):
    poses = []

    def look(moment):
        poses.append(moment.observation)
        if moment.time > 0.02:
            simulation.stop()

    scene = Scene.read(TOP, {"output.figures": False})
    simulation = Simulation(scene, tmp_path / "run", observers=[Every(0.005, look)])
    results = simulation.run()
    assert results.interrupted
    assert results["time"][-1] == pytest.approx(0.025)
    assert read(tmp_path / "run" / "motion.csv")["time (s)"][-1] == results["time"][-1]
    assert poses[-1].rotation[2, 2] == pytest.approx(np.cos(results["theta"][-1]), abs=1e-14)


def test_a_run_that_fails_keeps_the_motion_so_far(tmp_path):
    scene = Scene.read(
        TOP,
        {
            "output.figures": False,
            "run.integrator": "rk4",
            "run.formulation": "euler_angles",
            "start.euler_angles_deg": [0.0, 1e-3, 0.0],
            "start.euler_rates_rad_s": [0.0, -5.0, 0.0],
        },
    )
    with pytest.raises(SimulationError, match=r"singular at t = .* too near 0"):
        Simulation(scene, tmp_path / "run").run()
    assert len(read(tmp_path / "run" / "motion.csv")["time (s)"]) >= 1


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_resolved_scenes_are_scenes(path, tmp_path):
    scene = Scene.read(path)
    resolved = rigidmd.with_defaults(scene)
    assert rigidmd.with_defaults(resolved) == resolved == build_body(scene).scene
    assert resolved.output.interval_s == (scene.output.interval_s or scene.run.duration_s / 2000)
    assert resolved.output.trajectory_A_per_m > 0
    assert resolved.watch.orthogonality == 1e-9
    assert resolved.run == scene.run
    write_scene(tmp_path, resolved)
    assert Scene.read(tmp_path / "scene.toml").model_dump() == resolved.model_dump()


@pytest.mark.parametrize("integrator", ["rk4", "dop853"])
@pytest.mark.parametrize("name", ["heavy_top_3", "dropped_stone"])
def test_resolved_scenes_hold_what_a_solver_needs(name, integrator, tmp_path):
    """And no formulation of a point, which does not rotate."""
    scene = Scene.read(ROOT / "systems" / f"{name}.toml", {"run.integrator": integrator})
    resolved = rigidmd.with_defaults(scene)
    assert rigidmd.with_defaults(resolved) == resolved
    assert resolved.run.formulation == ("matrix" if build_body(scene).rotates else None)
    tolerance = 1e-10 if integrator == "dop853" else None
    assert resolved.run.relative_tolerance == resolved.run.absolute_tolerance == tolerance
    assert resolved.watch.orthogonality == 0.1
    write_scene(tmp_path, resolved)
    assert (
        rigidmd.with_defaults(Scene.read(tmp_path / "scene.toml")).model_dump()
        == resolved.model_dump()
    )


def test_wheels_are_shown(tmp_path):
    results = Simulation(
        Scene.read(ROOT / "systems" / "satellite_wheel.toml"), tmp_path / "run"
    ).run()
    assert results["h_body_3"][-1] == pytest.approx(0.4)
    assert (tmp_path / "run" / "omega.png").is_file()
    assert repr(results).count("\n") == 0


def test_a_run_reports_what_is_wrong_with_it():
    scene = Scene.read(
        TOP,
        {"output.trajectory": False, "run.integrator": "velocity_verlet", "run.timestep_s": 0.06},
    )
    simulation = Simulation(scene)
    said = simulation._introduction() + simulation._conclusion(simulation.run())
    assert "timestep_s is too long for this motion" in said
    assert "is not a whole number of steps of" in said
    assert "rotates by more than 180° between samples" in said


def test_what_a_trajectory_cannot_hold_is_reported(tmp_path):
    stone = {
        "body": {"mass_kg": 1.0, "solid": {"shape": "sphere", "radius_m": 0.05}},
        "run": {"duration_s": 1.0, "timestep_s": 0.1},
        "output": {"figures": False},
    }
    with pytest.raises(SceneError, match=r"start.position_m is 2e\+05 Å in the trajectory"):
        Simulation(
            Scene.from_dict(stone | {"start": {"position_m": [0.0, 0.0, 1000.0]}}), tmp_path / "far"
        )
    for speed in (1e7, 1e60):  # the second one is beyond single precision, too
        fast = Scene.from_dict(stone | {"start": {"velocity_m_s": [speed, 0.0, 0.0]}})
        with pytest.raises(
            SimulationError,
            match=r"beyond the 2e\+07 Å that .xtc .output.trajectory. can hold.* The motion so far",
        ):
            Simulation(fast, tmp_path / f"{speed:g}").run()
        assert (tmp_path / f"{speed:g}" / "motion.csv").is_file()


@pytest.mark.parametrize("integrator", ["velocity_verlet", "rk4", "dop853"])
def test_the_scene_that_a_run_writes_runs_again_to_the_same_bits(integrator, tmp_path):
    changes = {"run.duration_s": 0.05, "run.integrator": integrator}
    first = Simulation(
        Scene.read(ROOT / "systems" / "heavy_top_3.toml", changes), tmp_path / "out"
    ).run()
    again = Scene.read(tmp_path / "out" / "scene.toml")
    assert again.output.interval_s is not None
    assert (again.run.formulation is None) == (integrator == "velocity_verlet")
    assert (again.run.relative_tolerance is None) == (integrator != "dop853")
    repeated = Simulation(again).run()
    assert same_bits(first.state, repeated.state)
    assert first["theta"].tobytes() == repeated["theta"].tobytes()


@pytest.mark.parametrize(
    ("output", "position", "topology"),
    [
        ({}, [0.0, 0.0, 3.0], "topology.pdb"),
        ({}, [0.0, 0.0, -18.0], "topology.gro"),
        ({"trajectory_A_per_m": 1e4}, [0.0, 0.0, 0.0], "topology.gro"),
        ({"topology": "t.gro"}, [0.0, 0.0, 0.0], "t.gro"),
    ],
)
def test_a_topology_holds_the_first_place(output, position, topology):
    data = {
        "body": {"mass_kg": 1.0, "solid": {"shape": "sphere", "radius_m": 0.2}},
        "start": {"position_m": position},
        "run": {"duration_s": 0.1, "timestep_s": 0.01},
    }
    assert build_body(Scene.from_dict(data | {"output": output})).scene.output.topology == topology
    with pytest.raises(SceneError, match=r"which t\.pdb cannot hold"):
        build_body(
            Scene.from_dict(
                data | {"output": {"topology": "t.pdb"}, "start": {"position_m": [0.0, 0.0, -30.0]}}
            )
        )
    with pytest.raises(SceneError, match=r"are both topology\.pdb"):
        Scene.from_dict(data | {"output": {"trajectory": "topology.pdb"}})


STIFF = """\
[body]
mass_kg = 1.0
inertia_kg_m2 = [0.02, 0.02, 0.01]
pinned = true
centre_of_mass_m = [0.0, 0.0, 0.1]
[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
[friction]
viscous_N_m_s = [{friction}, {friction}, {friction}]
[start]
euler_angles_deg = [0, 40, 0]
angular_velocity_body_rad_s = [0.0, 0.0, 50.0]
[run]
integrator = "{integrator}"
duration_s = 0.02
timestep_s = 1e-3
[output]
figures = false
"""


def stiff(tmp_path, friction, integrator="dop853"):
    (tmp_path / "stiff.toml").write_text(STIFF.format(friction=friction, integrator=integrator))
    return Scene.read(tmp_path / "stiff.toml")


@pytest.mark.parametrize("integrator", ["dop853", "radau"])
def test_a_solver_of_many_internal_steps_ends_between_two_observations_and_resumes_to_the_same_bits(
    tmp_path, integrator
):
    scene = stiff(tmp_path, 1e3, integrator)
    whole = Simulation(scene, tmp_path / "whole", warn=str).run()
    for name, after in (("early", 3), ("late", 10 if integrator == "radau" else 250)):
        run = Simulation(scene, tmp_path / name, warn=str)
        counted = iter(range(after))
        reset = run._part.reset

        def counting(reset=reset, run=run, counted=counted):
            reset()
            halts = run.engine.stop_requested
            run.engine.stop_requested = lambda: (
                halts() or (next(counted, None) is None and (run.stop(15) or True))
            )

        run._part.reset = counting
        results = run.run()
        assert (results.interrupted, results.signal, results.out_of_time) == (True, 15, False)
        assert run.engine.chosen_steps[0] == after + 1
        assert results["time"][-1] < 0.02
        if integrator == "dop853":
            Simulation(scene, tmp_path / name, resume=True, warn=str).run()
            for file in ("motion.csv", "trajectory.xtc"):
                assert (tmp_path / name / file).read_bytes() == (
                    tmp_path / "whole" / file
                ).read_bytes()
    assert whole["time"][-1] == pytest.approx(0.02)


def test_a_stiff_motion_ends_in_its_time_with_advice(tmp_path, monkeypatch):
    scene = stiff(tmp_path, 1e7)
    looks = iter(range(400))
    monkeypatch.setattr(
        CheckpointSchedule, "time_is_up", property(lambda self: next(looks, None) is None)
    )
    results = Simulation(scene, tmp_path / "out", warn=str).run()
    assert results.interrupted
    assert results.out_of_time
    assert results["time"].tolist() == [0.0]
    assert any("stiff" in note and "radau" in note for note in results.summary["notes"])


def test_a_motion_that_is_not_stiff_gets_no_such_advice():
    scene = Scene.read(
        TOP, {"run.integrator": "dop853", "run.duration_s": 0.5, "output.interval_s": 0.01}
    )
    run = Simulation(scene)
    run.run()
    assert run.engine.chosen_steps[0] > 50
    assert not run.engine.is_stiff
    assert run.engine._stiff_steps == 0


def test_a_run_of_a_body_imports_nothing_that_it_does_not_use(tmp_path):
    script = """
import atexit, gc, linecache, sys
atexit.register(lambda: print(gc.get_threshold()[0], gc.get_freeze_count(), *sys.modules))  # the last to be called
from rigidmd.commands.cli import main
from rigidmd.scene import Scene
assert not linecache.cache  # pydantic reads sources at the import of a scene if it is to find docstrings
assert main(["run", sys.argv[1], "--set", "run.duration_s=0.01", "--output", sys.argv[2]]) == 0
"""
    scene, folder = ROOT / "systems" / "heavy_top_3.toml", tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-c", script, scene, folder], capture_output=True, text=True, check=True
    )
    threshold, frozen, *loaded = done.stdout.splitlines()[-1].split()
    unused = {
        "ase",
        "rigidmd.features.bodies.ode.engine",
        "rigidmd.forces.ewald.pme",
        "rigidmd.run.molecular",
        "rigidmd.view",
        "matplotlib.pyplot",
        "scipy.integrate",
        "scipy.interpolate",
    }
    assert unused & set(loaded) == set()
    assert (
        int(threshold) >= 10_000 and int(frozen) > 100_000
    )  # no search for garbage among what is imported
    assert (folder / "axis.png").is_file()


@pytest.mark.usefixtures("draws")
def test_a_figure_is_laid_out_once_and_drawn_once_for_each_file(tmp_path, monkeypatch):
    drawn, laid_out = [], []
    draw, lay_out = Picture.draw, ConstrainedLayoutEngine.execute
    monkeypatch.setattr(
        Picture, "draw", lambda figure, renderer: (drawn.append(figure), draw(figure, renderer))
    )
    monkeypatch.setattr(
        ConstrainedLayoutEngine,
        "execute",
        lambda engine, figure: (laid_out.append(figure), lay_out(engine, figure)),
    )
    scene = Scene.read(ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.01})
    files = Simulation(scene, tmp_path / "run").run().files
    assert len(drawn) == len([path for path in files if path.suffix in (".png", ".svg")]) == 8
    assert len(laid_out) == 1  # axis.png; panels of curves have fixed positions


@pytest.mark.parametrize("integrator", ["velocity_verlet", "srkn_6", "dop853"])
def test_a_body_starts_from_the_reverse_of_its_end(integrator):
    changes = {"run.integrator": integrator, "run.duration_s": 0.5, "run.timestep_s": 1e-3}
    simulation = Simulation(Scene.read(TOP, changes))
    start = simulation.state.copy()
    end = simulation.run().state.copy()
    assert np.abs(end.rotation - start.rotation).max() > 0.1
    simulation.start_from(end._replace(angular_momentum_body=-end.angular_momentum_body))
    assert simulation.state.time[0] == simulation.state.step[0] == 0
    results = simulation.run()
    assert results["time"][0] == 0
    np.testing.assert_allclose(results.state.rotation, start.rotation, atol=1e-9)
    np.testing.assert_allclose(
        results.state.angular_momentum_body,
        -start.angular_momentum_body,
        atol=1e-9 * np.abs(start.angular_momentum_body).max(),
    )
    repeated = simulation.run().state
    assert same_bits(repeated, results.state)


@pytest.mark.parametrize("integrator", ["velocity_verlet", "dop853"])
def test_a_run_from_another_state_is_resumed_from_its_own_start(integrator, tmp_path):
    scene = Scene.read(
        TOP, {"run.duration_s": 0.4, "output.interval_s": 0.01, "run.integrator": integrator}
    )
    state = Simulation(scene).run().state
    ends = []
    for name, steps in (("whole", None), ("parts", 100)):
        simulation = Simulation(scene, tmp_path / name)
        simulation.start_from(state)
        if steps:
            simulation.step(steps)
            simulation.close()
            again = Scene.read(tmp_path / name / "scene.toml")
            simulation = Simulation(again, tmp_path / name, resume=True)
        ends.append(simulation.run())
    whole, parts = ends
    assert np.array_equal(whole.system.state.rotation, state.rotation)
    assert same_bits(whole.state, parts.state)
    assert (tmp_path / "whole" / "motion.csv").read_text() == (
        tmp_path / "parts" / "motion.csv"
    ).read_text()
    assert whole.summary["rates"] == parts.summary["rates"]


def test_a_body_begins_only_from_states_that_it_can_have():
    simulation = Simulation(Scene.read(TOP))
    state = simulation.state.copy()
    for name, value, message in (
        ("rotation", -state.rotation, "rotations"),
        ("rotation", np.eye(3)[None].repeat(2, 0), r"not \(1, 3, 3\); the scene is a single body"),
        ("angular_momentum_body", state.angular_momentum_body * np.nan, "is not finite"),
        ("position", np.zeros((1, 3)), r"has the shape \(1, 3\), not \(0, 3\).*pinned"),
        ("cell", np.eye(3), "has a periodic box"),
    ):
        with pytest.raises(StructureError, match=message):
            simulation.start_from(state._replace(**{name: value}))
    with pytest.raises(TypeError, match="needs a State"):
        simulation.start_from(state.rotation)
    rod = {"body": {"mass_kg": 1.0, "inertia_kg_m2": [0.0, 2.0, 2.0]}}
    rod |= {"start": {"angular_velocity_body_rad_s": [0.0, 1.0, 0.0]}}
    simulation = Simulation(Scene.from_dict(rod | {"run": {"duration_s": 1.0, "timestep_s": 0.1}}))
    along = simulation.state.angular_momentum_body + simulation.system.axes.T @ [0.1, 0.0, 0.0]
    with pytest.raises(StructureError, match="not 0 about an axis without inertia"):
        simulation.start_from(simulation.state._replace(angular_momentum_body=along))
    chosen = Scene.read(TOP, {"run.integrator": "auto", "run.energy_error": 1e-3})
    simulation = Simulation(chosen)
    with pytest.raises(StructureError, match="set integrator and timestep_s"):
        simulation.start_from(simulation.state)
    with simulation, pytest.raises(RuntimeError, match="the run has begun"):
        simulation.step(1)
        simulation.start_from(simulation.state)


@pytest.mark.parametrize(
    ("computing", "speed"), [(0.7, "; 143 steps/s"), (0.2, "; run time 1 s, most of it output")]
)
def test_a_run_that_mostly_writes_has_no_speed(computing, speed):
    times = {"wall_s": 1.5, "preparing_s": 0.5, "computing_s": computing}
    summary = {"steps": 100, "timestep_s": 0.01, "duration_s": 1.0, "steps_per_s": 100 / computing}
    assert title_of(summary | times) == f"100 steps of 0.01 s, 1 s{speed}"
