"""The running of points. A point is a process of `rigidmd run --resume` in its folder.

The threads of an executor wait for these processes, in this process or in the workers of a
dask.distributed cluster with a common file system. Messages of points are in files, which this
module reads. Another file requests that points stop.
"""

import re
import shutil
import signal
import subprocess
import time as clock
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from filelock import FileLock, Timeout

from rigidmd.core.files import write_text, writing
from rigidmd.core.process import BY_SIGNAL, OUT_OF_TIME, python_process
from rigidmd.core.signals import SEPARATE_GROUP, STOP_SIGNAL
from rigidmd.errors import OutputError, RigidMDError, SettingError, describe_error, option
from rigidmd.features import provider
from rigidmd.features.studies.sweep.folder import Manifest, SweepPoint
from rigidmd.features.studies.sweep.plan import digest_of
from rigidmd.io.folder import LOCK
from rigidmd.io.progress import Bar
from rigidmd.run.schedule import checked_walltime, signal_handler
from rigidmd.scene import Scene
from rigidmd.scene.base import format_override

#: Seconds to wait for a run in the folder of a point that is about to stop: its sweep was killed,
#: or dask moved it.
LOCK_TIMEOUT = 120.0
#: Seconds between two checks for a request to stop, between two readings of messages, and of
#: waiting for a scheduler.
POLL_INTERVAL, TICK, CONNECT_TIMEOUT = 0.2, 0.5, 20.0
POINTS_PER_SECOND = 1000  # of a large sweep, in the manifest
#: Time that is left for table and figure at the end of a wall time: seconds, and at most this
#: fraction.
FOR_TABLE, FOR_TABLE_FRACTION = 15.0, 0.1
OUTPUTS = ".points-"  # start of the name of the folder of messages
STOP = "stop"  # the file that requests a signal, by its number
#: Exit codes of runs that finished, or were stopped.
UNEVENTFUL = (0, OUT_OF_TIME, BY_SIGNAL + signal.SIGINT, BY_SIGNAL + STOP_SIGNAL)
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
PROGRESS = re.compile(r"  (\S+) of (\S+) \S+, ")


class CommonSettings(NamedTuple):
    """What all points of a sweep have in common, on any machine with its file system."""

    sweep: Manifest  # without points
    trust: Sequence[str]
    threads: int
    working_directory: str
    outputs: Path  # folder for messages, and of the file STOP
    ends_at: float | None  # `time.time()` at which all has to have ended


def run_words(sweep: Manifest, point: SweepPoint, trust: Sequence[str]) -> list[str]:
    """The command that runs a point, or continues it."""
    resume = "--resume" if sweep.has_checkpoints else "--force"
    words = ["rigidmd", "run", sweep.scene, "-o"]
    words += [str((sweep.folder / point.folder).absolute()), resume]
    for key, value in sweep.overrides(point.values).items():
        words += ["--set", format_override(key, value)]
    for path in trust:
        words += ["--trust", str(Path(path).absolute())]
    return words


def trusted_by(sweep: Manifest, point: SweepPoint, trust: Sequence[str]) -> list[str]:
    """The trusted files that the scene of a point runs."""
    if not trust:
        return []
    scene = Scene.read(sweep.scene, sweep.overrides(point.values))
    unused = provider("unused_files", "--trust").unused_files(scene, trust)
    return [path for path in trust if path not in unused]


