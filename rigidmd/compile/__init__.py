"""The interface to Numba: kernels are compiled, cached and called by address, and SIMD vectors.

The names that the author of a term needs are exported here; `simd` has the vectors.
"""

# isort: skip_file
from rigidmd.compile import settings  # noqa: F401  (before Numba is loaded)
from rigidmd.compile.code import (
    BoundTask, Code, CompiledTask, NumbaStruct, TaskArguments, call, call_blocks, load_arguments, pack_arguments, task,
)  # fmt: skip
from rigidmd.compile.kernels import chosen_by_type, implements, is_a, kernel
from rigidmd.compile.machine import BLOCKS, MOST_BLOCKS, SIMD_BITS
from rigidmd.compile.thread_pool import call_address, set_threads

__all__ = [
    "BLOCKS", "MOST_BLOCKS", "SIMD_BITS", "BoundTask", "Code", "CompiledTask", "NumbaStruct", "TaskArguments",
    "call", "call_address", "call_blocks", "chosen_by_type", "implements", "is_a", "kernel", "load_arguments",
    "pack_arguments", "set_threads", "task",
]  # fmt: skip
