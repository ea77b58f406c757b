"""The engine of molecules that runs compiled code on the CPU."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np

from rigidmd.compile import Pass, compile_together, set_threads
from rigidmd.compile.kernels import CompileError
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import BEHIND_WALL, Load, State, copy_into
from rigidmd.dynamics.barostats import BarostatWorkspace, barostat_workspace
from rigidmd.dynamics.force_gradient import gradient_workspace
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import LargestValues, StateSums, sums_of_state
from rigidmd.dynamics.registers import KEPT_BY_BAROSTAT, KEPT_BY_EXTENSION, new_registers
from rigidmd.dynamics.step_loop import Advance
from rigidmd.dynamics.step_parts import StepCore, StepExtension, StepParts, extension_of
from rigidmd.dynamics.step_rows import is_forces_row
from rigidmd.dynamics.thermostats import thermostat_workspace
from rigidmd.engines.cpu.compiled import CompiledEngine, Steps
from rigidmd.engines.protocol import Tally
from rigidmd.errors import SimulationError
from rigidmd.forces.fields.walls import LennardJonesWalls
from rigidmd.forces.terms import Setup, TermDispatcher, TermTable, trait

__all__ = ["BehindWallError", "CompileError", "CpuEngine", "Precision"]

Precision = Literal["double", "mixed"]
#: Owners of arrays in `Engine.memory`: the arrays of a barostat, and of an extension of the step.
BOX, EXTENSION = "box", "trajectory"
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
        self._registers = new_registers()
        # what thermostat, barostat and extension of a step remember, from their first use
        self._heat = thermostat_workspace()
        self._barostat: BarostatWorkspace | None = None
        self._extension: tuple[StepExtension, tuple] | None = None
        self._extension_arrays: dict[str, np.ndarray] = {}  # from a checkpoint

    def _move(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        def new_advance(dispatcher: TermDispatcher) -> Advance:
            return Advance(integrator, self.step_parts(integrator, state, load, dispatcher.table))

        if "steps" not in self._dispatchers:
            self._compile(lambda: new_advance(self._new_dispatcher("steps", workspaces)))
        dispatcher = self._dispatcher("steps", workspaces)
        advance = self._bind(
            (self.model, integrator, state, load, dispatcher), lambda: new_advance(dispatcher)
        )
        advance.begin(*step, self._last.is_current)
        dispatcher.bind(workspaces, state, load, advance.other_load)
        while status := advance():
            workspaces = self._handle_status(status, state)
            dispatcher.bind(workspaces, state, load, advance.other_load)
        return advance.loaded

    def step_parts(
        self, scheme: Scheme, state: State, load: Load, terms: TermTable | None = None
    ) -> StepParts:
        """What the rows of a scheme are made from."""
        if scheme.barostat is not None:
            self._barostat = self._barostat or barostat_workspace(state)
        extension = None
        if scheme.has_groups:
            extension = self._workspace_of(extension_of(scheme), state)
            self._extension = extension_of(scheme), extension
        else:
            self._registers.resting[0] = 0
            if self._extension is not None:
                self._extension[0].forget(self._extension[1])
        return StepParts(
            core=StepCore(
                self.model_for(scheme), state, load, self._registers, np.zeros(1, np.int64), terms
            ),
            heat=self._heat,
            has_rates=any(trait(term, "time_dependent") for term in self.terms.values()),
            barostat=None if scheme.barostat is None else self._barostat,
            gradient=gradient_workspace(state) if scheme.has_gradient else None,
            extension=extension,
        )

    def _workspace_of(self, extension: StepExtension, state: State) -> tuple:
        """The workspace of an extension; at the first use, with the arrays that were kept."""
        if self._extension is not None:
            return self._extension[1]
        if not self._extension_arrays:
            return extension.workspace(state)
        workspace = extension.restored(state, self._extension_arrays)
        if extension.keeps_energy(workspace):
            self._registers.known[0] |= KEPT_BY_EXTENSION
        return workspace

    def evaluate_current(self, state: State) -> tuple[Load, dict[str, Tally]]:
        moving = self._dispatchers.get("steps")
        last = self._last
        is_current = state is last.state and last.is_current
        if (
            self.load is None
            or moving is None
            or not (is_current and moving.table.tallies_valid[0])
        ):
            load, tallies = self.evaluate(state)
            last.evaluated = load if is_current else None
            return load, tallies
        last.observed, tallies = self._copies(self.load, moving)
        return last.observed, tallies

    def sums(self, state: State, load: Load) -> StateSums | None:
        if self._bound is None:
            return None
        found = self._bound[1].sums
        if load is self._last.observed:
            return found
        if load is not self._last.evaluated or found is None:
            return None
        return sums_of_state(self.model, state, load)._replace(curvature=found.curvature)

    def extent(self, state: State) -> LargestValues | None:
        last = self._last
        if self._bound is None or not last.is_current or state is not last.state:
            return None
        return self._bound[1].extent

    def _memory_by_owner(self) -> dict[str, dict[str, np.ndarray]]:
        """The arrays of terms, and the memory of the barostat and of the extension."""
        arrays_of = super()._memory_by_owner()
        if (box := self._barostat) is not None:
            known = self._registers.known & KEPT_BY_BAROSTAT != 0
            arrays_of[BOX] = {
                "tally": box.tally,
                "known": known.astype(np.int64),
                "counts": box.counts,
            }
        if self._extension is not None:
            extension, workspace = self._extension
            arrays_of[EXTENSION] = extension.arrays(workspace)
        elif self._extension_arrays:
            arrays_of[EXTENSION] = self._extension_arrays
        return arrays_of

    def _recall_couplings(self, state: State, arrays_of: dict[str, dict[str, np.ndarray]]) -> None:
        known = self._registers.known
        known[0] = 0
        if BOX in arrays_of:
            self._barostat, arrays = barostat_workspace(state), dict(arrays_of[BOX])
            known |= KEPT_BY_BAROSTAT * (arrays.pop("known") != 0)
            copy_into(self._barostat, arrays)
        self._extension, self._extension_arrays = None, arrays_of.get(EXTENSION, {})

    @property
    def moves(self) -> tuple[int, int]:
        if (box := self._barostat) is None:
            return 0, 0
        return int(box.counts[0]), int(box.counts[1])

    @property
    def extension_sums(self) -> np.ndarray | None:
        if self._extension is None:
            return None
        extension, workspace = self._extension
        return extension.sums(workspace)

    def measure(self, state: State) -> list[tuple[Pass, np.ndarray]]:
        """Measure the rows of steps from now on, and the rows of the forces in place of those that
        compute them.

        state : that `advance` has moved last

        Returns the rows, and the times of their blocks, see `Program.measure`.
        """
        assert self._bound is not None
        steps = self._bound[1]
        forces = [one._replace(text=f"{name}: {one.text}") for name, one in self.passes(state)]
        moves = zip(steps.passes, steps.program.measure(), strict=True)
        return [
            *zip(forces, self._dispatchers["steps"].program.measure(), strict=True),
            *((one, spent) for one, spent in moves if not is_forces_row(one)),
        ]

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
