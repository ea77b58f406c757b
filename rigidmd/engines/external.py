"""External engines: LAMMPS and OpenMM behind the protocol of engines, chosen by `engine.name` of a scene."""

from abc import ABC, abstractmethod

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.engines.force_field import force_field_of
from rigidmd.engines.protocol import Engine, keep_time
from rigidmd.engines.system import System
from rigidmd.engines.translations import checked_view
from rigidmd.errors import EngineError
from rigidmd.scene.validation import not_none


class ExternalEngine(Engine, ABC):
    """Base of the engines that run another program. A stage of the scene determines the motion. The first tally of
    `evaluate` has the virial of all terms."""

    def __init__(self, system: System, stage: int):
        self._system, self._view, self._stage = system, force_field_of(system), system.scene.stages[stage]
        self.conserves_energy = not (self._stage.has_thermostat or self._stage.has_barostat)
        self._known_state: State | None = None  # the present state of the program
        self._heat_offset = 0.0  # heat in the ledger of a state that was sent, less the heat of the program by then
        self._moved: State | None = None

    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        """None: the program itself keeps the variables of its thermostat and barostat."""
        return np.zeros(0)

    def advance(self, state: State, integrator: Scheme | Solver, dt: float, until: int, observed: bool = False) -> None:
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
        self._known_state = None

    @abstractmethod
    def _send(self, state: State) -> None:
        """Set the program's state, unless it has it already."""

    @abstractmethod
    def _run(self, state: State, steps: int, dt: float) -> None:
        """Let the program take steps of dt (ps) from `state`."""

    @abstractmethod
    def _receive(self, state: State) -> None:
        """Write the program's state, and its heat, into `state`."""


def same_state(one: State | None, other: State) -> bool:
    """Whether two states are equal to the bit, except for time and the energy ledger."""
    return one is not None and all(np.array_equal(a, b) for a, b in zip(one[:5], other[:5], strict=True))


def external_engine(system: System, stage: int = 0) -> ExternalEngine:
    """The external engine of a scene, for one of its stages. Raises SceneError with all features that it lacks, and
    EngineError if it is not installed."""
    choice, program = system.scene.engine, not_none(system.scene.engine.program)
    check_supported(system)
    return program.load(program.engine)(system, stage, **choice.options)


def check_supported(system: System) -> None:
    """Raise SceneError with all features of a scene that its external engine lacks."""
    choice = system.scene.engine
    checked_view(system, not_none(choice.program), f"engine.name = {choice.name!r}")


def check_engine(system: System) -> str:
    """What is installed of the external engine of a scene. Raises SceneError with all features that it lacks."""
    check_supported(system)
    program = not_none(system.scene.engine.program)
    try:
        return program.load(program.installed)() if program.installed else ""
    except EngineError as error:
        return str(error)
