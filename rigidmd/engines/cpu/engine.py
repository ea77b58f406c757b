"""The engine of molecules that runs compiled code on the CPU."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from rigidmd.compile import Rows, compile_together, set_threads
from rigidmd.compile.kernels import CompileError
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import BEHIND_WALL, Load, State
from rigidmd.dynamics.barostats import barostat_workspace
from rigidmd.dynamics.force_gradient import gradient_workspace
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import LargestValues, StateSums
from rigidmd.dynamics.step_loop import Advance, CouplingWorkspaces
from rigidmd.dynamics.thermostats import thermostat_workspace
from rigidmd.engines.cpu.compiled import (
    LOAD,
    ROUNDING,
    CompiledEngine,
    Steps,
    copy_into,
)
from rigidmd.engines.protocol import Tally
from rigidmd.errors import SimulationError
from rigidmd.features.monte_carlo.trajectories import trajectory_workspace
from rigidmd.forces.fields.walls import LennardJonesWalls
from rigidmd.forces.terms import Setup, TermDispatcher

__all__ = ["BehindWallError", "CompileError", "CpuEngine", "Precision"]

Precision = Literal["double", "mixed"]
#: Owners of arrays in `Engine.memory`: the arrays of a barostat, and of hybrid Monte Carlo.
BOX, TRAJECTORY = "box", "trajectory"
BOX_FIELDS = ("tally", "known", "counts")
TRAJECTORY_FIELDS = ("energies", "known", "sums")
DTYPES = {"double": np.float64, "mixed": np.float32}


class CpuEngine(CompiledEngine[Model, Advance]):
    """An engine of molecules. For the first arguments see `CompiledEngine`.

    precision : arithmetic between sites. "mixed": pairs in single precision, sums and motion in
        double
    skin : extra radius of neighbour lists, Å. Affects speed only
    threads : number of threads, at most `NUMBA_NUM_THREADS`. None for all of them. Affects speed
        only
    needs_virials : whether every step needs virials and no energies, as for a piston. Affects speed
        only
    """

    _owners = (LOAD, BOX, TRAJECTORY)

    def __init__(
        self,
        model: Model,
        terms: dict[str, NamedTuple],
        precision: Precision = "double",
        skin: float = 1.9,
        python_forces: dict[str, Callable] | None = None,
        threads: int | None = None,
        needs_virials: bool = False,
    ):
        setup = Setup(np.zeros((3, 3)), DTYPES[precision], skin, needs_virials)
        super().__init__(model, terms, setup, python_forces)
        self.threads = threads
        self._couplings = CouplingWorkspaces(thermostat_workspace(), None, None)

    def _move(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        model = self.model_for(integrator)

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

    def _couplings_of(self, integrator: Scheme, state: State) -> CouplingWorkspaces:
        """What thermostat, barostat and trajectories of an integrator remember. Made at their first
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

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        moving = self._dispatchers.get("steps")
        last = self._last
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
        return self._bound[1].extent

    def _memory_by_owner(self) -> dict[str, dict[str, np.ndarray]]:
        """The arrays of terms, and the memory of barostat and trajectories."""
        arrays_of = super()._memory_by_owner()
        if (box := self._couplings.box) is not None:
            arrays_of[BOX] = {key: getattr(box, key) for key in BOX_FIELDS}
        if (trajectory := self._couplings.trajectory) is not None:
            arrays_of[TRAJECTORY] = {key: getattr(trajectory, key) for key in TRAJECTORY_FIELDS}
        return arrays_of

    def _recall_couplings(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        heat, box, trajectory = self._couplings
        if BOX in arrays_of:
            box = barostat_workspace(state)
            copy_into(box, arrays_of[BOX])
            if box.known[0] not in (0, 1) or not 0 <= box.counts[1] <= box.counts[0]:
                raise ValueError("the numbers of tried and accepted moves of the box are invalid")
        if TRAJECTORY in arrays_of:
            trajectory = trajectory_workspace(state)
            copy_into(trajectory, arrays_of[TRAJECTORY])
            ended, accepted = trajectory.sums[:2]
            if trajectory.known[0] not in (0, 1) or not 0 <= accepted <= ended:
                raise ValueError("the numbers of ended and accepted trajectories are invalid")
        self._couplings = CouplingWorkspaces(heat, box, trajectory)

    def _check_lists(
        self,
        state: State,
        arrays_of: dict[str, dict[str, np.ndarray]],
        tallies: dict[str, Tally],
    ) -> None:
        if BOX not in arrays_of and TRAJECTORY not in arrays_of:
            super()._check_lists(state, arrays_of, tallies)
            return
        rounding = ROUNDING[self._setup.dtype]
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
        if not self._has_lists(arrays_of):
            self._recall_lists(state, arrays_of)

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

    def _prepare(self, state: State) -> tuple[NamedTuple, ...]:
        set_threads(usable_threads(self.threads))
        return super()._prepare(state)

    def _compile(self, make: Callable[[], object]) -> None:
        compile_together(make)

    def _handle_status(self, status: int, state: State) -> tuple[NamedTuple, ...]:
        if status == BEHIND_WALL:
            molecules_behind = [
                workspace.behind(state)
                for workspace in self._prepare(state)
                if isinstance(workspace, LennardJonesWalls)
            ]
            raise BehindWallError(
                *next(behind for behind in molecules_behind if behind is not None)
            )
        return super()._handle_status(status, state)


class BehindWallError(SimulationError):
    def __init__(self, molecule: int, reason: str):
        self.molecule, self.reason = molecule, reason
        super().__init__(f"molecule {self.molecule + 1} {self.reason}")
