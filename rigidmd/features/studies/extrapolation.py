"""Averages at zero time step: mean = limit + slope dt^p, where p is the order of the integrator.

The limit belongs to the ensemble, not to the integrator, so that one weighted fit has the same
limit for all methods and a slope for each of them. See "Several steps" in the theory chapter
`zero_step`.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.core.statistics import format_signed, student_factor

#: Degrees of freedom of the scatter of replicas, over all steps, from which on it gives the size of
#: errors. With fewer the errors of single runs do.
LEAST_FREEDOM = 8


class MeanAtStep(NamedTuple):
    method: str
    timestep: float  # fs
    mean: float
    error: float
    order: int = 2  # of the method

    @property
    def power(self) -> float:
        """dt^order."""
        return self.timestep**self.order


class BiasFit(NamedTuple):
    """mean = limit + slope[method] dt^order, over steps up to `longest`."""

    limit: float
    limit_error: float
    slopes: dict[str, tuple[float, float]]  # method -> slope and its error, per fs^order
    weights: dict[MeanAtStep, float]  # of the points in the limit, which is their weighted sum
    longest: float  # fs
    chi2: float = 0.0
    freedom: int = 0  # degrees of freedom of chi²: points less fitted numbers

    def bias(self, point: MeanAtStep) -> tuple[float, float]:
        """Mean less limit, and its error, which accounts for the weight of the mean in the
        limit."""
        weight = self.weights.get(point, 0.0)
        others = self.limit_error**2 - (weight * point.error) ** 2
        return point.mean - self.limit, sqrt(max(0.0, others) + ((1 - weight) * point.error) ** 2)

    def describe_limit(self) -> str:
        return format_signed(self.limit, self.limit_error).lstrip("+")


def extrapolate(points: Sequence[MeanAtStep]) -> BiasFit:
    """The limit of means at zero time step, from all methods at once and from the short steps that
    dt^order describes.

    Long steps are omitted one by one while chi² exceeds its mean by more than two of its standard
    deviations and enough points are left. Raises ValueError without points.
    """
    steps = sorted({point.timestep for point in points}, reverse=True)
    fits = [fit for longest in steps if (fit := _fit(points, longest)) is not None]
    if fits:
        return first_good([[fit] for fit in fits])[0]
    best = min(points, key=lambda point: (point.timestep, point.error))
    return BiasFit(best.mean, best.error, {}, {best: 1.0}, best.timestep)


def first_good(fits: Sequence[list[BiasFit]]) -> list[BiasFit]:
    """The first of several fits, each of some quantities with one chi², whose chi² is as expected.
    If there is none, the last one, with errors as large as chi² shows."""
    for of_all in fits:
        chi2, freedom = of_all[0].chi2, of_all[0].freedom
        if freedom == 0 or chi2 <= freedom + 2 * sqrt(2 * freedom):
            return of_all
    factor = sqrt(fits[-1][0].chi2 / fits[-1][0].freedom)
    return [fit._replace(limit_error=factor * fit.limit_error) for fit in fits[-1]]


class LeastSquares(NamedTuple):
    """The solution of linear equations (values, unknowns) whose values have errors of 1.

    inverse : (unknowns, values), of which the solution is the product with the values
    """

    solution: list[float]
    errors: list[float]
    chi2: float
    inverse: np.ndarray


def least_squares(design: np.ndarray, values: np.ndarray) -> LeastSquares:
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / size) / size[:, None]
    solution = inverse @ values
    chi2 = float(((values - design @ solution) ** 2).sum())
    errors = np.linalg.norm(inverse, axis=1)
    return LeastSquares(solution.tolist(), errors.tolist(), chi2, inverse)


def _fit(points: Sequence[MeanAtStep], longest: float) -> BiasFit | None:
    """Weighted least squares over steps up to the longest. None with too few points."""
    points = [point for point in points if point.timestep <= longest]
    methods = list(dict.fromkeys(point.method for point in points))
    columns = [
        [1.0] * len(points),
        *([(point.method == name) * point.power for point in points] for name in methods),
    ]
    if len(points) < len(columns):
        return None
    error = np.array([point.error for point in points])
    error = np.maximum(error, 1e-9 * error.max(initial=0.0) or 1.0)
    means = np.array([point.mean for point in points])
    fitted = least_squares(np.array(columns).T / error[:, None], means / error)
    weights = dict(zip(points, (fitted.inverse[0] / error).tolist(), strict=True))
    limit, *slopes = zip(fitted.solution, fitted.errors, strict=True)
    freedom = len(points) - len(columns)
    of_methods = dict(zip(methods, slopes, strict=True))
    return BiasFit(*limit, of_methods, weights, longest, fitted.chi2, freedom)


class Together(NamedTuple):
    """A value of several runs analysed together, and its error over the runs."""

    value: float
    error: float
    runs: int


class _AtStep(NamedTuple):
    """A mean at a step; variance : of a single run by its own error, None if unknown."""

    mean: float
    runs: int
    squares: float  # sum of the squares of the deviations of the runs from the mean
    variance: float | None


def means_of_runs(
    runs: Mapping[float, Sequence[tuple[float, float | None]]],
    together: Mapping[float, Together] | None = None,
) -> list[MeanAtStep]:
    """Means over the runs at each step, with errors. None where the runs are too few and too short
    for an error.

    runs : step (fs) -> value and error of each of its runs
    together : step -> value of its runs together, used instead of the mean of their values

    The errors of single runs give the ratios of the time-step errors. Their common size is from
    the scatter of the runs about the means of their steps if that has at least `LEAST_FREEDOM`
    degrees of freedom, else as it is. Values of runs together need no errors of single runs.
    """
    together = together or {}
    names = [step for step in dict.fromkeys([*runs, *together]) if step in together or runs[step]]
    steps = {step: _at_step(runs.get(step, ()), together.get(step)) for step in names}
    known = all(at.variance is not None for at in steps.values())
    variances = [(at.variance if known else None) or 1.0 for at in steps.values()]
    freedom = sum(at.runs - 1 for at in steps.values())
    factor = 1.0
    if freedom >= LEAST_FREEDOM or (not known and together.keys() >= steps.keys()):
        squares = sum(
            at.squares / variance for at, variance in zip(steps.values(), variances, strict=True)
        )
        factor = sqrt(squares / freedom) * student_factor(freedom)
    elif not known:
        return []
    return [
        MeanAtStep("", step, at.mean, factor * sqrt(variance / at.runs))
        for (step, at), variance in zip(steps.items(), variances, strict=True)
    ]


def _at_step(runs: Sequence[tuple[float, float | None]], together: Together | None) -> _AtStep:
    values = np.array([value for value, _ in runs])
    within = [error**2 for _, error in runs if error is not None]
    variance = float(np.mean(within)) if any(within) else None
    if together is None:
        return _AtStep(
            float(values.mean()), len(values), float(len(values) * values.var()), variance
        )
    count = together.runs
    return _AtStep(together.value, count, count * (count - 1) * together.error**2, variance)
