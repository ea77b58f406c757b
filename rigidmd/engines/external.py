"""External engines: LAMMPS and OpenMM behind the protocol of engines, chosen by `engine.name` of a scene.

What an engine can translate is a table. All that is not in the table is refused with one kind of message. Thermostats,
potentials and fields do not know about other engines: a new one is refused until a table has it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.engines.force_field import ForceFieldView, force_field_of, unknown_terms
from rigidmd.engines.protocol import Engine, keep_time
from rigidmd.engines.registry import Program
from rigidmd.engines.system import System
from rigidmd.errors import EngineError, SceneError
from rigidmd.scene.validation import not_none


class Missing(str):
    """In place of a translation: why the engine has none, with advice."""


class Key(NamedTuple):
    """The values of a key of a scene that an engine can translate."""

    name: str  # of a scene, with a dot, or of a stage
    values: Mapping[Any, Any]  # value -> its translation, or `Missing`
    reason: str = ""  # why other values are refused, with advice; default: "ENGINE has ..."
    matters: Callable[[ForceFieldView], Any] = lambda view: True

    def refusal(self, title: str, value: Any) -> str | None:
        """The message on a value without a translation."""
        how = self.values.get(value, Missing(self.reason))
        if not isinstance(how, Missing):
            return None
        known = " and ".join(str(name) for name, how in self.values.items() if name and not isinstance(how, Missing))
        return f"{self.name} = {value!r}: {how or f'{title} has {known}'}"


class Limit(NamedTuple):
    """A combination of settings that an engine lacks."""

    message: str  # with {} for what `applies` returns
    applies: Callable[[Any], Any]  # whether a `ForceFieldView` or a `Stage` has them


class Translations(NamedTuple):
    """The table of an engine. rigidmd itself performs minimisations, in which nothing is refused."""

    title: str
    scene: tuple[Key, ...]
    stage: tuple[Key, ...]
    limits: tuple[Limit, ...]  # of a `ForceFieldView`
    stage_limits: tuple[Limit, ...]

    def of(self, name: str) -> Mapping[Any, Any]:
        """The translations of a key."""
        return next(key.values for key in (*self.scene, *self.stage) if key.name == name)

    def refusals(self, view: ForceFieldView) -> Iterator[str]:
        """Messages on all that a system has and the engine lacks."""
        yield from unknown_terms(view.system)
        for key in self.scene:
            table, name = key.name.split(".")
            if key.matters(view) and (message := key.refusal(self.title, getattr(getattr(view.scene, table), name))):
                yield message
        yield from _limits(self.limits, view)
        for k, stage in enumerate(view.scene.stages):
            messages = [key.refusal(self.title, getattr(stage, key.name)) for key in self.stage]
            if not stage.is_minimisation:
                yield from (f"stages.{k}.{m}" for m in (*messages, *_limits(self.stage_limits, stage)) if m)


def _limits(limits: tuple[Limit, ...], subject: Any) -> Iterator[str]:
    return (limit.message.format(found) for limit in limits if (found := limit.applies(subject)))


def checked_view(system: System, program: Program, where: str, more: Iterable[str] = ()) -> ForceFieldView:
    """The view of a system for an external engine. Raises SceneError with all it lacks, and `more`, after `where`."""
    view = force_field_of(system)
    if found := [*program.load(program.translations).refusals(view), *more]:
        raise SceneError(system.scene.source, [f"{where}: {message}" for message in found])
    return view


def moves(title: str, bodies: str) -> tuple[Key, Limit, Limit]:
    """What holds for all programs: `velocity_verlet`, or baoab with langevin; one friction."""
    by = f"{title} moves {bodies} by velocity_verlet"
    return (
        Key("integrator", {"velocity_verlet": "", "baoab": ""}, by),
        Limit(f"integrator = 'baoab': {by}", lambda stage: stage.integrator == "baoab" and not is_langevin(stage)),
        Limit(
            f"friction_rotation_per_ps: {title} has one friction for translation and rotation",
            lambda stage: is_langevin(stage) and len(set(stage.frictions)) > 1,
        ),
    )


def is_langevin(stage: Any) -> bool:
    return stage.thermostat_kind == "langevin"


#: With constrained distances or split rotations, the exact flow of a free rotor does not exist.
SPLIT = {None: "", "split": ""}


class ExternalEngine(Engine, ABC):
    """Base of engines that run another program for one stage. The first tally of `evaluate` has the whole virial."""

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
    """The external engine for a stage. Raises SceneError with all that it lacks; EngineError if not installed."""
    program = _supporting_program(system)
    return program.load(program.engine)(system, stage, **system.scene.engine.options)


def _supporting_program(system: System) -> Program:
    """The external engine of a scene. Raises SceneError with all features that it lacks."""
    program = not_none(system.scene.engine.program)
    checked_view(system, program, f"engine.name = {program.name!r}")
    return program


def check_engine(system: System) -> str:
    """What is installed of the external engine of a scene. Raises SceneError with all features that it lacks."""
    program = _supporting_program(system)
    try:
        return program.load(program.installed)() if program.installed else ""
    except EngineError as error:
        return str(error)
