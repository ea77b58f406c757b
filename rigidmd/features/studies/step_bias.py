"""What the time step does to the means of a run, to first order in dt², from its own fluctuations.

See "One run" in the theory chapter `zero_step`.
"""

from collections.abc import Iterator, Mapping
from math import ceil, hypot, isfinite, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.core.integrators import DRIFT, KICK
from rigidmd.core.quantities import MOTIONS, Quantity
from rigidmd.core.statistics import inefficiency, mean_and_error
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.forces.terms import trait
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

GAS_CONSTANT = BOLTZMANN / KJ_PER_MOL  # kJ/mol/K
BAR_NM3 = 1e3 * BAR / KJ_PER_MOL  # kJ/mol
#: Sums over translation and rotation in the log: squares of forces and torques.
SQUARES = ("force_squares", "torque_squares")
#: Blocks of a run that give errors of what fluctuations predict.
BLOCKS = 10
#: Minimum number of independent samples of a run whose fluctuations count.
LEAST_SAMPLES = 20.0
#: Largest mean (ω dt)² over the degrees of freedom with an estimate of first order.
LARGEST_SQUARE = 0.5
#: The fraction (ω dt)² of each part of a bias that its next term is taken to be: 1/4 in harmonic
#: motions of one frequency.
NEXT_TERM = 0.25
#: Shortest time constant of a thermostat of single molecules, in mean periods over 2π, at which it
#: leaves the motions in equilibrium.
LEAST_FRICTION_TIME = 10.0
#: Relative rounding error of columns.
ROUNDING = 1e-9
#: Reach of the correlation in time of motions with a column, in inefficiencies of the potential
#: energy.
MEMORY = 2.0


class Conditions(NamedTuple):
    """The state that a run samples, and its method; kJ/mol, nm³, ps, K."""

    step: float
    temperature: float
    pressure: float  # 0 at constant volume
    count: int  # of molecules
    moving: int  # of molecules that are not frozen
    freedom: tuple[int, int]  # degrees of freedom of translation and rotation
    drift_number: float  # of p U'' p in the shadow Hamiltonian, see `Scheme.shadow_correction`
    kick_number: float  # of F²/m, see `Scheme.shadow_squares`
    correction: float  # see `Scheme.kinetic_correction`
    has_barostat: bool = False
    reads_kinetic: bool = False  # the barostat
    rates: tuple[float, float] = (0.0, 0.0)  # see `scene.ensemble_methods.Thermostat.rates`
    friction: float = 0.0  # the largest rate of a thermostat of single molecules, 1/ps

    @property
    def thermal_energy(self) -> float:
        return GAS_CONSTANT * self.temperature

    @property
    def all_freedom(self) -> int:
        return sum(self.freedom)


def conditions(system: System, stage: Stage) -> Conditions | str:
    """The conditions of a stage, or why its step has no estimate."""
    scheme = stage.scheme.with_thermostat(())
    moving = [(flow.kind, flow.fraction) for flow in scheme.flows if flow.kind <= DRIFT]
    if stage.ensemble not in ("nvt", "npt"):
        return f"it is for nvt and npt, and the stage is {stage.ensemble}"
    if stage.ramps:
        return "temperature or pressure change during the stage"
    if stage.in_trajectories:
        return f"{stage.thermostat_kind} has no time-step error"
    if system.thermostat is not None or system.scene.engine.name != "rigidmd":
        return "it is for the thermostats of rigidmd"
    if stage.scheme.order != 2:
        return f"it is for integrators of order 2, and {stage.integrator} has {stage.scheme.order}"
    if driven := [name for name, term in system.terms.items() if trait(term, "time_dependent")]:
        return f"these forces depend on time: {', '.join(driven)}"
    if stage.has_barostat and (moving[0] != (KICK, 0.5) or len(moving) > 4):
        return (
            f"npt has it with velocity_verlet and baoab, and the integrator is {stage.integrator}"
        )
    if stage.has_barostat and stage.pressure_coupling not in (None, "isotropic"):
        return f"pressure_coupling is {stage.pressure_coupling!r}, not 'isotropic'"
    freedom = system.freedom_in(system.scene.stages.index(stage))
    counts = freedom.translation, freedom.rotation
    thermostat = stage.thermostat_method
    rates = thermostat.rates(stage.thermostat_values)
    strong = [rate for rate, count in zip(rates, counts, strict=True) if count]
    return Conditions(
        stage.step,
        stage.temperatures[0],
        stage.pressures[0][0] * BAR_NM3 if stage.has_barostat else 0.0,
        len(system.model.species),
        int(mobile(system.model).sum()),
        counts,
        scheme.shadow_correction,
        scheme.shadow_squares,
        scheme.kinetic_correction,
        stage.has_barostat,
        stage.has_barostat and stage.barostat_method.reads_momenta,
        rates if all(counts) else (0.0, 0.0),
        max(strong, default=0.0) if thermostat.on_molecules else 0.0,
    )


