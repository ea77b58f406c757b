"""Progress of a run on a terminal, in a notebook and elsewhere; lines of the log."""

import contextlib
import fcntl
import io
import os
import pty
import struct
import subprocess
import sys
import termios

import numba
import pytest
from support.common import ROOT, small_scene
from support.processes import process

from rigidmd.commands.streams import shown_working, warn
from rigidmd.compile.cache import CacheIndex
from rigidmd.io import progress, run_files
from rigidmd.run import Every, Simulation, molecular
from rigidmd.run.minimise import minimise
from rigidmd.run.molecular import MolecularRun


def test_lines_of_the_log_are_written_together_but_soon(tmp_path, monkeypatch):
    now = 0.0
    monkeypatch.setattr(run_files.clock, "monotonic", lambda: now)
    path, samples = (
        tmp_path / "log.csv",
        Simulation(small_scene({"argon": 5}, 30.0)).run().samples.rows,
    )
    file = run_files.Log(path, run_files.columns(tensor=False))

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


def test_compiling_is_announced_without_a_terminal(tmp_path, monkeypatch, printed):
    """A run that waits for the compiler states so, once."""
    prepare = MolecularRun.prepare
    index = CacheIndex(str(tmp_path), "kernel", 0)

    def compile_first(run):
        for n in (1, 2):
            assert index.load(((numba.types.UniTuple(numba.types.float64, n),), ())) is None
        prepare(run)

    monkeypatch.setattr(MolecularRun, "prepare", compile_first)
    scene = [str(ROOT / "systems" / "argon.toml"), "--set", "stages.0.duration_ps=0.01"]
    lines = printed("run", *scene, "-o", tmp_path / "out").err.splitlines()
    assert len([line for line in lines if "compiling (" in line]) == 1


def test_off_a_terminal_lines_state_how_far_it_is(monkeypatch, capsys):
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
            {"ensemble": "minimise", "max_iterations": 2},
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


@pytest.mark.parametrize("terminal", [True, False])
def test_a_command_shows_that_it_works_on_a_terminal(terminal):
    """Also on one that has no size. The line is cleared before the command ends."""
    command = [
        sys.executable,
        "-m",
        "rigidmd",
        "energy",
        str(ROOT / "systems" / "water_dimer.toml"),
    ]
    if not terminal:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stderr == ""
        return
    leader, follower = pty.openpty()
    fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 0, 0, 0, 0))
    with process(command, stdout=subprocess.PIPE, stderr=follower) as energy:
        os.close(follower)
        shown = b""
        with contextlib.suppress(OSError):  # at the end of a terminal
            while part := os.read(leader, 1000):
                shown += part
        os.close(leader)
        assert b"potential" in energy.stdout.read()
        assert energy.wait() == 0
    assert b"computing energies and forces ..." in shown
    assert not shown.decode().rstrip("\r").rpartition("\r")[2].strip()


def test_a_warning_is_not_on_the_line_of_a_bar(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    with shown_working("comparing"):
        warn("too long")
        shown = sys.stderr.getvalue()
    assert shown.startswith("\r  comparing ...\r")
    assert "\rrigidmd: warning: too long\n\r  comparing ..." in shown
