"""Stages of minimisation: input, messages, files, frames, precision."""

import csv
import json
import warnings

import ase.units
import numpy as np
import pytest
from support.common import shaken, small_scene
from support.minima import TIGHT, WELL, minimum_of, stage_of

from rigidmd.assemble.build import build
from rigidmd.core.state import state_of
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.engines.samples import moving
from rigidmd.errors import RigidMDWarning, SceneError, SimulationError
from rigidmd.features.studies.accuracy.accuracy import measure_accuracy
from rigidmd.features.view.kind_display import panels
from rigidmd.features.view.run_page import write_report
from rigidmd.io.trajectory import read_frames
from rigidmd.run import Every, Simulation
from rigidmd.run import minimise as minimise_module
from rigidmd.run import molecular as molecular_run
from rigidmd.run.kind import describe
from rigidmd.run.minimise import minimise, precision_of_minimisation
from rigidmd.run.record import read_record
from rigidmd.run.schedule import CheckpointSchedule
from rigidmd.scene import Scene
from rigidmd.units import KJ_PER_MOL


def test_it_begins_from_overlaps():
    """Two pairs of molecules in one another, one of them a hundredth of a diameter from each other: 1e24
    wells."""
    scene = small_scene({"argon": 10, "spce": 10}, 18.5, stages=[stage_of()])
    system, _, state = shaken(build(scene), 1, spread=0.1)
    state.position[1] = state.position[0] + [0.03, 0.01, 0.0]
    state.position[12] = state.position[11] + [0.4, 0.2, 0.1]
    found = minimise(system, state, scene.stages[0])
    assert found.energy_before > 1e20 * WELL
    assert found.converged
    assert found.overlap_steps > 0
    assert found.energy_after < 0
    assert found.force <= 0.1 * KJ_PER_MOL
    assert np.abs(np.linalg.det(state.rotation) - 1).max() < 1e-12


def test_it_states_how_far_it_came():
    scene = small_scene({"spce": 10}, 18.5, stages=[stage_of(max_iterations=3)])
    with pytest.warns(
        RigidMDWarning,
        match=r"stages.0: the minimisation has not converged after 3 iterations .*max_iterations = 3",
    ):
        results, found = minimum_of(scene)
    assert not found["converged"]
    assert found["ended_by"] == "max_iterations = 3"
    assert found["iterations"] == 3
    assert found["largest_force_kJ_mol_A"] > 0.1
    assert any(
        "largest force" in note and "(limit 0.1)" in note for note in results.summary["notes"]
    )
    assert found["energy_after_kJ_mol_per_molecule"] < found["energy_before_kJ_mol_per_molecule"]


def test_it_can_be_stopped():
    scene = small_scene({"spce": 10}, 18.5, stages=[stage_of()])
    system, _, state = shaken(build(scene), 1, spread=0.1)
    done = []
    found = minimise(system, state, scene.stages[0], lambda: len(done) == 2, done.append)
    assert (found.converged, found.ended_by, found.iterations) == (False, "interrupted", 2)
    assert found.energy_after < found.energy_before


def test_charges_that_nothing_separates():
    ion = {"mass_u": 20.0, "position_A": [0.0, 0.0, 0.0]}
    molecules = [
        {
            "name": "plus",
            "count": 1,
            "sites": [ion | {"name": "P", "charge_e": 1.0, "sigma_A": 2.5, "epsilon_kJ_mol": 0.4}],
        },
        {"name": "minus", "count": 1, "sites": [ion | {"name": "M", "charge_e": -1.0}]},
    ]
    scene = small_scene({}, None, molecules=molecules, stages=[stage_of()])
    simulation = Simulation(scene)
    simulation.start_from(state_of([[0.0, 0, 0], [4.0, 0.3, 0]]))
    with pytest.raises(
        SimulationError,
        match=r"no lower bound: P of molecule 1 .* and M of molecule 2 .*forces.pairs",
    ):
        simulation.run()


def test_atoms_that_are_nearly_in_one_position():
    """The squares of their forces exceed the range of numbers."""
    scene = small_scene({"argon": 2}, None, stages=[stage_of()])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results, minimum = minimum_of(scene, state_of([[0.0, 0.0, 0.0], [1e-12, 0.0, 0.0]]))
    assert minimum["converged"]
    assert results["potential"][-1] == pytest.approx(-WELL / KJ_PER_MOL, rel=1e-3)
    assert np.isnan(results["force_squares"][0]) and np.isfinite(results["force_squares"][-1])


