"""The compiled loop over steps of molecules, for any sequence of flows, any forces, any thermostat
and any barostat.

The loop is compiled once: a step is a table of rows, which it calls by address.
"""

import numpy as np

from rigidmd.compile import (
    ALWAYS,
    BoundTask,
    Pass,
    Program,
    kernel,
    load_arguments,
    run_from,
    task,
)
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NOW, OK, ORIGIN, Load
from rigidmd.dynamics.observables import (
    CURVATURE,
    SUM_COUNT,
    LargestValues,
    StateSums,
    curvature,
    fill_sums,
    find_largest,
    unpack_sums,
)
from rigidmd.dynamics.step_parts import (
    ENERGIES,
    EVERY,
    FIRST,
    LAST,
    PLAIN,
    REPEATED,
    WATCHED,
    StepParts,
    extension_of,
)
from rigidmd.dynamics.step_table import StepTable
from rigidmd.dynamics.thermostats import thermostat_code
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES, WITH_VIRIALS

#: Indices of the integers of a call: the steps at which it begins and ends, whether energies and
#: virials are computed with its last forces, and its status.
START, UNTIL, OBSERVED, STATUS = range(4)


@kernel
def advance(rows, intervals, state, row, call):
    """Take steps of molecules until state.step is call[UNTIL]. Returns a status code.

    rows, intervals : of a `StepTable`; row : `Registers.row`; call : integers, see START

    If the status is not OK, another call continues with the row that has set it.
    """
    while state.step[NOW] < call[UNTIL]:
        status = run_from(rows, acting(intervals, state, call), row)
        if status != OK:
            return status
        state.step[NOW] += 1
    return OK


@kernel
def acting(intervals, state, call):
    """Bits of the rows that act in the next step, see `step_parts.EVERY`."""
    step = state.step[NOW]
    bits = EVERY | due(intervals, state, step)
    left = call[UNTIL] - step
    if call[OBSERVED] != 0 and left <= 2:
        bits |= LAST | (ENERGIES | WATCHED if left == 1 else 0)
    elif left == 1:
        bits |= LAST
    follows = due(intervals, state, step - 1) & LAST != 0 or bits & WATCHED != 0
    bits |= FIRST if step == call[START] or follows else REPEATED
    return bits if bits & ENERGIES != 0 else bits | PLAIN


@kernel
def due(intervals, state, step):
    """Bits of the intervals for the step after `step` steps."""
    bits = 0
    for n in range(len(intervals.every)):
        counted = step - intervals.in_segment[n] * state.step[ORIGIN] + intervals.phase[n]
        if counted % intervals.every[n] == 0:
            bits |= intervals.bits[n]
    return bits


class Advance:
    """`advance` of molecules, for Python: bound to all that it works on. At the end it also sums
    over the state and its load, while these are in the caches of the cores.

    parts : without the code of the thermostat and recovery, which are made here
    """

    def __init__(self, scheme: Scheme, parts: StepParts):
        recovery = extension_of(scheme).after_failure(parts)
        self._recovery = bound_program(recovery, parts.core.status)
        core = parts.core._replace(recovery=self._recovery.rows)
        parts = parts._replace(core=core, code=thermostat_code(scheme.thermostat, core.model))
        table = StepTable(scheme, parts)
        self.passes, self.program = table.passes, bound_program(table.passes, core.status)
        self._parts, self._call = parts, np.zeros(4, np.int64)
        self._extent, self._sums = np.zeros(len(LargestValues._fields)), np.zeros(SUM_COUNT)
        steps = self.program.rows, table.intervals, core.registers, self._call
        self._task = BoundTask(
            _advance, (core.model, core.state, core.load, steps, self._extent, self._sums)
        )

    def begin(self, dt: float, until: int, observed: bool, is_current: bool) -> None:
        """Set what the next calls do.

        is_current : whether the load belongs to the current positions
        """
        _, state, _, registers, _, terms, _ = self._parts.core
        self._call[:] = state.step[NOW], until, observed, OK
        registers.dt[0], registers.row[0], registers.before[:] = dt, 0, np.nan
        known = int(registers.known[0]) | FORCES_ONLY if is_current else 0
        if terms is not None and not terms.tallies_valid[0]:
            known &= ~(WITH_ENERGIES | WITH_VIRIALS)
        registers.known[0] = known

    def __call__(self) -> int:
        """Start or continue. A status code."""
        self._task()
        return int(self._call[STATUS])

    @property
    def other_load(self) -> Load | None:
        """The second load of force gradients."""
        return None if self._parts.gradient is None else self._parts.gradient.load

    @property
    def loaded(self) -> bool:
        """Whether the load belongs to the current positions."""
        return bool(self._parts.core.registers.known[0])

    @property
    def extent(self) -> LargestValues:
        """The largest values of the state, and of the load as last computed."""
        return LargestValues(*self._extent.tolist())

    @property
    def sums(self) -> StateSums | None:
        """The sums over the state and its load. None if the last call was not `observed`."""
        return unpack_sums(self._sums) if self._call[OBSERVED] else None


def bound_program(passes: list[Pass], status: np.ndarray) -> Program:
    """The program of passes, bound to their arguments."""
    program = Program(passes, ALWAYS, status)
    program.bind(passes)
    return program


@task()
def _advance(arguments, block):
    model, state, load, steps, extent, sums = load_arguments(arguments)
    rows, intervals, registers, call = steps
    call[STATUS] = advance(rows, intervals, state, registers.row, call)
    if call[STATUS] == OK:
        find_largest(
            state.position.ravel(),
            state.velocity.ravel(),
            state.rotation.ravel(),
            state.angular_momentum_body.ravel(),
            load.force.ravel(),
            load.torque_body.ravel(),
            extent,
        )
        if call[OBSERVED] != 0:
            fill_sums(
                model.species,
                model.mass,
                model.inverse_mass,
                model.inverse_inertia,
                state.velocity,
                state.rotation,
                state.angular_momentum_body,
                load.force,
                load.torque_body,
                sums,
            )
            sums[CURVATURE] = curvature(model, state, load, registers.before, registers.dt[0])
