"""Properties of this machine: its processor, the width of its vectors, its threads, how finely work is divided."""

import os

import numba
from llvmlite.binding import get_host_cpu_name
from numba.core.codegen import get_host_cpu_features

from rigidmd.errors import SettingError

#: As LLVM names them: the processor, and what it can do.
PROCESSOR = get_host_cpu_name()
PROCESSOR_FEATURES = tuple(sorted(name[1:] for name in get_host_cpu_features().split(",") if name.startswith("+")))
BLOCKS = 16  # of work, at least, which any thread may take: enough for 16 threads
MOST_BLOCKS = 128
WIDTHS = ("128", "256", "512")  # of vectors, in bits


def _simd_bits() -> int:
    """Bits of the vectors in pair loops: the widest that this machine supports."""
    if named := os.environ.get("RIGIDMD_SIMD_BITS"):
        if named not in WIDTHS:
            raise SettingError(f"RIGIDMD_SIMD_BITS is {named[:40]!r}, must be one of {', '.join(WIDTHS)}")
        return int(named)
    return 512 if "avx512f" in PROCESSOR_FEATURES else 256 if "avx2" in PROCESSOR_FEATURES else 128


SIMD_BITS = _simd_bits()

#: Threads that there may be: the cores of this process, or what `NUMBA_NUM_THREADS` says.
MOST_THREADS: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]


def threads_for(asked: int | None) -> int:
    """Number of threads that compute when so many are asked for; None: all."""
    return min(asked or MOST_THREADS, MOST_THREADS)