def test_a_box_that_nothing_holds_together():
    scene = small_scene(
        {"argon": 8}, 12.5, forces={"cutoff_A": 6.0}, stages=[stage_of(pressure_bar=-5000.0)]
    )
    with pytest.raises(SimulationError, match=r"has grown to .* volumes .*higher pressure_bar"):
        minimum_of(scene)


def test_a_box_that_becomes_too_small_for_the_cutoff():
    scene = small_scene(
        {"argon": 8}, 12.5, forces={"cutoff_A": 6.0}, stages=[stage_of(pressure_bar=5000.0)]
    )
    with pytest.raises(SimulationError, match="too small for the cutoff"):
        minimum_of(scene)


@pytest.mark.parametrize(
    ("stages", "more", "expected"),
    [
        ([stage_of(duration_ps=1.0)], {}, "duration_ps would have no effect in a minimise stage"),
        ([stage_of(timestep_fs=1.0)], {}, "timestep_fs would have no effect"),
        ([stage_of(temperature_K=300.0)], {}, "temperature_K would have no effect"),
        ([stage_of(integrator="srkn_6")], {}, "integrator would have no effect"),
        (
            [stage_of(pressure_coupling="flexible")],
            {},
            "would have no effect in a minimise stage without pressure_bar",
        ),
        (
            [stage_of(pressure_limit_bar=2.0)],
            {},
            "would have no effect in a minimise stage without pressure_bar",
        ),
        ([stage_of(pressure_bar=(1.0, 2.0))], {}, "one pressure, not one that changes"),
        ([stage_of(pressure_bar=(1.0, 2.0, 3.0))], {}, "pressure_coupling = 'anisotropic'"),
        ([stage_of(max_iterations=0)], {}, "max_iterations"),
        ([stage_of(force_limit_kJ_mol_A=0.0)], {}, "force_limit_kJ_mol_A"),
        (
            [{"duration_ps": 1.0, "force_limit_kJ_mol_A": 0.2}],
            {},
            "force_limit_kJ_mol_A would have no effect in an nve stage",
        ),
        ([{"ensemble": "nve"}], {}, r"stages.0.duration_ps: is missing"),
        (
            [stage_of(), {"duration_ps": 1.0}],
            {"start": {}},
            "the first stage that is not a minimisation is nve",
        ),
        (
            [stage_of(pressure_bar=1.0)],
            {"box": {"lengths_A": 20.0, "periodic": False}},
            "box.periodic is false",
        ),
        (
            [stage_of(pressure_bar=1.0)],
            {"molecules": [{"model": "spce", "count": 4, "frozen": "1"}]},
            "frozen molecules do not move",
        ),
        (
            [stage_of(), {"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300.0}],
            {"start": {"temperature_K": 0.0}},
            "cannot heat molecules at rest",
        ),
    ],
)
def test_bad_input(stages, more, expected):
    with pytest.raises(SceneError, match=expected):
        small_scene({"spce": 4}, 20.0, stages=stages, **more)


def test_accuracy_needs_a_stage_that_is_not_a_minimisation():
    with pytest.raises(SceneError, match="the last stage is a minimisation"):
        measure_accuracy(small_scene({"spce": 4}, 20.0, stages=[stage_of()]))


def test_momenta_are_those_of_the_first_stage_that_moves():
    nvt = {"ensemble": "nvt", "duration_ps": 0.01, "temperature_K": 250.0}
    drawn = build(small_scene({"spce": 8}, 20.0, stages=[stage_of(), nvt], start={}))
    plain = build(small_scene({"spce": 8}, 20.0, stages=[nvt], start={}))
    assert drawn.scene.start.temperature_K == 250.0
    assert np.array_equal(drawn.state.velocity, plain.state.velocity)
    alone = build(small_scene({"spce": 8}, 20.0, stages=[stage_of()], start={}))
    assert alone.scene.start.temperature_K == 0.0
    assert not alone.state.velocity.any()
    assert not alone.state.angular_momentum_body.any()


SCENE = """\
[box]
density_g_cm3 = 0.9
[[molecules]]
model = "spce"
count = 40
[forces]
cutoff_A = 5.0
[[stages]]
ensemble = "minimise"
[[stages]]
name = "cell"
ensemble = "minimise"
pressure_bar = 1
[[stages]]
ensemble = "nvt"
temperature_K = 300
duration_ps = 0.02
[output]
log_interval_ps = 0.01
trajectory_interval_ps = 0.01
"""


def test_a_scene_through_the_command_line(tmp_path, printed):
    (tmp_path / "scene.toml").write_text(SCENE)
    said = " ".join(printed("check", tmp_path / "scene.toml").out.split())  # lines are wrapped
    assert (
        "0: minimise: to a minimum of the potential energy. No time passes and momenta do not change"
        in said
    )
    assert "1: cell: to a minimum of the enthalpy at 1 bar, the cell isotropic" in said
    assert "torques of 0.1 kJ/mol and a pressure within 1 bar. At most 5000 iterations" in said
    command = ["run", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "out"), "-v"]
    said = printed(*command).out
    assert "minimise: converged after" in said
    assert "cell: converged after" in said
    assert "bar of the given pressure" in said
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["Stage"] for row in rows] == ["minimise", "minimise", "cell", "nvt", "nvt"]
    assert [float(row["Time (ps)"]) for row in rows] == pytest.approx([0, 0, 0, 0.01, 0.02])
    assert [row["Drift (kJ/mol)"] for row in rows[:3]] == ["", "", ""]
    assert [float(row["Temperature (K)"]) for row in rows[:3]] == pytest.approx([300, 300, 300])
    energies = [float(row["Potential Energy (kJ/mol)"]) for row in rows]
    assert energies[0] > energies[1] > energies[2]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    kept, cell, nvt = summary["stages"]
    assert kept["minimum"]["converged"]
    assert kept["minimum"]["largest_pressure_deviation_bar"] is None
    assert cell["minimum"]["largest_pressure_deviation_bar"] <= 1
    assert cell["density_g_cm3"] == pytest.approx(float(rows[2]["Density (g/cm^3)"]))
    assert cell["density_g_cm3"] != pytest.approx(0.9, rel=1e-3)
    assert 40 * kept["minimum"]["energy_after_kJ_mol_per_molecule"] == pytest.approx(energies[1])
    assert nvt["steps"] == 8  # of 2.5 fs, the default that divides the intervals
    assert nvt["temperature_K"] > 0
    assert (tmp_path / "out" / "energy.png").is_file()
    again = Simulation(Scene.read(tmp_path / "out" / "scene.toml")).run()
    assert [ts.time for ts in again.universe().trajectory] == pytest.approx([0, 0.01, 0.02])
    with np.load(tmp_path / "out" / "final.npz") as final:
        for name in ("position", "rotation", "velocity"):
            assert np.array_equal(final[name], getattr(again.state, name))


