"""Properties of this machine: the width of its vectors, and how finely work is divided."""

import os

from numba.core.codegen import get_host_cpu_features

BLOCKS = 16  # of work, which any thread may take: enough for 16 threads


def _simd_bits() -> int:
    """Bits of the vectors in pair loops: the widest that this machine supports."""
    if named := os.environ.get("RIGIDMD_SIMD_BITS"):
        return int(named)
    features = get_host_cpu_features().split(",")
    return 512 if "+avx512f" in features else 256 if "+avx2" in features else 128


SIMD_BITS = _simd_bits()
