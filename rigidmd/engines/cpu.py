"""The Python side of the compiled code. It owns lists, grids, sums and machine code, enlarges arrays at the request of
kernels, and handles their status codes."""

from collections.abc import Callable
from typing import Literal, NamedTuple, Protocol, cast

import numpy as np

from rigidmd.compile import compile_together, set_threads
from rigidmd.compile.machine import threads_for
from rigidmd.compile.own import CompileError
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import (
    ASK,
    BEHIND_WALL,
    CELL_CHANGED,
    EXAMPLE,
    LIST_FULL,
    NOT_FINITE,
    NOW,
    ORIGIN,
    Load,
    State,
    no_load,
)
from rigidmd.dynamics.barostats import BoxRoom, NoBox, Piston, box_room
from rigidmd.dynamics.body_step_loop import Body
from rigidmd.dynamics.force_gradient import Probe, probe_for
from rigidmd.dynamics.observables import Extent, Sums, sums_over
from rigidmd.dynamics.step_loop import Advance, Model, advance_body, code_of, row_of
from rigidmd.dynamics.thermostats import NoBath, heat_room
from rigidmd.engines.protocol import Tally
from rigidmd.errors import SimulationError
from rigidmd.forces.fields.walls import Behind, LennardJonesWalls
from rigidmd.forces.terms import (
    Loading,
    NoForce,
    Setup,
    in_common,
    memory_of,
    recalled,
    tally_now,
    with_code,
    with_room,
    workspace_of,
)
from rigidmd.mechanics.free_rotor import NONE, ExactRotor, SplitRotor

__all__ = ["BehindWallError", "CompileError", "Engine", "NotFiniteError", "Precision", "keep_time"]

Precision = Literal["double", "mixed"]
#: Owners of arrays in the memory of an engine, besides its terms, and the arrays of each.
LOAD, BOX = "load", "box"
REMEMBERED = {LOAD: Load._fields, BOX: ("tally", "known", "counts")}
#: dt, `until` and `looked` of `Engine.advance`.
Orders = tuple[float, int, bool]
DTYPES = {"double": np.float64, "mixed": np.float32}
#: Relative difference of forces and virials that were computed on two machines.
ROUNDING = {np.float64: 1e-8, np.float32: 1e-3}


class Asks(Protocol):
    """A workspace of what Python computes."""

    def answer(self, function: Callable, state: State) -> None:
        """Let a function fill it in for a state."""
        ...


