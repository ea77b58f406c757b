"""Intervals of a run in whole steps, and signals that end it."""

import csv
import json
import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import MDAnalysis as mda
import pytest
from support.common import ROOT, small_scene
from support.processes import process, wait_until

from rigidmd.run import Every, Simulation
from rigidmd.run.kind import describe

ASKED = {
    "log_interval_ps": 0.01,
    "trajectory_interval_ps": 0.05,
    "pressure_tensor_interval_ps": 0.002,
}


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
        assert note in " ".join(describe(scene).split())  # lines are wrapped
    results = run.run()
    assert set(scene.rounded_times()) <= set(results.summary["notes"])
    times = [ts.time for ts in results.universe().trajectory]
    assert times[1] == pytest.approx(0.066)  # the first stage is shorter than the interval
    assert results["time"][:3] == pytest.approx([0.0, 0.008, 0.016])


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


def test_a_signal_that_the_program_handles_is_left_to_it():
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


def test_a_killed_run_leaves_a_readable_log_and_trajectory(tmp_path):
    with running(tmp_path, 100) as (_, folder):
        pass
    with (folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) >= 99
    assert frames_in(folder) >= len(rows) // 10 - 1  # a frame every ten lines
