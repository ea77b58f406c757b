"""The interface to Numba: how kernels are compiled, cached and called by address, and SIMD vectors.

The names that the author of a term needs are exported here; `lanes` has the vectors.
"""

from rigidmd.compile import settings  # noqa: F401  (before Numba is loaded)
from rigidmd.compile.code import (
    Bound,
    Code,
    Parcel,
    Task,
    call,
    call_blocks,
    compile_together,
    opened,
    packed,
    task,
)
from rigidmd.compile.kernels import implements, is_a, kernel
from rigidmd.compile.layout import Laid
from rigidmd.compile.machine import BLOCKS, MOST_BLOCKS, SIMD_BITS
from rigidmd.compile.thread_pool import jump_to, set_threads

__all__ = [
    "BLOCKS",
    "MOST_BLOCKS",
    "SIMD_BITS",
    "Bound",
    "Code",
    "Laid",
    "Parcel",
    "Task",
    "call",
    "call_blocks",
    "compile_together",
    "implements",
    "is_a",
    "jump_to",
    "kernel",
    "opened",
    "packed",
    "set_threads",
    "task",
]
