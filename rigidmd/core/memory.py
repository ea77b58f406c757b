"""How much memory this process may still take, and sentences for what needs more."""

import contextlib
import importlib
from math import inf
from pathlib import Path

resource = None
with contextlib.suppress(ImportError):  # not on Windows
    resource = importlib.import_module("resource")

#: Share of the free memory that is left to other things: Python, machine code, files.
SPARE = 0.05


def free_memory() -> float:
    """Bytes that this process may still take: what the machine has free, within limits of container and process.

    Infinite where the system does not tell.
    """
    free = _number_in("/proc/meminfo", "MemAvailable:") * 1024
    for limit, used in (
        ("memory.max", "memory.current"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
    ):
        free = min(free, _number_in(f"/sys/fs/cgroup/{limit}") - min(_number_in(f"/sys/fs/cgroup/{used}"), 1e18))
    return max(0.0, min(free, left_by_limit()))


def memory_fault(needed: float, what: str) -> str:
    """Why there is no room for what needs so many bytes; empty if there is."""
    free = free_memory()
    if needed <= (1 - SPARE) * free:
        return ""
    return f"{what} needs {in_words(needed)} of memory, and this machine has {in_words(free)} free"


def in_words(size: float) -> str:
    """Bytes as GB."""
    return f"{size / 1e9:.3g} GB"


def left_by_limit() -> float:
    """Bytes of addresses that the limit of this process (`ulimit -v`) leaves; infinite where there is none."""
    if resource is None:
        return inf
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = 1024 * _number_in("/proc/self/status", "VmSize:", 0.0)
    return inf if soft == resource.RLIM_INFINITY else soft - used


def _number_in(file: str, label: str = "", absent: float = inf) -> float:
    """The number after a label in a file of the system; `absent` if there is none."""
    try:
        words = Path(file).read_text(encoding="ascii", errors="replace").split()
        return float(words[words.index(label) + 1 if label else 0])
    except (OSError, ValueError, IndexError):
        return absent
