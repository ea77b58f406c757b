"""Correlation functions; mean squared displacement, diffusion and viscosity, each with its error."""

from typing import Any

import numpy as np
from scipy import fft, optimize

from rigidmd.analysis.registry import built_in
from rigidmd.analysis.result import BLOCKS, AnalysisResult, Curve, Value, converged_value, too_short, with_group_error
from rigidmd.analysis.rigid_frames import EVEN, RigidFrames
from rigidmd.errors import OutputError
from rigidmd.run.rigid_fit import Kind
from rigidmd.units import BAR

AT_ONCE = 4_000_000  # numbers that are transformed at a time


def correlation(series: np.ndarray, lags: int) -> np.ndarray:
    """<x(0) x(t)> at the first `lags` lags, mean over origins and over all series (f, ...) together."""
    frames = len(series)
    flat = series.reshape(frames, -1)
    size = int(fft.next_fast_len(frames + lags, True) or 0)
    power = np.zeros(size // 2 + 1)
    chunk = max(1, AT_ONCE // size)
    for first in range(0, flat.shape[1], chunk):
        found: Any = fft.rfft(flat[:, first : first + chunk], size, axis=0)
        power += np.einsum("fm,fm->f", found.real, found.real) + np.einsum("fm,fm->f", found.imag, found.imag)
    return np.asarray(fft.irfft(power, size))[:lags] / (frames - np.arange(lags)) / flat.shape[1]


def squared_displacement(path: np.ndarray, lags: int) -> np.ndarray:
    """<|x(t) - x(0)|²> at the first `lags` lags, mean over origins and molecules; path (f, n, d). From sums of squares
    and the correlation of positions (Calandrini et al. 2011, Collection SFN 12, 201)."""
    path = path - path.mean(axis=0)
    squares = np.einsum("fnd,fnd->f", path, path)
    n, frames = path.shape[1], len(path)
    before, after = np.cumsum(squares), np.cumsum(squares[::-1])
    lag = np.arange(lags)
    both = (before[frames - 1 - lag] + after[frames - 1 - lag]) / (frames - lag) / n
    return np.maximum(both - 2 * correlation(path, lags) * path.shape[2], 0.0)


FIT_FROM, FIT_TO = 0.1, 0.5  # lags that are fitted, as fractions of a block
BEND = 0.1  # relative change of the slope of the displacement above which molecules do not diffuse yet
#: Yeh & Hummer 2004, J. Phys. Chem. B 108, 15873: cubic boxes.
YEH_HUMMER = 2.837297
#: One mPa s in u/(Å ps), and 1e-9 m²/s in Å²/ps.
MPA_S, NM2_PER_S = BAR * 1e4, 0.1


def interval_and_lags(frames: RigidFrames, what: str) -> tuple[float, int]:
    """Interval between frames (ps) and number of lags for a correlation function: half a block. Raises OutputError."""
    if frames.interval is None:
        gaps = np.diff(frames.time)
        raise OutputError(f"{what} needs frames at equal intervals; these are {gaps.min():g} to {gaps.max():g} ps")
    lags = int(len(frames) // BLOCKS * FIT_TO) + 1
    if lags < 3:
        raise OutputError(f"{what} needs at least {4 * BLOCKS} frames; there are {len(frames)}")
    return frames.interval, lags


@built_in("mean squared displacement of the centres of mass", position=50)
def msd(frames: RigidFrames) -> AnalysisResult:
    """Mean squared displacement (Å²) of each species against time, all origins, up to half a fifth of the frames. Paths
    continue through the faces of the box, without the scaling by a barostat. Raises OutputError."""
    interval, lags = interval_and_lags(frames, "a mean squared displacement")
    curve = Curve("msd", ("Time (ps)", interval * np.arange(lags)), "MSD (Å²)", {}, log=(True, True))
    for kind in frames.moving:
        found = with_group_error(
            frames, kind, lambda part, group: squared_displacement(part.paths[:, group.index], lags)
        )
        curve.add(f"MSD {kind.name} (A^2)", *found)
    return AnalysisResult("msd", "mean squared displacement", curves=[curve])


@built_in("diffusion coefficient, with the correction for the size of the box", position=60)
def diffusion(frames: RigidFrames, viscosity_mPa_s: float | None = None) -> AnalysisResult:
    """D of each species (1e-9 m²/s) from the slope of its mean squared displacement, and D of an infinite box.

    viscosity_mPa_s : for the correction of Yeh and Hummer; default: from the pressure tensor of the run, if any
    Raises OutputError.
    """
    if viscosity_mPa_s is not None and not 0 < viscosity_mPa_s < np.inf:
        raise OutputError(f"viscosity_mPa_s must be a number above 0, not {viscosity_mPa_s:g}")
    interval, lags = interval_and_lags(frames, "a diffusion coefficient")
    first = max(1, int(len(frames) // BLOCKS * FIT_FROM))
    time = interval * np.arange(first, lags)
    if len(time) < 4:
        raise OutputError(f"a diffusion coefficient needs at least {8 * BLOCKS} frames; there are {len(frames)}")

    half = len(time) // 2

    def slopes(part: RigidFrames, kind: Kind) -> np.ndarray:
        seen = squared_displacement(part.paths[:, kind.index], lags)[first:]
        whole, first_half, second_half = (
            np.polyfit(time[part], seen[part], 1)[0] for part in (slice(None), slice(half), slice(half, None))
        )
        return np.array([whole, second_half - first_half]) / 6

    later = interval * np.arange(1, lags)
    curve = Curve("diffusion", ("Time (ps)", later), "MSD/6t (1e-9 m²/s)", {})  # it tends to D
    found = AnalysisResult("diffusion", "diffusion coefficients", curves=[curve])
    found.notes.append(f"slope of the mean squared displacement from {time[0]:.3g} to {time[-1]:.3g} ps")
    edge = None  # of a cubic box
    distance = frames.system.smallest_diameter  # over which a molecule has to move to change its surroundings
    if frames.has_box:
        distance = float((frames.volume.mean() / len(frames.system.model.species)) ** (1 / 3))
        cell = frames.cell.mean(axis=0)
        if np.abs(cell - cell[0, 0] * np.eye(3)).max() < 0.01 * cell[0, 0]:
            edge = float(cell[0, 0])
    eta = Value("viscosity", "mPa s", viscosity_mPa_s, None)
    if viscosity_mPa_s is None:
        try:
            eta = viscosity(frames).value()
        except OutputError as error:
            eta = eta._replace(note=str(error))
    for kind in frames.moving:
        seen = with_group_error(
            frames, kind, lambda part, group: squared_displacement(part.paths[:, group.index], lags)
        )
        so_far = (values[1:] / (6 * NM2_PER_S * later) for values in seen)
        curve.add(f"MSD/6t {kind.name} (1e-9 m^2/s)", *so_far)
        name = f"D of {kind.name}"
        (D, bend), (error, doubt) = np.array(with_group_error(frames, kind, slopes)).tolist()
        if D <= 0 or abs(bend) > BEND * D + 2 * np.nan_to_num(doubt):
            why = (
                f"the slope of its displacement changes from {time[0]:.3g} to {time[-1]:.3g} ps, too short for a "
                f"value; a run of {4 * frames.span:.3g} ps follows it four times as far"
            )
            found.values.append(too_short(name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, why))
            continue
        away = distance**2 / (6 * D)
        value = converged_value(name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, frames.span, away, least=BLOCKS)
        found.values.append(value)
        if value.value is None or edge is None:
            continue
        name = f"D of {kind.name} in an infinite box"
        if eta.value is None:
            note = f"no correction for the size of the box without a viscosity: {eta.note}"
            found.values.append(Value(name, "1e-9 m²/s", None, None, None, note))
            continue
        more = YEH_HUMMER * frames.thermal_energy / (6 * np.pi * eta.value * MPA_S * edge) / NM2_PER_S
        source = "from this run" if viscosity_mPa_s is None else "as given, without its error"
        note = f"corrected by {more:.3g} for L = {edge:.4g} Å with a viscosity of {eta.value:.3g} mPa s, {source}"
        doubt = more * (eta.error or 0.0) / eta.value
        both = None if value.error is None else float(np.hypot(value.error, doubt))
        found.values.append(value._replace(name=name, value=value.value + more, error=both, note=note))
    if edge is None and frames.has_box:
        found.notes.append("no correction for the size of the box: the one of Yeh and Hummer is for cubic boxes")
    return found


SEGMENTS, SHORTEST = 10, 2.0  # number of segments of the tensor, and the least length of each, ps
#: Least points of a fit, and least correlation over one interval of the tensor: below it the trapezoidal rule is more
#: than 4 % too large, if the correlation is an exponential.
FEWEST, CLOSE = 8, 0.5
#: The fit ends where the standard error of the mean integral is this fraction of it. With 0.15 the noise of the tail
#: makes values 5 to 13% too large (400 ps, correlation times of 0.1 to 0.8 ps); with 0.05 fits of 0.4 ns end too early.
DOUBT = 0.08
#: Fraction of the integral that the second half of the fit may add, as an exponential does with 2.2 of its times there.
GROWS = 0.25
DRAWS = 50  # bootstrap samples of the segments for the error of the fit


@built_in("viscosity from the pressure tensor, by Green and Kubo", position=100)
def viscosity(frames: RigidFrames) -> AnalysisResult:
    """Shear viscosity (mPa s): V/kT times the integral of the correlation of five independent components of the
    pressure tensor (output.pressure_tensor_interval_ps).

    Integrals of ten segments are averaged; A a (1 - exp(-t/a)) + B b (1 - exp(-t/b)) is fitted, each point weighted by
    its scatter, and its limit is the value (Zhang, Otani & Maginn 2015, J. Chem. Theory Comput. 11, 3537). The error is
    from a bootstrap of the segments. Raises OutputError.
    """
    if not frames.has_box:
        raise OutputError("a viscosity needs a box")
    if frames.tensor is None or len(frames.tensor) < 2:
        advice = "output.pressure_tensor_interval_ps = 0.01 suits water"
        raise OutputError(f"a viscosity needs the pressure tensor: {advice}")
    gaps = np.diff(frames.tensor[:, 0])
    interval = float(gaps.mean())
    if np.ptp(gaps) > EVEN * gaps.max():
        raise OutputError("a viscosity needs the pressure tensor at equal intervals")
    if gaps.sum() + interval < SEGMENTS * SHORTEST:
        least, have = f"{SEGMENTS * SHORTEST:g} ps", f"{gaps.sum():.3g} ps"
        raise OutputError(f"a viscosity needs at least {least} of the pressure tensor; there are {have}")
    xx, yy, zz, xy, xz, yz = (frames.tensor[:, k] * BAR for k in range(1, 7))
    parts = np.stack([xy, xz, yz, (xx - yy) / 2, (yy - zz) / 2], axis=1)
    size = len(frames.tensor) // SEGMENTS
    lags = size // 2
    factor = float(frames.volume.mean()) / frames.thermal_energy / MPA_S
    segments = parts[: size * SEGMENTS].reshape(SEGMENTS, size, 5)
    seen = np.array([[correlation(one[:, k], max(2, lags)) for k in range(5)] for one in segments])
    seen = seen.reshape(-1, max(2, lags))
    if lags < FEWEST or seen[:, 1].sum() < CLOSE * seen[:, 0].sum():
        raise OutputError(
            f"an interval of {interval:.3g} ps of the pressure tensor is too long for a viscosity: stresses decay "
            "in it; output.pressure_tensor_interval_ps = 0.01 suits water"
        )
    running = factor * interval * (np.cumsum(seen, axis=1) - 0.5 * (seen + seen[:, :1]))
    time = interval * np.arange(lags)
    mean, scatter = running.mean(axis=0), running.std(axis=0, ddof=1)
    wide = np.flatnonzero(scatter[1:] > DOUBT * np.sqrt(len(running)) * np.abs(mean[1:]))
    wide = wide[wide > int(np.argmax(mean > 0.5 * mean.max()))]
    end = max(int(wide[0]) + 1 if len(wide) else lags, FEWEST)
    whole = _limit(time[:end], mean[:end], scatter[:end])
    random = np.random.default_rng(0)
    groups = running.reshape(SEGMENTS, 5, lags)
    resampled = []
    for _ in range(DRAWS):
        chosen = groups[random.integers(0, SEGMENTS, SEGMENTS)].reshape(-1, lags)
        again = _limit(time[:end], chosen.mean(axis=0)[:end], scatter[:end])
        resampled += [] if again is None else [again]
    found = AnalysisResult("viscosity", "viscosity")
    memory = seen.mean(axis=0) / seen[:, 0].mean()
    axis, title = ("Time (ps)", time[:end]), "integral (mPa s)"
    errors = {title: scatter[:end] / np.sqrt(len(running))}
    found.curves += [
        Curve("viscosity", axis, "viscosity (mPa s)", {title: mean[:end]}, errors),
        Curve("stress_correlation", axis, "correlation of stress", {"correlation": memory[:end]}, level=0.0),
    ]
    grows = float(mean[end - 1] - mean[end // 2]) > GROWS * float(mean[end - 1])
    if whole is None or grows or len(resampled) < DRAWS // 2:
        why = (
            f"the integral of the stress correlation still grows after {time[end - 1]:.3g} ps, too short for a value; "
            f"a run of {4 * gaps.sum():.3g} ps follows it four times as far"
        )
        error = float(scatter[end - 1] / np.sqrt(len(running)))
        found.values.append(too_short("viscosity", "mPa s", float(mean[end - 1]), error, why))
        return found
    tau = whole / factor / float(seen[:, 0].mean())  # integral over the value at 0
    note, error = f"fitted up to {time[end - 1]:.3g} ps", float(np.std(resampled))
    found.values.append(converged_value("viscosity", "mPa s", whole, error, float(gaps.sum()), tau, note))
    return found


def _limit(time: np.ndarray, values: np.ndarray, scatter: np.ndarray) -> float | None:
    """Limit of a running integral by a fit of two exponentials; None where the fit fails."""
    top, longest = float(np.max(values)), float(time[-1]) / 2  # longer times would be fits to noise
    if not top > 0:
        return None

    def model(t, first, second, fast, slow):
        return first * (1 - np.exp(-t / fast)) + second * (1 - np.exp(-t / slow))

    start = (0.4 * top, 0.6 * top, longest / 50, longest / 5)
    bounds = ([0, 0, time[1] / 10, time[1] / 10], [3 * top, 3 * top, longest, longest])
    try:
        best, _ = optimize.curve_fit(model, time[1:], values[1:], start, scatter[1:], bounds=bounds)
    except (RuntimeError, ValueError):
        return None
    return float(best[0] + best[1])
