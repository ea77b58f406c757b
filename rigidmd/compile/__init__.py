"""The interface to Numba: kernels are compiled, cached and called by address, and SIMD vectors.

The names that the author of a term needs are exported here; `simd` has the vectors.
"""

# ruff: noqa: F401  (other packages import these names from here)
from rigidmd.compile import settings  # before Numba is loaded
from rigidmd.compile.code import (
    BoundTask,
    Code,
    CompiledTask,
    TaskArguments,
    call_blocks,
    compile_together,
    load_arguments,
    pack_arguments,
    task,
)
from rigidmd.compile.kernels import chosen_by_type, implements, is_a, kernel
from rigidmd.compile.machine import BLOCKS, MOST_BLOCKS, SIMD_BITS
from rigidmd.compile.program import (
    ALONE,
    ALWAYS,
    JOINED,
    Pass,
    Program,
    Rows,
    call_row,
    run_from,
    run_passes,
)
from rigidmd.compile.records import NumbaStruct
from rigidmd.compile.thread_pool import call_address, set_threads
