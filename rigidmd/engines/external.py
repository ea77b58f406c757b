"""The other engine of a scene, by name, and what it cannot do."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, Load, State
from rigidmd.dynamics.step_loop import Model
from rigidmd.engines.cpu import keep_time
from rigidmd.engines.force_field import ForceFieldView, force_field_of
from rigidmd.engines.protocol import Tally
from rigidmd.engines.system import System
from rigidmd.errors import SceneError


class ExternalEngine(ABC):
    """An `Engine` of another program: what such engines share. It moves the molecules as a stage of the scene says."""

    version: str  # its name and version
    moves: tuple[int, int] = (0, 0)  # of the box, tried and accepted; (0, 0) where it does not tell
    length_tolerance = 0.0  # relative error of lengths in its molecules

    def __init__(self, system: System, stage: int):
        self._system, self._view, self._stage = system, force_field_of(system), system.scene.stages[stage]
        #: Whether the energy less heat is conserved; if not, heat is what the energy gains.
        self.conserves_energy = not (self._stage.has_thermostat or self._stage.has_barostat)
        self._known_state: State | None = None  # the state that the program has
        self._heat_offset = 0.0  # heat in the books of a state that it was given, less what it had counted by then
        self._moved: State | None = None

    def variables(self, state: State, row: Scheme | Solver) -> np.ndarray:
        """None: what thermostats and barostats evolve is the program's own."""
        return np.zeros(0)

    def begin(self, state: State, row: Scheme | Solver) -> State:
        return state.copy()._replace(bath=self.variables(state, row))

    def advance(self, state: State, row: Scheme | Solver, dt: float, until: int, observed: bool = False) -> None:
        """Move the state in steps of dt until `until` steps are counted in it, in place. Raises SimulationError."""
        keep_time(state, dt)
        self._send(state)
        self._moved = state
        steps = until - int(state.step[NOW])
        if steps <= 0:
            return
        self._run(state, steps, dt)
        self._receive(state)
        state.step[NOW] = until
        state.time[NOW] = state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN]) * dt
        self._known_state = state.copy()

    def snapshot(self) -> State:
        if self._moved is None:
            raise ValueError("this engine has moved no state yet")
        return self._moved.copy()

    def forget(self) -> None:
        """Declare that positions were changed from outside since the last step."""
        self._known_state = None

    @abstractmethod
    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, and each term's energy; the virial of all of them stands with the first."""

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """As `evaluate`, which asks the program anew only about other positions than those that it has."""
        return self.evaluate(state)

    @abstractmethod
    def memory(self) -> dict[str, np.ndarray]:
        """What the next steps depend on besides the state, as far as it can be had."""

    @abstractmethod
    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Go on from a state with what `memory` gave for it."""

    @abstractmethod
    def rotor(self, model: Model) -> "NamedTuple | None":
        """The rotor that turns bodies in its very steps; None if its method is another one."""

    @abstractmethod
    def close(self) -> None:
        """End what it has started."""

    @abstractmethod
    def _send(self, state: State) -> None:
        """Let the program have a state, unless it has it already."""

    @abstractmethod
    def _run(self, state: State, steps: int, dt: float) -> None:
        """Let the program take steps of dt (ps); `state` is the one that they begin at."""

    @abstractmethod
    def _receive(self, state: State) -> None:
        """Fill a state in, in place, with what the program has, its heat too."""


def same_state(one: State | None, other: State) -> bool:
    """Whether two states are the same to the bit, but for time and books."""
    return one is not None and all(np.array_equal(a, b) for a, b in zip(one[:5], other[:5], strict=True))


def external_engine(system: System, stage: int = 0) -> ExternalEngine:
    """The engine that the scene names, for one of its stages.

    Raises SceneError with all that it cannot do, EngineError if it is not here.
    """
    refuse(system)
    choice = system.scene.engine
    if choice.name == "lammps":
        from rigidmd.engines.lammps.engine import LammpsEngine

        return LammpsEngine(system, stage, choice.ranks or 1)
    from rigidmd.engines.openmm.engine import OpenmmEngine

    return OpenmmEngine(system, stage, choice.platform or "CPU")


def refuse(system: System) -> None:
    """Raise SceneError with all that the engine of a scene cannot do."""
    choice = system.scene.engine
    if not choice.is_external:
        return
    if found := _faults_of(choice.name)(force_field_of(system)):
        raise SceneError(system.scene.source, [f"engine.name = {choice.name!r}: {fault}" for fault in found])


def _faults_of(name: str) -> Callable[[ForceFieldView], list[str]]:
    if name == "lammps":
        from rigidmd.engines.lammps.files import unsupported_features
    else:
        from rigidmd.engines.openmm.system import unsupported_features
    return unsupported_features
