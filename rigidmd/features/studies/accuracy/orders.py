"""Measured orders of integrators, and the trials whose error no shorter step reduces."""

from itertools import combinations
from math import log
from statistics import median
from typing import NamedTuple

from rigidmd.core.integrators import RK4, Scheme
from rigidmd.features.studies.accuracy.measurement import IntegratorAccuracy
from rigidmd.io.write import Column, ReportTable, format_cell
from rigidmd.run.trials import Trial

#: Errors fall where their slopes are at least this fraction of the order.
FLOOR_FRACTION = 0.5
#: The slope across a trial, as a fraction of the order, from which its error is small by accident.
TREND_FRACTION = 0.8
#: The reference error counts as a floor below this multiple of it.
REFERENCE_MARGIN = 3.0
FLOOR_MARK = "*"
#: Numbers of trials with the shortest steps above the floor, from which an order is measured.
FEWEST, MOST = 3, 5
#: Largest error of a measured order. Beyond it there is none.
LARGEST_ERROR = 0.5
#: Standard deviation of normal numbers over the median of their absolute values.
NORMAL = 1.4826


class Order(NamedTuple):
    """A measured order. value, error : the median of the slopes between all pairs of trials, and
    the scatter of these slopes, from the median of their absolute differences from `value`"""

    value: float
    error: float

    def __str__(self) -> str:
        return f"{self.value:.2f} ± {self.error:.2f}"


class Convergence(NamedTuple):
    """How an error of an integrator falls with its step.

    order : from the shortest steps above the floor. None with fewer than three, or if they scatter
    floor : trials with the shortest steps, whose errors do not fall any more
    """

    order: Order | None
    floor: list[Trial]


def convergence(measured: IntegratorAccuracy, integrator: str, error: str) -> Convergence:
    """The convergence of an error, an attribute of `Trial`."""
    order = measured.trial_system.methods[integrator].order
    tried = measured.bounded(integrator, error)
    points = [(log(trial.timestep), log(getattr(trial, error))) for trial in tried]
    lowest = REFERENCE_MARGIN * measured.reference_error if error in OF_TRAJECTORY else 0.0
    end = len(tried)
    while end > 1 and getattr(tried[end - 1], error) < lowest:
        end -= 1
    end = next((k + 1 for k in range(end - 1) if _is_lowest(points[:end], k, order)), end)
    return Convergence(fitted_order(points[max(0, end - MOST) : end]), tried[end:])


Point = tuple[float, float]  # logarithms of a step and of its error


def _is_lowest(points: list[Point], k: int, order: int) -> bool:
    """Whether the errors of steps shorter than that of point k do not fall from it: to none of
    them, nor among them, and not because its own error is small by accident."""
    least = FLOOR_FRACTION * order
    if any(_slope(points[k], shorter) >= least for shorter in points[k + 1 :]):
        return False
    if median(_slopes(points[k:])) >= least:
        return False
    return k == 0 or _slope(points[k - 1], points[k + 1]) < TREND_FRACTION * order


def fitted_order(points: list[Point]) -> Order | None:
    """The order of errors at successive steps."""
    if len(points) < FEWEST:
        return None
    slopes = _slopes(points)
    value = median(slopes)
    error = NORMAL * median(abs(slope - value) for slope in slopes)
    return Order(value, error) if error <= LARGEST_ERROR else None


def _slopes(points: list[Point]) -> list[float]:
    """The slopes between all pairs of points (Theil 1950, Sen 1968)."""
    return [_slope(a, b) for a, b in combinations(points, 2)]


def _slope(a: Point, b: Point) -> float:
    return (a[1] - b[1]) / (a[0] - b[0])


OF_TRAJECTORY = ("trajectory_error", "rotation_error", "position_error")
ENERGY = "energy_rms"


def order_table(measured: IntegratorAccuracy) -> ReportTable:
    """A row for each integrator: its order, the measured ones, its longest stable step."""
    system = measured.trial_system
    rotates = any(trial.rotation_error > 0 for trial in measured.trials)
    of, error = ("Q", "rotation_error") if rotates else ("X", "position_error")

    def order(integrator: str) -> str | None:
        """The order of a scheme. A solver that chooses its steps has none."""
        method = system.methods[integrator]
        adapts = not isinstance(method.scheme, Scheme) and method.scheme.name != RK4
        return None if adapts else str(method.order)

    def measured_order(error: str):
        def text(integrator: str) -> str | None:
            order = convergence(measured, integrator, error).order
            return None if order is None else str(order)

        return text

    def stable_step(integrator: str) -> float | None:
        return next((trial.timestep for trial in measured.bounded(integrator)), None)

    return ReportTable(
        [
            Column("integrator", str),
            Column("order", order),
            Column("measured, energy", measured_order(ENERGY)),
            Column(f"measured, {of}", measured_order(error)),
            Column(f"longest stable step ({system.time_unit})", stable_step),
        ],
        measured.integrators,
    )


def with_marks(measured: IntegratorAccuracy, error: str, column: Column[Trial]) -> Column[Trial]:
    """A column of an error as text, with a mark where the error is at its floor."""
    floors = [
        trial for name in measured.integrators for trial in convergence(measured, name, error).floor
    ]

    def value(trial: Trial) -> str | None:
        number = column.value(trial)
        at_floor = any(trial is other for other in floors)
        return None if number is None else format_cell(number) + (FLOOR_MARK if at_floor else " ")

    return column._replace(value=value)
