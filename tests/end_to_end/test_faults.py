"""Errors from outside: disks that fill, folders that go, signals, streams that are closed, damaged
files.

Whatever happens, a run ends with one sentence, and what it has written before can be read and gone
on with.
"""

import ctypes
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT
from support.processes import WAIT, process, search_path, wait_until

import rigidmd
from rigidmd.commands import cli
from rigidmd.core.files import AppendedFile
from rigidmd.core.state_file import read_state
from rigidmd.errors import RigidMDError
from rigidmd.io.checkpoint import latest, read_checkpoint
from rigidmd.io.folder import CHECKPOINT, FINAL, LOG, PREVIOUS
from rigidmd.run.schedule import interruptible

SCENE = """\
box.density_g_cm3 = 0.9
forces = { cutoff_A = 5.0, truncation = "smooth_switch" }
start.temperature_K = 298.0
output = { log_interval_ps = 0.002, trajectory_interval_ps = 0.02, checkpoint_minutes = 1e-9, figures = false }

[[molecules]]
model = "spce"
count = 40

[[stages]]
ensemble = "nvt"
temperature_K = 298.0
duration_ps = 0.1
"""
TRAJECTORY = "trajectory.xtc"
PIPES = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
#: So long that a test ends it, without the estimate of the longest stable step that a long run
#: makes.
LONG = ("--set", "stages.0.duration_ps=1000", "--set", "watch.stable_step=false")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A scene; a run of it, in `whole` next to it."""
    path = tmp_path_factory.mktemp("scene") / "water.toml"
    path.write_text(SCENE)
    assert cli.main(["run", str(path), "-o", str(path.parent / "whole"), "--threads", "1"]) == 0
    return path


def command(scene: Path, folder: Path, *more: str) -> list[str]:
    return [
        sys.executable,
        "-m",
        "rigidmd",
        "run",
        str(scene),
        "-o",
        str(folder),
        "--threads",
        "1",
        *more,
    ]


def ran(arguments: list[str], **options) -> subprocess.CompletedProcess:
    """A finished process, with what it wrote."""
    options = PIPES | options
    return subprocess.run(arguments, env=os.environ | options.pop("env", {}), **options)


def same(scene: Path, folder: Path) -> bool:
    """Whether a run ended like the one that nothing happened to."""
    return cli.main(["compare", str(scene.parent / "whole"), str(folder)]) == 0


@pytest.fixture
def disk(tmp_path) -> Iterator:
    """A function that makes a small file system of this many kB; its folder."""
    place = tmp_path / "disk"
    place.mkdir()

    def make(size: int) -> Path:
        made = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", place], capture_output=True
        )
        if made.returncode:
            pytest.skip(f"no small file system can be made here: {made.stderr.decode().strip()}")
        return place

    yield make
    subprocess.run(["umount", place], capture_output=True)


# What is written when the disk is full: the scene, the log, the first checkpoint, frames or a later
# checkpoint.
@pytest.mark.parametrize(
    "size",
    [
        96,
        *(
            pytest.param(size, marks=pytest.mark.soak)
            for size in (4, 8, 16, 24, 32, 48, 64, 128, 192, 256)
        ),
    ],
)
def test_a_disk_that_fills(size, scene, disk, tmp_path):
    """The run ends with a sentence; with workspace again it continues to the same bits."""
    place = disk(size)
    done = ran(command(scene, place / "run", *LONG))
    said = done.stderr.decode()
    assert done.returncode == 1 and "No space left on device" in said and "Traceback" not in said
    assert not [
        path for path in (place / "run").iterdir() if path.name.startswith(".") and path.suffix
    ]
    shutil.copytree(place / "run", tmp_path / "run")
    if "rigidmd resume" in said:
        until = "0.1ps" if size < 150 else "0.5ps"
        shutil.copytree(scene.parent / "whole", tmp_path / "whole")
        for name in ("run", "whole"):
            assert cli.main(["resume", str(tmp_path / name), "--until", until]) == 0
        assert cli.main(["compare", str(tmp_path / "whole"), str(tmp_path / "run")]) == 0
    else:
        assert not (tmp_path / "run" / CHECKPOINT).exists()


def test_a_folder_that_is_removed_meanwhile(scene, tmp_path):
    log = tmp_path / "run" / LOG
    with process(command(scene, tmp_path / "run", *LONG), **PIPES) as run:
        wait_until(lambda: log.exists() and log.stat().st_size > 2000, run)
        (tmp_path / "run").rename(
            tmp_path / "gone"
        )  # at once: one file after another may leave a checkpoint for a moment
        said = run.communicate()[1].decode()
    assert run.returncode == 1
    # the file that the run is writing to, or the next one, whichever it notices first
    assert (
        "was removed while the run was writing it" in said
        or "cannot be written: No such file" in said
    ), said
    assert "Traceback" not in said and "rigidmd resume" not in said


def test_a_folder_that_cannot_be_written(scene, disk, tmp_path):
    place = disk(64)
    subprocess.run(["mount", "-o", "remount,ro", place], check=True)
    done = ran(command(scene, place / "run"))
    assert done.returncode == 2
    assert "cannot be written: no permission" in done.stderr.decode()


@pytest.mark.parametrize(
    "stream",
    [
        "full",
        pytest.param("closed", marks=pytest.mark.soak),
        pytest.param("gone", marks=pytest.mark.soak),
    ],
)
def test_a_standard_output_that_takes_nothing(stream, scene, tmp_path):
    """The run is not lost for it."""
    line = " ".join(f"'{part}'" for part in command(scene, tmp_path / "run"))
    into = {"full": "> /dev/full", "closed": ">&- 2>&-", "gone": "| true; exit ${PIPESTATUS[0]}"}[
        stream
    ]
    done = ran(["bash", "-c", f"{line} {into}"])
    assert "Traceback" not in done.stderr.decode()
    assert same(scene, tmp_path / "run")


@pytest.mark.parametrize(
    "changed",
    [{"LC_ALL": "C"}, pytest.param({"PYTHONIOENCODING": "latin-1"}, marks=pytest.mark.soak)],
)
def test_a_poor_environment(changed, scene, tmp_path):
    """No home, no UTF-8, a path with spaces and letters of other scripts."""
    folder = tmp_path / "ein Häuschen 水"
    # variables of OpenBLAS choose its code, and with it the last bits of what NumPy multiplies
    names = [
        name
        for name in os.environ
        if name in ("PATH", "RIGIDMD_CACHE") or name.startswith("OPENBLAS_")
    ]
    kept = {name: os.environ[name] for name in names}
    done = subprocess.run(
        command(scene, folder),
        capture_output=True,
        env=kept | changed | search_path(),
    )
    assert done.returncode == 0, done.stderr
    assert b"rigidmd view" in done.stdout
    assert same(scene, folder)


SIGNALS = [signal.SIGTERM, signal.SIGINT]


@pytest.mark.soak
@pytest.mark.parametrize("sent", SIGNALS, ids=lambda sent: sent.name)
def test_a_run_that_is_stopped_by_signals_continues(sent, scene, tmp_path):
    """At 25 random moments each, preparing included."""
    rng = np.random.default_rng(int(sent))
    for _ in range(25):
        words = ("--resume", "--set", "stages.0.duration_ps=0.5")
        with process(command(scene, tmp_path / "run", *words), **PIPES) as run:
            time.sleep(float(rng.uniform(1.0, 8.0)))  # not while Python itself starts
            run.send_signal(sent)
            said = run.communicate(timeout=WAIT)[1].decode()
        assert run.returncode in (0, 128 + sent, -sent), said
        assert "Traceback" not in said
    shutil.copytree(scene.parent / "whole", tmp_path / "whole")
    for name in ("run", "whole"):
        assert cli.main(["resume", str(tmp_path / name), "--until", "0.5ps"]) == 0
    assert cli.main(["compare", str(tmp_path / "whole"), str(tmp_path / "run")]) == 0


def test_ctrl_c_in_a_callback_of_a_compiler_is_not_lost(capfd):
    """Python ignores exceptions in functions that C calls, and prints them."""
    steps = []

    def press():
        steps.append("pressed")
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("not interrupted")
        return 0

    call = ctypes.CFUNCTYPE(ctypes.c_int)(press)
    before = signal.signal(
        signal.SIGINT, signal.default_int_handler
    )  # a process in the background may ignore it
    try:
        with pytest.raises(KeyboardInterrupt), interruptible():
            call()
            steps.append("called")
            for _ in range(12_000):  # two minutes: only where the interrupt is lost until the end
                time.sleep(0.01)
            steps.append("lost")
    finally:
        signal.signal(signal.SIGINT, before)
    assert steps == ["pressed", "called"]
    assert capfd.readouterr().err == ""


@pytest.mark.soak
def test_a_command_that_is_interrupted_while_it_compiles(scene, tmp_path):
    """Ctrl-C ends it with 130, wherever it comes, and the code that it leaves behind can be
    used."""
    rng = np.random.default_rng(4)
    for k in range(9):
        cache = {"RIGIDMD_CACHE": str(tmp_path / f"cache{k}")}
        environ = os.environ | cache
        with process(command(scene, tmp_path / f"run{k}"), env=environ, **PIPES) as run:
            time.sleep(float(rng.uniform(1.0, 20.0)))
            run.send_signal(signal.SIGINT)
            said = run.communicate(timeout=WAIT)[1].decode()
        assert run.returncode == 130, said
        assert "Traceback" not in said and "no compiled object" not in said
    assert ran(command(scene, tmp_path / "last"), env=cache).returncode == 0
    assert same(scene, tmp_path / "last")


@pytest.mark.soak
def test_two_first_compilations_at_once(scene, tmp_path):
    options = {"env": os.environ | {"RIGIDMD_CACHE": str(tmp_path / "cache")}} | PIPES
    with (
        process(command(scene, tmp_path / "run0"), **options) as first,
        process(command(scene, tmp_path / "run1"), **options) as second,
    ):
        for run in (first, second):
            assert b"Traceback" not in run.communicate(timeout=WAIT)[1] and run.returncode == 0
    assert same(scene, tmp_path / "run0") and same(scene, tmp_path / "run1")


def test_a_run_that_was_killed_at_its_first_file_begins_again(scene, tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "..rigidmd-run.0123456789abcdef").write_text("half a na")
    assert cli.main(["run", str(scene), "-o", str(folder), "--threads", "1", "--resume"]) == 0
    assert same(scene, folder)


@pytest.mark.parametrize("of", [MemoryError, KeyboardInterrupt])
def test_what_a_library_makes_an_error_of_another_type_is_reported(of, scene, monkeypatch, printed):
    """zipfile raises ValueError where memory ends."""

    def read(*given, **more):
        try:
            raise of
        except of:
            raise ValueError("an open file is in the way")  # noqa: B904

    monkeypatch.setattr(rigidmd.Scene, "read", read)
    said = printed("check", scene, code=2 if of is MemoryError else 130).err
    assert (
        "not enough memory" if of is MemoryError else "interrupted"
    ) in said and "way" not in said


def read_back(folder: Path, name: str) -> bytes | dict[str, bytes]:
    """What a command would continue with after reading a file of a run. Raises RigidMDError."""
    if name == FINAL:
        found = read_state(folder / name)
        arrays = {
            "species": found.species,
            "residue_number": found.residue_number,
            "models": found.models,
        }
        arrays |= found.state._asdict()
        return {name: array.tobytes() for name, array in arrays.items() if array is not None}
    kept, faults = latest(folder)
    if name in (CHECKPOINT, PREVIOUS):
        assert all(CHECKPOINT in fault for fault in faults)
        return {name: array.tobytes() for name, array in kept.arrays.items()}
    owner = {LOG: "LogFile", TRAJECTORY: "Frames"}[name]
    size, checksum = next(part["kept"] for who, part in kept.values["of"].items() if who == owner)[
        :2
    ]
    found = AppendedFile(folder / name, (size, checksum))
    found.cut()
    found.close()
    return (folder / name).read_bytes()


@pytest.mark.parametrize("times", [25, pytest.param(1000, marks=pytest.mark.soak)])
def test_damaged_files_of_a_run(times, scene, tmp_path):
    """Flipped and cut files are rejected by name or give way to the checkpoint before; or the damage
    changes nothing."""
    names = [CHECKPOINT, PREVIOUS, FINAL, LOG, TRAJECTORY]
    whole = {name: read_back(scene.parent / "whole", name) for name in names}
    before = {
        name: array.tobytes()
        for name, array in read_checkpoint(scene.parent / "whole" / PREVIOUS).arrays.items()
    }
    rng = np.random.default_rng(times)
    refused = dict.fromkeys(names, 0)
    for k in range(times):
        name = names[k % len(names)]
        shutil.copytree(scene.parent / "whole", tmp_path / "run")
        path = tmp_path / "run" / name
        data = bytearray(path.read_bytes())
        if rng.random() < 0.5:
            del data[int(rng.integers(len(data))) :]
        else:
            data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(data))
        try:
            found = read_back(tmp_path / "run", name)
            assert found == whole[name] or (name == CHECKPOINT and found == before)
        except RigidMDError as error:
            assert name in str(error)
            refused[name] += 1
        shutil.rmtree(tmp_path / "run")
    assert refused[CHECKPOINT] == refused[PREVIOUS] == 0
    assert refused[FINAL] > times / 20
    assert refused[LOG] == refused[TRAJECTORY] == times // 5


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="the driver forks, and reads /proc")


def drive(*arguments: str) -> int:
    """Number of cases that `python tests/support/faults.py` executed without a failure."""
    command = [sys.executable, str(ROOT / "tests" / "support" / "faults.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return int(re.search(r"^(\d+) cases .* 0 failures$", done.stdout, re.MULTILINE)[1])


@LINUX
def test_runs_survive_mixed_errors():
    """The first cases of a fixed series."""
    assert drive("--first", "1", "--cases", "4") == 4


@LINUX
@pytest.mark.soak
@pytest.mark.parametrize("series", [[], ["--wide"]], ids=["narrow", "wide"])
def test_runs_survive_mixed_errors_for_an_hour(series):
    """Another series each time; the message of a failure has the line that replays it."""
    assert drive("--minutes", "60", *series) > 100
