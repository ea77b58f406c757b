"""Numbers of the step loop that change from flow to flow, which its passes read and write."""

from typing import NamedTuple

import numpy as np

from rigidmd.core.state import TALLY_SIZE

#: Indices of `Registers.progress`: flows done in this step; whether the load belongs to the current
#: positions (1), and the load of a kick with gradient too (2); whether a move of the box has been
#: made and is not yet accepted or rejected.
DONE, LOADED, TRIAL = range(3)
#: What passes may follow, besides the kinds of flows in `core.integrators`: a move of the box;
#: forces that failed.
AFTER_BAROSTAT, FAILED = -1, -2


class Registers(NamedTuple):
    """The numbers, each an array."""

    h: np.ndarray  # (1,) time over which the current flow acts, ps
    draw: np.ndarray  # (1,) int64, its first random number
    progress: np.ndarray  # (3,) int64, see DONE
    tally: np.ndarray  # (2, 10) energies and virials for a barostat, see `BarostatWorkspace`
    known: np.ndarray  # (1,) whether tally[0] belongs to the load
    resting: np.ndarray  # (1,) whether a trajectory has diverged and rests at its start
    failure: np.ndarray  # (1,) status code of forces that failed


def begin_call(progress: np.ndarray, *, is_current: bool) -> None:
    """Set the progress at the begin of a call of a step loop.

    is_current : whether the load belongs to the current positions. The load of a kick with gradient
        then still belongs to them if it did at the end of the last call
    """
    progress[:] = 0, max(1, progress[LOADED]) if is_current else 0, 0


def new_registers(progress: np.ndarray | None = None) -> Registers:
    """Registers for a scheme without a barostat and trajectories."""
    return Registers(
        h=np.zeros(1),
        draw=np.zeros(1, np.int64),
        progress=np.zeros(3, np.int64) if progress is None else progress,
        tally=np.zeros((2, TALLY_SIZE)),
        known=np.zeros(1, np.int64),
        resting=np.zeros(1, np.int64),
        failure=np.zeros(1, np.int64),
    )
