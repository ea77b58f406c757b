"""Where the points of a sweep run: on this machine, or on a cluster of dask.distributed with a
common file system.

Both are executors of concurrent.futures, whose threads each watch a process that runs one point. A
ProcessPoolExecutor cannot do that: it loses all points when one process is killed, and cannot stop
a point with a checkpoint. When dask moves a point to another worker, it continues there from its
last checkpoint.

The process is this module as a program. Each line of its standard input is a task, each line of its
output a message, both JSON. It ends with its input: when its parent process has died, it stops with
a checkpoint.
"""

import contextlib
import json
import logging
import os
import queue
import select
import signal
import subprocess
import sys
import tempfile
import threading
import time as clock
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor, Future, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, TypedDict

from filelock import FileLock, Timeout

from rigidmd.core.files import write_text, writing
from rigidmd.core.process import python_process, without_local_settings
from rigidmd.errors import OutputError, RigidMDError, SettingError, option
from rigidmd.io.folder import LOCK
from rigidmd.studies.sweep.folder import STOP, State, SweepPoint, state_on_disk

PROGRESS_REPORTS = 100  # number of progress messages of a run
#: Seconds to wait for a run in the folder of a point that is about to stop: its sweep was killed,
#: or dask moved it.
LOCK_TIMEOUT = 120.0

Send = Callable[[str, Any], None]


class PointTask(TypedDict):
    folder: str  # of the sweep
    name: str  # of the point's folder in it
    scene: str
    overrides: dict[str, Any]
    trust: list[str]
    sha256: str  # digest of its scene
    ran_sha256: str | None
    ends_at: float | None  # `time.time()` at which it has to have ended; None for never


class PointResult(TypedDict):
    state: State
    message: str | None
    sha256: str | None  # scene_sha256 of its summary
    seconds: float
    out_of_time: bool


#: Seconds between two checks of whether to stop, and of waiting for a scheduler.
POLL_INTERVAL, CONNECT_TIMEOUT = 0.2, 20.0
LOCAL = "local"
#: Number of the last letters of a worker's standard error that the message about its death may
#: show.
LAST_LETTERS = 400


