"""The engine that runs compiled code on the CPU, for molecules and for a single body.

This is the Python side of the kernels: it owns their lists, grids, sums and machine code, enlarges
arrays when a kernel returns that one is full, and raises exceptions for status codes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, cast

import numpy as np

from rigidmd.compile import Pass, Rows, compile_together, set_threads
from rigidmd.compile.kernels import CompileError
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import (
    BEHIND_WALL,
    CELL_CHANGED,
    EXAMPLE,
    LIST_FULL,
    NEEDS_PYTHON_FORCES,
    NOT_FINITE,
    NOW,
    TALLY_SIZE,
    Load,
    State,
    no_load,
)
from rigidmd.dynamics.barostats import barostat_workspace
from rigidmd.dynamics.body_step_loop import Body, advance_body
from rigidmd.dynamics.force_gradient import GradientWorkspace, gradient_workspace
from rigidmd.dynamics.hybrid_monte_carlo import trajectory_workspace
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import LargestValues, StateSums
from rigidmd.dynamics.registers import LOADED
from rigidmd.dynamics.step_loop import Advance, CouplingWorkspaces, FlowArrays, flow_arrays
from rigidmd.dynamics.thermostats import thermostat_workspace
from rigidmd.engines.protocol import Engine, NotFiniteError, Tally, keep_time
from rigidmd.errors import SimulationError
from rigidmd.forces.fields.walls import LennardJonesWalls
from rigidmd.forces.terms import (
    FORCES_ONLY,
    TALLIED,
    WITH_ENERGIES,
    Evaluation,
    NoForce,
    Setup,
    TermDispatcher,
    compute_load_with_energies,
    trait,
    with_common_scratch,
)
from rigidmd.mechanics.free_rotor import NO_SYMMETRY, ExactRotor, SplitRotor

__all__ = ["BehindWallError", "CompileError", "CpuEngine", "Precision"]

Precision = Literal["double", "mixed"]
#: Owners of arrays in `Engine.memory` besides the terms; the arrays of a barostat, and of hybrid
#: Monte Carlo.
LOAD, BOX, TRAJECTORY = "load", "box", "trajectory"
BOX_FIELDS = ("tally", "known", "counts")
TRAJECTORY_FIELDS = ("energies", "known", "sums")

#: When the passes of terms act, by what the engine uses them for.
USES = {"steps": FORCES_ONLY | TALLIED, "observations": WITH_ENERGIES}
#: dt, `until` and `observed` of `Engine.advance`.
Steps = tuple[float, int, bool]
DTYPES = {"double": np.float64, "mixed": np.float32}
#: Relative difference of forces and virials between two machines, by arithmetic.
ROUNDING = {np.float64: 1e-8, np.float32: 1e-3}


@dataclass
class LastAdvance:
    """What the last call of `CpuEngine.advance` has left.

    The load, the energies and the sums of the engine belong to `state` alone, and to its positions
    only while `is_current`, which `forget` and `change` end, and steps that end without forces.
    """

    state: State | None = None
    is_current: bool = False
    observed: Load | None = (
        None  # the copy of the load that `evaluate_current` has returned, to which the sums belong
    )


class CpuEngine(Engine):
    """An engine of compiled code.

    model : the constant part of the system
    terms : name -> term, in the order in which forces are added
    precision : arithmetic between sites; "mixed": pairs in single precision, sums and motion in
        double
    skin : extra radius of neighbour lists, Å; affects speed only
    python_forces : name of a term that Python computes -> its function, as the term's workspace
        calls it
    threads : number of threads, at most `NUMBA_NUM_THREADS`; None for all of them; affects speed
        only
    needs_virials : whether every step needs virials and no energies, as for a piston; affects speed
        only
    """

    is_repeatable = True

    def __init__(
        self,
        model: Model | Body,
        terms: dict[str, NamedTuple],
        precision: Precision = "double",
        skin: float = 1.9,
        python_forces: dict[str, Callable] | None = None,
        threads: int | None = None,
        needs_virials: bool = False,
    ):
        self.model, self.terms = model, terms
        self._setup = Setup(np.zeros((3, 3)), DTYPES[precision], skin, needs_virials)
        self._python_forces = python_forces or {}
        self.threads = threads
        self.load: Load | None = None
        # What terms and couplings remember. The other attributes can be made from these and the
        # state at any time.
        self._workspaces: tuple[NamedTuple, ...] | None = None
        self._couplings = CouplingWorkspaces(thermostat_workspace(), None, None)
        self._last = LastAdvance()
        self._dispatchers: dict[str, TermDispatcher] = {}
        self._bound: tuple[tuple, Any] | None = (
            None  # the step loop, with the objects that it is bound to
        )

    @property
    def names(self) -> list[str]:
        """Names of the terms."""
        return list(self.terms)

    @property
    def workspaces(self) -> dict[str, NamedTuple]:
        """Name of a term -> its present workspace. Empty before the first use."""
        return dict(zip(self.names, self._workspaces or (), strict=False))

    def change(self, model: Model | Body, terms: dict[str, NamedTuple]) -> None:
        self.model, self.terms = model, terms
        self._workspaces = None
        self.forget()

    def forget(self) -> None:
        self._last.is_current = False

    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        """The variables of the thermostat and the barostat of a scheme, at rest."""
        return np.zeros(_as_scheme(integrator).variables)

    def advance(
        self,
        state: State,
        integrator: Scheme | Solver,
        dt: float,
        until: int,
        observed: bool = False,
    ) -> None:
        integrator = _as_scheme(integrator)
        workspaces = self._prepare(state)
        keep_time(state, dt)
        last = self._last
        # its energies belong to another state
        if state is not last.state and "steps" in self._dispatchers:
            self._dispatchers["steps"].table.tallies_valid[0] = 0
        if self.load is None:
            self.load = no_load(state)
        last.state, last.observed = state, None
        move = self._move_molecules if isinstance(self.model, Model) else self._move_body
        last.is_current = move(
            state, self.load, integrator, workspaces, (float(dt), int(until), observed)
        )

    def _move_molecules(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        """Advance molecules. Returns whether the load belongs to the new positions."""
        model = cast(Model, self.model_for(integrator))

        def new_advance(dispatcher: TermDispatcher) -> Advance:
            couplings = self._couplings_of(integrator, state)
            gradient = gradient_workspace(state) if integrator.has_gradient else None
            return Advance(integrator, model, state, load, dispatcher.table, couplings, gradient)

        if "steps" not in self._dispatchers:
            self._compile(lambda: new_advance(self._new_dispatcher("steps", workspaces)))
        dispatcher = self._dispatcher("steps", workspaces)
        advance = self._bind(
            (self.model, integrator, state, load, dispatcher), lambda: new_advance(dispatcher)
        )
        advance.begin(*step, self._last.is_current)
        other = advance.gradient and advance.gradient.load
        dispatcher.bind(workspaces, state, load, other)
        while status := advance():
            dispatcher.bind(self._handle_status(status, state), state, load, other)
        return advance.loaded

    def _move_body(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        """Advance a body. Returns whether the load belongs to the new position."""

        def flows_and_gradient() -> tuple[FlowArrays, GradientWorkspace | None]:
            return flow_arrays(integrator), (
                gradient_workspace(state) if integrator.has_gradient else None
            )

        flows, gradient = self._bind((integrator, state), flows_and_gradient)
        model, (dt, until, _) = self.model_for(integrator), step
        progress = np.array([0, self._last.is_current, 0], np.int64)
        while status := advance_body(
            model, state, load, workspaces, flows, gradient, dt, until, progress
        ):
            workspaces = self._handle_status(status, state)
        # also False after no step, because then no forces were evaluated
        return progress[LOADED] != 0

    def _bind(self, objects: tuple, make: Callable[[], Any]) -> Any:
        """What `make` returns, which is kept while it is bound to the same objects."""
        if self._bound is None or not _are_same(objects, self._bound[0]):
            self._bound = objects, make()
        return self._bound[1]

    def _couplings_of(self, integrator: Scheme, state: State) -> CouplingWorkspaces:
        """What thermostat, barostat and trajectories of an integrator remember; made at their first
        use."""
        heat, box, trajectory = self._couplings
        if integrator.barostat is not None:
            box = box or barostat_workspace(state)
        if integrator.trajectory_steps:
            trajectory = trajectory or trajectory_workspace(state)
        elif trajectory is not None:
            trajectory.known[0] = 0  # another integrator moves the state
        self._couplings = CouplingWorkspaces(heat, box, trajectory)
        used = self._couplings
        if integrator.barostat is None:
            used = used._replace(box=None)
        return used if integrator.trajectory_steps else used._replace(trajectory=None)

    def _dispatcher(self, use: str, workspaces: tuple[NamedTuple, ...]) -> TermDispatcher:
        if use not in self._dispatchers:
            self._dispatchers[use] = self._new_dispatcher(use, workspaces)
        return self._dispatchers[use]

    def _new_dispatcher(self, use: str, workspaces: tuple[NamedTuple, ...]) -> TermDispatcher:
        return TermDispatcher(workspaces, USES[use], with_rates=use == "steps")

    def model_for(self, scheme: Scheme) -> Model | Body:
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

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        moving, last = self._dispatchers.get("steps"), self._last
        is_current = state is last.state and last.is_current
        if (
            self.load is None
            or moving is None
            or not (is_current and moving.table.tallies_valid[0])
        ):
            return self.evaluate(state)
        last.observed, tallies = self._copies(self.load, moving)
        return last.observed, tallies

    def sums(self, state: State, load: Load) -> StateSums | None:
        return (
            self._bound[1].sums if self._bound is not None and load is self._last.observed else None
        )

    def extent(self, state: State) -> LargestValues | None:
        last = self._last
        if self._bound is None or not last.is_current or state is not last.state:
            return None
        return self._bound[1].extent if isinstance(self.model, Model) else None

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
        """Neighbour lists as last built, forces at the current positions, and the memory of the
        barostat."""
        owners = self._checkpoint_arrays()
        if self.load is not None and self._last.is_current:
            owners[LOAD] = self.load._asdict()
        if (box := self._couplings.box) is not None:
            owners[BOX] = {key: getattr(box, key) for key in BOX_FIELDS}
        if (trajectory := self._couplings.trajectory) is not None:
            owners[TRAJECTORY] = {key: getattr(trajectory, key) for key in TRAJECTORY_FIELDS}
        return {
            f"{owner}.{key}": array
            for owner, arrays in owners.items()
            for key, array in arrays.items()
        }

    def _checkpoint_arrays(self) -> dict[str, dict[str, np.ndarray]]:
        """Name of a term -> the arrays on which its next forces depend."""
        workspaces = self.workspaces.items()
        return {name: trait(workspace, "checkpoint_arrays")() for name, workspace in workspaces}

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        self._prepare(state)
        arrays_of: dict[str, dict[str, np.ndarray]] = {}
        for name, array in memory.items():
            owner, _, key = name.rpartition(".")
            arrays_of.setdefault(owner, {})[key] = array
        if unknown := arrays_of.keys() - {*self.names, LOAD, BOX, TRAJECTORY}:
            raise ValueError(
                f"an engine of {', '.join(self.names)} has no memory of"
                f" {', '.join(sorted(unknown))}"
            )
        self._recall_lists(state, arrays_of)
        self.load, self._last = no_load(state), LastAdvance(is_current=LOAD in arrays_of)
        self._dispatchers.pop("steps", None)  # its energies belong to another state
        heat, box, trajectory = self._couplings
        if LOAD in arrays_of:
            _copy_into(self.load, arrays_of[LOAD])
        if BOX in arrays_of:
            box = barostat_workspace(state)
            _copy_into(box, arrays_of[BOX])
            if box.known[0] not in (0, 1) or not 0 <= box.counts[1] <= box.counts[0]:
                raise ValueError("the numbers of tried and accepted moves of the box are invalid")
        if TRAJECTORY in arrays_of:
            trajectory = trajectory_workspace(state)
            _copy_into(trajectory, arrays_of[TRAJECTORY])
            ended, accepted = trajectory.sums[:2]
            if trajectory.known[0] not in (0, 1) or not 0 <= accepted <= ended:
                raise ValueError("the numbers of ended and accepted trajectories are invalid")
        self._couplings = CouplingWorkspaces(heat, box, trajectory)
        if LOAD in arrays_of and not self._python_forces:
            self._check_recalled(state, arrays_of)

    def _recall_lists(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        """Make new workspaces, with the neighbour lists that were kept: all of them or none."""
        spaces = _with_code(self.new_workspaces(state))
        now = float(state.time[NOW])
        if arrays_of.keys() & set(self.names):
            pairs = zip(self.names, spaces, strict=False)
            spaces = tuple(
                trait(workspace, "restore")(arrays_of.get(name, {}), self._setup.skin, now)
                for name, workspace in pairs
            )
        self._workspaces = with_common_scratch(spaces)

    def _check_recalled(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        """Raise ValueError unless the kept forces are those that the kept lists give at the
        state."""
        try:
            load, tallies = self.evaluate(state)
        except SimulationError as error:
            raise ValueError(f"forces cannot be evaluated at its state: {error}") from None
        rounding = ROUNDING[self._setup.dtype]
        for name, evaluated, recalled in zip(Load._fields, load, self.load or (), strict=True):
            if np.abs(evaluated - recalled).max(initial=0.0) > rounding * np.abs(evaluated).max(
                initial=0.0
            ):
                raise ValueError(f"its state has another {name} than was kept with it")
        lists = self._checkpoint_arrays()
        same = all(
            np.array_equal(array, arrays_of[name][key])
            for name, of in lists.items()
            for key, array in of.items()
        )
        if BOX in arrays_of or TRAJECTORY in arrays_of:
            terms = np.array([[tally.energy, *tally.virial.flat] for tally in tallies.values()])
            _, box, trajectory = self._couplings
            first = int(self._setup.needs_virials)  # a piston needs no energies
            totals = [box.tally[0, first:]] if box is not None and box.known[0] else []
            totals += (
                [trajectory.energies[:1]] if trajectory is not None and trajectory.known[0] else []
            )
            for values in totals:
                evaluated_total = terms.sum(0)[first : first + len(values)]
                if (np.abs(evaluated_total - values) > rounding * np.abs(terms).sum(0).max()).any():
                    raise ValueError("its state has another energy or virial than was kept with it")
            # they were built for a trial box or the end of a trajectory that was rejected
            if not same:
                self._recall_lists(state, arrays_of)
        elif not same:
            raise ValueError("its neighbour lists are not those of its state")

    @property
    def moves(self) -> tuple[int, int]:
        if (box := self._couplings.box) is None:
            return 0, 0
        return int(box.counts[0]), int(box.counts[1])

    @property
    def trajectories(self) -> np.ndarray | None:
        return None if (workspace := self._couplings.trajectory) is None else workspace.sums.copy()

    def rows_of_steps(self) -> Rows:
        """The rows of the forces of steps, bound to the state that `advance` has moved last."""
        return self._dispatchers["steps"].table.rows

    def passes(self, state: State) -> dict[str, list[Pass]]:
        """Name of a term -> its passes at a state, in their order. Nothing is compiled."""
        load, status = no_load(state), np.zeros(1, np.int64)
        into = Evaluation(state, load, np.zeros(TALLY_SIZE), status)
        workspaces = zip(self.names, self.new_workspaces(state), strict=False)
        return {name: trait(workspace, "passes")(into) for name, workspace in workspaces}

    def new_workspaces(self, state: State) -> tuple[NamedTuple, ...]:
        """New workspaces for the cell of a state, without machine code. Their arrays show the
        memory needed."""
        setup = self._setup._replace(cell=state.cell)
        return with_common_scratch(
            tuple(trait(term, "workspace")(setup) for term in self.terms.values())
        ) or (NoForce(),)

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
        if isinstance(self.model, Model):
            set_threads(usable_threads(self.threads))
        if self._workspaces is None:
            spaces = self.new_workspaces(state)
            self._compile(lambda: TermDispatcher(_with_code(spaces), USES["observations"]))
            self._workspaces = _with_code(spaces)
        return self._workspaces

    def _compile(self, make: Callable[[], object]) -> None:
        """Compile all code that a function makes for molecules. A body has too little for a second
        process."""
        if isinstance(self.model, Model):
            compile_together(make)

    def _handle_status(self, status: int, state: State) -> tuple[NamedTuple, ...]:
        """Handle a status code of a kernel, and return the workspaces with which to call it
        again."""
        workspaces = self._prepare(state)
        if status in (LIST_FULL, CELL_CHANGED):
            enlarged = tuple(trait(space, "with_capacity")(state.cell) for space in workspaces)
            workspaces = self._workspaces = with_common_scratch(enlarged)
        elif status == NOT_FINITE:
            raise NotFiniteError(state)
        elif status == BEHIND_WALL:
            molecules_behind = [
                workspace.behind(state)
                for workspace in workspaces
                if isinstance(workspace, LennardJonesWalls)
            ]
            raise BehindWallError(
                *next(behind for behind in molecules_behind if behind is not None)
            )
        elif status == NEEDS_PYTHON_FORCES:
            for name, workspace in zip(self.names, workspaces, strict=False):
                if name in self._python_forces:
                    workspace.update(self._python_forces[name], state)  # type: ignore[attr-defined]  # of such terms
        return workspaces


def _with_code(workspaces: tuple[NamedTuple, ...]) -> tuple[NamedTuple, ...]:
    return tuple(trait(workspace, "with_code")() for workspace in workspaces)


def _as_scheme(integrator: Scheme | Solver) -> Scheme:
    """The same integrator, if it is a scheme. Raises TypeError for a solver."""
    if not isinstance(integrator, Scheme):
        raise TypeError(f"{integrator.name} is a general solver, which only OdeEngine uses")
    return integrator


def _are_same(objects: tuple, others: tuple) -> bool:
    """Whether two tuples have the same objects."""
    return len(objects) == len(others) and all(
        one is other for one, other in zip(objects, others, strict=True)
    )


def _copy_into(arrays: NamedTuple, sources: dict[str, np.ndarray]) -> None:
    """Copy kept arrays into the arrays of a tuple. Raises ValueError if they do not fit."""
    for name, array in sources.items():
        target = getattr(arrays, name)
        if (target.shape, target.dtype) != (array.shape, array.dtype):
            raise ValueError(
                f"{name} has the shape {array.shape}, not {target.shape}, or is of another type"
            )
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
        target[:] = array


class BehindWallError(SimulationError):
    def __init__(self, molecule: int, reason: str):
        self.molecule, self.reason = molecule, reason
        super().__init__(f"molecule {self.molecule + 1} {self.reason}")
