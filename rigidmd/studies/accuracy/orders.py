"""Measured orders of integrators, and the trials whose error no shorter step reduces."""

from dataclasses import dataclass
from itertools import pairwise
from math import log
from statistics import median

from rigidmd.core.integrators import RK4, Scheme
from rigidmd.io.write import Column, Table, format_cell
from rigidmd.run.trials import Method, Trial
from rigidmd.studies.accuracy.measurement import IntegratorAccuracy

#: A trial is at the floor where its error fell by less than this fraction of the order.
FLOOR_FRACTION = 0.5
#: The reference error counts as a floor below this multiple of it.
REFERENCE_MARGIN = 3.0
FLOOR_MARK = "*"
LAST = 3  # local orders whose median is the measured order


@dataclass
class Convergence:
    """How an error of an integrator falls with its step.

    order : median of the last local orders, between successive steps above the floor. None with
        fewer than two steps
    floor : trials at the floor
    """

    order: float | None
    floor: list[Trial]


def convergence(measured: IntegratorAccuracy, integrator: str, error: str) -> Convergence:
    """The convergence of an error, an attribute of `Trial`."""
    order = measured.trial_system.methods[integrator].order
    tried = [
        trial
        for trial in measured.trials
        if trial.integrator == integrator and not trial.diverged and getattr(trial, error) > 0
    ]
    tried.sort(key=lambda trial: -trial.timestep)
    lowest = REFERENCE_MARGIN * measured.reference_error if error in OF_TRAJECTORY else 0.0
    local = []
    last = len(tried)
    for k, (longer, shorter) in enumerate(pairwise(tried), 1):
        fall = log(getattr(longer, error) / getattr(shorter, error))
        slope = fall / log(longer.timestep / shorter.timestep)
        if slope < FLOOR_FRACTION * order or getattr(shorter, error) < lowest:
            last = k
            break
        local.append(slope)
    return Convergence(median(local[-LAST:]) if local else None, tried[last:])


OF_TRAJECTORY = ("trajectory_error", "rotation_error", "position_error")
ENERGY = "energy_rms"


def order_table(measured: IntegratorAccuracy) -> Table:
    """A row for each integrator: its order, the measured ones, its longest stable step."""
    system = measured.trial_system
    rotates = any(trial.rotation_error > 0 for trial in measured.trials)
    of, name = ("Q", "rotation_error") if rotates else ("X", "position_error")
    integrators = list(dict.fromkeys(trial.integrator for trial in measured.trials))

    def measured_order(error: str):
        return lambda name: _rounded(convergence(measured, name, error).order)

    return Table(
        [
            Column("integrator", str),
            Column("order", lambda each: _order_of(system.methods[each])),
            Column("measured, energy", measured_order(ENERGY)),
            Column(f"measured, {of}", measured_order(name)),
            Column(f"longest stable step ({system.time_unit})", measured.stable_step),
        ],
        integrators,
    )


def _order_of(method: Method) -> str | None:
    """The order of a scheme. A solver that chooses its steps has none."""
    adapts = not isinstance(method.scheme, Scheme) and method.scheme.name != RK4
    return None if adapts else str(method.order)


def _rounded(order: float | None) -> str | None:
    return None if order is None else f"{order:.1f}"


def with_marks(measured: IntegratorAccuracy, table: Table) -> Table:
    """The table of trials with a mark at errors that are at their floor."""
    marked = {"energy rms": ENERGY, "error of Q": "rotation_error", "error of X": "position_error"}
    columns = []
    for column in table.columns:
        error = next((value for key, value in marked.items() if column.header.startswith(key)), "")
        columns.append(column._replace(value=_marked(measured, column, error)) if error else column)
    return Table(columns, table.rows)


def _marked(measured: IntegratorAccuracy, column: Column, error: str):
    """The value of a column as text, with a mark where it is at its floor."""
    integrators = dict.fromkeys(trial.integrator for trial in measured.trials)
    floors = [trial for name in integrators for trial in convergence(measured, name, error).floor]

    def value(trial: Trial) -> str | None:
        number = column.value(trial)
        if number is None:
            return None
        at_floor = any(trial is other for other in floors)
        return format_cell(number) + (FLOOR_MARK if at_floor else " ")

    return value
