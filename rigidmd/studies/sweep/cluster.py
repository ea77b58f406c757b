"""Points of a sweep on a cluster of dask.distributed, whose machines have a file system in common with this one.

Each point runs in a separate process, which a worker of dask starts and watches. When dask moves a point to another
worker, it continues there from its last checkpoint.
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
from rigidmd.studies.sweep.worker import PointTask

#: Seconds between two checks for the file that stops points, and of waiting for a scheduler.
POLL_INTERVAL, CONNECT_TIMEOUT = 1.0, 20.0
LOCAL = "local"


class Cluster:
    """Runs points on a cluster.

    address : address of its scheduler, tcp://HOST:8786, or "local" for a cluster of `jobs` threads in this process
    threads : threads of each point
    working_directory : of the points

    Raises SettingError without dask.distributed, or if nothing answers.
    """

    def __init__(self, address: str, jobs: int, threads: int, folder: Path, working_directory: Path):
        try:
            from distributed import Client, LocalCluster
        except ImportError:
            raise SettingError("--scheduler needs dask.distributed: pip install 'rigidmd[dask]'") from None
        self._stop = folder.absolute() / STOP
        self._threads, self._working_directory = threads, str(working_directory)
        self._local_cluster = None
        try:
            if address == LOCAL:
                # Threads, since the points run in separate processes
                quiet: dict[str, Any] = {"dashboard_address": None, "silence_logs": logging.ERROR}
                self._local_cluster = LocalCluster(n_workers=1, threads_per_worker=jobs, processes=False, **quiet)
            self._client: Any = Client(self._local_cluster or address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise SettingError(
                f"--scheduler {address}: no scheduler of dask.distributed answers ({error}); start one with `dask "
                "scheduler` and workers with `dask worker`"
            ) from None
        self._stop.unlink(missing_ok=True)
        self._futures: dict[str, Any] = {}
        self._heard: queue.SimpleQueue[tuple[str, Message]] = queue.SimpleQueue()
        self._topic = f"rigidmd-{self._client.id}"
        self._client.subscribe_topic(self._topic, self._receive)

    @property
    def free(self) -> int:
        """Number of points that it would accept now: two per thread of its workers, so that none is ever idle."""
        return max(1, 2 * sum(self._client.nthreads().values())) - len(self._futures)

    def submit(self, task: PointTask) -> None:
        name = task["name"]
        future = self._client.submit(
            _run_on_worker, task, self._threads, self._topic, self._working_directory,
            key=f"{self._topic}-{name}-{next(_COUNT)}", pure=False,
        )  # fmt: skip
        self._futures[name] = future
        future.add_done_callback(lambda done: self._heard.put((name, self._end_message(done))))

    def _receive(self, event: tuple[float, Any]) -> None:
        name, kind, value = event[1]
        self._heard.put((name, Message(kind, value)))

    @staticmethod
    def _end_message(future: Any) -> Message:
        if future.status == "finished":
            return Message("ended", future.result())
        if future.status == "cancelled":
            return Message("died", "it was cancelled")
        return Message("died", f"dask failed to run it: {future.exception()}")

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
        """Stop all runs, with checkpoints, by a file that their workers check for."""
        write_text(self._stop, "")

    def kill(self) -> None:
        """Stop all runs without waiting for their ends."""
        self.stop()
        for name, future in list(self._futures.items()):
            self._heard.put((name, Message("died", "it was abandoned")))
            future.release()

    def close(self) -> None:
        """Leave the cluster, and end it if it was started here."""
        self._client.close()
        if self._local_cluster is not None:
            self._local_cluster.close()
        if not self._futures:
            self._stop.unlink(missing_ok=True)


_COUNT = itertools.count()


def _run_on_worker(task: PointTask, threads: int, topic: str, working_directory: str) -> Any:
    """Run a point in a process of this worker of dask, and send its messages to the topic."""
    from distributed import get_worker

    stop, dask_worker = Path(task["folder"]) / STOP, get_worker()
    worker = Worker(threads, working_directory)
    try:
        worker.submit(task)
        while True:
            if stop.exists():
                worker.stop()
            if not select.select([worker], [], [], POLL_INTERVAL)[0]:
                continue
            for message in worker.messages():
                if message.kind == "ended":
                    return message.value
                if message.kind == "died":
                    raise RigidMDError(message.value)
                dask_worker.log_event(topic, [task["name"], *message])
    finally:
        worker.close()