class Engine:
    """Moves states of a model under terms with compiled code.

    Parameters
    ----------
    model : the constant part of the system
    terms : name -> term, in the order in which forces are added
    precision : arithmetic between sites; "mixed": pairs in single precision, sums and motion in double
    skin : extra radius of neighbour lists, Å; speed only
    applied : the functions that terms of type `Told` (of a body) and `ToldForces` stand for: name -> function, as their
        workspaces call it
    threads : number of threads that compute, at most those of `NUMBA_NUM_THREADS`; None: all. Speed only
    presses : whether a piston will move, which needs virials at every step and no energies. Speed only
    """

    def __init__(
        self,
        model: Model | Body,
        terms: dict[str, NamedTuple],
        precision: Precision = "double",
        skin: float = 1.9,
        applied: dict[str, Callable] | None = None,
        threads: int | None = None,
        presses: bool = False,
    ):
        self.model = model
        self.terms = terms
        self.names = list(terms)
        self._setup = Setup(np.zeros((3, 3)), DTYPES[precision], skin, np.ones(1, np.int64), presses)
        self._applied = applied or {}
        self.threads = threads
        self._workspaces: tuple[NamedTuple, ...] | None = None
        self._codes: dict = {}
        self.load: Load | None = None
        self._probe: Probe | None = None
        self._heat = heat_room()
        self._loadings: dict[str, Loading] = {}
        self._seen: Load | None = None
        self._room: BoxRoom | None = None
        self._stale = True
        self._first = True
        self._checked: State | None = None
        self._moved: State | None = None
        self._known: Load | None = None  # what was last told of the steps
        self._bound: tuple[tuple, Advance] | None = None  # what it is bound to
        self._row: tuple[Scheme, tuple] | None = None

    @property
    def workspaces(self) -> dict[str, NamedTuple]:
        """Name of a term -> its present workspace; empty before the first use."""
        return dict(zip(self.names, self._workspaces or (), strict=False))

    def change(self, model: Model | Body, terms: dict[str, NamedTuple]) -> None:
        """Continue with a model and terms of the same types, as at a break of given functions of time."""
        self.model, self.terms = model, terms
        self._workspaces = None
        self.forget()

    def forget(self) -> None:
        """Declare that positions were changed from outside since the last step."""
        self._stale = True

    def variables(self, state: State, row: Scheme | Solver) -> np.ndarray:
        """What a scheme moves besides the bodies, for `state.bath`; chains and pistons begin at rest."""
        row = _scheme_of(row)
        return np.zeros(getattr(row.bath, "variables", 0) + isinstance(row.box, Piston))

    def begin(self, state: State, row: Scheme | Solver) -> State:
        """A copy of a state, with the variables of a row."""
        return state.copy()._replace(bath=self.variables(state, row))

    def advance(self, state: State, row: Scheme | Solver, dt: float, until: int, looked: bool = False) -> None:
        """Move the state in steps of dt until `until` steps are counted in it, in place. Raises SimulationError.

        looked : whether `look` follows; speed only
        """
        row = _scheme_of(row)
        workspaces = self._prepare(state)
        keep_time(state, dt)
        if state is not self._moved and "steps" in self._loadings:  # the energies of its last step are of another state
            self._loadings["steps"].loader.known[0] = 0
        self._moved = state
        if self.load is None:
            self.load = no_load(state)
        move = self._move_molecules if isinstance(self.model, Model) else self._move_body
        self._known = None
        self._stale = not move(state, self.load, row, workspaces, (float(dt), int(until), looked))

    def _move_molecules(self, state: State, load: Load, row: Scheme, workspaces: tuple, orders: Orders) -> bool:
        """`advance` of molecules; whether the load is that of the new positions."""
        loading = self._loading_for("steps", workspaces)
        bound_to = (self.model, row, state, load, loading)
        if self._bound is None or any(now is not then for now, then in zip(bound_to, self._bound[0], strict=True)):
            model, rest = self.model_for(row), self._rest_of(row, state)
            kind = (type(model.rotor), type(rest[0]))
            if kind not in self._codes:
                self._codes[kind] = code_of(model, rest[0])
            self._bound = bound_to, Advance(model, self._codes[kind], state, load, loading.loader, *rest)
        advance = self._bound[1]
        advance.begin(*orders, not self._stale)
        other = self._probe and self._probe.load
        loading.bind(workspaces, state, load, other)
        while status := advance():
            loading.bind(self._answer(status, state), state, load, other)
        return advance.loaded

    def _move_body(self, state: State, load: Load, row: Scheme, workspaces: tuple, orders: Orders) -> bool:
        """`advance` of a body; whether the load is that of the new position."""
        if self._row is None or self._row[0] is not row:
            self._row = row, self._rest_of(row, state)
        model, rest, cursor = self.model_for(row), self._row[1], np.array([0, not self._stale, 0], np.int64)
        while status := advance_body(model, state, load, workspaces, *rest, *orders, cursor):
            workspaces = self._answer(status, state)
        return cursor[1] != 0  # False also if there was no step, so that no forces were evaluated

    def _rest_of(self, row: Scheme, state: State) -> tuple:
        """What `advance` needs for a row besides the bodies and what acts on them."""
        if row.has_gradient and self._probe is None:
            self._probe = probe_for(state)
        if row.box is not None and self._room is None:
            self._room = box_room(state)
        probe, room = self._probe if row.has_gradient else None, self._room if row.box is not None else None
        return row.bath or NoBath(), row.box or NoBox(), row_of(row), probe, self._heat, room

    def _loading_for(self, use: str, workspaces: tuple[NamedTuple, ...]) -> Loading:
        """The terms behind a loader, one for steps and one for looks, each bound to a load of its own."""
        if use not in self._loadings:
            self._loadings[use] = Loading(workspaces, isinstance(self.model, Model), self._setup.with_energies)
        return self._loadings[use]

    def model_for(self, scheme: Scheme) -> Model | Body:
        """The model with the rotor that a scheme needs; only asymmetric bodies turn differently with an exact one."""
        rotor = self.model.rotor
        if scheme.exact_rotor and isinstance(rotor, SplitRotor) and (rotor.symmetry == NONE).any():
            return self.model._replace(rotor=ExactRotor(*rotor))
        return self.model

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """Forces and torques at a state, fresh arrays, and each term's energy and virial. Raises SimulationError."""
        workspaces = self._prepare(state)
        if self._seen is None or len(self._seen.force) != len(state.velocity):
            self._seen = no_load(state)
        load, loading = self._seen, self._loading_for("looks", workspaces)
        while status := tally_now(loading.bind(workspaces, state, load), *load):
            workspaces = self._answer(status, state)
        return self._told(load, loading)

    def look(self, state: State) -> tuple[Load, dict[str, Tally]]:
        """`evaluate` at the state that was just moved; what its last step has computed is not computed again."""
        moving = self._loadings.get("steps")
        if self.load is None or moving is None or state is not self._moved or self._stale or not moving.loader.known[0]:
            return self.evaluate(state)
        self._known, tallies = self._told(self.load, moving)
        return self._known, tallies

    def sums(self, state: State, load: Load) -> Sums:
        """The sums over a state of molecules and the load on it, as `look` or `evaluate` has given it."""
        found = self._bound[1].sums if self._bound is not None and load is self._known else None
        return found or sums_over(cast(Model, self.model), state, load)

    def extent(self, state: State) -> Extent | None:
        """The extent of the state that was just moved, and of the load on it; None of any other."""
        if self._bound is None or self._stale or state is not self._moved:
            return None
        return self._bound[1].extent

    def _told(self, load: Load, loading: Loading) -> tuple[Load, dict[str, Tally]]:
        """Copies of a load and of the tallies of its terms."""
        tallies = loading.loader.tallies
        virials = tallies[:, 1:].copy().reshape(-1, 3, 3)
        told = [Tally(energy, virial) for energy, virial in zip(tallies[:, 0].tolist(), virials, strict=True)]
        return Load(load.force.copy(), load.torque_body.copy()), dict(zip(self.names, told, strict=False))

    def snapshot(self) -> State:
        """A copy of the state that was last moved."""
        if self._moved is None:
            raise ValueError("this engine has moved no state yet")
        return self._moved.copy()

    def memory(self) -> dict[str, np.ndarray] | None:
        """Lists as last built, forces at the present positions, what the box knows: for `recall`."""
        found = {
            f"{name}.{key}": array for name, own in self.workspaces.items() for key, array in memory_of(own).items()
        }
        if self.load is not None and not self._stale:
            found |= self._named(self.load, LOAD)
        return found | (self._named(self._room, BOX) if self._room is not None else {})

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Go on from a state with what `memory` gave for it, to the same bits. Raises ValueError if they do not fit."""
        self._prepare(state)
        kept = {name: {key: memory[f"{name}.{key}"] for key in of} for name, of in _by_owner(memory).items()}
        if strange := kept.keys() - {*self.names, *REMEMBERED}:
            raise ValueError(f"an engine of {', '.join(self.names)} remembers no {', '.join(sorted(strange))}")
        self._recall_lists(state, kept)
        self.load, self._stale = no_load(state), LOAD not in kept
        self._loadings.pop("steps", None)  # what it knows of energies belongs to another moment
        if LOAD in kept:
            _fill(self.load, kept[LOAD])
        if BOX in kept:
            self._room = room = box_room(state)
            _fill(room, kept[BOX])
            if room.known[0] not in (0, 1) or not 0 <= room.counts[1] <= room.counts[0]:
                raise ValueError("the moves of the box are not counted as a run counts them")
        if LOAD in kept and not self._applied:
            self._check_recalled(state, kept)

    def _recall_lists(self, state: State, kept: dict[str, dict[str, np.ndarray]]) -> None:
        """New workspaces with the lists that were kept, all or none."""
        own, now = tuple(with_code(workspace) for workspace in self.room(state)), float(state.time[NOW])
        if kept.keys() & set(self.names):
            pairs = zip(self.names, own, strict=False)
            own = tuple(recalled(workspace, kept.get(name, {}), self._setup.skin, now) for name, workspace in pairs)
        self._workspaces = in_common(own)

    def _check_recalled(self, state: State, kept: dict[str, dict[str, np.ndarray]]) -> None:
        """Raise ValueError unless the forces that were kept are those of the state, computed with the lists."""
        try:
            load, tallies = self.evaluate(state)
        except SimulationError as error:
            raise ValueError(f"its state has no forces: {error}") from None
        rounding = ROUNDING[self._setup.dtype]
        for name, found, there in zip(Load._fields, load, self.load or (), strict=True):
            if np.abs(found - there).max(initial=0.0) > rounding * np.abs(found).max(initial=0.0):
                raise ValueError(f"its state has another {name} than was kept with it")
        lists = {name: memory_of(workspace) for name, workspace in self.workspaces.items()}
        served = all(np.array_equal(array, kept[name][key]) for name, of in lists.items() for key, array in of.items())
        if BOX in kept:
            if self._room is not None and self._room.known[0]:
                parts = np.array([[tally.energy, *tally.virial.flat] for tally in tallies.values()])
                apart = np.abs(parts.sum(0) - self._room.tally[0]) > rounding * np.abs(parts).sum(0).max()
                if apart[int(self._setup.presses) :].any():  # a piston asks for no energies
                    raise ValueError("its state has another energy or virial than was kept with it")
            if not served:  # they were built for a box that was tried and given up
                self._recall_lists(state, kept)
        elif not served:
            raise ValueError("its neighbour lists are not those of its state")

    @staticmethod
    def _named(arrays: NamedTuple, owner: str) -> dict[str, np.ndarray]:
        return {f"{owner}.{name}": getattr(arrays, name) for name in REMEMBERED[owner]}

    @property
    def moves(self) -> tuple[int, int]:
        """Moves of the box tried and accepted so far."""
        return (0, 0) if self._room is None else (int(self._room.counts[0]), int(self._room.counts[1]))

    def room(self, state: State) -> tuple[NamedTuple, ...]:
        """New workspaces for the cell of a state, without machine code; they show the memory needed."""
        setup = self._setup._replace(cell=state.cell)
        return in_common(tuple(workspace_of(term, setup) for term in self.terms.values())) or (NoForce(),)

    def _prepare(self, state: State) -> tuple[NamedTuple, ...]:
        """Check the arrays for compiled code; return its workspaces, made at the first use."""
        if state is not self._checked:
            _check_arrays(state)
            self._checked = state
        if isinstance(self.model, Model):
            set_threads(threads_for(self.threads))
        if self._workspaces is None:
            room = self.room(state)
            if self._first and isinstance(self.model, Model):
                compile_together(lambda: self._codes_for(room))
            self._first = False
            self._workspaces = tuple(with_code(workspace) for workspace in room)
        return self._workspaces

    def _codes_for(self, room: tuple[NamedTuple, ...]) -> None:
        """Make all machine code of molecules that does not depend on a thermostat or a barostat."""
        workspaces = tuple(with_code(workspace) for workspace in room)
        Loading(workspaces, True, self._setup.with_energies)
        code_of(self.model, NoBath())

    def _answer(self, status: int, state: State) -> tuple[NamedTuple, ...]:
        """Handle a status of compiled code; return the workspaces with which to call it again."""
        workspaces = self._prepare(state)
        if status in (LIST_FULL, CELL_CHANGED):
            enlarged = tuple(with_room(workspace, state.cell) for workspace in workspaces)
            workspaces = self._workspaces = in_common(enlarged)
        elif status == NOT_FINITE:
            raise NotFiniteError(state)
        elif status == BEHIND_WALL:
            found = [workspace.behind(state) for workspace in workspaces if isinstance(workspace, LennardJonesWalls)]
            raise BehindWallError(next(behind for behind in found if behind is not None))
        elif status == ASK:
            for name, workspace in zip(self.names, workspaces, strict=False):
                if name in self._applied:
                    cast(Asks, workspace).answer(self._applied[name], state)
        return workspaces


def _scheme_of(row: Scheme | Solver) -> Scheme:
    """The row itself. Raises TypeError unless it is a scheme."""
    if not isinstance(row, Scheme):
        raise TypeError(f"{row.name} is a general solver; OdeEngine moves a body by it")
    return row


def keep_time(state: State, dt: float) -> None:
    """Begin a new stretch of equal steps, in place, if the step has changed or time was set from outside."""
    time, step = state.time.tolist(), state.step.tolist()
    if time[NOW] != time[ORIGIN] + (step[NOW] - step[ORIGIN]) * dt:
        state.begin_stretch()


def _by_owner(memory: dict[str, np.ndarray]) -> dict[str, list[str]]:
    """Owner -> names of its arrays, of names such as owner.array."""
    found: dict[str, list[str]] = {}
    for name in memory:
        owner, _, key = name.rpartition(".")
        found.setdefault(owner, []).append(key)
    return found


def _fill(arrays: NamedTuple, kept: dict[str, np.ndarray]) -> None:
    """Copy arrays of a memory into those of a tuple. Raises ValueError if they do not fit."""
    for name, array in kept.items():
        there = getattr(arrays, name)
        if (there.shape, there.dtype) != (array.shape, array.dtype):
            raise ValueError(f"{name} has the shape {array.shape}, not {there.shape}, or is of another type")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
        there[:] = array


def _check_arrays(state: State) -> None:
    """Raise TypeError if an array of a state has another type than code is compiled for."""
    for name, array, example in zip(State._fields, state, EXAMPLE[0], strict=True):
        if array.dtype != example.dtype or array.ndim != example.ndim or not array.flags.carray:
            raise TypeError(
                f"state.{name} must be a contiguous, writable array of {example.dtype} in C order with "
                f"{example.ndim} axes (core.state.state_of makes a state of any arrays)"
            )


class NotFiniteError(SimulationError):
    """Positions or momenta that are not finite, or positions too large to define forces."""

    def __init__(self, state: State):
        moving = [array for array in state[:4] if len(array)]
        rows = [np.abs(array).reshape(len(array), -1).max(axis=1, initial=0.0) for array in moving]
        size = np.max(np.where(np.isnan(rows), np.inf, rows), axis=0)
        if np.isfinite(size).all():
            self.molecule = int(rows[0].argmax())
            distance = rows[0][self.molecule]
            self.fault = f"it is {distance:.3g} Å from the origin, too far to tell in which image of the box"
        else:
            self.molecule = int(size.argmax())
            self.fault = "its position or momentum is not finite"
        super().__init__(f"molecule {self.molecule + 1} is lost: {self.fault}")


class BehindWallError(SimulationError):
    """A site is behind a wall that it cannot pass."""

    def __init__(self, behind: Behind):
        self.molecule = behind.molecule
        self.fault = str(behind)
        super().__init__(f"molecule {self.molecule + 1} {self.fault}")