def test_a_minimum_alone_has_no_figure(tmp_path):
    Simulation(
        small_scene({"argon": 4}, None, stages=[stage_of()], start={}), tmp_path / "out"
    ).run(progress=True)
    assert "energy.png" not in {path.name for path in (tmp_path / "out").iterdir()}
    assert "stages:" in describe(small_scene({"argon": 4}, None, stages=[stage_of()], start={}))


SHORT = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.02}
SEVERAL = [
    stage_of(name="a"),
    stage_of(name="b"),
    SHORT,
    stage_of(name="c", max_iterations=3),
    SHORT,
]
EVERY_STEP_OR_TWO = {
    "trajectory_interval_ps": 0.01,
    "log_interval_ps": 0.004,
    "pressure_tensor_interval_ps": 0.01,
}


def several(folder, stages, trajectory, **options):
    output = EVERY_STEP_OR_TWO | {"trajectory": trajectory, "figures": False}
    scene = small_scene(
        {"argon": 20}, 20.0, stages=stages, start={"temperature_K": 90.0}, output=output
    )
    return Simulation(scene, folder, warn=lambda warning: None, **options)


@pytest.mark.parametrize(
    "ending", [".xtc", ".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb", None]
)
@pytest.mark.usefixtures("reads_here")
def test_a_trajectory_has_one_frame_of_each_time(tmp_path, ending):
    folder = None if ending is None else tmp_path / "out"
    seen = []
    looks = Every(0.01, lambda moment: seen.append(moment.state.position.copy()))
    results = several(folder, SEVERAL, f"t{ending or '.xtc'}", observers=looks).run()
    times = [0.0, 0.01, 0.02, 0.03, 0.04]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        u = results.universe()
    assert [ts.time for ts in u.trajectory] == pytest.approx(times)
    assert u.trajectory.dt == pytest.approx(0.01)
    assert u.trajectory.totaltime == pytest.approx(0.04)
    for ts, positions in zip(u.trajectory, seen, strict=True):  # those after the minimisations
        assert ts.positions == pytest.approx(positions, abs=6e-3)
    energies = results["potential"]
    minima = {0: results.summary["stages"][1], 2: results.summary["stages"][3]}
    for k, stage in minima.items():
        assert results.atoms(
            k
        ).get_potential_energy() / ase.units.kJ * ase.units.mol == pytest.approx(
            20 * stage["minimum"]["energy_after_kJ_mol_per_molecule"]
        )
    assert list(results["stage"][:3]) == [
        0,
        0,
        1,
    ]  # the log has the energy before each minimisation
    assert energies[0] > energies[1] >= energies[2]
    if ending is None:
        assert results._tensor[:, 0] == pytest.approx(times)
        return
    found = read_frames(folder / f"t{ending}", 20, 100)
    assert found.time == pytest.approx(times, abs=1e-6)
    record = read_record(folder)
    assert list(record.columns["stage"]) == list(results["stage"])
    assert list(
        np.unique(record.columns["stage"][moving(record.scene.stages, record.columns["stage"])])
    ) == [2, 4]


