"""Settings and memory of the process, which runs in several threads share, and other processes of
Python."""

import contextlib
import os
import resource
import sys
import threading
import warnings
from collections.abc import Iterator
from math import inf
from pathlib import Path

from rigidmd.core.toml import Json
from rigidmd.errors import SettingError

#: Held while settings of the process change temporarily, and while a run compiles, which changes
#: some too. A thread that holds it may wait for the locks of Numba and of `compile`, but not the
#: other way round.
PROCESS_LOCK = threading.RLock()


class FairLock:
    """A reentrant lock. A thread that waits gets it before the one that has just released it."""

    def __init__(self) -> None:
        self._queue, self._lock = threading.Lock(), threading.Lock()
        self._owner: int | None = None
        self._depth = 0

    def __enter__(self) -> None:
        thread = threading.get_ident()
        if self._owner != thread:
            with self._queue:
                self._lock.acquire()
            self._owner = thread
        self._depth += 1

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if self._depth == 0:
            self._owner = None
            self._lock.release()


@contextlib.contextmanager
def ignore_warnings() -> Iterator[None]:
    """Hide all warnings within the block. Python has one list of warning filters for all
    threads."""
    with PROCESS_LOCK, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


#: Exit codes of commands, which other processes read. The first is added to the number of a signal
#: that ended it: 130 for Ctrl-C, 143 for SIGTERM. The second is of a run that stopped because its
#: wall time was up: run it again with --resume.
BY_SIGNAL, OUT_OF_TIME = 128, 75


#: Configuration files that libraries read in the working directory: Numba and Matplotlib.
LOCAL_SETTINGS = (".numba_config.yaml", "matplotlibrc")


@contextlib.contextmanager
def without_local_settings() -> Iterator[None]:
    """Within the block, libraries do not find their configuration files in the working directory.

    A folder from others could otherwise change results by such a file, or stop a run. The libraries
    have no setting for this. Both look for the file by `os.path.exists`, which is replaced for all
    threads. A program keeps it replaced until its end.
    """
    exists = os.path.exists

    def exists_elsewhere(path: int | str | bytes | os.PathLike) -> bool:
        return path not in LOCAL_SETTINGS and exists(path)

    os.path.exists = exists_elsewhere
    try:
        yield
    finally:
        os.path.exists = exists


def python_process(*arguments: str) -> Json:
    """Arguments of `subprocess.Popen` for a Python process with the search path of this process.

    The process does not import from the working directory (`-P`), where a file of others may be
    called `json.py`. It finds this package in any case.
    """
    entries = [os.path.abspath(entry) for entry in sys.path if entry]
    path = os.pathsep.join([*entries, str(Path(__file__).parents[2])])
    return {"args": [sys.executable, "-P", *arguments], "env": os.environ | {"PYTHONPATH": path}}


#: Bytes of address space to load all libraries. With less they fail in many ways, and OpenBLAS may
#: hang.
LIBRARY_BYTES = 1e9
RESERVED = 0.05  # fraction of the free memory that is reserved for Python, machine code and files


def free_memory() -> float:
    """Free bytes of this machine, within the limits of container and process. Infinite where the
    system has no data."""
    if sys.platform != "linux":
        import psutil

        return min(float(psutil.virtual_memory().available), address_space_left())
    free = _system_number("/proc/meminfo", "MemAvailable:") * 1024
    group = "/sys/fs/cgroup/memory"
    for limit, used in ((".max", ".current"), ("/memory.limit_in_bytes", "/memory.usage_in_bytes")):
        free = min(
            free, _system_number(f"{group}{limit}") - min(_system_number(f"{group}{used}"), 1e18)
        )
    return max(0.0, min(free, address_space_left()))


def memory_shortage(needed: float, what: str) -> str:
    """Why `what` cannot have this many bytes of memory, or an empty text if it can."""
    free = free_memory()
    if needed <= (1 - RESERVED) * free:
        return ""
    return (
        f"{what} needs {format_gigabytes(needed)} of memory, and this machine has"
        f" {format_gigabytes(free)} free"
    )


def format_gigabytes(size: float) -> str:
    """A number of bytes as text."""
    return f"{size / 1e9:.3g} GB"


def address_space_left() -> float:
    """Bytes of address space left by the limit of this process (`ulimit -v`). Infinite without a
    limit."""
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = 1024 * _system_number("/proc/self/status", "VmSize:", 0.0)
    return inf if soft == resource.RLIM_INFINITY else soft - used


def check_address_space() -> None:
    """Raise SettingError if the libraries cannot be loaded within the limit of this process
    (`ulimit -v`)."""
    if "numba" in sys.modules or (left := address_space_left()) >= LIBRARY_BYTES:
        return
    raise SettingError(
        f"not enough memory: the program and its libraries need {format_gigabytes(LIBRARY_BYTES)}"
        f" of addresses, and the limit of this process leaves {format_gigabytes(left)}. Raise it"
        " (ulimit -v)"
    )


def _system_number(file: str, label: str = "", absent: float = inf) -> float:
    """The number after a label in a system file. `absent` if there is none."""
    try:
        words = Path(file).read_text(encoding="ascii", errors="replace").split()
        return float(words[words.index(label) + 1 if label else 0])
    except (OSError, ValueError, IndexError):
        return absent
