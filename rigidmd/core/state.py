"""The state: everything that evolves during a run, and nothing else. The load on its bodies, and
status codes."""

from math import acos, degrees, hypot, inf
from operator import mul
from typing import NamedTuple

import numpy as np

# Status codes of kernels. The largest one wins, and Python acts on it (engines.cpu).
OK = 0
NEEDS_PYTHON_FORCES = (
    1  # a Python function has to compute its force: do so and call the kernel again
)
LIST_FULL = 2  # a neighbour list needs more memory: enlarge it and call the kernel again
CELL_CHANGED = (
    3  # the cell is now too small for the skin of a list: fit the list and call the kernel again
)
BEHIND_WALL = 4  # a site is on a wall that it cannot pass, or behind it
NOT_FINITE = 5  # a position is not a number, or too large to be meaningful

#: Columns of `State.energy_ledger`, energies added so far: heat of thermostats, work of driving and
#: braking forces and of barostats, and the (negative) kinetic energy of total momentum that was
#: removed.
HEAT, WORK, REMOVED = 0, 1, 2
#: Columns of `State.time` and `State.step`: now, and where the current segment of equal steps
#: started.
NOW, ORIGIN = 0, 1

# A tally is a float64 array (10,): energy, then the molecular virial tensor sum F (x) R in rows (u
# Å²/ps²).
# None instead of it compiles the kernels without energies.
TALLY_SIZE = 10


class State(NamedTuple):
    """Everything that evolves, for n bodies. Molecules in Å, ps and u, single bodies in SI units.

    A scene of points has rotation (0, 3, 3) and angular_momentum_body (0, 3), because points do not
    rotate. A pinned body has position and velocity (0, 3). Within a segment of equal steps the time
    is computed from the step, time[ORIGIN] + (step[NOW] - step[ORIGIN]) dt, so a run in parts has
    exactly the times of an uninterrupted one.

    Attributes
    ----------
    position : ndarray
        Centres of mass (n, 3), lab frame, never wrapped
    velocity : ndarray
        Their velocities (n, 3), lab frame
    rotation : ndarray
        Rotation matrices Q (n, 3, 3), body to lab
    angular_momentum_body : ndarray
        Angular momenta (n, 3), body frame
    cell : ndarray
        Rows (3, 3): a along x, b in the xy plane, c. Infinite edges without a box
    time : ndarray
        Time now, and when the segment of equal steps started (2,). `Simulation.time` is the first
    step : ndarray
        Steps since the start, and those when the segment started (2,), int64
    energy_ledger : ndarray
        Energies added so far (3,): heat, work, removed momentum. The energy less their sum is
        conserved
    extra_variables : ndarray
        Variables (m,) of a thermostat, a piston or an ODE formulation. (0,) in most runs
    """

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    angular_momentum_body: np.ndarray
    cell: np.ndarray
    time: np.ndarray
    step: np.ndarray
    energy_ledger: np.ndarray
    extra_variables: np.ndarray

    def copy(self) -> "State":
        """A state with copies of all arrays.

        Returns
        -------
        State
            The copy
        """
        return State(*(array.copy() for array in self))

    @property
    def read_only(self) -> "State":
        """The same arrays, which cannot be written through this state."""
        views = [array.view() for array in self]
        for view in views:
            view.flags.writeable = False
        return State(*views)

    def __repr__(self) -> str:
        """Short: arrays of many bodies would flood a screen."""
        count = max(len(self.rotation), len(self.position))
        bodies = f"{count} {'body' if count == 1 else 'bodies'}"
        return f"<State of {bodies} at time {self.time[NOW]:g}, step {self.step[NOW]}>"

    @property
    def volume(self) -> float:
        """Volume of the cell, Å³. Infinite without a box."""
        # the cell is lower triangular: its determinant is the product of its diagonal
        (ax, _, _), (_, by, _), (_, _, cz) = self.cell.tolist()
        return ax * by * cz

    @property
    def is_finite(self) -> bool:
        """Whether all variables are finite."""
        return all(
            bool(np.isfinite(array).all())
            for array in (*self[:4], self.energy_ledger, self.extra_variables)
            if array.size
        )

    def time_of(self, step: int, dt: float) -> float:
        """The time at a step of the current segment.

        Parameters
        ----------
        step : int
            Steps since the start
        dt : float
            Length of a step, ps, for a body s

        Returns
        -------
        float
            The time, ps, for a body s
        """
        return self.time[ORIGIN] + (step - self.step[ORIGIN]) * dt

    def begin_segment(self, time: float | None = None) -> None:
        """Start a segment of equal steps, in place.

        Parameters
        ----------
        time : float, optional
            The current time if it is known exactly, ps, for a body s
        """
        self.time[:] = self.time[NOW] if time is None else time
        self.step[ORIGIN] = self.step[NOW]


#: The cell of a scene without a box.
NO_CELL = np.diag([inf, inf, inf])


def edges_and_angles(cell: np.ndarray) -> list[float]:
    """a, b, c (Å), alpha, beta, gamma (degrees) of a cell (3, 3). NumPy would take ten times as
    long."""
    a, b, c = cell.tolist()
    edges = [hypot(*edge) for edge in (a, b, c)]
    pairs = ((b, c, edges[1] * edges[2]), (c, a, edges[2] * edges[0]), (a, b, edges[0] * edges[1]))
    angles = [
        degrees(acos(max(min(sum(map(mul, u, v)) / size, 1.0), -1.0))) for u, v, size in pairs
    ]
    return [*edges, *angles]


def state_of(
    position: np.ndarray | None = None,
    velocity: np.ndarray | None = None,
    rotation: np.ndarray | None = None,
    angular_momentum_body: np.ndarray | None = None,
    cell: np.ndarray | None = None,
) -> State:
    """A state at time 0 with contiguous copies of these arrays. By default at rest and without a
    box.

    Without position it is a pinned body. Without rotation, points.
    """
    position = _array(np.zeros((0, 3)) if position is None else position)
    rotation = _array(np.zeros((0, 3, 3)) if rotation is None else rotation)
    return State(
        position,
        np.zeros_like(position) if velocity is None else _array(velocity),
        rotation,
        np.zeros((len(rotation), 3))
        if angular_momentum_body is None
        else _array(angular_momentum_body),
        _array(NO_CELL if cell is None else cell),
        np.zeros(2),
        np.zeros(2, np.int64),
        np.zeros(3),
        np.zeros(0),
    )


def _array(values: np.ndarray) -> np.ndarray:
    return np.array(values, dtype=np.float64, order="C")


class Load(NamedTuple):
    """Forces and torques on the bodies at the current positions."""

    force: np.ndarray  # (n, 3) lab frame; (0, 3) for a pinned body
    torque_body: np.ndarray  # (n, 3) body frame; (0, 3) for points


#: A state and a load with the array types for which code is compiled.
EXAMPLE = (state_of(), Load(np.zeros((0, 3)), np.zeros((0, 3))))


def no_load(state: State) -> Load:
    """Zero forces and torques for the bodies of a state."""
    return Load(np.zeros_like(state.velocity), np.zeros_like(state.angular_momentum_body))


def copy_into(arrays: NamedTuple, sources: dict[str, np.ndarray]) -> None:
    """Copy kept arrays into the arrays of a tuple. Raises ValueError if they do not fit."""
    for name, array in sources.items():
        getattr(arrays, name)[:] = array
