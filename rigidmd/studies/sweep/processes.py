"""Worker processes of a sweep, as their parent sees them. If one is killed, only its point fails."""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

from rigidmd.studies.sweep.worker import PointTask

#: Number of the last letters of a worker's standard error that the message about its death may show.
LAST_LETTERS = 400


class Message(NamedTuple):
    """A message of a worker: begun, fraction, announced, warned, ended; or died, with the reason."""

    kind: str
    value: Any


class Worker:
    """A process with a number of threads that runs one task at a time.

    folder : working directory; default: this one
    """

    def __init__(self, threads: int, folder: str | None = None):
        counts = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  (as long as the process lives)
        # In a separate session: Ctrl-C goes only to its parent, which ends it with a checkpoint
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rigidmd.studies.sweep.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr, env=os.environ | counts, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        self._rest = b""
        self.task: PointTask | None = None
        self._stopped = False

    def fileno(self) -> int:
        """The descriptor of its messages, for `select`."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def submit(self, task: PointTask) -> None:
        self.task = task
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has died, which its messages will show
            self._process.stdin.write(json.dumps(task).encode() + b"\n")
            self._process.stdin.flush()

    def messages(self) -> list[Message]:
        """New messages; waits for one. After "ended" and "died" the worker has no task."""
        read = os.read(self.fileno(), 1 << 16)
        *lines, self._rest = (self._rest + read).split(b"\n")
        found = [Message(*json.loads(line)) for line in lines]
        if not read:
            found.append(Message("died", self._death_reason()))
        if found and found[-1].kind in ("ended", "died"):
            self.task = None
        return found

    def stop(self) -> None:
        """Stop the run at its next observation, with a checkpoint. A second signal would end it at once."""
        if not self._stopped:
            self._signal(signal.SIGTERM)
        self._stopped = True

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def close(self) -> None:
        """End the process; a run in it ends with a checkpoint."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._process.wait()
        self._stderr.close()

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def _death_reason(self) -> str:
        code = self._process.wait()
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip()[-LAST_LETTERS:].splitlines()
        last = f": {lines[-1]}" if lines else ""
        if code == -signal.SIGKILL:
            return "its process was killed, perhaps because memory was full (run fewer points at a time: --jobs)"
        if code < 0:
            return f"its process was ended by {signal.Signals(-code).name}{last}"
        return f"its process ended with exit code {code}{last}"


class Pool:
    """Up to `jobs` workers with `threads` each. Workers that are idle keep what they have loaded."""

    def __init__(self, jobs: int, threads: int):
        self.jobs, self._threads = jobs, threads
        self._idle: list[Worker] = []
        self._busy: list[Worker] = []

    @property
    def free(self) -> int:
        """Number of tasks that it would accept now."""
        return self.jobs - len(self._busy)

    def submit(self, task: PointTask) -> None:
        worker = self._idle.pop() if self._idle else Worker(self._threads)
        worker.submit(task)
        self._busy.append(worker)

    def messages(self, seconds: float) -> list[tuple[str, Message]]:
        """(name of the point, message) of those that come within this time."""
        ready, _, _ = select.select(self._busy, [], [], seconds)
        found = []
        for worker in ready:
            name = worker.task["name"] if worker.task else ""
            found += [(name, message) for message in worker.messages()]
            if worker.task is None:
                self._busy.remove(worker)
                if found[-1][1].kind == "died":
                    worker.close()
                else:
                    self._idle.append(worker)
        return found

    def stop(self) -> None:
        """Stop all runs at their next observations, with checkpoints."""
        for worker in self._busy:
            worker.stop()

    def kill(self) -> None:
        for worker in self._busy:
            worker.kill()

    def close(self) -> None:
        for worker in [*self._busy, *self._idle]:
            worker.close()
