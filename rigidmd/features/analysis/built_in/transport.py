"""Correlation functions. Mean squared displacement, diffusion and viscosity, each with its
error."""

from typing import Annotated

import numpy as np
from scipy import fft

from rigidmd.errors import OutputError
from rigidmd.features.analysis.conditions import box, equilibrium, motion, trajectory
from rigidmd.features.analysis.options import Limits
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.relaxation import Relaxations, integral_of, longest_time
from rigidmd.features.analysis.result import (
    BLOCKS,
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    too_short,
    with_group_error,
)
from rigidmd.features.analysis.rigid_frames import EVEN, RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.run.rigid_fit import Kind
from rigidmd.scene.validation import not_none
from rigidmd.units import BAR

AT_ONCE = 4_000_000  # numbers that are transformed at a time


def correlation(series: np.ndarray, lags: int) -> np.ndarray:
    """<x(0) x(t)> at the first `lags` lags, mean over origins and over all series (f, ...)
    together."""
    frames = len(series)
    flat = series.reshape(frames, -1)
    size = int(fft.next_fast_len(frames + lags, real=True) or 0)
    power = np.zeros(size // 2 + 1)
    chunk = max(1, AT_ONCE // size)
    for first in range(0, flat.shape[1], chunk):
        transform = np.asarray(fft.rfft(flat[:, first : first + chunk], size, axis=0))
        real, imaginary = np.real(transform), np.imag(transform)
        power += np.einsum("fm,fm->f", real, real) + np.einsum("fm,fm->f", imaginary, imaginary)
    return np.asarray(fft.irfft(power, size))[:lags] / (frames - np.arange(lags)) / flat.shape[1]


def squared_displacement(path: np.ndarray, lags: int) -> np.ndarray:
    """<|x(t) - x(0)|²> at the first `lags` lags, mean over origins and molecules. Path (f, n, d).
    From sums of squares and the correlation of positions (Calandrini et al. 2011, Collection SFN
    12, 201)."""
    path = path - path.mean(axis=0)
    squares = np.einsum("fnd,fnd->f", path, path)
    n = path.shape[1]
    frames = len(path)
    before, after = np.cumsum(squares), np.cumsum(squares[::-1])
    lag = np.arange(lags)
    both = (before[frames - 1 - lag] + after[frames - 1 - lag]) / (frames - lag) / n
    return np.maximum(both - 2 * correlation(path, lags) * path.shape[2], 0.0)


FIT_FROM, FIT_TO = 0.1, 0.5  # lags that are fitted, as fractions of a block
BEND = (
    0.1  # relative change of the slope of the displacement above which molecules do not diffuse yet
)
#: Yeh & Hummer 2004, J. Phys. Chem. B 108, 15873: cubic boxes.
YEH_HUMMER = 2.837297
#: One mPa s in u/(Å ps), and 1e-9 m²/s in Å²/ps.
MPA_S = BAR * 1e4
NM2_PER_S = 0.1


def interval_and_lags(runs: Runs, what: str) -> tuple[float, int]:
    """Interval between frames (ps) and number of lags for a correlation function: half a block of
    all frames, and at most half of a run. Raises OutputError."""
    if runs.interval is None:
        gaps = np.concatenate([np.diff(run.time) for run in runs.members])
        raise OutputError(
            f"{what} needs frames at equal intervals. These are {gaps.min():g} to {gaps.max():g} ps"
        )
    lags = int(min(runs.frame_count // BLOCKS, runs.shortest) * FIT_TO) + 1
    if lags < 3:
        raise OutputError(
            f"{what} needs at least {4 * BLOCKS} frames; there are {runs.frame_count}"
        )
    return runs.interval, lags


def _displacement(runs: Runs, kind: Kind, lags: int) -> tuple[np.ndarray, np.ndarray]:
    """`squared_displacement` of a species, with its error."""
    return with_group_error(
        runs, kind, lambda part, group: squared_displacement(part.paths[:, group.index], lags)
    )


@built_in(
    "mean squared displacement of the centres of mass", position=50, needs=(trajectory, motion)
)
def msd(runs: Runs) -> AnalysisResult:
    """Mean squared displacement (Å²) of each species against time, all origins, up to a tenth of
    the frames.

    Paths continue through the faces of the box, without the scaling by a barostat."""
    interval, lags = interval_and_lags(runs, "a mean squared displacement")
    time = ("Time (ps)", interval * np.arange(lags))
    curve = Curve("msd", time, "MSD (Å²)", {}, log=(True, True), power=1.0)
    for kind in runs.moving:
        curve.add(f"MSD {kind.name} (A^2)", *_displacement(runs, kind, lags))
    return AnalysisResult("msd", "mean squared displacement", curves=[curve])


def _in_infinite_box(runs: Runs, value: Value, eta: Value, edge: float, is_measured: bool) -> Value:
    """The diffusion coefficient without the effect of the periodic images (Yeh and Hummer 2004),
    from that in a cubic box.

    edge : of the box, Å; is_measured : whether the viscosity is of these runs
    """
    name = f"{value.name} in an infinite box"
    if eta.value is None:
        note = f"no correction for the size of the box without a viscosity: {eta.note}"
        return Value(name, "1e-9 m²/s", None, None, None, note)
    correction = (
        YEH_HUMMER * runs.thermal_energy / (6 * np.pi * eta.value * MPA_S * edge) / NM2_PER_S
    )
    source = "measured here" if is_measured else "as given, without its error"
    note = (
        f"corrected by {correction:.3g} for L = {edge:.4g} Å with a viscosity of"
        f" {eta.value:.3g} mPa s, {source}"
    )
    doubt = correction * (eta.error or 0.0) / eta.value
    both = None if value.error is None else float(np.hypot(value.error, doubt))
    return value._replace(
        name=name, value=not_none(value.value) + correction, error=both, note=note
    )


@built_in(
    "diffusion coefficient, with the correction for the size of the box",
    position=60,
    needs=(trajectory, motion),
)
def diffusion(
    runs: Runs, viscosity_mPa_s: Annotated[float, Limits(1e-6, 1e12)] | None = None
) -> AnalysisResult:
    """D for each species (1e-9 m²/s) from the slope of its mean squared displacement, and D in an
    infinite box.

    Parameters
    ----------
    viscosity_mPa_s : float, optional
        Viscosity for the correction of Yeh and Hummer, mPa s. Default: from the pressure tensor of
        the run, if any
    """
    interval, lags = interval_and_lags(runs, "a diffusion coefficient")
    first = max(1, int((lags - 1) * FIT_FROM / FIT_TO))
    time = interval * np.arange(first, lags)
    if len(time) < 4:
        raise OutputError(
            f"a diffusion coefficient needs at least {8 * BLOCKS} frames; there are"
            f" {runs.frame_count}"
        )

    half = len(time) // 2

    def slopes(part: RigidFrames, kind: Kind) -> np.ndarray:
        displacement = squared_displacement(part.paths[:, kind.index], lags)[first:]
        slope, first_half, second_half = (
            np.polyfit(time[part], displacement[part], 1)[0]
            for part in (slice(None), slice(half), slice(half, None))
        )
        return np.array([slope, second_half - first_half]) / 6

    later = interval * np.arange(1, lags)
    curve = Curve("diffusion", ("Time (ps)", later), "MSD/6t (1e-9 m²/s)", {})  # it tends to D
    result = AnalysisResult("diffusion", "diffusion coefficients", curves=[curve])
    result.notes.append(
        f"slope of the mean squared displacement from {time[0]:.3g} to {time[-1]:.3g} ps"
    )
    edge = None  # of a cubic box
    # over which a molecule has to move to change its surroundings
    distance = runs.system.smallest_diameter
    if runs.has_box:
        distance = float((runs.volume / len(runs.system.model.species)) ** (1 / 3))
        cell = runs.mean_cell
        if np.abs(cell - cell[0, 0] * np.eye(3)).max() < 0.01 * cell[0, 0]:
            edge = float(cell[0, 0])
    eta = Value("viscosity", "mPa s", viscosity_mPa_s, None)
    if viscosity_mPa_s is None:
        try:
            eta = viscosity(runs).value()
        except OutputError as error:
            eta = eta._replace(note=str(error))
    for kind in runs.moving:
        so_far = (
            values[1:] / (6 * NM2_PER_S * later) for values in _displacement(runs, kind, lags)
        )
        curve.add(f"MSD/6t {kind.name} (1e-9 m^2/s)", *so_far)
        name = f"D of {kind.name}"
        (D, bend), (error, doubt) = np.array(with_group_error(runs, kind, slopes)).tolist()
        if D <= 0 or abs(bend) > BEND * D + 2 * np.nan_to_num(doubt):
            why = (
                f"the slope of its displacement changes from {time[0]:.3g} to {time[-1]:.3g} ps,"
                f" too short for a value. A run of {4 * runs.span:.3g} ps follows it four times"
                " as far"
            )
            result.values.append(
                too_short(name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, why)
            )
            continue
        away = distance**2 / (6 * D)
        value = converged_value(
            name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, runs.span, away, least=BLOCKS
        )
        result.values.append(value)
        if value.value is not None and edge is not None:
            result.values.append(_in_infinite_box(runs, value, eta, edge, viscosity_mPa_s is None))
    if edge is None and runs.has_box:
        result.notes.append(
            "no correction for the size of the box: the Yeh-Hummer correction is for cubic boxes"
        )
    return result


LEAST_TENSOR = 20.0  # least length of the pressure tensor of all runs, ps
#: Number of segments whose integrals are shown, and least correlation over one interval of the
#: tensor: below it the trapezoidal rule is more than 4 % too large, if the correlation is an
#: exponential.
SEGMENTS, CLOSE = 10, 0.5
#: Largest relative error of a viscosity, and its longest relaxation time as a fraction of the
#: longest of a fit.
LARGEST_DOUBT, LONGEST_SEEN = 0.5, 0.9
#: The integral is shown up to this multiple of the longest relaxation time.
SHOWN_TIMES = 6.0
COMPONENTS = 5


@built_in(
    "viscosity from the pressure tensor, by Green and Kubo",
    position=100,
    needs=(box, motion, equilibrium),
)
def viscosity(runs: Runs) -> AnalysisResult:
    """Shear viscosity (mPa s): V/kT times the time integral over the autocorrelation of five
    independent pressure components (output.pressure_tensor_interval_ps).

    The integral is half the spectral density at frequency 0, from a fit of relaxations to the
    periodogram (`features.analysis.relaxation`). It has no time at which it would be cut off. The
    error follows from the likelihood and from the choice of the model."""
    stresses = [_stresses(run) for run in runs.members]
    interval = _interval_of(runs)
    length = interval * sum(map(len, stresses))
    if length < LEAST_TENSOR:
        raise OutputError(
            f"a viscosity needs at least {LEAST_TENSOR:g} ps of the pressure tensor; there are"
            f" {length - interval * len(stresses):.3g} ps"
        )
    factor = runs.volume / runs.thermal_energy / MPA_S
    start = np.mean([correlation(stress, 2) for stress in stresses], axis=0)
    limit = integral_of(stresses, interval) if start[1] > CLOSE * start[0] else None
    if limit is None:
        raise OutputError(
            f"an interval of {interval:.3g} ps of the pressure tensor is too long for a viscosity:"
            " stresses decay in it. output.pressure_tensor_interval_ps = 0.01 suits water"
        )
    slowest = float(limit.best.times.max())
    lags = int(max(8, min(SHOWN_TIMES * slowest / interval, min(map(len, stresses)) // 2)))
    result = AnalysisResult(
        "viscosity", "viscosity", curves=_curves_of(stresses, interval, lags, factor, limit.best)
    )
    value, error = factor * limit.value, factor * limit.error
    longest = longest_time(runs=len(stresses), length=interval * min(map(len, stresses)))
    if slowest > LONGEST_SEEN * longest or error > LARGEST_DOUBT * value:
        why = (
            f"the integral of the stress correlation still grows after {longest:.3g} ps, too short"
            f" for a value. A run of {4 * (length - interval * len(stresses)):.3g} ps follows it"
            " four times as far"
        )
        result.values.append(too_short("viscosity", "mPa s", value, error, why))
        return result
    tau = limit.value / float(start[0])  # integral over the value at 0
    note = (
        f"relaxation times up to {slowest:.2g} ps, from the spectrum below {limit.highest:.3g}/ps"
    )
    result.values.append(converged_value("viscosity", "mPa s", value, error, length, tau, note))
    return result


def _stresses(frames: RigidFrames) -> np.ndarray:
    """Five independent components of the stress (l, 5) whose means are 0, u/(Å ps²). Raises
    OutputError."""
    if frames.tensor is None or len(frames.tensor) < 2:
        advice = "set output.pressure_tensor_interval_ps = 0.01, which suits water"
        raise OutputError(
            f"a viscosity needs the pressure tensor, which this run did not write: {advice}"
        )
    xx, yy, zz, xy, xz, yz = (frames.tensor[:, k] * BAR for k in range(1, 7))
    return np.stack([xy, xz, yz, (xx - yy) / 2, (yy - zz) / 2], axis=1)


def _interval_of(runs: Runs) -> float:
    """Time between lines of the pressure tensor, ps. Raises OutputError if it varies."""
    gaps = np.concatenate(
        [np.diff(run.tensor[:, 0]) for run in runs.members if run.tensor is not None]
    )
    if np.ptp(gaps) > EVEN * gaps.max():
        raise OutputError("a viscosity needs the pressure tensor at equal intervals")
    return float(gaps.mean())


def _curves_of(
    stresses: list[np.ndarray], interval: float, lags: int, factor: float, model: Relaxations
) -> list[Curve]:
    """The running integral with its error from segments of all runs, the integral of a model, and
    the correlation."""
    each = -(-SEGMENTS // len(stresses))  # segments of a run
    parts = [part for stress in stresses for part in np.array_split(stress, each)]
    lags = min(lags, min(map(len, parts)) // 2)
    correlations = np.array(
        [correlation(part[:, k], lags) for part in parts for k in range(COMPONENTS)]
    )
    ends = 0.5 * (correlations + correlations[:, :1])  # by the trapezoidal rule
    running = factor * interval * (np.cumsum(correlations, axis=1) - ends)
    time = interval * np.arange(lags)
    title = "integral (mPa s)"
    columns = {title: running.mean(axis=0), "fit (mPa s)": factor * model.integral(time)}
    errors = {title: running.std(axis=0, ddof=1) / np.sqrt(len(running))}
    memory = {"correlation": correlations.mean(axis=0) / correlations[:, 0].mean()}
    return [
        Curve("viscosity", ("Time (ps)", time), "viscosity (mPa s)", columns, errors),
        Curve(
            "stress_correlation", ("Time (ps)", time), "correlation of stress", memory, level=0.0
        ),
    ]
