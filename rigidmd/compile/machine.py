"""Properties of this machine: the width of its vectors, and how finely work is divided."""

import os

from numba.core.codegen import get_host_cpu_features

from rigidmd.errors import SettingError

BLOCKS = 16  # of work, which any thread may take: enough for 16 threads
WIDTHS = ("128", "256", "512")  # of vectors, in bits


def _simd_bits() -> int:
    """Bits of the vectors in pair loops: the widest that this machine supports."""
    if named := os.environ.get("RIGIDMD_SIMD_BITS"):
        if named not in WIDTHS:
            raise SettingError(f"RIGIDMD_SIMD_BITS is {named[:40]!r}, must be one of {', '.join(WIDTHS)}")
        return int(named)
    features = get_host_cpu_features().split(",")
    return 512 if "+avx512f" in features else 256 if "+avx2" in features else 128


SIMD_BITS = _simd_bits()
