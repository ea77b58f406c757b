"""Bias of averages against the time step: means of runs at several steps, and their limit at a step of zero.

With a step of second order a mean is a + b dt² up to O(dt⁴). The limit a belongs to the ensemble, not to the
integrator, so all integrators and thermostats share it in one weighted fit, and each has its own b.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import sqrt
from typing import NamedTuple

import numpy as np

#: A bias of this share of the scale of a quantity is told of.
SHARE = 0.01
#: A slope within so many of its errors is taken for nothing seen.
UNSEEN = 2.0


class Quantity(NamedTuple):
    """What is averaged."""

    name: str
    unit: str
    scale: float  # of which a share is told; NaN: the quantity's own limit
    exact: float | None = None  # the limit where it is known
    bias_unit: str = ""  # of reported biases, `unit` when empty
    bias_size: float = 1.0  # of one such unit, in `unit`
    only: str = ""  # the integrator that has it, where not all do


class Point(NamedTuple):
    """A mean at a time step."""

    method: str
    timestep: float  # fs
    mean: float
    error: float


class Fit(NamedTuple):
    """mean = limit + slope[method] dt², over steps up to `longest`."""

    limit: float
    limit_error: float
    slopes: dict[str, tuple[float, float]]  # method -> slope and its error, per fs²
    weights: dict[Point, float]  # of the points in the limit, which is their weighted sum
    longest: float  # fs

    def bias(self, point: Point) -> tuple[float, float]:
        """Mean less limit, and its error, with the part of the mean in the limit taken into account."""
        own = self.weights.get(point, 0.0)
        others = self.limit_error**2 - (own * point.error) ** 2
        return point.mean - self.limit, sqrt(max(0.0, others) + ((1 - own) * point.error) ** 2)


def extrapolate(points: Sequence[Point], exact: float | None = None) -> Fit:
    """The limit of means at a step of zero, from all methods at once; from so many short steps as dt² describes.

    Long steps are left out one by one as long as chi² is above its mean by more than two of its standard deviations and
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
    return Fit(best.mean, best.error, {}, {best: 1.0}, best.timestep)


def _fit(points: Sequence[Point], longest: float, exact: float | None) -> tuple[Fit, float, int] | None:
    """Weighted least squares over steps up to the longest: fit, chi², degrees of freedom. None with too few points."""
    own = [point for point in points if point.timestep <= longest]
    methods = list(dict.fromkeys(point.method for point in own))
    columns = [[float(point.method == name) * point.timestep**2 for point in own] for name in methods]
    if exact is None:
        columns.insert(0, [1.0] * len(own))
    if len(own) < len(columns):
        return None
    error = np.array([point.error for point in own])
    error = np.maximum(error, 1e-9 * error.max(initial=0.0) or 1.0)
    design = np.array(columns).T / error[:, None]
    value = np.array([point.mean for point in own]) - (exact or 0.0)
    size = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv(design / size) / size[:, None]
    found = inverse @ (value / error)
    chi2, freedom = float(((value / error - design @ found) ** 2).sum()), len(own) - len(columns)
    errors = np.linalg.norm(inverse, axis=1)
    if exact is None:
        limit, limit_error = float(found[0]), float(errors[0])
        weights = dict(zip(own, (inverse[0] / error).tolist(), strict=True))
        found, errors = found[1:], errors[1:]
    else:
        limit, limit_error, weights = exact, 0.0, {}
    slopes = {name: (float(b), float(e)) for name, b, e in zip(methods, found, errors, strict=True)}
    return Fit(limit, limit_error, slopes, weights, longest), chi2, freedom


@dataclass
class AverageRun:
    """One method at one time step."""

    integrator: str
    thermostat: str
    timestep: float  # fs
    forces_per_ps: float
    seconds_per_ns: float | None = None
    averages: dict[str, tuple[float, float]] = field(default_factory=dict)  # name -> mean, standard error
    short: list[str] = field(default_factory=list)  # names of those that are sampled too short for an error
    fault: str = ""  # why there are none

    @property
    def method(self) -> str:
        """Integrator and thermostat."""
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
    quantities: list[Quantity]
    runs: list[AverageRun]

    def __post_init__(self):
        self._fits: dict[str, Fit] = {}

    def __repr__(self) -> str:
        return f"<Averages of {self.name}, {self.stage}: {len(self.runs)} runs of {self.sampled:g} ps>"

    def points(self, quantity: Quantity) -> list[Point]:
        """All means of a quantity."""
        return [point for run in self.runs if (point := self.point(run, quantity))]

    def point(self, run: AverageRun, quantity: Quantity) -> Point | None:
        """The mean of a run; None where it has none."""
        if quantity.name not in run.averages or (quantity.only and quantity.only != run.integrator):
            return None
        return Point(run.method, run.timestep, *run.averages[quantity.name])

    def fit(self, quantity: Quantity) -> Fit | None:
        """The limit of a quantity and how far each method is from it; None of what no run has."""
        if quantity.name not in self._fits:
            points = self.points(quantity)
            if not points:
                return None
            self._fits[quantity.name] = extrapolate(points, quantity.exact)
        return self._fits[quantity.name]

    def bias(self, run: AverageRun, quantity: Quantity) -> tuple[float, float] | None:
        """Mean less limit and its error, in the quantity's unit of biases; None where there is no mean."""
        point, fit = self.point(run, quantity), self.fit(quantity)
        if point is None or fit is None:
            return None
        value, error = fit.bias(point)
        return value / quantity.bias_size, error / quantity.bias_size

    def allowed(self, quantity: Quantity) -> float:
        """The bias that is told of, in the quantity's unit of biases."""
        fit = self.fit(quantity)
        scale = quantity.scale if quantity.scale == quantity.scale or fit is None else abs(fit.limit)
        return SHARE * scale / quantity.bias_size

    def off_at(self, method: str, quantity: Quantity) -> tuple[float, bool] | None:
        """The step (fs) at which a method's bias is what is told of, and whether it was seen.

        Not seen, where its slope is within `UNSEEN` errors of none: the bias is then smaller up to that step. None
        where the fit has no slope of the method.
        """
        fit = self.fit(quantity)
        if fit is None or method not in fit.slopes:
            return None
        slope, error = fit.slopes[method]
        seen = abs(slope) > UNSEEN * error
        steepest = abs(slope) if seen else abs(slope) + UNSEEN * error
        return (sqrt(self.allowed(quantity) * quantity.bias_size / steepest), seen) if steepest > 0 else None
