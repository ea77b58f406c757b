"""What this machine computes with."""

import os

from numba.core.codegen import get_host_cpu_features

BLOCKS = 16  # that threads share: enough for 16 of them


def _simd_bits() -> int:
    """Bits of the vectors that pair loops use: the widest that this machine computes with."""
    if named := os.environ.get("RIGIDMD_SIMD_BITS"):
        return int(named)
    features = get_host_cpu_features().split(",")
    return 512 if "+avx512f" in features else 256 if "+avx2" in features else 128


SIMD_BITS = _simd_bits()
