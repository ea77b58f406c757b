"""The protocol of engines. An engine moves the state of a system by steps of an integrator and
evaluates its forces.

`cpu` runs compiled code. `ode` moves a single body by a general ODE solver. `external` lets another
program (LAMMPS or OpenMM) compute.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, Load, State
from rigidmd.errors import SimulationError

if TYPE_CHECKING:
    from rigidmd.dynamics.observables import LargestValues, StateSums


class Tally(NamedTuple):
    """Energy and virial of one term at one state."""

    energy: float  # u Å²/ps²
    virial: np.ndarray  # (3, 3) molecular, sum F (x) R, u Å²/ps²


class Engine(Protocol):
    """All that a run asks of an engine. An implementation needs the abstract methods. The defaults
    of all others mean that the engine does not know or cannot do it, which a run accepts."""

    version: str = "rigidmd"
    """Name and version of the program"""
    conserves_energy: bool = True
    """Whether the energy less the ledger's heat and work is conserved, so that its drift is an
    error. Otherwise heat is defined as the change of the energy"""
    is_repeatable: bool = False
    """Whether steps from an earlier state are repeated to the same bits, and evaluations at other
    states leave no trace in the motion and are cheap"""
    force_tolerance: float = 0.0
    """Relative error of energies and of rms forces by the arithmetic of the engine"""
    virial_tolerance: float = 0.0
    """Relative error of the virial by the method of the engine"""
    length_tolerance: float = 0.0
    """Relative error of distances within molecules"""
    load: Load | None = None
    """The forces of the last step, where the engine keeps them"""
    is_stiff: bool | None = None
    """Whether stability, not accuracy, has limited these steps for long"""
    stop_requested: Callable[[], bool] = staticmethod(lambda: False)
    """Set by a run. An engine that chooses its steps calls it at each of them, and raises Halted if
    it is true"""

    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        """The extra variables of an integrator (`state.extra_variables`) at the start of a segment.
        By default none."""
        return np.zeros(0)

    def begin(self, state: State, integrator: Scheme | Solver) -> State:
        """A copy of a state with the variables of an integrator."""
        return state.copy()._replace(extra_variables=self.variables(state, integrator))

    @abstractmethod
    def advance(
        self,
        state: State,
        integrator: Scheme | Solver,
        dt: float,
        until: int,
        observed: bool = False,
    ) -> None:
        """Move the state in place, in steps of dt, until its step counter is `until`. Raises
        SimulationError. `observed`: whether `evaluate_current` follows. Affects speed only."""

    @abstractmethod
    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state (new arrays), and energy and virial of each term. Raises
        SimulationError."""

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """`evaluate` at the state that was just moved, with what its last step has already
        computed."""
        return self.evaluate(state)

    def sums(self, state: State, load: Load) -> "StateSums | None":
        """Sums over the state that was just moved and its load from `evaluate_current`, if its last
        step has added them up."""

    def extent(self, state: State) -> "LargestValues | None":
        """Largest values in the state that was just moved and its load, if its last step has found
        them."""

    @property
    def moves(self) -> tuple[int, int] | None:
        """Moves of the box, tried and accepted so far."""

    @property
    def extension_sums(self) -> np.ndarray | None:
        """What the extension of the step has counted and summed so far, see
        `dynamics.step_parts.StepExtension`."""

    @property
    def chosen_steps(self) -> tuple[int, int] | None:
        """Steps that a solver has chosen itself, and its evaluations of forces."""

    @abstractmethod
    def memory(self) -> dict[str, np.ndarray] | None:
        """The arrays besides the state on which the next steps depend. None if arrays cannot hold
        all of it."""

    @abstractmethod
    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Resume from a state with the arrays of `memory`, to the same bits. Raises ValueError if
        they do not fit."""

    @abstractmethod
    def forget(self) -> None:
        """Discard what depends on positions, because they were changed from outside since the last
        step."""

    def change(self, model: NamedTuple, terms: dict[str, NamedTuple]) -> None:
        """Continue with a model and terms of the same types, as at a kink in prescribed functions
        of time."""
        raise TypeError(f"{self.version} cannot change its forces")

    def rotor(self, model: NamedTuple) -> "NamedTuple | None":
        """The rotor by which rigidmd rotates bodies exactly as this engine does, if there is
        one."""

    def close(self) -> None:
        """End what the engine has started outside this process."""


class Halted(Exception):
    """A run was asked to stop between two observations. The state is as at the last observation."""


class NotFiniteError(SimulationError):
    """A position or momentum is not finite, or a position is too large to define forces."""

    def __init__(self, state: State):
        moving = [array for array in state[:4] if len(array)]
        rows = [np.abs(array).reshape(len(array), -1).max(axis=1, initial=0.0) for array in moving]
        size = np.max(np.where(np.isnan(rows), np.inf, rows), axis=0)
        if np.isfinite(size).all():
            self.molecule = int(rows[0].argmax())
            distance = rows[0][self.molecule]
            self.reason = (
                f"it is {distance:.3g} Å from the origin, too far to find its image of the box"
            )
        else:
            self.molecule = int(size.argmax())
            self.reason = "its position or momentum is not finite"
        super().__init__(f"molecule {self.molecule + 1} is lost: {self.reason}")


def keep_time(state: State, dt: float) -> None:
    """Begin a new segment of equal steps, in place, if the step has changed or time was set from
    outside."""
    time, step = state.time.tolist(), state.step.tolist()
    if time[NOW] != time[ORIGIN] + (step[NOW] - step[ORIGIN]) * dt:
        state.begin_segment()