class Series(NamedTuple):
    """What the estimate reads of the samples (l,) of a run; kJ/mol, nm³, ps."""

    potential: np.ndarray
    volume: np.ndarray
    kinetic: tuple[np.ndarray, np.ndarray]  # of translation and rotation, where thermostats act
    squares: tuple[np.ndarray, np.ndarray]  # sum F²/m, sum n²/I
    curvature: np.ndarray  # NaN if the log has none
    interval: float

    @property
    def all_squares(self) -> np.ndarray:
        return self.squares[0] + self.squares[1]

    @property
    def mean_squares(self) -> tuple[float, float]:
        return float(self.squares[0].mean()), float(self.squares[1].mean())


def series_of(columns: Mapping[str, np.ndarray], at: Conditions) -> Series | str:
    """The series of samples, or what they lack."""
    if not all(np.isfinite(columns.get(name, np.nan)).all() for name in SQUARES):
        return "the log has no F^2/m and n^2/I, which runs of earlier versions lack"
    kinetic = [
        0.5 * count * GAS_CONSTANT * columns[f"temperature_{motion}"] if count else np.zeros(1)
        for count, motion in zip(at.freedom, MOTIONS, strict=True)
    ]
    time = columns["time"]
    zero = np.zeros(len(time))
    return Series(
        columns["potential"],
        columns["volume"] if at.has_barostat else zero,
        (zero + kinetic[0], zero + kinetic[1]),
        (columns[SQUARES[0]], columns[SQUARES[1]]),
        columns.get("curvature", zero + np.nan),
        float(time[-1] - time[0]) / max(1, len(time) - 1),
    )


#: Columns of `Moments.covariance`: with the potential energy, the volume, all squares, the
#: curvature; with the kinetic energies of translation and of rotation times `Conditions.rates`,
#: their difference and their sum, as integrals over the correlation in time.
POTENTIAL, VOLUME, ALL_SQUARES, CURVATURE, DIFFERENCE_IN_TIME, SUM_IN_TIME = range(6)


class Moments(NamedTuple):
    """Means over a part of a run of m columns, of squares of forces and of torques, and of the
    volume, and covariances of the columns with the series above."""

    mean: np.ndarray  # (m,)
    squares: tuple[float, float]
    volume: float
    covariance: np.ndarray  # (m, 6)


