"""A second process that compiles too: it begins with the last of the tasks that are wanted, this one with the first.

Python and LLVM compile one function at a time in a process, so a second core helps only a second process. What it has
compiled is read from the cache. It is started only where several tasks are not in the cache and there is a second core.
The environment variable `RIGIDMD_COMPILERS` is the number of processes, 1 or 2; without it, 2.
"""

import contextlib
import importlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextvars import ContextVar

from rigidmd.compile.cache import is_persistent
from rigidmd.errors import SettingError

#: A helper is started for so many tasks; for fewer, loading the package in a second process takes longer.
FEWEST_TASKS = 3
#: (module of a task, its name there, the type of its parcel)
TaskKey = tuple[str, str, object]
#: What the helper runs: it finds the package where this process does.
HELPER_PROGRAM = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from rigidmd.compile import ahead; ahead.serve()"
)  # fmt: skip


def compiler_processes() -> int:
    """Number of processes that compile."""
    named = os.environ.get("RIGIDMD_COMPILERS", "2")
    if named not in ("1", "2"):
        raise SettingError(f"RIGIDMD_COMPILERS is {named[:40]!r}, must be 1 or 2")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(named) if cores > 1 and sys.executable and is_persistent() else 1


class HelperProcess:
    """A process that compiles tasks, the last of them first."""

    def __init__(self, wanted: Sequence[TaskKey]):
        content = pickle.dumps(sys.path) + pickle.dumps(list(wanted))
        self._places = {one: k for k, one in enumerate(wanted)}
        self._begun: set[int] = set()
        self._done: set[int] = set()
        self._news = threading.Condition()
        self._over = False
        self._process = subprocess.Popen(
            [sys.executable, "-c", HELPER_PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for this process, which then ends the helper
        )
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has ended: then there is no help
            self._process.stdin.write(content)
            self._process.stdin.close()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                word, _, place = line.decode().partition(" ")
                with self._news:
                    (self._begun if word == "begun" else self._done).add(int(place))
                    self._news.notify_all()
        with self._news:
            self._over = True
            self._news.notify_all()

    def wait_for(self, one: TaskKey) -> None:
        """Wait until the helper has compiled a task that it has begun."""
        place = self._places.get(one)
        with self._news:
            while place in self._begun and place not in self._done and not self._over:
                self._news.wait()

    def stop(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()


#: The helper of this thread, if there is one.
_helper: ContextVar[HelperProcess | None] = ContextVar("helper", default=None)


@contextlib.contextmanager
def use_helper(wanted: Sequence[TaskKey]) -> Iterator[None]:
    """Within it a helper compiles the same tasks; nobody helps if another process cannot be told their types."""
    helper = None
    with contextlib.suppress(OSError, pickle.PicklingError, TypeError, AttributeError):
        helper = HelperProcess(wanted)
    before = _helper.set(helper)
    try:
        yield
    finally:
        _helper.reset(before)
        if helper is not None:
            helper.stop()


def wait_for(module: str, name: str, parcel: object) -> None:
    """Called before a task is compiled here: waits if a helper has begun it."""
    helper = _helper.get()
    if helper is not None:
        helper.wait_for((module, name, parcel))


def compile_requested() -> None:
    """The helper: compile what standard input says, and say so."""
    wanted = pickle.load(sys.stdin.buffer)
    for place in range(len(wanted) - 1, -1, -1):
        module, name, parcel = wanted[place]
        task = getattr(importlib.import_module(module), name)
        print("begun", place, flush=True)
        task.address(parcel)
        print("done", place, flush=True)
