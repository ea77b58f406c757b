"""Points of a sweep in processes of their own, on clusters and by schedulers: stops, errors, signals."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from support.processes import WAIT, process, wait_until
from support.sweeps import GRID, run_here, states, written

from rigidmd.commands import cli
from rigidmd.errors import OutputError
from rigidmd.features.studies.sweep import points as sweep_points
from rigidmd.features.studies.sweep import sweeping
from rigidmd.features.studies.sweep.folder import read_manifest
from rigidmd.features.studies.sweep.points import format_walltime, wait_for_folder
from rigidmd.io.folder import FolderLock
from rigidmd.io.progress import progress_of


def same_runs(first, second):
    """Whether two sweeps have the same points, with the same bits in logs and trajectories."""
    names = sorted(path.parent.name for path in first.glob("*/log.csv"))
    assert names == sorted(path.parent.name for path in second.glob("*/log.csv"))
    files = ("log.csv", "trajectory.trr")
    return all(
        (first / n / f).read_bytes() == (second / n / f).read_bytes() for n in names for f in files
    )


def test_values_of_numpy_in_a_sweep(argon, tmp_path):
    """Arrays and their numbers name folders as numbers do."""
    numbers = {"seed": [1, 2], "start.temperature_K": [90.5, 100.25], "stages.0.duration_ps": 0.5}
    arrays = {
        "seed": np.arange(1, 3),
        "start.temperature_K": np.array([90.5, 100.25]),
        "stages.0.duration_ps": np.float32(0.5),
    }
    listed = {
        "seed": (np.int64(k) for k in (1, 2)),
        "start.temperature_K": list(arrays["start.temperature_K"]),
    }
    wanted = sweeping.axes_of(numbers)
    assert sweeping.axes_of(arrays) == wanted
    assert sweeping.axes_of(listed) == wanted[:2]
    found = [
        [point.folder for point in long_sweep(argon, tmp_path / name, **changes).points]
        for name, changes in (("a", numbers), ("b", arrays))
    ]
    assert found[0] == found[1]


#: Two points that take seconds: the log is written each second.
LONG = {
    "stages.0.duration_ps": 6000.0,
    "output.trajectory_interval_ps": 200.0,
    "output.log_interval_ps": 10.0,
    "seed": range(1, 3),
}


def long_sweep(argon, folder, **more):
    """Manifest of a sweep of points that take seconds."""
    with sweeping.open_sweep(argon, sweeping.axes_of(LONG | more), folder) as manifest:
        return manifest


def finish(manifest, jobs=2, receive=lambda name, line: None, pool=None):
    """Run what is left of a sweep, and return the signal that stopped it."""
    bar = progress_of(1.0, "points", shown=False)
    with bar, pool or ThreadPoolExecutor(jobs) as executor:
        return sweep_points.run_points(manifest, executor, bar, receive=receive)


def names_in(manifest, *states):
    return [point.folder for point in manifest.points_in(*states)]


@contextmanager
def when_running(folder, act):
    """Within the block, call `act(name)` with the first point of a sweep whose log has grown, from
    another thread."""
    ended = threading.Event()

    def watch():
        while not ended.wait(0.05):
            for log in folder.glob("*/log.csv"):
                is_moving = log.read_bytes().count(b"\n") > 3
                if is_moving and not (log.parent / "summary.json").exists():
                    act(log.parent.name)
                    return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture(scope="module")
def whole(argon, tmp_path_factory):
    """Two points that were never stopped."""
    folder = tmp_path_factory.mktemp("whole") / "sweep"
    run_here(argon, sweeping.axes_of(LONG), folder)
    return folder


def kill_run(folder):
    """Kill the process of a run in a folder."""
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (path / "cmdline").read_bytes().split(b"\0")
            if str(folder).encode() in words:
                os.kill(int(path.name), signal.SIGKILL)


def test_a_killed_process_loses_its_point_alone_and_a_signal_stops_all(argon, whole, tmp_path):
    """The first point that moves is killed, then the sweep is stopped, and continues later."""
    folder = tmp_path / "sweep"
    manifest, killed = long_sweep(argon, folder), []

    def kill_first(name):
        killed.append(name)
        kill_run(folder / name)

    def stop_later(name):
        kill_first(name)
        while states(folder)[name] not in ("failed", "finished"):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    with when_running(folder, stop_later):
        stopped = finish(manifest, jobs=1)  # the next point has only begun when the signal comes
    assert killed, "no point was seen while it ran"
    assert stopped == signal.SIGTERM
    assert names_in(manifest, "failed") == killed
    assert names_in(manifest, "interrupted", "waiting")
    failed = next(point for point in read_manifest(folder).points if point.folder == killed[0])
    assert "was killed" in failed.message
    assert set(states(folder).values()) <= {"interrupted", "waiting", "finished", "failed"}
    assert not list(folder.glob(".points-*"))
    again = long_sweep(argon, folder)
    assert finish(again) is None and not again.unfinished
    assert same_runs(folder, whole)


def test_a_second_interrupt_ends_all_points_at_once(argon, tmp_path):
    folder = tmp_path / "sweep"
    manifest = long_sweep(argon, folder, **{"stages.0.duration_ps": 1e6})

    with when_running(folder, lambda name: [os.kill(os.getpid(), signal.SIGINT) for _ in "12"]):
        assert finish(manifest) == signal.SIGINT
    assert not names_in(manifest, "finished", "failed")


def test_points_end_with_their_sweep(argon, tmp_path):
    """Their standard input ends with the process of the sweep, however it dies."""
    folder = tmp_path / "sweep"
    words = ["--set", "seed=1,2", "--set", "stages.0.duration_ps=1e6", "-o", str(folder)]
    command = [sys.executable, "-m", "rigidmd", "sweep", str(argon), *words, "--jobs", "1"]
    moving = threading.Event()
    with (
        process(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as sweep,
        when_running(folder, lambda name: moving.set()),
    ):
        wait_until(moving.is_set, sweep)
    wait_for_folder(folder / "seed=1", WAIT)
    assert (folder / "seed=1" / "checkpoint.npz").is_file()
    assert len(list(folder.glob(".points-*"))) == 1
    assert cli.main([*command[3:], "--walltime", "0:00:01"]) == 75
    assert not list(folder.glob(".points-*"))


def test_points_that_fail_are_reported_and_repeated(argon, tmp_path, capsys):
    """A time step that is far too long ends a run."""
    folder = tmp_path / "sweep"
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "stages.0.timestep_fs=5,100000",
        "--set",
        "stages.0.duration_ps=100",
        "--set",
        "watch.stable_step=false",
        "-o",
        str(folder),
    ]
    assert cli.main(arguments) == 1
    assert states(folder) == {"timestep_fs=5": "finished", "timestep_fs=100000": "failed"}
    said = capsys.readouterr().out
    assert "failed: timestep_fs=100000" in said
    assert "the same command" in said


def test_a_wall_time_that_is_over_leaves_the_rest(argon, tmp_path, capsys):
    """Two points that nobody has the time for."""
    folder = tmp_path / "sweep"
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1,2",
        "--set",
        "stages.0.duration_ps=1e7",
        "--set",
        "output.trajectory=false",
        "--set",
        "output.log_interval_ps=100",
        "-o",
        str(folder),
    ]
    assert cli.main([*arguments, "--walltime", "0:00:03", "--jobs", "1"]) == 75
    assert set(states(folder).values()) <= {"interrupted", "waiting"}
    assert "the same command continues" in capsys.readouterr().out


def test_a_point_waits_for_a_run_that_is_about_to_stop(tmp_path):
    lock = FolderLock(tmp_path)
    lock.take()
    with pytest.raises(OutputError, match="did not end within"):
        wait_for_folder(tmp_path, 0.1)
    lock.release()
    wait_for_folder(tmp_path, 0.1)


def test_a_scene_that_changes_meanwhile_is_not_run(argon, tmp_path):
    manifest = long_sweep(argon, tmp_path / "sweep", seed=[1, 2])
    for point in manifest.points:
        point.scene_sha256 = "other"
    finish(manifest)
    assert len(manifest.points_in("failed")) == 2
    assert "has changed since the sweep began" in manifest.points[0].message


@pytest.mark.soak
def test_a_sweep_that_is_killed_continues(argon, tmp_path):
    """3 temperatures, 8 seeds, two at a time; the sweep is killed in the middle."""
    arguments = [
        str(argon),
        "--set",
        "start.temperature_K=90,100,110",
        "--set",
        "seed=1..8",
        "--set",
        "stages.0.duration_ps=100",
        "--jobs",
        "2",
    ]
    command = [sys.executable, "-m", "rigidmd", "sweep", *arguments, "-o", str(tmp_path / "parts")]
    with process(command, start_new_session=True) as parent:
        wait_until(
            lambda: list(states_or_none(tmp_path / "parts").values()).count("finished") >= 6, parent
        )
    for point in (tmp_path / "parts").glob("seed=*"):
        wait_for_folder(point, WAIT)
    done = written(tmp_path / "parts")
    assert 6 <= len(done) < 24
    assert cli.main(["sweep", *arguments, "-o", str(tmp_path / "parts")]) == 0
    assert {
        name: when for name, when in written(tmp_path / "parts").items() if name in done
    } == done
    assert cli.main(["sweep", *arguments, "-o", str(tmp_path / "whole")]) == 0
    assert same_runs(tmp_path / "parts", tmp_path / "whole")
    assert (tmp_path / "parts" / "sweep.csv").read_bytes() == (
        tmp_path / "whole" / "sweep.csv"
    ).read_bytes()


def states_or_none(folder):
    return states(folder) if (folder / "sweep.json").exists() else {}


def test_points_run_on_a_cluster_of_dask(argon, finished, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        arguments = ["sweep", str(argon), "--set", "seed=1..1", "--set", "start.temperature_K=120"]
        arguments += ["-o", str(tmp_path / "sweep"), "--scheduler", cluster.scheduler_address]
        assert cli.main(arguments) == 0
    assert "1 finished" in capsys.readouterr().out
    ours, theirs = tmp_path / "sweep" / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()


@pytest.mark.soak
def test_a_signal_stops_a_cluster(argon, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    folder = tmp_path / "sweep"
    manifest = long_sweep(argon, folder)
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            processes=False,
            dashboard_address=None,
            protocol="tcp",
        ) as cluster,
        when_running(folder, lambda name: os.kill(os.getpid(), signal.SIGTERM)),
    ):
        stopped = finish(manifest, pool=sweep_points.cluster(cluster.scheduler_address))
    assert stopped == signal.SIGTERM
    assert manifest.unfinished and not manifest.points_in("failed")
    again = long_sweep(argon, folder)
    finish(again)
    assert not again.unfinished
    assert same_runs(folder, whole)


def test_without_a_cluster(argon, tmp_path, monkeypatch, printed):
    monkeypatch.setattr(sweep_points, "CONNECT_TIMEOUT", 0.5)
    arguments = ["sweep", str(argon), *GRID, "-o", str(tmp_path / "sweep"), "--scheduler"]
    if "distributed" in sys.modules:
        assert (
            "no scheduler of dask.distributed answers"
            in printed(*arguments, "tcp://127.0.0.1:9", code=2).err
        )
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert "pip install distributed" in printed(*arguments, "tcp://127.0.0.1:9", code=2).err


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A working directory, and a stub of sbatch that runs an array at once."""
    (tmp_path / "bin").mkdir()
    stub = f"""#!{sys.executable}
import os, re, subprocess, sys
script = sys.argv[-1]
told = [a.partition("=")[2] for a in sys.argv[1:] if a.startswith("--array=")]
spec = told[0] if told else re.search("--array=(.*)", open(script).read())[1]
print("sbatch", spec, file=open("jobs", "a"))
for part in spec.split(","):
    first, _, last = part.partition("-")
    for k in range(int(first), int(last or first) + 1):
        subprocess.run(["bash", script], env=os.environ | {{"SLURM_ARRAY_TASK_ID": str(k)}})
"""
    for name, text in (
        ("sbatch", stub),
        ("rigidmd", f'#!/bin/bash\nexec {sys.executable} -m rigidmd "$@"\n'),
    ):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")


