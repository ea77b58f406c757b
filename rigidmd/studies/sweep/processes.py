"""Worker processes of a sweep, as their parent sees them. One that is killed takes its point with it, and no other."""

import contextlib
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from typing import Any, NamedTuple

from rigidmd.studies.sweep.worker import Task

#: Letters of the end of a worker's standard error that are told when it dies.
TOLD = 400


class Message(NamedTuple):
    """What a worker says: begun, share, said, warned, ended; or died, with a sentence."""

    kind: str
    value: Any


class Worker:
    """A process with a number of threads that runs one task at a time.

    folder : working directory; default: this one
    """

    def __init__(self, threads: int, folder: str | None = None):
        counts = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), str(threads))
        self._said = tempfile.TemporaryFile()  # noqa: SIM115  (as long as the process lives)
        # In a session of its own: Ctrl-C goes to its parent alone, which ends it with a checkpoint
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rigidmd.studies.sweep.worker"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._said, env=os.environ | counts, cwd=folder,
            start_new_session=True,
        )  # fmt: skip
        self._rest = b""
        self.task: Task | None = None
        self._stopped = False

    def fileno(self) -> int:
        """Of its messages, for `select`."""
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def give(self, task: Task) -> None:
        """Let it run a task."""
        self.task = task
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has died, and its messages will tell
            self._process.stdin.write(json.dumps(task).encode() + b"\n")
            self._process.stdin.flush()

    def messages(self) -> list[Message]:
        """What it has said since; waits for something. After "ended" and "died" it has no task."""
        read = os.read(self.fileno(), 1 << 16)
        *lines, self._rest = (self._rest + read).split(b"\n")
        found = [Message(*json.loads(line)) for line in lines]
        if not read:
            found.append(Message("died", self._why()))
        if found and found[-1].kind in ("ended", "died"):
            self.task = None
        return found

    def stop(self) -> None:
        """Let its run end at its next look, with a checkpoint. A second call does nothing: it would end it at once."""
        if not self._stopped:
            self._signal(signal.SIGTERM)
        self._stopped = True

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def close(self) -> None:
        """End it; a run in it ends with a checkpoint."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._process.wait()
        self._said.close()

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(number)

    def _why(self) -> str:
        code = self._process.wait()
        self._said.seek(0)
        said = self._said.read().decode(errors="replace").strip()[-TOLD:].splitlines()
        last = f": {said[-1]}" if said else ""
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
        """Tasks that it would take now."""
        return self.jobs - len(self._busy)

    def give(self, task: Task) -> None:
        worker = self._idle.pop() if self._idle else Worker(self._threads)
        worker.give(task)
        self._busy.append(worker)

    def messages(self, seconds: float) -> list[tuple[str, Message]]:
        """(name of the point, message) of those that come within so many seconds."""
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
        """Let all runs end at their next looks, with checkpoints."""
        for worker in self._busy:
            worker.stop()

    def kill(self) -> None:
        for worker in self._busy:
            worker.kill()

    def close(self) -> None:
        for worker in [*self._busy, *self._idle]:
            worker.close()
