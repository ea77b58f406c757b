"""What all engines of compiled code share.

This is the Python side of the kernels: it owns their lists, grids, sums and machine code, enlarges
arrays when a kernel returns that one is full, and raises exceptions for status codes.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from rigidmd.compile import Pass
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import (
    CELL_CHANGED,
    EXAMPLE,
    LIST_FULL,
    NEEDS_PYTHON_FORCES,
    NOT_FINITE,
    TALLY_SIZE,
    Load,
    State,
    copy_into,
    no_load,
)
from rigidmd.engines.protocol import Engine, NotFiniteError, Tally, keep_time
from rigidmd.errors import SimulationError
from rigidmd.forces.terms import (
    FORCES_ONLY,
    TALLIED,
    WITH_ENERGIES,
    Evaluation,
    NoForce,
    Setup,
    TermDispatcher,
    compute_load_with_energies,
    in_order,
    trait,
)
from rigidmd.mechanics.free_rotor import NO_SYMMETRY, ExactRotor, SplitRotor

#: Owner of arrays in `Engine.memory` besides the terms.
LOAD = "load"
#: When the passes of terms act, by what the engine uses them for.
USES = {"steps": FORCES_ONLY | TALLIED, "observations": WITH_ENERGIES}
#: dt, `until` and `observed` of `Engine.advance`.
Steps = tuple[float, int, bool]
#: Relative difference of forces and virials between two machines, by arithmetic.
ROUNDING = {np.float64: 1e-8, np.float32: 1e-3}


@dataclass
class LastAdvance:
    """What the last call of `CompiledEngine.advance` has left.

    The load, the energies and the sums of the engine belong to `state` alone, and to its positions
    only while `is_current`, which `forget` and `change` end, and steps that end without forces.
    """

    state: State | None = None
    is_current: bool = False
    observed: Load | None = (
        None  # the copy of the load that `evaluate_current` has returned, to which the sums belong
    )
    evaluated: Load | None = None  # what it returned where it had to evaluate forces again


class HasRotor(Protocol):
    """The constant part of a system, a NamedTuple."""

    @property
    def rotor(self) -> NamedTuple: ...
    def _replace(self, *, rotor: NamedTuple) -> Self: ...


ModelT = TypeVar("ModelT", bound=HasRotor)
#: What an engine binds to a state and its load.
Bound = TypeVar("Bound")


class CompiledEngine(Engine, Generic[ModelT, Bound]):
    """An engine of compiled code.

    model : the constant part of the system
    terms : name -> term, in the order in which forces are added
    python_forces : name of a term that Python computes -> its function, as the term's workspace
        calls it
    """

    is_repeatable = True
    model: ModelT

    def __init__(
        self,
        model: ModelT,
        terms: dict[str, NamedTuple],
        setup: Setup,
        python_forces: dict[str, Callable] | None,
    ):
        self.model, self.terms = model, terms
        self._setup = setup
        self._python_forces = python_forces or {}
        self.load: Load | None = None
        # What terms remember. The other attributes can be made from this and the state at any time.
        self._workspaces: tuple[NamedTuple, ...] | None = None
        self._last = LastAdvance()
        self._dispatchers: dict[str, TermDispatcher] = {}
        self._bound: tuple[tuple, Bound] | None = None  # with the objects that it is bound to

    @property
    def names(self) -> list[str]:
        """Names of the terms."""
        return list(self.terms)

    @property
    def workspaces(self) -> dict[str, NamedTuple]:
        """Name of a term -> its present workspace. Empty before the first use."""
        return dict(zip(self.names, self._workspaces or (), strict=False))

    def change(self, model: ModelT, terms: dict[str, NamedTuple]) -> None:
        self.model, self.terms = model, terms
        self._workspaces = None
        self.forget()

    def forget(self) -> None:
        self._last.is_current = False

    def renew_lists(self) -> None:
        """Make the next evaluation independent of earlier ones: it builds all neighbour lists."""
        for workspace in self._workspaces or ():
            trait(workspace, "renew_list")()

    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        """The variables of the thermostat and the barostat of a scheme, at rest."""
        return np.zeros(as_scheme(integrator).variables)

    def advance(
        self,
        state: State,
        integrator: Scheme | Solver,
        dt: float,
        until: int,
        observed: bool = False,
    ) -> None:
        integrator = as_scheme(integrator)
        workspaces = self._prepare(state)
        keep_time(state, dt)
        last = self._last
        # its energies belong to another state
        if state is not last.state and "steps" in self._dispatchers:
            self._dispatchers["steps"].table.tallies_valid[0] = 0
        if self.load is None:
            self.load = no_load(state)
        last.state, last.observed, last.evaluated = state, None, None
        step = float(dt), int(until), observed
        last.is_current = self._move(state, self.load, integrator, workspaces, step)

    @abstractmethod
    def _move(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        """Advance the system. Returns whether the load belongs to the new positions."""

    def _bind(self, objects: tuple, make: Callable[[], Bound]) -> Bound:
        """What `make` returns, which is kept while it is bound to the same objects."""
        if self._bound is None or not _are_same(objects, self._bound[0]):
            self._bound = objects, make()
        return self._bound[1]

    def _dispatcher(self, use: str, workspaces: tuple[NamedTuple, ...]) -> TermDispatcher:
        if use not in self._dispatchers:
            self._dispatchers[use] = self._new_dispatcher(use, workspaces)
        return self._dispatchers[use]

    def _new_dispatcher(self, use: str, workspaces: tuple[NamedTuple, ...]) -> TermDispatcher:
        return TermDispatcher(workspaces, USES[use], with_rates=use == "steps")

    def model_for(self, scheme: Scheme) -> ModelT:
        """The model with the rotor of a scheme. The exact rotor differs only for asymmetric
        bodies."""
        rotor = self.model.rotor
        if (
            scheme.exact_rotor
            and isinstance(rotor, SplitRotor)
            and (rotor.symmetry == NO_SYMMETRY).any()
        ):
            return self.model._replace(rotor=ExactRotor(*rotor))
        return self.model

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        workspaces = self._prepare(state)
        dispatcher = self._dispatcher("observations", workspaces)
        copy, load = dispatcher.copy_and_load(state)
        while status := compute_load_with_energies(dispatcher.bind(workspaces, copy, load), *load):
            workspaces = self._handle_status(status, state)
        return self._copies(load, dispatcher)

    def _copies(self, load: Load, dispatcher: TermDispatcher) -> tuple[Load, dict[str, Tally]]:
        """A copy of a load, and the tally of each term."""
        tallies = dispatcher.table.tallies
        virials = tallies[:, 1:].copy().reshape(-1, 3, 3)
        by_term = [
            Tally(energy, virial)
            for energy, virial in zip(tallies[:, 0].tolist(), virials, strict=True)
        ]
        return Load(load.force.copy(), load.torque_body.copy()), dict(
            zip(self.names, by_term, strict=False)
        )

    def memory(self) -> dict[str, np.ndarray] | None:
        return {
            f"{owner}.{key}": array
            for owner, arrays in self._memory_by_owner().items()
            for key, array in arrays.items()
        }

    def _memory_by_owner(self) -> dict[str, dict[str, np.ndarray]]:
        """Neighbour lists as last built, and forces at the current positions."""
        arrays_of: dict[str, dict[str, np.ndarray]] = {
            name: trait(workspace, "checkpoint_arrays")()
            for name, workspace in self.workspaces.items()
        }
        if self.load is not None and self._last.is_current:
            arrays_of[LOAD] = self.load._asdict()
        return arrays_of

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        self._prepare(state)
        arrays_of: dict[str, dict[str, np.ndarray]] = {}
        for name, array in memory.items():
            owner, _, key = name.rpartition(".")
            arrays_of.setdefault(owner, {})[key] = array
        self._recall_lists(state, arrays_of)
        self.load, self._last = no_load(state), LastAdvance(is_current=LOAD in arrays_of)
        self._dispatchers.pop("steps", None)  # its energies belong to another state
        if LOAD in arrays_of:
            copy_into(self.load, arrays_of[LOAD])
        self._recall_couplings(state, arrays_of)
        if LOAD in arrays_of and not self._python_forces:
            self._check_recalled(state, arrays_of)

    def _recall_couplings(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        """Make what the rows of the step remember, with the arrays that were kept."""

    def _recall_lists(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        """Make new workspaces, with the neighbour lists that were kept: all of them or none."""
        spaces = _with_code(self.new_workspaces(state))
        if arrays_of.keys() & set(self.names):
            pairs = zip(self.names, spaces, strict=False)
            spaces = tuple(
                trait(workspace, "restore")(arrays_of.get(name, {}), self._setup.skin)
                for name, workspace in pairs
            )
        self._workspaces = spaces

    def _check_recalled(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        """Raise ValueError unless the kept forces are those of this code at the state."""
        try:
            load, _ = self.evaluate(state)
        except SimulationError as error:
            raise ValueError(f"forces cannot be evaluated at its state: {error}") from None
        rounding = ROUNDING[self._setup.dtype]
        for name, evaluated, recalled in zip(Load._fields, load, self.load or (), strict=True):
            largest = np.abs(evaluated).max(initial=0.0)
            # forces that are not finite differ, too
            if not np.abs(evaluated - recalled).max(initial=0.0) <= rounding * largest:
                raise ValueError(f"its state has another {name} than was kept with it")
        self._recall_lists(state, arrays_of)  # the evaluation may have built others

    def passes(self, state: State) -> list[tuple[str, Pass]]:
        """The passes of the forces at a state, in their order, each with the name of its term.
        Nothing is compiled."""
        load = no_load(state)
        status = np.zeros(1, np.int64)
        into = Evaluation(state, load, np.zeros(TALLY_SIZE), status)
        workspaces = zip(self.names or ["no forces"], self.new_workspaces(state), strict=True)
        return in_order([(name, trait(of, "passes")(into)) for name, of in workspaces])

    def new_workspaces(self, state: State) -> tuple[NamedTuple, ...]:
        """New workspaces for the cell of a state, without machine code. Their arrays show the
        memory needed."""
        setup = self._setup._replace(cell=state.cell)
        return tuple(trait(term, "workspace")(setup) for term in self.terms.values()) or (
            NoForce(),
        )

    def _prepare(self, state: State) -> tuple[NamedTuple, ...]:
        """Check the arrays of a state for compiled code, and return the workspaces, which the first
        use makes."""
        for name, array, example in zip(State._fields, state, EXAMPLE[0], strict=True):
            if array.dtype != example.dtype or array.ndim != example.ndim or not array.flags.carray:
                kind = (
                    f"a contiguous, writable array of {example.dtype} in C order with"
                    f" {example.ndim} axes"
                )
                raise TypeError(
                    f"state.{name} must be {kind} (core.state.state_of makes a state of any arrays)"
                )
        if self._workspaces is None:
            spaces = self.new_workspaces(state)
            self._compile(lambda: TermDispatcher(_with_code(spaces), USES["observations"]))
            self._workspaces = _with_code(spaces)
        return self._workspaces

    def _compile(self, make: Callable[[], object]) -> None:
        """Compile all code that a function makes, where a second process saves time."""

    def _handle_status(self, status: int, state: State) -> tuple[NamedTuple, ...]:
        """Handle a status code of a kernel, and return the workspaces with which to call it
        again."""
        workspaces = self._prepare(state)
        if status in (LIST_FULL, CELL_CHANGED):
            workspaces = self._workspaces = tuple(
                trait(space, "with_capacity")(state.cell) for space in workspaces
            )
        elif status == NOT_FINITE:
            raise NotFiniteError(state)
        elif status == NEEDS_PYTHON_FORCES:
            for name, workspace in zip(self.names, workspaces, strict=False):
                if name in self._python_forces:
                    workspace.update(self._python_forces[name], state)  # type: ignore[attr-defined]  # of such terms
        return workspaces


def _with_code(workspaces: tuple[NamedTuple, ...]) -> tuple[NamedTuple, ...]:
    return tuple(trait(workspace, "with_code")() for workspace in workspaces)


def as_scheme(integrator: Scheme | Solver) -> Scheme:
    """The same integrator, if it is a scheme. Raises TypeError for a solver."""
    if not isinstance(integrator, Scheme):
        raise TypeError(f"{integrator.name} is a general solver, which only OdeEngine uses")
    return integrator


def _are_same(objects: tuple, others: tuple) -> bool:
    """Whether two tuples have the same objects."""
    return len(objects) == len(others) and all(
        one is other for one, other in zip(objects, others, strict=True)
    )