def run_point(point: SweepPoint, common: CommonSettings) -> tuple[int, float]:
    """Run a point. Returns its exit code and the seconds that it took. Raises RigidMDError."""
    began = clock.monotonic()
    sweep = common.sweep
    outputs = common.outputs
    words = ["-m", "rigidmd.core.bound_process"]
    walltime = []
    if _requested_signal(outputs):
        return BY_SIGNAL + STOP_SIGNAL, 0.0
    if common.ends_at is not None:
        seconds_left = common.ends_at - clock.time()
        if seconds_left <= 0:
            return OUT_OF_TIME, 0.0
        walltime = ["--walltime", format_walltime(seconds_left)]
    if not _is_unchanged(point, common):
        raise RigidMDError(
            f"{sweep.scene} or a file that it reads has changed since the sweep began"
        )
    wait_for_folder(sweep.folder / point.folder)
    words += run_words(sweep, point, trusted_by(sweep, point, common.trust))
    python = python_process(*words, *walltime)
    with (outputs / point.folder).open("wb") as output:
        # In a separate session: Ctrl-C goes only to its parent, which stops it with a checkpoint
        process = subprocess.Popen(
            python["args"],
            env=python["env"] | dict.fromkeys(THREADS, str(common.threads)),
            cwd=common.working_directory,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=output,
            **SEPARATE_GROUP,
        )
    sent = 0
    with process:
        while process.poll() is None:
            requested = _requested_signal(outputs)
            if requested != sent:
                process.kill() if requested == signal.SIGKILL else process.terminate()
                sent = requested
            with suppress(subprocess.TimeoutExpired):
                process.wait(POLL_INTERVAL)
    return process.returncode, clock.monotonic() - began


def _is_unchanged(point: SweepPoint, common: CommonSettings) -> bool:
    """Whether the scene of a point is the one that was checked. A worker in another directory would
    not find its files, and does not check it."""
    if str(Path.cwd()) != common.working_directory:
        return True
    with suppress(RigidMDError):
        scene = Scene.read(common.sweep.scene, common.sweep.overrides(point.values))
        return digest_of(scene) == point.scene_sha256
    return False


def _requested_signal(outputs: Path) -> int:
    """The signal that points have to get, 0 for none. Without the folder their sweep has ended."""
    stop = outputs / STOP
    if stop.exists():
        return int(stop.read_text())
    return 0 if outputs.is_dir() else STOP_SIGNAL


def wait_for_folder(folder: Path, timeout: float = LOCK_TIMEOUT) -> None:
    """Wait until no other run writes in a folder. Raises OutputError after the timeout."""
    with writing(folder):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / LOCK, timeout=timeout):
                pass
        except Timeout:
            raise OutputError(
                f"another run is writing in {folder}, and did not end within {timeout:g} s"
            ) from None