def test_a_script_for_slurm(argon, finished, slurm, printed):
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1..1",
        "--set",
        "start.temperature_K=120",
        "-o",
        "my sweep",
    ]
    assert cli.main([*arguments, "--to", "slurm", "--walltime", "0:10:00"]) == 0
    script = Path("my sweep/sweep.sbatch")
    text = script.read_text()
    assert "#SBATCH --array=0\n" in text
    assert "#SBATCH --time=0:10:00\n" in text
    assert not list(Path("my sweep").glob("*/log.csv"))
    subprocess.run(["sbatch", str(script.absolute())], check=True)
    assert "1 of them finished" in printed("sweep", argon, "-o", "my sweep", "--collect").out
    ours, theirs = Path("my sweep") / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()
    assert (
        cli.main(
            [*arguments[:3], "seed=1..3", *arguments[4:], "--to", "slurm", "--walltime", "0:10:00"]
        )
        == 0
    )
    assert "#SBATCH --array=1,2\n" in script.read_text()


def test_commands_for_any_scheduler(argon, finished, slurm, printed):
    """A line for each point that has not finished, which a shell runs."""
    axes = ["--set", "start.temperature_K=120", "--set", "seed=1..2"]
    lines = printed("sweep", argon, *axes, "-o", "my sweep", "--to", "commands").out.splitlines()
    assert len(lines) == 2
    assert not list(Path("my sweep").glob("*/log.csv"))
    subprocess.run(["bash", "-c", lines[0]], check=True)
    assert (
        printed("sweep", argon, *axes, "-o", "my sweep", "--to", "commands").out.splitlines()
        == lines[1:]
    )
    ours, theirs = Path("my sweep") / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()


@pytest.mark.soak
def test_slurm_jobs_submit_themselves_again(argon, slurm):
    """Jobs whose time is up, until their points have finished."""
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1..2",
        "--set",
        "stages.0.duration_ps=2500",
        "-o",
        "sweep",
    ]
    assert cli.main([*arguments, "--to", "slurm", "--walltime", "0:00:08"]) == 0
    subprocess.run(["sbatch", "sweep/sweep.sbatch"], check=True)
    assert len(Path("jobs").read_text().splitlines()) > 2
    assert cli.main(["sweep", str(argon), "-o", "sweep", "--collect"]) == 0
    assert cli.main([*arguments[:-1], "whole"]) == 0
    assert same_runs(Path("sweep"), Path("whole"))


def test_words_for_slurm():
    assert format_walltime(3661.9) == "1:01:01"
    assert format_walltime(100 * 3600) == "100:00:00"