@pytest.mark.parametrize("stopped_in", [0, 1, 3])
def test_an_interrupted_minimisation_leaves_a_frame_that_its_repetition_replaces(
    tmp_path, monkeypatch, stopped_in
):
    whole = several(tmp_path / "whole", SEVERAL, "t.xtc")
    whole.run()
    run = several(tmp_path / "out", SEVERAL, "t.xtc")

    def stopped(system, state, stage, stop, advanced):
        if stage is system.scene.stages[stopped_in]:
            run.stop()
        return minimise(system, state, stage, stop, advanced)

    monkeypatch.setattr(molecular_run, "minimise", stopped)
    results = run.run()
    done = [0.0] if stopped_in < 2 else [0.0, 0.01, 0.02]
    assert results.interrupted
    assert [ts.time for ts in results.universe().trajectory] == pytest.approx(done)
    several(tmp_path / "out", SEVERAL, "t.xtc", resume=True).run()
    for name in ("t.xtc", "log.csv", "pressure_tensor.csv", "final.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_minimisation_and_its_overlap_removal_end_in_their_time(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        CheckpointSchedule, "time_is_up", property(lambda self: asked.append(1) or len(asked) > 1)
    )
    (tmp_path / "two.xyz").write_text("3\n\nAr 0 0 0\nAr 0.9 0 0\nAr 0 1.1 0\n")
    sections = {
        "structure": {"file": "two.xyz"},
        "molecules": [{"model": "argon"}],
        "box": {"periodic": False},
    }
    scene = small_scene({}, None, tmp_path, **sections, stages=[stage_of(), SHORT], start={})
    results = Simulation(scene, tmp_path / "out", warn=lambda warning: None).run()
    assert results.interrupted
    assert results.out_of_time
    (found,) = [stage["minimum"] for stage in results.summary["stages"]]
    assert (found["converged"], found["ended_by"], found["iterations"]) == (False, "interrupted", 0)
    assert found["overlap_removal_steps"] <= 2
    monkeypatch.undo()
    results = Simulation(scene, tmp_path / "out", resume=True, warn=lambda warning: None).run()
    assert not results.interrupted
    assert results.summary["stages"][0]["minimum"]["converged"]
    assert results.summary["stages"][0]["minimum"]["overlap_removal_steps"] > 2


def test_a_minimum_alone_has_one_frame(tmp_path):
    results = several(tmp_path / "out", [stage_of(), stage_of(name="again")], "t.xtc").run()
    u = results.universe()
    assert len(u.trajectory) == 1
    assert u.atoms.positions == pytest.approx(results.state.position, abs=6e-3)
    write_report(tmp_path / "out", tmp_path / "report.html")
    record = read_record(tmp_path / "out")
    assert panels(record) == []
    assert not moving(record.scene.stages, record.columns["stage"]).any()


