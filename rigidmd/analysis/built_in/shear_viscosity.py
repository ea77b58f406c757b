"""The viscosity, from the fluctuation of the pressure tensor (Green and Kubo)."""

import numpy as np
from scipy import optimize

from rigidmd.analysis.built_in.translation import MPA_S
from rigidmd.analysis.correlation import correlation
from rigidmd.analysis.registry import built_in
from rigidmd.analysis.result import AnalysisResult, Curve, Value, converged_value, describe_so_far
from rigidmd.analysis.rigid_frames import EVEN, RigidFrames
from rigidmd.errors import OutputError
from rigidmd.units import BAR

#: Number of segments of the tensor, and the least length of each, ps.
SEGMENTS, SHORTEST = 10, 2.0
#: Least points of a fit, and least correlation over one interval of the tensor: below it the trapezoidal rule is more
#: than 4 % too large, if the correlation is an exponential.
FEWEST, CLOSE = 8, 0.5
#: The fit ends where the standard error of the mean integral is this fraction of it. With 0.15 the noise of the tail
#: makes values 5 to 13% too large (400 ps, correlation times of 0.1 to 0.8 ps); with 0.05 fits of 0.4 ns end too early.
DOUBT = 0.08
#: Fraction of the integral that the second half of the fit may add, as an exponential does with 2.2 of its times there.
GROWS = 0.25
#: Bootstrap samples of the segments for the error of the fit.
DRAWS = 50


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
        raise OutputError(
            "a viscosity needs the pressure tensor: output.pressure_tensor_interval_ps = 0.01 suits water"
        )
    gaps = np.diff(frames.tensor[:, 0])
    interval = float(gaps.mean())
    if np.ptp(gaps) > EVEN * gaps.max():
        raise OutputError("a viscosity needs the pressure tensor at equal intervals")
    size = len(frames.tensor) // SEGMENTS
    if gaps.sum() + interval < SEGMENTS * SHORTEST:
        need = SEGMENTS * SHORTEST
        raise OutputError(
            f"a viscosity needs at least {need:g} ps of the pressure tensor; there are {gaps.sum():.3g} ps"
        )
    xx, yy, zz, xy, xz, yz = (frames.tensor[:, k] * BAR for k in range(1, 7))
    parts = np.stack([xy, xz, yz, (xx - yy) / 2, (yy - zz) / 2], axis=1)
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
    half_from = int(np.argmax(mean > 0.5 * mean.max()))
    wide = wide[wide > half_from]
    end = max(int(wide[0]) + 1 if len(wide) else lags, FEWEST)
    whole = _limit(time[:end], mean[:end], scatter[:end])
    random = np.random.default_rng(0)
    groups = running.reshape(SEGMENTS, 5, lags)
    resampled = []
    for _ in range(DRAWS):
        chosen = groups[random.integers(0, SEGMENTS, SEGMENTS)].reshape(-1, lags)
        again = _limit(time[:end], chosen.mean(axis=0)[:end], scatter[:end])
        if again is not None:
            resampled.append(again)
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
        note = (
            f"the integral of the stress correlation still grows after {time[end - 1]:.3g} ps, too short for a value; "
            f"a run of {4 * gaps.sum():.3g} ps follows it four times as far. "
            f"{describe_so_far(mean[end - 1], scatter[end - 1] / np.sqrt(len(running)), 'mPa s')}"
        )
        found.values.append(Value("viscosity", "mPa s", None, None, None, note))
        return found
    correlation_time = whole / factor / float(seen[:, 0].mean())  # integral over the value at 0
    note = f"fitted up to {time[end - 1]:.3g} ps"
    found.values.append(
        converged_value(
            "viscosity", "mPa s", whole, float(np.std(resampled)), float(gaps.sum()), correlation_time, note
        )
    )
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


def viscosity_of(frames: RigidFrames) -> Value:
    """The viscosity (mPa s), or a value with a note on why there is none."""
    try:
        return viscosity(frames).value()
    except OutputError as error:
        return Value("viscosity", "mPa s", None, None, None, str(error))