def moments_of_run(
    values: np.ndarray, series: Series, at: Conditions, rows: np.ndarray | None = None
) -> Iterator[Moments]:
    """Moments of columns (m, l) of a run, and of the run without each of its `BLOCKS` blocks.

    rows : (l,) the samples of the series to which the columns belong. Default: all
    """
    every = len(series.potential)
    rows = np.arange(every) if rows is None else rows
    length = len(rows) // BLOCKS
    reach = min(ceil(MEMORY * inefficiency(_centred(series.potential))), every // BLOCKS // 4)
    window = np.full(2 * reach + 1, 0.5 * series.interval)
    one, other = (rate * kinetic for rate, kinetic in zip(at.rates, series.kinetic, strict=True))
    drivers = [series.potential, series.volume, series.all_squares, series.curvature]
    drivers += [
        np.convolve(_centred(kinetic), window, "same") for kinetic in (one - other, one + other)
    ]
    keep = rows[-BLOCKS * length :]
    plain = np.array([*series.squares, series.volume])[:, keep].reshape(3, BLOCKS, length)
    x = _centred(np.array(drivers)[:, keep]).reshape(len(drivers), BLOCKS, length)
    values = values[:, -BLOCKS * length :]
    means = values.mean(axis=1)
    y = (values - means[:, None]).reshape(len(values), BLOCKS, length)
    products = np.einsum("ibl,jbl->bij", y, x) / length
    of_x, of_y, of_plain = x.mean(axis=2).T, y.mean(axis=2).T, plain.mean(axis=2).T
    hidden = of_y.T @ of_x / BLOCKS / (BLOCKS - 1)  # by the subtraction of means
    for omitted in (None, *range(BLOCKS)):
        weight = np.full(BLOCKS, 1 / BLOCKS)
        if omitted is not None:
            weight[:] = 1 / (BLOCKS - 1)
            weight[omitted] = 0.0
        shift = weight @ of_y
        covariance = np.tensordot(weight, products, 1) - np.outer(shift, weight @ of_x) + hidden
        force, torque, volume = (weight @ of_plain).tolist()
        yield Moments(means + shift, (force, torque), volume, covariance)


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean(axis=-1, keepdims=True)


class Slopes(NamedTuple):
    """d(mean)/d(dt²) of m columns, 1/ps², the summed sizes of its parts, and what samples at an
    interval miss of it."""

    value: np.ndarray
    size: np.ndarray
    missed: np.ndarray


def slopes(of: Moments, at: Conditions, gradients: ArrayLike) -> Slopes:
    """gradients : of columns, over the gradient of the potential energy; NaN where unknown"""
    thermal, covariance, gradient = at.thermal_energy, of.covariance, np.asarray(gradients)
    # the bias of the distribution: -cov(A, B)/kT
    by_parts = (at.drift_number + at.kick_number) * covariance[:, ALL_SQUARES]
    by_parts -= at.drift_number * gradient * thermal * sum(of.squares)
    by_momenta = at.drift_number * covariance[:, CURVATURE]
    by_momenta += at.kick_number * covariance[:, ALL_SQUARES]
    direct = -np.where(np.isnan(gradient), by_momenta, by_parts) / thermal
    # the shifts of temperatures
    enthalpy = covariance[:, POTENTIAL] + at.pressure * covariance[:, VOLUME]
    hotter = heating(of.squares, at)
    common, difference = 0.5 * (hotter[0] + hotter[1]), 0.5 * (hotter[0] - hotter[1])
    heat = (common * enthalpy + difference * covariance[:, DIFFERENCE_IN_TIME]) / thermal
    missed = difference * (enthalpy - covariance[:, SUM_IN_TIME]) / thermal / 2
    denser = compression(of, at, hotter[0]) if at.has_barostat else 0.0
    parts = [direct, heat, -denser * covariance[:, VOLUME] / thermal]
    return Slopes(np.sum(parts, axis=0), np.abs(parts).sum(axis=0), np.abs(missed))


def heating(squares: tuple[float, float], at: Conditions) -> tuple[float, float]:
    """(T' - T)/T over dt² of translation and rotation, with the temperatures T' of the shadow
    Hamiltonian, 1/ps²."""
    factor = 2 * (at.drift_number - at.correction) / at.thermal_energy
    pairs = zip(squares, at.freedom, strict=True)
    shifts = [factor * square / count for square, count in pairs if count]
    return (shifts[0], shifts[-1]) if shifts else (0.0, 0.0)


def compression(of: Moments, at: Conditions, hotter: float) -> float:
    """p' - p over dt², kJ/mol/nm³/ps², where the barostat holds the pressure p.

    hotter : of translation
    """
    if at.reads_kinetic:
        return of.squares[0] / 12 / of.volume
    return (at.moving * at.thermal_energy * hotter + of.squares[0] / 36) / of.volume


def mean_square(squares: tuple[float, float], at: Conditions) -> float:
    """Mean of (ω dt)² over the degrees of freedom, weighted by their parts of it."""
    size = sum(squares)
    pairs = zip(squares, at.freedom, strict=True)
    weighted = sum(square**2 / count for square, count in pairs if count)
    return at.step**2 * weighted / size / at.thermal_energy if size else 0.0


class Bias(NamedTuple):
    """Means of m columns less those at a step of zero, and errors: by sampling, and by what the
    first order leaves out."""

    value: np.ndarray
    sampling: np.ndarray
    next_order: np.ndarray

    @property
    def error(self) -> np.ndarray:
        return np.hypot(self.sampling, self.next_order)


def bias_of(
    values: np.ndarray,
    series: Series,
    at: Conditions,
    gradients: ArrayLike,
    rows: np.ndarray | None = None,
) -> Bias:
    """The bias of columns (m, l) that depend on positions, as in `moments_of_run` and `slopes`."""
    square = mean_square(series.mean_squares, at)
    found, *without = (slopes(of, at, gradients) for of in moments_of_run(values, series, at, rows))
    scatter = np.array([of.value for of in without]).std(axis=0) * sqrt(BLOCKS - 1)
    next_term = NEXT_TERM * square * found.size
    factor = at.step**2
    return Bias(factor * found.value, factor * scatter, factor * np.hypot(next_term, found.missed))


class Production(NamedTuple):
    """The samples of the production of a run, and its conditions."""

    at: Conditions
    series: Series
    columns: dict[str, np.ndarray]


def production(system: System, stage: Stage, columns: Mapping[str, np.ndarray]) -> Production | str:
    """The samples of a stage, or why the bias of its means is not known."""
    at = conditions(system, stage)
    if isinstance(at, str):
        return at
    curvature = columns.get("curvature", np.zeros(0))
    # no step has ended at the start of a run
    start = int(np.isnan(curvature[:1]).any() and np.isfinite(curvature[1:]).all())
    columns = {name: values[start:] for name, values in columns.items()}
    if len(columns["time"]) < 2:
        return "there are no samples"
    series = series_of(columns, at)
    if isinstance(series, str):
        return series
    if reason := beyond_first_order(series, at):
        return reason
    potential = _centred(series.potential)
    if not len(potential) >= max(2 * BLOCKS, LEAST_SAMPLES * inefficiency(potential)):
        return f"the run has fewer than {LEAST_SAMPLES:g} independent samples"
    return Production(at, series, dict(columns))


def beyond_first_order(series: Series, at: Conditions) -> str:
    """Why the first order is not enough for a run. Empty if it is."""
    square = mean_square(series.mean_squares, at)
    if not square > 0:
        return "no forces act on what moves"
    if square > LARGEST_SQUARE:
        return (
            f"the step is too long: the mean of (ω dt)² is {square:.2g}, and the estimate is for at"
            f" most {LARGEST_SQUARE:g}"
        )
    if at.friction * at.step > sqrt(square) / LEAST_FRICTION_TIME:
        return (
            f"the thermostat relaxes kinetic energy at {at.friction:g}/ps, too strong for"
            " motions in equilibrium"
        )
    return ""


def biases(
    system: System, stage: Stage, columns: Mapping[str, np.ndarray]
) -> dict[str, tuple[float, float, float]] | str:
    """Means of columns of the log less those at a step of zero, their errors, and the errors of the
    means at zero, by name, or why they are not known."""
    run = production(system, stage, columns)
    return run if isinstance(run, str) else biases_of(run, system.quantities)


def biases_of(
    run: Production, quantities: Mapping[str, Quantity]
) -> dict[str, tuple[float, float, float]]:
    """The same of the samples of a run."""
    names, values, gradients, of_momenta = [], [], [], []
    for name, row in quantities.items():
        column = run.columns.get(name, np.full(1, np.nan))
        if not row.is_averaged or row.of_tensor or not np.isfinite(column).all():
            continue
        momenta = kinetic_part(row, run)
        rest = column - momenta
        # not what does not vary, nor what is kinetic energy alone, whose mean is exact at zero
        if np.ptp(rest) > ROUNDING * max(np.ptp(column), np.abs(column).max()):
            names.append(name)
            values.append(rest)
            gradients.append(row.gradient)
            of_momenta.append((float(momenta.mean()), mean_and_error(momenta)[1] or 0.0))
    if not names:
        return {}
    bias = bias_of(np.array(values), run.series, run.at, gradients)
    rows = zip(names, values, bias.value, bias.error.tolist(), of_momenta, strict=True)
    found = {}
    for name, rest, value, error, (mean, uncertain) in rows:
        of_rest = mean_and_error(rest)[1]
        if isfinite(value) and of_rest is not None:
            found[name] = float(value) + mean, hypot(error, uncertain), hypot(error, of_rest)
    return found


def kinetic_part(quantity: Quantity, run: Production) -> np.ndarray:
    """The kinetic energy (l,) in a quantity of the log, less its mean at a step of zero for the
    same positions."""
    at, series = run.at, run.series
    part = np.zeros(len(series.potential))
    motions = [k for k, motion in enumerate(MOTIONS) if motion in quantity.kinetic]
    for k in motions:
        off = series.kinetic[k] - at.freedom[k] * at.thermal_energy / 2
        if quantity.unit == "K":
            part += off * 2 / GAS_CONSTANT / sum(at.freedom[k] for k in motions)
        elif quantity.unit == "bar":  # of all molecules, also where the momentum is kept at zero
            of_all = 3 * at.moving / max(1, at.freedom[k])
            part += off * of_all * 2 / 3 / run.columns["volume"] / BAR_NM3
        else:  # at the ends of steps
            part += off - at.correction * at.step**2 * series.squares[k]
    return part