class Worker:
    """A process with a number of threads that runs one task at a time in a working directory
    (default: this one)."""

    def __init__(self, threads: int, folder: str | None = None):
        counts = dict.fromkeys(
            ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads)
        )
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (as long as the process lives)
        python = python_process("-m", "rigidmd.studies.sweep.backends")
        # In a separate session: Ctrl-C goes only to its parent, which ends it with a checkpoint
        self._process: Any = subprocess.Popen(
            python["args"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=python["env"] | counts,
            cwd=folder,
            start_new_session=True,
        )

    def run(self, task: PointTask, must_stop: Callable[[], bool], send: Send) -> PointResult:
        """Run a task, pass its messages on, and stop it with a checkpoint. Raises RigidMDError if
        the process dies."""
        with contextlib.suppress(
            BrokenPipeError
        ):  # it has died, which the end of its messages will show
            self._process.stdin.write(json.dumps(task).encode() + b"\n")
            self._process.stdin.flush()
        rest, stopped = b"", False
        while True:
            if not stopped and must_stop():  # a second signal would end it at once
                stopped = True
                self._process.send_signal(signal.SIGTERM)
            if not select.select([self._process.stdout], [], [], POLL_INTERVAL)[0]:
                continue
            if not (read := os.read(self._process.stdout.fileno(), 1 << 16)):
                raise RigidMDError(self._death_reason())
            *lines, rest = (rest + read).split(b"\n")
            for kind, value in map(json.loads, lines):
                if kind == "ended":
                    return value
                send(kind, value)

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """End the process; a run in it ends with a checkpoint."""
        for pipe in (self._process.stdin, self._process.stdout):
            with contextlib.suppress(OSError):
                pipe.close()
        self._process.wait()
        self._stderr.close()

    def _death_reason(self) -> str:
        code = self._process.wait()
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip()[-LAST_LETTERS:].splitlines()
        last = f": {lines[-1]}" if lines else ""
        if code == -signal.SIGKILL:
            advice = f"run fewer points at a time: {option('jobs')}"
            return f"its process was killed, perhaps because memory was full ({advice})"
        if code < 0:
            return f"its process was ended by {signal.Signals(-code).name}{last}"
        return f"its process ended with exit code {code}{last}"


class Backend:
    """Runs points by run(task) on an executor. capacity() : number of points that it accepts at a
    time"""

    def __init__(
        self,
        executor: Executor,
        capacity: Callable[[], int],
        run: Callable[[PointTask], PointResult],
    ):
        self._executor, self._capacity, self._run = executor, capacity, run
        self.running: dict[str, Future] = {}
        self._messages: queue.SimpleQueue[tuple[str, str, Any]] = queue.SimpleQueue()

    @property
    def free(self) -> int:
        """Number of points that it would accept now."""
        return self._capacity() - len(self.running)

    def submit(self, task: PointTask) -> None:
        future = self.running[task["name"]] = self._executor.submit(self._run, task)
        future.add_done_callback(partial(self._end, task["name"]))

    def _end(self, name: str, future: Future) -> None:
        try:
            self._messages.put((name, "ended", future.result()))
        except RigidMDError as error:
            self._messages.put((name, "died", str(error)))
        except (Exception, CancelledError) as error:  # of the executor
            self._messages.put((name, "died", f"it failed to run: {type(error).__name__}: {error}"))

    def messages(self, seconds: float) -> Iterator[tuple[str, str, Any]]:
        """(point, kind, value) of messages that come within this time: those of `run_task`, ended,
        or died with why."""
        with contextlib.suppress(queue.Empty):
            while True:
                name, kind, value = self._messages.get(timeout=seconds)
                seconds = 0.0
                if name in self.running:  # a cluster may deliver late
                    if kind in ("ended", "died"):
                        del self.running[name]
                    yield name, kind, value


class Pool(Backend):
    """Up to `jobs` processes of this machine with `threads` each. Idle ones keep what they have
    loaded."""

    def __init__(self, jobs: int, threads: int):
        super().__init__(ThreadPoolExecutor(jobs), lambda: jobs, self._run_here)
        self._threads, self._stopping = threads, threading.Event()
        self._idle: list[Worker] = []
        self.busy: dict[str, Worker] = {}  # by the name of the point

    def _run_here(self, task: PointTask) -> PointResult:
        name = task["name"]
        worker = self.busy[name] = self._idle.pop() if self._idle else Worker(self._threads)
        try:
            ended = worker.run(
                task, self._stopping.is_set, lambda *message: self._messages.put((name, *message))
            )
            self._idle.append(worker)
            return ended
        except RigidMDError:
            worker.close()
            raise
        finally:
            del self.busy[name]

    def stop(self) -> None:
        """Stop all runs at their next observations, with checkpoints."""
        self._stopping.set()

    def kill(self) -> None:
        """Stop all runs without waiting for their ends."""
        for worker in list(self.busy.values()):
            worker.kill()

    def close(self) -> None:
        self.stop()
        self._executor.shutdown(cancel_futures=True)
        for worker in self._idle:
            worker.close()


class Cluster(Backend):
    """Runs points on a cluster.

    address : address of its scheduler, tcp://HOST:8786, or "local" for a cluster of `jobs` threads
        in this process
    threads : threads of each point
    working_directory : of the points

    Raises SettingError without dask.distributed, or if nothing answers.
    """

    def __init__(
        self, address: str, jobs: int, threads: int, folder: Path, working_directory: Path
    ):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise SettingError(
                f"{option('scheduler')} needs dask.distributed: pip install distributed"
            ) from None
        self._local_cluster = None
        try:
            if address == LOCAL:
                # Threads, since the points run in separate processes
                quiet: dict[str, Any] = {"dashboard_address": None, "silence_logs": logging.ERROR}
                self._local_cluster = LocalCluster(
                    n_workers=1, threads_per_worker=jobs, processes=False, **quiet
                )
            client: Any = Client(
                self._local_cluster or address, timeout=CONNECT_TIMEOUT, set_as_default=False
            )
        except (OSError, ValueError, TypeError) as error:
            raise SettingError(
                f"{option('scheduler')} {address}: no scheduler of dask.distributed answers"
                f" ({error}); start one with `dask scheduler` and workers with `dask worker`"
            ) from None
        # two points per thread of its workers, so that none is ever idle
        capacity, topic = (
            lambda: max(1, 2 * sum(client.nthreads().values())),
            f"rigidmd-{client.id}",
        )
        run = partial(
            _run_on_cluster, threads=threads, topic=topic, working_directory=str(working_directory)
        )
        super().__init__(client.get_executor(pure=False), capacity, run)
        client.subscribe_topic(topic, lambda event: self._messages.put(tuple(event[1])))
        self._client, self._stop = client, folder.absolute() / STOP
        self._stop.unlink(missing_ok=True)

    def stop(self) -> None:
        """Stop all runs, with checkpoints, by a file that their workers check for."""
        write_text(self._stop, "")

    def kill(self) -> None:
        self.stop()
        for name in list(self.running):
            self._messages.put((name, "died", "it was abandoned"))

    def close(self) -> None:
        """Leave the cluster, and end it if it was started here."""
        self._client.close()
        if self._local_cluster is not None:
            self._local_cluster.close()
        if not self.running:
            self._stop.unlink(missing_ok=True)


def _run_on_cluster(
    task: PointTask, threads: int, topic: str, working_directory: str
) -> PointResult:
    """Run a point in a process of this worker of dask, and send its messages to the topic."""
    from distributed import get_worker

    worker, dask_worker, stop = (
        Worker(threads, working_directory),
        get_worker(),
        Path(task["folder"]) / STOP,
    )
    try:
        return worker.run(
            task,
            stop.exists,
            lambda *message: dask_worker.log_event(topic, [task["name"], *message]),
        )
    finally:
        worker.close()


def run_task(
    task: PointTask, send: Send = lambda kind, value: None, progress: bool = False
) -> PointResult:
    """Run a point in its folder, from its last checkpoint if it has one; a point that has finished
    is not run again.

    send : called with ("begun", None) when it is compiled, ("fraction", fraction done),
        ("announced" or "warned", text)
    """
    began = clock.monotonic()
    ended: PointResult = {
        "state": "failed",
        "message": None,
        "sha256": None,
        "seconds": 0.0,
        "out_of_time": False,
    }
    try:
        ended["state"], ended["sha256"], ended["out_of_time"] = _run(task, send, progress)
    except RigidMDError as error:
        ended["message"] = str(error)
    except KeyboardInterrupt:
        ended["state"] = "interrupted"
    except MemoryError:
        ended["message"] = f"not enough memory; run fewer points at a time ({option('jobs')})"
    except Exception as error:
        traceback.print_exc()
        ended["message"] = f"{type(error).__name__}: {error}"
    ended["seconds"] = clock.monotonic() - began
    return ended


def _run(task: PointTask, send: Send, progress: bool) -> tuple[State, str | None, bool]:
    """The state of a point after its run, the digest of its scene if it has finished, and whether
    its time was up."""
    from rigidmd.assemble.user_code.trust import trust
    from rigidmd.run import Every, Observer, Simulation
    from rigidmd.scene import BodyScene, Scene
    from rigidmd.studies.sweep.plan import digest_of

    class Begun(Observer):
        def begin(self, run: Simulation) -> None:
            send("begun", None)

    for path in task["trust"]:
        trust(path)
    scene = Scene.read(task["scene"], task["overrides"])
    if digest_of(scene) != task["sha256"]:
        raise RigidMDError(
            f"{task['scene']} or a file that it reads has changed since the sweep began"
        )
    sweep, folder = Path(task["folder"]), Path(task["folder"]) / task["name"]
    wait_for_folder(folder)
    point = SweepPoint(task["name"], {}, task["sha256"], ran_sha256=task["ran_sha256"])
    if state_on_disk(sweep, point) == "finished":
        return "finished", task["ran_sha256"], False
    walltime = None if task["ends_at"] is None else max(0.0, task["ends_at"] - clock.time())
    observers: list[Observer] = [Begun()]
    whole = (
        scene.run.duration_s
        if isinstance(scene, BodyScene)
        else sum(stage.duration for stage in scene.stages)
    )
    if whole > 0:

        def fraction(moment):
            return send("fraction", min(1.0, moment.time / whole))

        observers.append(Every(whole / PROGRESS_REPORTS, fraction))
    resume = scene.output.checkpoint_minutes is not False  # without checkpoints it starts again
    simulation = Simulation(
        scene,
        folder,
        not resume,
        observers=observers,
        say=lambda sentence: send("announced", sentence),
        warn=lambda sentence: send("warned", sentence),
        resume=resume,
        walltime=walltime,
    )
    results = simulation.run(progress=progress)
    if results.interrupted:
        return "interrupted", None, results.out_of_time
    return "finished", results.summary["scene_sha256"], False


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


def main() -> None:
    """Run tasks until standard input ends."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what others print must not be read as a message
    tasks: queue.SimpleQueue[PointTask | None] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            tasks.put(json.loads(line))
        tasks.put(None)
        os.kill(os.getpid(), signal.SIGTERM)  # a run stops at its next observation

    def send(kind: str, value: Any) -> None:
        with contextlib.suppress(BrokenPipeError):  # the parent has died: the run is stopping
            print(json.dumps([kind, value]), file=channel, flush=True)

    threading.Thread(target=read, daemon=True).start()
    while (task := tasks.get()) is not None:
        send("ended", run_task(task, send))
    os._exit(0)


if __name__ == "__main__":
    with without_local_settings():
        main()