def format_walltime(span: float) -> str:
    """Seconds as H:MM:SS."""
    minutes, seconds = divmod(int(span), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The executor of the dask.distributed cluster whose scheduler has this address. Raises
    SettingError without the library, or if nothing answers."""
    try:
        from distributed import Client
    except ImportError:
        message = f"{option('scheduler')} needs dask.distributed: pip install distributed"
        raise SettingError(message) from None
    try:
        client = Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise SettingError(
            f"{option('scheduler')} {address}: no scheduler of dask.distributed answers ({error})."
            " Start one with `dask scheduler` and workers with `dask worker`"
        ) from None
    with client:
        yield client.get_executor(pure=False)


def run_points(
    manifest: Manifest,
    executor: Executor,
    bar: Bar,
    threads: int = 1,
    walltime: float | None = None,
    trust: Sequence[str] = (),
    receive: Callable[[str, str], object] = lambda name, line: None,
) -> int | None:
    """Run what is not finished. Returns the number of the signal that stopped it, if there was one.

    threads : of each point
    walltime : seconds after which all has to have ended
    trust : Python files that the scene may run
    receive : called with (point, line) of all messages of runs

    Raises OutputError if the manifest cannot be written.
    """
    ends_at = None
    if walltime is not None:
        for_table = min(FOR_TABLE, FOR_TABLE_FRACTION * walltime)
        ends_at = clock.time() + checked_walltime(walltime) - for_table
    signals: list[int] = []
    folder = manifest.folder.absolute()
    for abandoned in folder.glob(f"{OUTPUTS}*"):  # of a sweep that was killed
        shutil.rmtree(abandoned, ignore_errors=True)
    with TemporaryDirectory(prefix=OUTPUTS, dir=folder, ignore_cleanup_errors=True) as name:
        outputs = Path(name)

        def stop(number: int) -> None:
            signals.append(number)
            if signals.count(signal.SIGINT) > 2:  # a cluster may not answer
                raise KeyboardInterrupt
            at_once = signals.count(signal.SIGINT) > 1
            write_text(outputs / STOP, str(int(signal.SIGKILL if at_once else STOP_SIGNAL)))

        alone = replace(manifest, points=[])
        alone.folder = folder
        trusted = [str(Path(path).absolute()) for path in trust]
        common = CommonSettings(alone, trusted, threads, str(Path.cwd()), outputs, ends_at)
        messages = _Messages(outputs, bar, receive)
        with signal_handler(stop, signal.SIGINT, STOP_SIGNAL):
            running = {executor.submit(run_point, p, common): p for p in manifest.unfinished}
            while running:
                manifest.write()
                done, _ = wait(running, max(TICK, len(manifest.points) / POINTS_PER_SECOND))
                messages.read(running.values())
                for future in done:
                    _record_end(manifest, running.pop(future), future, messages, signals)
    manifest.write()
    return signals[0] if signals else None


class _Messages:
    """Reads what points write to their standard error.

    bar : shows the number of points that are done
    receive : see `run_points`
    """

    def __init__(self, outputs: Path, bar: Bar, receive: Callable[[str, str], object]):
        self._outputs, self._bar, self._receive = outputs, bar, receive
        self._lines: dict[str, list[str]] = {}  # by the folder of the point
        self._fractions: dict[str, float] = {}

    def read(self, points: Iterable[SweepPoint]) -> None:
        for point in points:
            name = point.folder
            path = self._outputs / point.folder
            if not path.is_file():
                continue
            point.state, point.message = "running", None
            before = self.lines_of(point)
            lines = path.read_text("utf-8", errors="replace").split("\n")
            self._lines[name] = lines[:-1]
            for line in lines[len(before) : -1]:
                self._receive(name, line)
                if done := PROGRESS.match(line):
                    self.advance(point, float(done[1]) / float(done[2]))

    def lines_of(self, point: SweepPoint) -> list[str]:
        return self._lines.get(point.folder, [])

    def advance(self, point: SweepPoint, fraction: float) -> None:
        before = self._fractions.get(point.folder, 0.0)
        self._fractions[point.folder] = fraction
        self._bar.update(max(0.0, fraction - before))


def _record_end(
    manifest: Manifest, point: SweepPoint, future: Future, messages: _Messages, signals: list[int]
) -> None:
    """Note in a point how it ended."""
    reason = ""
    try:
        code, seconds = future.result()
        point.seconds += seconds
        if code not in UNEVENTFUL:
            reason = _failure_reason(messages.lines_of(point), code)
    except RigidMDError as error:
        reason = str(error)
    except (Exception, CancelledError) as error:  # of the executor
        reason = f"it failed to run: {describe_error(error)}"
    point.state, point.message = "interrupted", None
    manifest.update_state(point)
    if point.state == "finished":
        messages.advance(point, 1.0)
    elif reason and not signals:
        point.state, point.message = "failed", reason


def _failure_reason(lines: list[str], code: int) -> str:
    """Why a process has failed, by its output: the last message, or else the last line."""
    if code == -signal.SIGKILL:
        advice = f"run fewer points at a time: {option('jobs')}"
        return f"its process was killed, perhaps because memory was full ({advice})"
    last = "\n".join(lines[-1:])
    if code < 0:
        return f"its process was ended by {signal.Signals(-code).name}: {last}"
    _, mark, message = "\n".join(["", *lines]).rpartition("\nrigidmd: ")
    if mark and not message.startswith("warning: "):
        return message
    return f"its process ended with exit code {code}: {last}"
