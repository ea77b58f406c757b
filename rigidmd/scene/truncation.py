"""The cutoff schemes of pair potentials."""

from typing import Literal

TruncationName = Literal["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
