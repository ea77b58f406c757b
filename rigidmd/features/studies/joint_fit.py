"""Energy and volume at zero time step together: means at several steps, and the slopes that
fluctuations predict.

See "Energy and volume together" in the theory chapter `errors`.
"""

from collections.abc import Mapping, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import DRIFT, KICK
from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.statistics import inefficiency, mean_and_error
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.features.analysis.rigid_frames import production_samples
from rigidmd.features.studies.extrapolation import (
    BiasFit,
    MeanAtStep,
    extrapolate,
    first_good,
    least_squares,
    means_of_runs,
)
from rigidmd.run.record import Record
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, BOLTZMANN, FEMTOSECOND, KJ_PER_MOL

POTENTIAL, VOLUME, DENSITY = (
    QUANTITIES[name].mean_header for name in ("potential", "volume", "density")
)
#: Sums of squares of forces and torques in the log.
SQUARES = ("force_squares", "torque_squares")
GAS_CONSTANT = BOLTZMANN / KJ_PER_MOL  # kJ/mol/K
BAR_NM3 = 1e3 * BAR / KJ_PER_MOL  # kJ/mol
#: Blocks of a run that give errors of what fluctuations predict, and their correlations.
BLOCKS = 10
#: Minimum number of independent samples of a run whose fluctuations count.
LEAST_SAMPLES = 20.0


class Conditions(NamedTuple):
    """The state that a run samples, in kJ/mol, nm³, ps, K."""

    step: float
    temperature: float
    pressure: float  # 0 at constant volume
    count: int  # of molecules
    moving: int  # of molecules that are not frozen
    freedom: int
    rotation: int  # degrees of freedom of rotation
    correction: float  # see `Scheme.kinetic_correction`
    reads_kinetic: bool

    @property
    def thermal_energy(self) -> float:
        return GAS_CONSTANT * self.temperature


class RunResults(NamedTuple):
    """Results of a run by name, and changes of all of them (blocks, results) whose products, summed
    over blocks, are their covariances."""

    values: dict[str, float]
    errors: dict[str, float | None]
    changes: np.ndarray
    samples: int


def slope_name(quantity: str) -> str:
    return f"slope of {quantity}"


def size_name(quantity: str) -> str:
    """The summed sizes of the parts of a slope, which may cancel."""
    return f"size of the slope of {quantity}"


#: Mean kinetic energy where the thermostat acts, less its value at the set temperature.
BALANCE = "kinetic energy less its set value"
#: Mean of (ω dt)² over the degrees of freedom. Times NEXT_TERM it is the fraction of a bias that
#: its next term is taken to be: 1/4 in harmonic motions of one frequency, more where frequencies
#: differ. In nitrogen at 90 K it was 1.4 ± 0.9, at (ω dt)² = 0.14.
MEAN_SQUARE = "(ω dt)²"
NEXT_TERM = 1.0


def why_not(stage: Stage) -> str:
    """Why a stage has no joint fit. An empty text if it has one."""
    moving = [(flow.kind, flow.fraction) for flow in stage.scheme.flows if flow.kind <= DRIFT]
    drifts = sum(fraction for kind, fraction in moving if kind == DRIFT)
    if stage.ensemble not in ("nvt", "npt"):
        return f"it is for nvt and npt, and the stage is {stage.ensemble}"
    if stage.ramps:
        return "temperature or pressure change during the stage"
    if stage.in_trajectories:
        return f"{stage.thermostat_kind} has no time-step error"
    if moving[0] != moving[-1] or moving[0] != (KICK, 0.5) or abs(drifts - 1) > 1e-12:
        return f"it is for velocity_verlet and baoab, and the integrator is {stage.integrator}"
    if stage.has_barostat and stage.pressure_coupling not in (None, "isotropic"):
        return f"pressure_coupling is {stage.pressure_coupling!r}, not 'isotropic'"
    return ""


def results_of_run(record: Record[System]) -> RunResults | str:
    """Results of a run, or why it has none. Raises OutputError."""
    stage, production = production_samples(record)
    if reason := why_not(stage):
        return reason
    at = _conditions(record, stage)
    columns = {name: values[production] for name, values in record.columns.items()}
    if not all(np.isfinite(columns.get(name, np.nan)).all() for name in SQUARES):
        names = " and ".join(QUANTITIES[name].header for name in SQUARES)
        return f"the log has no {names}, which runs of earlier versions lack"
    samples = _Samples(
        columns["potential"] / at.count,
        columns["volume"] if stage.has_barostat else np.zeros(production.sum()),
        columns["density"] if stage.has_barostat else np.zeros(production.sum()),
        columns["kinetic"],
        columns["force_squares"] + columns["torque_squares"],
        columns["force_squares"],
    )
    return results_of_samples(np.array(samples), at, has_barostat=stage.has_barostat)


def _conditions(record: Record[System], stage: Stage) -> Conditions:
    system = record.system
    freedom = system.freedom_in(system.scene.stages.index(stage))
    return Conditions(
        stage.step,
        stage.temperatures[0],
        stage.pressures[0][0] * BAR_NM3 if stage.has_barostat else 0.0,
        len(system.model.species),
        int(mobile(system.model).sum()),
        freedom.total,
        freedom.rotation,
        stage.scheme.with_thermostat(()).kinetic_correction,
        stage.barostat_method.reads_momenta,
    )


class _Samples(NamedTuple):
    """Series (l,), or their means, or their covariances with one of them."""

    potential: np.ndarray  # per molecule
    volume: np.ndarray
    density: np.ndarray
    kinetic: np.ndarray
    squares: np.ndarray  # sum F²/m + sum n²/I
    of_forces: np.ndarray  # sum F²/m


