"""Energy and volume at zero time step together: means at several steps, and the slopes that
fluctuations predict.

See "Energy and volume together" in the theory chapter `zero_step`.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.statistics import inefficiency, mean_and_error
from rigidmd.engines.system import System
from rigidmd.features.analysis.rigid_frames import production_samples
from rigidmd.features.studies import step_bias
from rigidmd.features.studies.extrapolation import (
    BiasFit,
    MeanAtStep,
    extrapolate,
    first_good,
    least_squares,
    means_of_runs,
)
from rigidmd.features.studies.step_bias import (
    BAR_NM3,
    BLOCKS,
    GAS_CONSTANT,
    LEAST_SAMPLES,
    NEXT_TERM,
    Conditions,
    Moments,
    Series,
    beyond_first_order,
    conditions,
    mean_square,
    moments_of_run,
    series_of,
    slopes,
)
from rigidmd.run.record import Record
from rigidmd.units import FEMTOSECOND

POTENTIAL, VOLUME, DENSITY = (
    QUANTITIES[name].mean_header for name in ("potential", "volume", "density")
)


class RunResults(NamedTuple):
    """Results of a run by name, and changes of all of them (blocks, results) whose products, summed
    over blocks, are their covariances."""

    values: dict[str, float]
    errors: dict[str, float | None]
    changes: np.ndarray
    samples: int


def slope_name(quantity: str) -> str:
    return f"slope of {quantity}"


def rest_name(quantity: str) -> str:
    """What the first order, and the interval of the log, leave out of a slope."""
    return f"rest of the slope of {quantity}"


#: Mean kinetic energy where the thermostat acts, less its value at the set temperature.
BALANCE = "kinetic energy less its set value"
#: Mean of (ω dt)² over the degrees of freedom.
MEAN_SQUARE = "(ω dt)²"


def results_of_run(record: Record[System]) -> RunResults | str:
    """Results of a run, or why it has none. Raises OutputError."""
    stage, production = production_samples(record)
    at = conditions(record.system, stage)
    if isinstance(at, str):
        return at
    columns = {name: values[production] for name, values in record.columns.items()}
    series = series_of(columns, at)
    if isinstance(series, str):
        return series
    return beyond_first_order(series, at) or results_of_samples(columns["density"], series, at)


def results_of_samples(density: np.ndarray, series: Series, at: Conditions) -> RunResults:
    """Results of the samples of a run."""
    if len(density) < BLOCKS:
        return RunResults({}, {}, np.zeros((BLOCKS, 0)), 0)
    observed = dict(
        zip(_observables(at), (series.potential / at.count, series.volume, density), strict=False)
    )
    observed[BALANCE] = series.kinetic[0] + series.kinetic[1]
    found, *without = (
        _evaluate(of, at) for of in moments_of_run(np.array([*observed.values()]), series, at)
    )
    table = np.array([list(one.values()) for one in without])
    changes = (table - table.mean(axis=0)) * sqrt((BLOCKS - 1) / BLOCKS)
    errors = dict(zip(found, np.linalg.norm(changes, axis=0).tolist(), strict=True))
    errors |= {name: mean_and_error(values)[1] for name, values in observed.items()}
    # enough independent samples for the fluctuations of each
    known = all(
        len(values) >= LEAST_SAMPLES * inefficiency(values - values.mean())
        for values in observed.values()
    )
    errors = {name: error if known else None for name, error in errors.items()}
    return RunResults(found, errors, changes, len(density))


def _observables(at: Conditions) -> list[str]:
    return [POTENTIAL, VOLUME, DENSITY] if at.has_barostat else [POTENTIAL]


def _evaluate(of: Moments, at: Conditions) -> dict[str, float]:
    """Means, their slopes over dt² (per fs²), and responses at constant pressure or volume."""
    names = _observables(at)
    of_columns = of._replace(covariance=of.covariance[: len(names)])
    gradients = [1 / at.count, 0.0, 0.0]
    slope = slopes(of_columns, at, gradients[: len(names)])
    found = dict(zip(names, of.mean.tolist(), strict=False))
    square = mean_square(of.squares, at)
    for k, name in enumerate(names):
        found[slope_name(name)] = FEMTOSECOND**2 * float(slope.value[k])
        rest = np.hypot(NEXT_TERM * square * slope.size[k], slope.missed[k])
        found[rest_name(name)] = FEMTOSECOND**2 * float(rest)
    found[MEAN_SQUARE] = square
    found[BALANCE] = float(of.mean[-1]) - at.all_freedom * at.thermal_energy / 2
    return found | _responses(of, at)


def _responses(of: Moments, at: Conditions) -> dict[str, float]:
    """Response functions from fluctuations, with the part of the momenta as it is in theory."""
    thermal, covariance = at.thermal_energy, of.covariance
    momenta = 0.5 * GAS_CONSTANT * (3 * at.moving + at.freedom[1])
    with_enthalpy = (
        covariance[:, step_bias.POTENTIAL] + at.pressure * covariance[:, step_bias.VOLUME]
    )
    of_enthalpy = at.count * with_enthalpy[0]
    of_enthalpy += at.pressure * with_enthalpy[1] if at.has_barostat else 0.0
    capacity = 1e3 * (momenta + of_enthalpy / thermal / at.temperature) / at.moving
    if not at.has_barostat:
        return {"c_v (J/(mol K))": float(capacity)}
    return {
        "c_p (J/(mol K))": float(capacity),
        "kappa_T (1/bar)": float(covariance[1, step_bias.VOLUME] / thermal / of.volume * BAR_NM3),
        "alpha_p (1/K)": float(with_enthalpy[1] / thermal / at.temperature / of.volume),
    }


class JointLimits(NamedTuple):
    """Limits by quantity with the means at the steps: of the joint fit, and of responses."""

    joint: dict[str, tuple[list[MeanAtStep], BiasFit]]
    responses: dict[str, tuple[list[MeanAtStep], BiasFit]]


def fit_jointly(runs: Mapping[float, Sequence[RunResults]]) -> JointLimits:
    """Limits from the results of the runs at each step (fs). Empty if they are too short."""
    names = next((list(of.values) for of_step in runs.values() for of in of_step), [])
    averaged = {name for name in names if slope_name(name) in names} | {BALANCE}
    points = {
        name: means_of_runs(_with_errors(runs, name, of_series=name in averaged)) for name in names
    }
    if not names or not all(points.values()):
        return JointLimits({}, {})
    slopes = [name for name in names if slope_name(name) in names]
    joint: dict[str, tuple[list[MeanAtStep], BiasFit]] = {}
    for other in slopes[1:] or slopes:
        together = list(dict.fromkeys([slopes[0], other]))
        used = [*together, *map(slope_name, together), BALANCE]
        correlation = _correlation(runs, used)
        steps = [
            _Step([points[name][k] for name in used], correlation, _next_terms(points, together, k))
            for k in range(len(points[BALANCE]))
        ]
        for name, fit in zip(together, _fit_with_slopes(steps), strict=True):
            joint.setdefault(name, (points[name], fit))
    plain = names[names.index(BALANCE) + 1 :]
    return JointLimits(joint, {name: (points[name], extrapolate(points[name])) for name in plain})


def _with_errors(
    runs: Mapping[float, Sequence[RunResults]], name: str, *, of_series: bool
) -> dict[float, list[tuple[float, float | None]]]:
    """The values of a result at each step with their errors.

    of_series : whether each error is that of its run, else all runs have the same one for the same
        length, as errors from few blocks scatter, and are smaller where fluctuations are
    """
    every = [of for found in runs.values() for of in found]
    errors = [of.errors[name] for of in every]
    squares = [of.samples * error**2 for of, error in zip(every, errors, strict=True) if error]
    common = sqrt(np.mean(squares)) if squares else 0.0
    return {
        step: [
            (
                of.values[name],
                of.errors[name] if of_series or not of.errors[name] else common / sqrt(of.samples),
            )
            for of in found
        ]
        for step, found in runs.items()
    }


def _correlation(runs: Mapping[float, Sequence[RunResults]], names: list[str]) -> np.ndarray:
    """Error correlations between results, over the blocks of all runs."""
    total = np.zeros((len(names), len(names)))
    for of in (of for found in runs.values() for of in found):
        columns = [list(of.values).index(name) for name in names]
        changes = of.changes[:, columns]
        changes = changes / np.linalg.norm(changes, axis=0)
        total += changes.T @ changes
    size = np.sqrt(np.diag(total))
    return total / np.outer(size, size)


def _next_terms(points: Mapping[str, list[MeanAtStep]], names: list[str], k: int) -> np.ndarray:
    """What terms of higher order may change in means and in slopes at step k."""
    rest = np.array([points[rest_name(name)][k].mean for name in names])
    return np.concatenate([points[MEAN_SQUARE][k].timestep ** 2 * rest, rest])


class _Step(NamedTuple):
    """Data of a step: means, then as many slopes, then what is 0 at any step."""

    points: list[MeanAtStep]
    correlation: np.ndarray
    next_terms: np.ndarray  # sizes of terms of higher order, of means and slopes

    @property
    def step(self) -> float:
        return self.points[0].timestep

    @property
    def size(self) -> int:
        """Number of means."""
        return len(self.points) // 2

    def whitened(self) -> tuple[np.ndarray, np.ndarray]:
        """Design and values, for limits and slopes as unknowns, with errors of 1."""
        unit = np.eye(self.size)
        zero = np.zeros((self.size, self.size))
        rest = np.zeros((len(self.points) % 2, 2 * self.size))
        design = np.block([[unit, self.step**2 * unit], [zero, unit]])
        errors = np.array([point.error for point in self.points])
        values = np.array([point.mean for point in self.points])
        covariance = self.correlation * np.outer(errors, errors)
        covariance += np.diag(np.append(self.next_terms, np.zeros(len(rest))) ** 2)
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
        return whiten @ np.vstack([design, rest]), whiten @ values


def _fit_with_slopes(steps: Sequence[_Step]) -> list[BiasFit]:
    """Generalised least squares. Long steps are omitted as in `extrapolate`."""
    steps = sorted(steps, key=lambda step: step.step)
    return first_good([_fit_steps(steps[:count]) for count in range(len(steps), 0, -1)])


def _fit_steps(steps: Sequence[_Step]) -> list[BiasFit]:
    designs, values = zip(*(step.whitened() for step in steps), strict=True)
    fitted = least_squares(np.vstack(designs), np.concatenate(values))
    size, longest = steps[0].size, steps[-1].step
    numbers = [*zip(fitted.solution, fitted.errors, strict=True)]
    freedom = len(fitted.inverse[0]) - 2 * size
    return [
        BiasFit(*limit, {"": slope}, {}, longest, fitted.chi2, freedom)
        for limit, slope in zip(numbers[:size], numbers[size:], strict=True)
    ]
