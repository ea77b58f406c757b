"""The protocol of engines. An engine moves the state of a system by steps of an integrator and evaluates its forces.

`cpu` runs compiled code. `ode` moves a single body by a general ODE solver. `external` lets another program (LAMMPS or
OpenMM) compute.
"""

from abc import abstractmethod
from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import Load, State


class Tally(NamedTuple):
    """Energy and virial of one term at one state."""

    energy: float  # u Å²/ps²
    virial: np.ndarray  # (3, 3) molecular, sum F (x) R, u Å²/ps²


class Halted(Exception):
    """A run was asked to stop between two observations. The state is as at the last observation."""


class Engine(Protocol):
    """The methods of an engine that a run uses."""

    @abstractmethod
    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        """The extra variables of an integrator (`state.extra_variables`) at the begin of a segment."""

    def begin(self, state: State, integrator: Scheme | Solver) -> State:
        """A copy of a state with the variables of an integrator."""
        return state.copy()._replace(extra_variables=self.variables(state, integrator))

    @abstractmethod
    def advance(self, state: State, integrator: Scheme | Solver, dt: float, until: int, observed: bool = False) -> None:
        """Move the state in place, in steps of dt, until its step counter is `until`. Raises SimulationError.
        `observed`: whether `evaluate_current` follows; affects speed only."""

    @abstractmethod
    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state (new arrays), and energy and virial of each term. Raises SimulationError."""

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """`evaluate` at the state that was just moved, with what its last step has already computed."""
        return self.evaluate(state)

    @abstractmethod
    def snapshot(self) -> State:
        """An exact copy of the state that was last moved."""

    @abstractmethod
    def memory(self) -> dict[str, np.ndarray] | None:
        """The arrays besides the state on which the next steps depend; None if arrays cannot hold all of it."""

    @abstractmethod
    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Resume from a state with the arrays of `memory`, to the same bits. Raises ValueError if they do not fit."""

    @abstractmethod
    def forget(self) -> None:
        """Discard what depends on positions, because they were changed from outside since the last step."""