def test_structures_that_overlap_may_be_minimised(tmp_path):
    (tmp_path / "two.xyz").write_text("2\n\nAr 0 0 0\nAr 1.5 0 0\n")
    sections = {
        "structure": {"file": "two.xyz"},
        "molecules": [{"model": "argon"}],
        "box": {"periodic": False},
    }
    scene = small_scene(
        {}, None, tmp_path, **sections, stages=[stage_of(force_limit_kJ_mol_A=1e-4)], start={}
    )
    results, found = minimum_of(scene)
    assert found["converged"]
    assert any("overlap" in note for note in results.summary["notes"])
    assert np.linalg.norm(np.diff(results.state.position, axis=0)) == pytest.approx(
        2 ** (1 / 6) * 3.405, rel=1e-3
    )


def test_compiling_is_not_minimising(monkeypatch):
    """The first forces, which may compile for a minute, come before the clock of the stage, in its
    precision."""
    from rigidmd.run import molecular

    order = []
    evaluate, minimise_stage = CpuEngine.evaluate, molecular.minimise

    def evaluate_and_record(engine, state):
        order.append(f"forces in {engine._setup.dtype.__name__}")
        return evaluate(engine, state)

    def minimise_and_record(*arguments):
        order.append("minimise")
        return minimise_stage(*arguments)

    monkeypatch.setattr(CpuEngine, "evaluate", evaluate_and_record)
    monkeypatch.setattr(molecular, "minimise", minimise_and_record)
    stages = [
        stage_of(max_iterations=2, **TIGHT),
        {"duration_ps": 0.002},
        stage_of(max_iterations=2),
    ]
    Simulation(small_scene({"argon": 20}, 20.0, stages=stages, precision="mixed"), warn=str).run()
    assert order.count("minimise") == 2
    assert "forces in float64" in order[: order.index("minimise")]


@pytest.mark.parametrize(
    ("counts", "limit", "precision"),
    [
        ({"spce": 10}, 10.0, "mixed"),
        ({"argon": 10}, 0.1, "mixed"),
        ({"spce": 10}, 1e-4, "double"),
        ({"argon": 10}, 1e-5, "double"),
    ],
)
def test_loose_limits_need_no_double_precision(counts, limit, precision):
    """The minimum is the same to the error of mixed precision; no kernel of double precision is
    loaded."""
    limits = {"force_limit_kJ_mol_A": limit, "torque_limit_kJ_mol": limit}
    energies = {}
    for each in ("mixed", "double"):
        scene = small_scene(counts, 18.5, stages=[stage_of(**limits)], precision=each)
        system, _, state = shaken(build(scene), 1, spread=0.1)
        minimum = minimise(system, state, scene.stages[0])
        assert minimum.converged
        assert minimum.precision == (precision if each == "mixed" else "double")
        at_minimum, _ = system.engine_of(system.terms, "double").evaluate(state)
        assert np.linalg.norm(at_minimum.force, axis=1).max() < 1.01 * limit * KJ_PER_MOL
        energies[each] = minimum.energy_after
    assert energies["mixed"] == pytest.approx(energies["double"], rel=1e-4 if limit < 10 else 0.1)


def test_a_pressure_is_found_in_double_precision():
    scene = small_scene({"argon": 20}, 20.0, stages=[stage_of(pressure_bar=1.0)], precision="mixed")
    assert precision_of_minimisation(build(scene), scene.stages[0]) == "double"


def test_where_mixed_precision_stalls_double_precision_continues(monkeypatch):
    """Also from a start whose energy single precision cannot hold: two sites 0.001 Å from each other."""
    scene = small_scene({"argon": 10}, 18.5, stages=[stage_of()], precision="mixed")
    system, _, state = shaken(build(scene), 1, spread=0.1)
    overlapping = state.copy()
    minimum = minimise(system, state, scene.stages[0])
    assert minimum.precision == "mixed"
    overlapping.position[1] = overlapping.position[0] + [0.001, 0.0, 0.0]
    assert minimise(system, overlapping, scene.stages[0]).precision == "double"
    step = minimise_module._Descent.step

    def stall_in_mixed_precision(descent, point):
        return None if descent._enthalpy.precision == "mixed" else step(descent, point)

    monkeypatch.setattr(minimise_module._Descent, "step", stall_in_mixed_precision)
    _, _, state = shaken(build(scene), 1, spread=0.1)
    stalled = minimise(system, state, scene.stages[0])
    assert (stalled.converged, stalled.precision) == (True, "double")
    assert stalled.energy_after == pytest.approx(minimum.energy_after, rel=1e-4)
