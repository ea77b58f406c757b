"""A second process that compiles tasks: it begins with the last one of a list, and the main process with the first.

Python and LLVM compile one function at a time per process, so a second core is useful only to a second process. Its
code is read from the cache. It is started only if several tasks are not in the cache and there is a second core. The
environment variable `RIGIDMD_COMPILERS` is the number of processes, 1 or 2; the default is 2.
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

#: Least number of tasks for a helper; for fewer, importing the package in a second process takes longer.
FEWEST_TASKS = 3
#: Module of a task, its name there, and the type of its arguments.
TaskKey = tuple[str, str, object]
#: Program of the helper, which finds the package with the same search path.
HELPER_PROGRAM = (
    "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from rigidmd.compile import second_process; second_process.compile_requested()"
)  # fmt: skip


def compiler_processes() -> int:
    """Number of processes that compile."""
    named = os.environ.get("RIGIDMD_COMPILERS", "2")
    if named not in ("1", "2"):
        raise SettingError(f"RIGIDMD_COMPILERS is {named[:40]!r}, must be 1 or 2")
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return int(named) if cores > 1 and sys.executable and is_persistent() else 1


class HelperProcess:
    """A process that compiles tasks, the last one first."""

    def __init__(self, wanted: Sequence[TaskKey]):
        content = pickle.dumps(sys.path) + pickle.dumps(list(wanted))
        self._indices = {one: k for k, one in enumerate(wanted)}
        self._begun: set[int] = set()
        self._done: set[int] = set()
        self._changed = threading.Condition()
        self._ended = False
        self._process = subprocess.Popen(
            [sys.executable, "-c", HELPER_PROGRAM],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C goes to this process, which then ends the helper
        )  # fmt: skip
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has already ended
            self._process.stdin.write(content)
            self._process.stdin.close()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                event, _, index = line.decode().partition(" ")
                with self._changed:
                    (self._begun if event == "begun" else self._done).add(int(index))
                    self._changed.notify_all()
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def wait_for(self, one: TaskKey) -> None:
        """Wait for a task that the helper has begun."""
        index = self._indices.get(one)
        with self._changed:
            while index in self._begun and index not in self._done and not self._ended:
                self._changed.wait()

    def stop(self) -> None:
        self._process.kill()
        self._process.wait()


#: The helper of this thread, if any.
_helper: ContextVar[HelperProcess | None] = ContextVar("helper", default=None)


@contextlib.contextmanager
def use_helper(wanted: Sequence[TaskKey]) -> Iterator[None]:
    """Within the block a helper compiles the same tasks, unless their types cannot be pickled."""
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


def wait_for(module: str, name: str, arguments_type: object) -> None:
    """Wait for a task if a helper has begun it; called before it is compiled in this process."""
    helper = _helper.get()
    if helper is not None:
        helper.wait_for((module, name, arguments_type))


def compile_requested() -> None:
    """In the helper: compile the tasks listed on standard input, and print the index of each before and after."""
    wanted = pickle.load(sys.stdin.buffer)
    for index in range(len(wanted) - 1, -1, -1):
        module, name, arguments_type = wanted[index]
        task = getattr(importlib.import_module(module), name)
        print("begun", index, flush=True)
        task.address(arguments_type)
        print("done", index, flush=True)
