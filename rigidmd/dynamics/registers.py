"""Numbers of the step that change from row to row, and what rows know of them."""

from typing import NamedTuple

import numpy as np

#: Bits of `Registers.known`, in addition to those of `forces.terms` (FORCES_ONLY, WITH_ENERGIES,
#: WITH_VIRIALS, INTO_OTHER_LOAD): a barostat, and an extension of the step, have kept the energies
#: that they need.
KEPT_BY_BAROSTAT, KEPT_BY_EXTENSION = 16, 32


class Registers(NamedTuple):
    """The numbers, each an array (1,) where nothing else is given."""

    dt: np.ndarray  # the time step, ps
    row: np.ndarray  # int64, the row that runs next
    known: np.ndarray  # int64, bits: what has been computed at the current positions
    resting: np.ndarray  # int64, whether kicks and drifts take no time
    before: np.ndarray  # (2,) power and squares of the load before a watched step, else NaN


def new_registers() -> Registers:
    """Registers in which nothing is known."""
    integers = (np.zeros(1, np.int64) for _ in range(3))
    return Registers(np.zeros(1), *integers, np.full(2, np.nan))


class Timing(NamedTuple):
    """When a row acts, over which time, and its random numbers."""

    fraction: float  # of the time step
    draw: int  # its first random number
    when: int  # bits of `Pass.when`
