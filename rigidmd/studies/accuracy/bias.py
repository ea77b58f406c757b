"""Bias of averages against the time step: means of runs at several steps, and their limit at a step of zero.

With a method of second order a mean is a + b dt² up to O(dt⁴). The limit a belongs to the ensemble, not to the
integrator, so one weighted fit has the same a for all integrators and thermostats, and a b for each of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import NamedTuple

import numpy as np

#: The step of this bias, as a fraction of the scale of a quantity, is reported.
BIAS_LIMIT = 0.01
#: A slope of at most this many standard errors counts as not seen.
UNSEEN = 2.0


class AveragedQuantity(NamedTuple):
    name: str
    unit: str
    scale: float  # of which the bias limit is a fraction; NaN: the limit of the quantity at a step of zero
    exact: float | None = None  # the limit where it is known
    bias_unit: str = ""  # of reported biases, `unit` when empty
    bias_size: float = 1.0  # of one such unit, in `unit`
    only: str = ""  # the integrator that has it, where not all do


class MeanAtStep(NamedTuple):
    method: str
    timestep: float  # fs
    mean: float
    error: float


class BiasFit(NamedTuple):
    """mean = limit + slope[method] dt², over steps up to `longest`."""

    limit: float
    limit_error: float
    slopes: dict[str, tuple[float, float]]  # method -> slope and its error, per fs²
    weights: dict[MeanAtStep, float]  # of the points in the limit, which is their weighted sum
    longest: float  # fs

    def bias(self, point: MeanAtStep) -> tuple[float, float]:
        """Mean less limit, and its error, which accounts for the weight of the mean in the limit."""
        weight = self.weights.get(point, 0.0)
        others = self.limit_error**2 - (weight * point.error) ** 2
        return point.mean - self.limit, sqrt(max(0.0, others) + ((1 - weight) * point.error) ** 2)


def extrapolate(points: Sequence[MeanAtStep], exact: float | None = None) -> BiasFit:
    """The limit of means at a step of zero, from all methods at once and from the short steps that dt² describes.

    Long steps are left out one by one while chi² exceeds its mean by more than two of its standard deviations and
    enough points are left. exact : the limit, where it is known. Raises ValueError without points.
    """
    steps = sorted({point.timestep for point in points}, reverse=True)
    fits = [fit for longest in steps if (fit := _fit(points, longest, exact)) is not None]
    for fit, chi2, freedom in fits:
        if freedom == 0 or chi2 <= freedom + 2 * sqrt(2 * freedom):
            return fit
    if fits:
        fit, chi2, freedom = fits[-1]
        return fit._replace(limit_error=fit.limit_error * sqrt(chi2 / freedom))
    best = min(points, key=lambda point: (point.timestep, point.error))
    return BiasFit(best.mean, best.error, {}, {best: 1.0}, best.timestep)


def _fit(points: Sequence[MeanAtStep], longest: float, exact: float | None) -> tuple[BiasFit, float, int] | None:
    """Weighted least squares over steps up to the longest: fit, chi², degrees of freedom. None with too few points."""
    points = [point for point in points if point.timestep <= longest]
    methods = list(dict.fromkeys(point.method for point in points))
    columns = [[float(point.method == name) * point.timestep**2 for point in points] for name in methods]
    if exact is None:
        columns.insert(0, [1.0] * len(points))
    if len(points) < len(columns):
        return None
    error = np.array([point.error for point in points])
    error = np.maximum(error, 1e-9 * error.max(initial=0.0) or 1.0)
    design = np.array(columns).T / error[:, None]
    value = np.array([point.mean for point in points]) - (exact or 0.0)
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / size) / size[:, None]
    found = inverse @ (value / error)
    chi2, freedom = float(((value / error - design @ found) ** 2).sum()), len(points) - len(columns)
    errors = np.linalg.norm(inverse, axis=1)
    if exact is None:
        limit, limit_error = float(found[0]), float(errors[0])
        weights = dict(zip(points, (inverse[0] / error).tolist(), strict=True))
        found, errors = found[1:], errors[1:]
    else:
        limit, limit_error, weights = exact, 0.0, {}
    slopes = {name: (float(b), float(e)) for name, b, e in zip(methods, found, errors, strict=True)}
    return BiasFit(limit, limit_error, slopes, weights, longest), chi2, freedom


@dataclass
class AverageRun:
    integrator: str
    thermostat: str
    timestep: float  # fs
    forces_per_ps: float
    seconds_per_ns: float | None = None
    averages: dict[str, tuple[float, float]] = field(default_factory=dict)  # name -> mean, standard error
    short: list[str] = field(default_factory=list)  # names of averages whose sampling is too short for an error
    failure: str = ""  # why there are none

    @property
    def method(self) -> str:
        return f"{self.integrator} + {self.thermostat}"


@dataclass
class Averages:
    """Averages of a stage with a thermostat, by methods and time steps."""

    name: str  # of the scene
    stage: str
    temperature: float  # K
    molecules: int
    freedom: int  # degrees of freedom
    sampled: float  # ps, each
    quantities: list[AveragedQuantity]
    runs: list[AverageRun]

    def __post_init__(self):
        self._fits: dict[str, BiasFit] = {}

    def __repr__(self) -> str:
        return f"<Averages of {self.name}, {self.stage}: {len(self.runs)} runs of {self.sampled:g} ps>"

    def points(self, quantity: AveragedQuantity) -> list[MeanAtStep]:
        return [point for run in self.runs if (point := self.point(run, quantity))]

    def point(self, run: AverageRun, quantity: AveragedQuantity) -> MeanAtStep | None:
        """The mean of a run, or None."""
        if quantity.name not in run.averages or (quantity.only and quantity.only != run.integrator):
            return None
        return MeanAtStep(run.method, run.timestep, *run.averages[quantity.name])

    def fit(self, quantity: AveragedQuantity) -> BiasFit | None:
        if quantity.name not in self._fits and (points := self.points(quantity)):
            self._fits[quantity.name] = extrapolate(points, quantity.exact)
        return self._fits.get(quantity.name)

    def bias(self, run: AverageRun, quantity: AveragedQuantity) -> tuple[float, float] | None:
        """Mean less limit and its error, in the quantity's unit of biases; None without a mean."""
        point, fit = self.point(run, quantity), self.fit(quantity)
        if point is None or fit is None:
            return None
        value, error = fit.bias(point)
        return value / quantity.bias_size, error / quantity.bias_size

    def bias_limit(self, quantity: AveragedQuantity) -> float:
        """The bias whose step is reported, in the quantity's unit of biases."""
        fit = self.fit(quantity)
        scale = quantity.scale if quantity.scale == quantity.scale or fit is None else abs(fit.limit)
        return BIAS_LIMIT * scale / quantity.bias_size

    def step_at_limit(self, method: str, quantity: AveragedQuantity) -> tuple[float, bool] | None:
        """The step (fs) at which the bias of a method reaches the limit, and whether a bias was seen.

        A bias is not seen if its slope is within `UNSEEN` errors of 0; it is then smaller up to that step. None if the
        fit has no slope of the method.
        """
        fit = self.fit(quantity)
        if fit is None or method not in fit.slopes:
            return None
        slope, error = fit.slopes[method]
        seen = abs(slope) > UNSEEN * error
        steepest = abs(slope) if seen else abs(slope) + UNSEEN * error
        return (sqrt(self.bias_limit(quantity) * quantity.bias_size / steepest), seen) if steepest > 0 else None
