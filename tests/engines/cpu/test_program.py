"""The step as a table of passes: what is compiled for which part of a scene, and how the table is
printed."""

import re
import time

import numpy as np
import pytest
from support.common import ROOT, built, same_bits, small_scene

from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.commands.cli import main
from rigidmd.compile import (
    ALWAYS,
    JOINED,
    Pass,
    Program,
    kernel,
    load_arguments,
    run_passes,
    set_threads,
    task,
)
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.dynamics import step_loop
from rigidmd.engines.cpu.program import profile_from, profile_of, program_of_forces, program_of_step
from rigidmd.forces.neighbors import update
from rigidmd.io.scene_file import write_scene
from rigidmd.run import Simulation

EARLY, LATE = 1, 2
PME = {"cutoff_A": 6.0, "electrostatics": "pme"}


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
    loops, updates = len(step_loop._advance.compiled), len(update.build_if_invalid.compiled)
    for thermostat in ("langevin", "nose_hoover", "hybrid_monte_carlo"):
        run(STAGE | {"thermostat": thermostat})
    for barostat in ("cell_rescaling", "monte_carlo"):
        run(PRESSED | {"barostat": barostat})
    run({"ensemble": "nve", "duration_ps": 0.002}, truncation="force_shift")
    assert len(step_loop._advance.compiled) == loops
    assert len(update.build_if_invalid.compiled) == updates


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


def test_the_program_of_the_forces_is_in_the_order_in_which_it_runs():
    _, engine, state = built({"spce": 150}, 17.0, forces=PME)
    rows = program_of_forces(engine, state)
    assert rows[0].text.startswith("lennard_jones: images of the neighbour list")
    assert {"with energies", "without energies", ""} == {row.when for row in rows}
    order = [row.text for row in rows]
    steps = [
        "coulomb_reciprocal: positions in grid cells",
        "coulomb_real: positions of sites",
        "lennard_jones: positions of sites",
        "lennard_jones: build the neighbour list, if it is not valid",
        "coulomb_reciprocal: charges on the grid, transform of planes",
        "coulomb_real: forces of pairs",
        "lennard_jones: forces of pairs",
        "lennard_jones: forces and torques on molecules",
        "coulomb_reciprocal: forces and torques on molecules",
    ]
    assert sorted(steps, key=order.index) == steps


def test_forces_of_terms_are_one_job_and_few_molecules_need_none():
    """Chains of terms run at the same time, and sums on molecules block by block."""
    for molecules, edge, jobs in ((150, 17.0, 3), (60, 13.0, 2)):
        _, engine, state = built({"spce": molecules}, edge, forces=PME)
        passes = engine.passes(state)
        assert len({one.job for _, one in passes}) == jobs + 1
        chains = [
            (name, one.chain)
            for name, one in passes
            if one.text in ("forces of pairs", "forces on sites")
        ]
        assert len({chain for _, chain in chains}) == 3
        assert {one.chain for _, one in passes if "on molecules" in one.text} == (
            {JOINED} if molecules > 128 else {0}
        )
        assert all(
            one.job == 0 for _, one in passes if "list" in one.text or "cell has" in one.text
        )


def test_check_prints_the_program_of_each_stage(tmp_path, printed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "water"]) == 0
    out = printed("check", "water.toml", "--program").out
    assert "program of a step of stages.1 (equilibration, baoab)" in out
    assert "program of a step of stages.2 (production, velocity_verlet)" in out
    assert "stages.0" not in out.partition("program of a step")[2]
    assert "lennard_jones: build the neighbour list" in out
    assert main(["new", "heavy_top_1"]) == 0
    assert (
        "--program is for molecules"
        in printed("check", "heavy_top_1.toml", "--program", code=2).err
    )


def measured_scene():
    return small_scene(
        {"spce": 150, "argon": 5},
        17.0,
        forces={"cutoff_A": 6.0},
        stages=[STAGE | {"timestep_fs": 0.5}],
    )


@pytest.mark.parametrize("threads", [1, min(2, MOST_THREADS)])
def test_a_profile_has_the_times_of_all_rows_of_a_step(threads):
    system = build(measured_scene())
    engine = system.engine()
    engine.threads = threads
    scheme = integrator_of_stage(system, 0)
    numbers, steps, rows, idle = profile_of(engine, system.state, scheme, 5e-4)
    assert numbers == tuple(dict.fromkeys((1, threads)))
    texts = [text for text, _ in rows]
    forces = program_of_forces(engine, system.state)
    assert set(texts) >= {row.text for row in forces if row.when != "with energies"}
    assert not set(texts) & {row.text for row in forces if row.when == "with energies"} - {
        row.text for row in forces if row.when != "with energies"
    }
    moves = [row.text for row in program_of_step(engine, system.state, scheme)]
    assert set(texts) >= {text for text in moves if "drift" in text or "thermostat" in text}
    assert "forces" not in texts
    for k, step in enumerate(steps):
        assert sum(times[k] for _, times in rows) == pytest.approx(step)
    assert all(max(times) > 0 and min(times) >= 0 for _, times in rows[:-1])
    assert 0 <= idle < 1
    assert engine.threads == threads
    assert profile_of(engine, system.state, scheme, 5e-4).threads == numbers


