"""Engines move states. `Engine` is their protocol; `cpu` runs compiled code, `textbook` general ODE solvers."""

from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import Load, State


class Tally(NamedTuple):
    """Contribution of one term at one moment."""

    energy: float  # u Å²/ps²
    virial: np.ndarray  # (3, 3) molecular, sum F (x) R, u Å²/ps²


class Halted(Exception):
    """An engine was asked to end between two looks; the state is that of the last one."""


class Engine(Protocol):
    """The methods of an engine that a run uses."""

    def variables(self, state: State, row: Scheme | Solver) -> np.ndarray:
        """What a row moves besides the bodies, for `state.bath`, as it is when a stretch of steps begins."""
        ...

    def begin(self, state: State, row: Scheme | Solver) -> State:
        """A copy of a state, with the variables of a row."""
        ...

    def advance(self, state: State, row: Scheme | Solver, dt: float, until: int, looked: bool = False) -> None:
        """Move the state in steps of dt until `until` steps are counted in it, in place. Raises SimulationError.

        looked : whether `look` follows; speed only
        """
        ...

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, fresh arrays, and each term's energy and virial. Raises SimulationError."""
        ...

    def look(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """`evaluate` at the state that was just moved; what its last step has computed is not computed again."""
        ...

    def snapshot(self) -> State:
        """An exact copy of the state that was last moved."""
        ...

    def memory(self) -> dict[str, np.ndarray] | None:
        """Arrays on which the next steps depend besides the state; None if there is more than arrays can hold."""
        ...

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Go on from a state with what `memory` gave for it, to the same bits. Raises ValueError if they do not fit."""
        ...

    def forget(self) -> None:
        """Declare that positions were changed from outside since the last step."""
        ...