def results_of_samples(samples: np.ndarray, at: Conditions, *, has_barostat: bool) -> RunResults:
    """Results of series (6, l) of `_Samples`."""
    length = samples.shape[1] // BLOCKS
    if length == 0:
        return RunResults({}, {}, np.zeros((BLOCKS, 0)), 0)
    blocks = samples[:, -BLOCKS * length :].reshape(len(samples), BLOCKS, length)
    values = _evaluate(blocks, at, has_barostat=has_barostat)
    without = [
        _evaluate(np.delete(blocks, k, 1), at, has_barostat=has_barostat) for k in range(BLOCKS)
    ]
    table = np.array([list(found.values()) for found in without])
    changes = (table - table.mean(axis=0)) * sqrt((BLOCKS - 1) / BLOCKS)
    errors = dict(zip(values, np.linalg.norm(changes, axis=0).tolist(), strict=True))
    series = _Samples(*samples)
    averaged = dict(zip(_observables(has_barostat=has_barostat), series, strict=False))
    averaged[BALANCE] = series.kinetic + at.correction * at.step**2 * series.squares
    errors |= {name: mean_and_error(values)[1] for name, values in averaged.items()}
    known = all(map(_is_long, averaged.values()))
    errors = {name: error if known else None for name, error in errors.items()}
    return RunResults(values, errors, changes, samples.shape[1])


def _is_long(series: np.ndarray) -> bool:
    """Whether a series has enough independent samples for its fluctuations."""
    return len(series) >= LEAST_SAMPLES * inefficiency(series - series.mean())


def _observables(*, has_barostat: bool) -> list[str]:
    return [POTENTIAL, VOLUME, DENSITY] if has_barostat else [POTENTIAL]


def _evaluate(blocks: np.ndarray, at: Conditions, *, has_barostat: bool) -> dict[str, float]:
    """Means, their slopes over dt² (per fs²), and responses at constant pressure or volume."""
    means = blocks.mean(axis=(1, 2))
    deviations = blocks - means[:, None, None]
    covariance = np.einsum("ibl,jbl->ij", deviations, deviations) / blocks[0].size
    covariance += np.cov(blocks.mean(axis=2)) / blocks.shape[1]  # hidden by the sample means
    mean = _Samples(*means)
    with_potential, with_volume, *_ = map(_Samples._make, covariance)
    with_squares = _Samples(*covariance[4])
    enthalpy = [
        at.count * one + at.pressure * other
        for one, other in zip(with_potential, with_volume, strict=True)
    ]
    with_enthalpy = _Samples(*enthalpy)
    hotter = _heating(mean, at)
    denser = _compression(mean, at, hotter) if has_barostat else 0.0
    found = dict(zip(_observables(has_barostat=has_barostat), means.tolist(), strict=False))
    for k, name in enumerate(list(found)):
        direct = -with_squares[k] / 24
        if name == POTENTIAL:
            direct += at.thermal_energy * mean.squares / at.count / 12
        parts = np.array([direct, with_enthalpy[k] * hotter, -with_volume[k] * denser])
        parts *= FEMTOSECOND**2 / at.thermal_energy
        found[slope_name(name)] = float(parts.sum())
        found[size_name(name)] = float(np.abs(parts).sum())
    set_energy = at.freedom * at.thermal_energy / 2
    found[MEAN_SQUARE] = float(at.step**2 * mean.squares / at.freedom / at.thermal_energy)
    found[BALANCE] = float(mean.kinetic + at.correction * at.step**2 * mean.squares - set_energy)
    return found | _responses(mean, with_volume, with_enthalpy, at, has_barostat=has_barostat)


def _heating(mean: _Samples, at: Conditions) -> float:
    """(T' - T)/T over dt², with the temperature T' of the shadow Hamiltonian, 1/ps²."""
    set_energy = at.freedom * at.thermal_energy / 2
    return float(mean.squares * (1 / 12 - at.correction) / set_energy)


def _compression(mean: _Samples, at: Conditions, hotter: float) -> float:
    """p' - p over dt², kJ/mol/nm³/ps², where the barostat holds the pressure p."""
    if at.reads_kinetic:
        return float(mean.of_forces / 12 / mean.volume)
    moving = at.moving * at.thermal_energy * hotter
    return float((moving + mean.of_forces / 36) / mean.volume)


def _responses(
    mean: _Samples,
    with_volume: _Samples,
    with_enthalpy: _Samples,
    at: Conditions,
    *,
    has_barostat: bool,
) -> dict[str, float]:
    """Response functions from fluctuations, with the part of the momenta as it is in theory."""
    thermal = at.thermal_energy
    momenta = 0.5 * GAS_CONSTANT * (3 * at.moving + at.rotation)
    of_enthalpy = at.count * with_enthalpy.potential + at.pressure * with_enthalpy.volume
    capacity = 1e3 * (momenta + of_enthalpy / thermal / at.temperature) / at.moving
    if not has_barostat:
        return {"c_v (J/(mol K))": float(capacity)}
    return {
        "c_p (J/(mol K))": float(capacity),
        "kappa_T (1/bar)": float(with_volume.volume / thermal / mean.volume * BAR_NM3),
        "alpha_p (1/K)": float(with_enthalpy.volume / thermal / at.temperature / mean.volume),
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
        fits = _fit_with_slopes(steps)
        for name, fit in zip(together, fits, strict=True):
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
    sizes = np.array([points[size_name(name)][k].mean for name in names])
    square = points[MEAN_SQUARE][k]
    return NEXT_TERM * square.mean * np.concatenate([square.timestep**2 * sizes, sizes])


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
