"""Points of a sweep on a cluster of dask.distributed. Its machines share a file system with this one.

Each point runs in a process of its own beside the worker of dask that has it. When dask moves it to another worker, it
goes on there from its last checkpoint.
"""

import itertools
import logging
import queue
import select
from pathlib import Path
from typing import Any

from rigidmd.core.files import write_text
from rigidmd.errors import RigidMDError, SettingError
from rigidmd.studies.sweep.folder import STOP
from rigidmd.studies.sweep.processes import Message, Worker
from rigidmd.studies.sweep.worker import Task

#: Seconds between two looks for a file that says stop, and of waiting for a scheduler.
LOOK, PATIENCE = 1.0, 20.0
LOCAL = "local"


class Cluster:
    """Runs points on a cluster.

    address : of its scheduler, tcp://HOST:8786, or "local" for a cluster of `jobs` threads in this process
    threads : of each point
    here : working directory of the points

    Raises SettingError without dask.distributed, or if nothing answers.
    """

    def __init__(self, address: str, jobs: int, threads: int, folder: Path, here: Path):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise SettingError("--scheduler needs dask.distributed: pip install 'rigidmd[dask]'") from None
        self._stop = folder.absolute() / STOP
        self._threads, self._here = threads, str(here)
        self._own = None
        try:
            if address == LOCAL:
                # Threads, since the points have processes of their own
                quiet: dict[str, Any] = {"dashboard_address": None, "silence_logs": logging.ERROR}
                self._own = LocalCluster(n_workers=1, threads_per_worker=jobs, processes=False, **quiet)
            self._client: Any = Client(self._own or address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise SettingError(
                f"--scheduler {address}: no scheduler of dask.distributed answers ({error}); start one with `dask "
                "scheduler` and workers with `dask worker`"
            ) from None
        self._stop.unlink(missing_ok=True)
        self._futures: dict[str, Any] = {}
        self._heard: queue.SimpleQueue[tuple[str, Message]] = queue.SimpleQueue()
        self._topic = f"rigidmd-{self._client.id}"
        self._client.subscribe_topic(self._topic, self._hear)

    @property
    def free(self) -> int:
        """Points that it would take now: two for each thread of its workers, so that none waits for this process."""
        return max(1, 2 * sum(self._client.nthreads().values())) - len(self._futures)

    def give(self, task: Task) -> None:
        """Submit a point."""
        name = task["name"]
        future = self._client.submit(
            _run_there,
            task,
            self._threads,
            self._topic,
            self._here,
            key=f"{self._topic}-{name}-{next(_COUNT)}",
            pure=False,
        )
        self._futures[name] = future
        future.add_done_callback(lambda done: self._heard.put((name, self._ending(done))))

    def _hear(self, event: tuple[float, Any]) -> None:
        name, kind, value = event[1]
        self._heard.put((name, Message(kind, value)))

    @staticmethod
    def _ending(future: Any) -> Message:
        if future.status == "finished":
            return Message("ended", future.result())
        if future.status == "cancelled":
            return Message("died", "it was taken back")
        return Message("died", f"dask gave it up: {future.exception()}")

    def messages(self, seconds: float) -> list[tuple[str, Message]]:
        found: list[tuple[str, Message]] = []
        try:
            found.append(self._heard.get(timeout=seconds))
            while True:
                found.append(self._heard.get_nowait())
        except queue.Empty:
            pass
        for name, message in found:
            if message.kind in ("ended", "died"):
                self._futures.pop(name, None)
        return found

    def stop(self) -> None:
        """Let all runs end with checkpoints: a file tells them."""
        write_text(self._stop, "")

    def kill(self) -> None:
        """Wait for nothing; the runs end by themselves."""
        self.stop()
        for name, future in list(self._futures.items()):
            self._heard.put((name, Message("died", "it was left")))
            future.release()

    def close(self) -> None:
        """Leave the cluster, and end one that was started here."""
        self._client.close()
        if self._own is not None:
            self._own.close()
        if not self._futures:
            self._stop.unlink(missing_ok=True)


_COUNT = itertools.count()


def _run_there(task: Task, threads: int, topic: str, here: str) -> Any:
    """Run a point in a process beside this worker of dask, and tell the topic what it says."""
    from distributed import get_worker

    stop, told = Path(task["folder"]) / STOP, get_worker()
    worker = Worker(threads, here)
    try:
        worker.give(task)
        while True:
            if stop.exists():
                worker.stop()
            if not select.select([worker], [], [], LOOK)[0]:
                continue
            for message in worker.messages():
                if message.kind == "ended":
                    return message.value
                if message.kind == "died":
                    raise RigidMDError(message.value)
                told.log_event(topic, [task["name"], *message])
    finally:
        worker.close()