def test_a_profile_divides_the_time_of_threads():
    """Two chains of one job, a list that is built on both threads, a serial row, one that did not
    act; times of all blocks on one thread and on two."""
    rows = [
        Pass("pairs", _work, (), 16, job=1, chain=0),
        Pass("serial row of a chain", _work, (), job=1, chain=1),
        Pass("list", _work, ()),
        Pass("serial", _work, ()),
        Pass("none", _work, ()),
    ]
    sums = np.array([[8.0, 2.0, 4.0, 1.0, 0.0], [9.0, 2.0, 2.0, 1.0, 0.0]])
    profile = profile_from(rows, (1, 2), np.array([16.0, 10.0]), sums)
    assert profile.rows == [
        ("pairs", (8.0, 4.5)),
        ("serial row of a chain", (2.0, 1.0)),
        ("list", (4.0, 2.0)),
        ("serial", (1.0, 1.0)),
        ("waiting, and all else", (1.0, 1.5)),
    ]
    # of 20: pairs 9, the chain 2, the list 4, as on one thread, and the serial row 1
    assert profile.idle == pytest.approx(1 - 16 / 20)


def test_a_profile_has_rows_that_act_rarely():
    barostat = {"ensemble": "npt", "pressure_bar": 1.0, "barostat": "monte_carlo"}
    scene = small_scene({"argon": 60}, 20.0, stages=[STAGE | barostat | {"timestep_fs": 2.0}])
    system = build(scene)
    rows = profile_of(system.engine(), system.state, integrator_of_stage(system, 0), 2e-3).rows
    assert any("trial move of the box" in text and min(times) > 0 for text, times in rows)


def test_measuring_changes_no_bits():
    system = build(measured_scene())
    scheme = integrator_of_stage(system, 0)
    found = []
    for is_measured in (False, True):
        engine = system.engine()
        state = engine.begin(system.state, scheme)
        engine.advance(state, scheme, 5e-4, 2)
        rows = engine.measure(state) if is_measured else []
        engine.advance(state, scheme, 5e-4, 30)
        assert all(of.any() for one, of in rows if one.text == "coulomb_real: forces of pairs")
        found.append(state)
    assert same_bits(*found)


@task()
def _work(arguments, block):
    total, count = load_arguments(arguments)
    for n in range(count):
        total[block] += np.sqrt(n + block)


def test_the_time_of_blocks_is_measured():
    status, total = np.zeros(1, np.int64), np.zeros(6)
    passes = [Pass("much", _work, (total, 400_000), 6), Pass("little", _work, (total, 100_000), 6)]
    program = Program(passes, ALWAYS, status)
    program.bind(passes)
    spent = program.measure()
    set_threads(1)
    assert run_rows(program.rows, ALWAYS) == 0  # compiles
    spent[:] = 0
    began = time.perf_counter_ns()
    assert run_rows(program.rows, ALWAYS) == 0
    whole = time.perf_counter_ns() - began
    set_threads(MOST_THREADS)
    assert (spent[:, :6, 0] > 0).all() and not spent[:, 6:].any() and not spent[..., 1:].any()
    assert spent.sum() < whole
    before = spent.copy()
    program.bind(passes)  # as when arrays have been enlarged
    assert program.measure() is spent
    run_rows(program.rows, ALWAYS)
    assert (spent[:, :6, 0] > before[:, :6, 0]).all()


def test_check_prints_a_profile(tmp_path, printed):
    write_scene(tmp_path, measured_scene())
    out = printed("check", tmp_path / "scene.toml", "--profile").out
    lines = out.partition("time of a step of stages.0")[2].splitlines()
    table = [re.split(r"\s{2,}", line.strip()) for line in lines[1:]]
    if MOST_THREADS == 1:
        assert table[0] == ["time, µs", "1 thread", "of a step"]
        assert table[-1][0] == "a step" and table[-1][-1] == "100.0%"
        return
    assert table[0] == ["time, µs", "1 thread", f"{MOST_THREADS} threads", "gain", "of a step"]
    assert table[-2][0] == "a step" and table[-2][-1] == "100.0%"
    assert table[-1][0].startswith("idle: ")
    alone, together, gain = map(float, table[-2][1:4])
    assert gain == pytest.approx(alone / together, abs=0.006)
    assert sum(float(row[2]) for row in table[1:-2]) == pytest.approx(together, abs=3)


def test_an_ideal_gas_has_a_program_and_a_profile(tmp_path, printed):
    scene = small_scene({"argon": 5}, 20.0, forces={"lennard_jones": False}, stages=[STAGE])
    write_scene(tmp_path, scene)
    out = printed("check", tmp_path / "scene.toml", "--program", "--profile").out
    assert out.count("no forces: add forces ") == 3


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
