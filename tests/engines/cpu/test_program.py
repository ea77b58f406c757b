"""The step as a table of passes: what is compiled for which part of a scene, and how the table is
printed."""

import numpy as np
import pytest
from support.common import ROOT, built, small_scene

from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.commands.cli import main
from rigidmd.compile import ALWAYS, Pass, Program, kernel, load_arguments, run_passes, task
from rigidmd.dynamics import step_loop
from rigidmd.engines.cpu.program import program_of_forces, program_of_step
from rigidmd.forces.neighbors import update
from rigidmd.io.scene_file import write_scene
from rigidmd.run import Simulation

EARLY, LATE = 1, 2


@task()
def _append(arguments, block):
    """Append a number to a list whose length is its first element; fail at a limit."""
    log, number, status = load_arguments(arguments)
    log[0] += 1
    log[log[0]] = number + block
    if log[0] >= 6:
        status[0] = 9


@kernel(from_python=True)
def run_rows(rows, at):
    return run_passes(rows, rows.arguments, at)


def made(uses=ALWAYS):
    log, status = np.zeros(20, np.int64), np.zeros(1, np.int64)
    passes = [
        Pass("one", _append, (log, 10, status)),
        Pass("early", _append, (log, 20, status), when=EARLY),
        Pass("late", _append, (log, 30, status), when=LATE),
    ]
    program = Program(passes, uses, status)
    program.bind(passes)
    return program, log


@pytest.mark.parametrize(
    ("at", "expected"), [(EARLY, [10, 20]), (LATE, [10, 30]), (EARLY | LATE, [10, 20, 30])]
)
def test_passes_run_in_their_order_when_they_act(at, expected):
    program, log = made()
    assert run_rows(program.rows, at) == 0
    assert log[1 : 1 + log[0]].tolist() == expected


def test_a_status_ends_a_program():
    program, log = made()
    assert [run_rows(program.rows, EARLY | LATE) for _ in range(2)] == [0, 9]
    assert log[0] == 6
    log[0] = 5
    assert run_rows(program.rows, EARLY | LATE) == 9
    assert log[1:7].tolist() == [10, 20, 30, 10, 20, 10]


def test_what_is_never_used_is_not_a_row():
    program, _ = made(uses=EARLY)
    assert program.rows.when.tolist() == [ALWAYS, EARLY]


def test_arguments_of_another_type_are_refused():
    program, log = made(uses=EARLY)
    status = np.zeros(1, np.int64)
    other = [
        Pass("one", _append, (log, 1.5, status)),
        Pass("early", _append, (log, 20, status), when=EARLY),
    ]
    with pytest.raises(TypeError, match="_append was compiled for"):
        program.bind(other)


STAGE = {"ensemble": "nvt", "temperature_K": 100.0, "duration_ps": 0.002}
PRESSED = STAGE | {"ensemble": "npt", "pressure_bar": 1.0, "barostat_interval_ps": 0.001}


def test_the_step_loop_is_compiled_once_for_all_thermostats_barostats_and_forces():
    """Also for trajectories, no thermostat, and charges; the update of a list is compiled once for
    all potentials."""
    counts = {"spce": 5, "argon": 5}

    def run(stage, **forces):
        forces = {"cutoff_A": 5.0, "electrostatics": "reaction_field"} | forces
        Simulation(small_scene(counts, 14.0, stages=[stage], forces=forces), warn=str).run()

    run(STAGE)
    loops, updates = len(step_loop._advance.compiled), len(update.update_pair_list.compiled)
    for thermostat in ("langevin", "nose_hoover", "hybrid_monte_carlo"):
        run(STAGE | {"thermostat": thermostat})
    for barostat in ("cell_rescaling", "monte_carlo"):
        run(PRESSED | {"barostat": barostat})
    run({"ensemble": "nve", "duration_ps": 0.002}, truncation="force_shift")
    assert len(step_loop._advance.compiled) == loops
    assert len(update.update_pair_list.compiled) == updates


def test_a_stage_without_a_thermostat_has_no_flow_of_one():
    system, engine, state = built(
        {"argon": 5}, 20.0, stages=[STAGE, {"ensemble": "nve", "duration_ps": 0.01}]
    )
    texts = [
        [row.text for row in program_of_step(engine, state, integrator_of_stage(system, k))]
        for k in (0, 1)
    ]
    assert any("thermostat VelocityRescaling" in text for text in texts[0])
    assert not any("thermostat" in text for text in texts[1])


def test_the_program_of_the_forces_is_in_the_order_of_the_terms():
    _, engine, state = built({"spce": 4, "argon": 3}, 14.0, forces={"cutoff_A": 5.0})
    rows = program_of_forces(engine, state)
    assert rows[0].text.startswith("lennard_jones: ")
    assert {"with energies", "without energies", ""} == {row.when for row in rows}


def test_check_prints_the_program_of_each_stage(tmp_path, printed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "water"]) == 0
    out = printed("check", "water.toml", "--program").out
    assert "program of a step of stages.1 (equilibration, baoab)" in out
    assert "program of a step of stages.2 (production, velocity_verlet)" in out
    assert "stages.0" not in out.partition("program of a step")[2]
    assert "lennard_jones: update the neighbour list" in out
    assert main(["new", "heavy_top_1"]) == 0
    assert (
        "--program is for molecules"
        in printed("check", "heavy_top_1.toml", "--program", code=2).err
    )


def test_check_measures_the_rows_of_a_step(tmp_path, printed):
    scene = small_scene(
        {"spce": 30, "argon": 5},
        14.0,
        forces={"cutoff_A": 5.0},
        stages=[STAGE | {"timestep_fs": 0.5}],
    )
    write_scene(tmp_path, scene)
    lines = (
        printed("check", tmp_path / "scene.toml", "--profile")
        .out.partition("time of a step of stages.0")[2]
        .splitlines()
    )
    rows = [" ".join(line.split()[:-2]) for line in lines[2:] if line.endswith("%")]
    system, engine = build(scene), build(scene).engine()
    program = program_of_forces(engine, system.state)
    assert rows[:-1] == [row.text for row in program if row.when != "with energies"]
    times = [float(line.split()[-2]) for line in lines[2:] if line.endswith("%")]
    assert len(times) > 5
    assert all(spent >= 0 for spent in times)


def test_check_measures_a_potential_of_bodies(printed):
    assert (
        "gay_berne: forces of pairs of bodies"
        in printed("check", ROOT / "systems" / "gay_berne.toml", "--profile").out
    )


def test_a_scene_is_compiled_without_running_it(tmp_path, capsys, printed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "heavy_top_1"]) == 0
    capsys.readouterr()
    for expected in ("heavy_top_1: ", "heavy_top_1: all code is there already"):
        assert expected in printed("compile", "heavy_top_1.toml").out
    assert not (tmp_path / "runs").exists()
    simulation = Simulation(small_scene({"argon": 5}, 20.0, stages=[STAGE]), warn=str)
    before = simulation.state.copy()
    simulation.compile()
    assert all(
        np.array_equal(one, other) for one, other in zip(simulation.state, before, strict=True)
    )
    assert simulation.run().state.step[0] == 1
