"""The state: everything that evolves during a run, and nothing else. Loads on it, and status codes."""

from math import inf
from typing import NamedTuple

import numpy as np

# What a kernel reports; the largest one wins, Python acts on it (engines.cpu).
OK = 0
ASK = 1  # a Python function has to be asked for its force: ask it and call again
LIST_FULL = 2  # a neighbour list needs more room: enlarge it and call again
CELL_CHANGED = 3  # the cell is now too small for the skin of a list: fit the list and call again
BEHIND_WALL = 4  # a site is on a wall that it cannot pass, or behind it
NOT_FINITE = 5  # a position is not a number, or so large that it says nothing any more

#: Columns of `State.books`, energies put in so far: heat of baths, work of what drives or brakes, and what goes (below
#: zero) with total momentum that is taken out.
HEAT, WORK, TAKEN = 0, 1, 2
#: Columns of `State.time` and `State.step`: now, and where the present stretch of equal steps began.
NOW, ORIGIN = 0, 1

# A tally is a float64 array (10,): energy, then the molecular virial tensor sum F (x) R in rows (u Å²/ps²).
# None in its place compiles the kernels without energies.
TALLY_SIZE = 10


class State(NamedTuple):
    """Everything that evolves. float64 but for `step`; n bodies; molecules in Å, ps, u, single bodies in SI.

    A scene of points has rotation (0, 3, 3) and angular_momentum_body (0, 3): what does not turn is not stored. Nor is
    the position and velocity of a body that is pinned at a point: (0, 3). Time is told by steps: within a stretch of
    equal steps it is time[ORIGIN] + (step[NOW] - step[ORIGIN]) dt, so a run in parts has the very times of a whole.
    """

    position: np.ndarray  # (n, 3) centre of mass, lab frame, never wrapped
    velocity: np.ndarray  # (n, 3) lab frame
    rotation: np.ndarray  # (n, 3, 3) Q, body to lab
    angular_momentum_body: np.ndarray  # (n, 3)
    cell: np.ndarray  # (3, 3) rows a along x, b in the xy plane, c; infinite edges where there is no box
    time: np.ndarray  # (2,) now; when this stretch of equal steps began
    step: np.ndarray  # (2,) int64 steps since the start; those when this stretch began
    books: np.ndarray  # (3,) energies put in so far, see HEAT; the energy less their sum is conserved
    bath: np.ndarray  # (m,) what a bath or a textbook formulation evolves besides; (0,) of most

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return State(*(array.copy() for array in self))

    def __repr__(self) -> str:
        """Short: arrays of many bodies would flood a screen."""
        count = max(len(self.rotation), len(self.position))
        bodies = f"{count} {'body' if count == 1 else 'bodies'}"
        return f"<State of {bodies} at time {self.time[NOW]:g}, step {self.step[NOW]}>"

    @property
    def volume(self) -> float:
        """Volume of the cell, Å³; infinite where there is no box."""
        (a, _, _), (_, b, _), (_, _, c) = self.cell.tolist()
        return a * b * c

    @property
    def is_finite(self) -> bool:
        """Whether all variables are finite."""
        return all(bool(np.isfinite(array).all()) for array in (*self[:4], self.books, self.bath))

    def begin_stretch(self, time: float | None = None) -> None:
        """Begin a stretch of equal steps here, in place; at a time that is known better than the sum of steps."""
        self.time[:] = self.time[NOW] if time is None else time
        self.step[ORIGIN] = self.step[NOW]


#: The cell of a scene without a box.
NO_CELL = np.diag([inf, inf, inf])


def state_of(
    position: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
    angular_momentum_body: np.ndarray | None = None,
    cell: np.ndarray | None = None,
) -> State:
    """A state at time 0 with these arrays, contiguous copies; at rest and without a box where they are not given.

    Without position it is a body pinned at a point; without rotation, points.
    """
    where = _array(np.zeros((0, 3)) if position is None else position)
    turned = _array(np.zeros((0, 3, 3)) if rotation is None else rotation)
    return State(
        where,
        np.zeros_like(where) if velocity is None else _array(velocity),
        turned,
        np.zeros((len(turned), 3)) if angular_momentum_body is None else _array(angular_momentum_body),
        _array(NO_CELL if cell is None else cell),
        np.zeros(2),
        np.zeros(2, np.int64),
        np.zeros(3),
        np.zeros(0),
    )


def _array(values: np.ndarray) -> np.ndarray:
    return np.array(values, dtype=np.float64, order="C")


class Load(NamedTuple):
    """What acts on the bodies at the present positions."""

    force: np.ndarray  # (n, 3) lab frame; (0, 3) for a pinned body
    torque_body: np.ndarray  # (n, 3) body frame; (0, 3) for points


#: What states and loads are: compiled code is made for these types of arrays.
EXAMPLE = (state_of(), Load(np.zeros((0, 3)), np.zeros((0, 3))))


def no_load(state: State) -> Load:
    """Zero forces and torques for the bodies of a state."""
    return Load(np.zeros_like(state.velocity), np.zeros_like(state.angular_momentum_body))
