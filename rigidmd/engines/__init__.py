"""Who moves a state. `Engine` is all that a run asks for; `cpu` is this machine's processor, `textbook` a solver."""

from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.core.schemes import Scheme, Solver
from rigidmd.core.state import Load, State


class Tally(NamedTuple):
    """What one term contributes at one moment."""

    energy: float  # u Å²/ps²
    virial: np.ndarray  # (3, 3) molecular, sum F (x) R, u Å²/ps²


class Engine(Protocol):
    """What a run asks of an engine."""

    def begin(self, state: State, row: Scheme | Solver) -> State:
        """A copy of a state with room for all that evolves when a row moves it."""
        ...

    def advance(self, state: State, row: Scheme | Solver, dt: float, until: int) -> None:
        """Move the state in steps of dt until `until` steps are counted in it, in place. Raises SimulationError."""
        ...

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, fresh arrays, and each term's energy and virial. Raises SimulationError."""
        ...

    def snapshot(self) -> State:
        """The state that was last moved, as arrays of this process that nobody else writes; bit for bit."""
        ...

    def forget(self) -> None:
        """Say that positions were changed from outside since the last step."""
        ...
