"""How molecules turn and shake: orientational correlation, rotational diffusion, spectra; from Q, L and V."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import signal

from rigidmd.analysis.correlation import correlation, squared_displacement
from rigidmd.analysis.findings import BLOCKS, LEAST_EACH, Curve, Finding, Value, over_parts, settled, so_far
from rigidmd.analysis.history import History
from rigidmd.analysis.registry import built_in
from rigidmd.analysis.translation import evenly
from rigidmd.errors import OutputError
from rigidmd.mechanics.inertia import rotational_freedom
from rigidmd.run.rigid_fit import Kind

#: Correlation below which the integral of a correlation function ends; what follows is an exponential.
TAIL = 0.05
#: Correlation at the longest lag above which there is no value: too much of the integral would be that exponential.
HIGH = 0.2
#: And up to which that lag tells when it will have decayed.
SLOWEST = 0.98
#: rad: largest turn between two frames, root mean square, at which turns about the body's axes can be added up.
LARGEST_TURN = 0.7
#: Correlation of a velocity over one interval of frames below which these are too far apart for a spectrum.
CLOSE = 0.5
#: 1/cm in 1/ps.
PER_CM = 0.0299792458


def _turning(history: History) -> list[Kind]:
    found = [kind for kind in history.moving if kind.molecule.degrees_of_freedom > 3]
    if not found:
        raise OutputError("no molecule of this run turns")
    return found


def _axes(kind: Kind) -> list[int]:
    """Body axes whose direction says something: of a linear molecule its own."""
    return [0] if rotational_freedom(kind.molecule.kind) == 2 else [0, 1, 2]


@built_in("orientational correlation C1 and C2 about each body axis, and rotational diffusion")
def orientation(history: History) -> Finding:
    """C_l(t) = <P_l(u(0)·u(t))>, l = 1, 2, of the body's principal axes u, their correlation times (ps), and the
    rotational diffusion about each axis (1/ps).

    Axes are those of `rigidmd models NAME`, ascending in inertia; of a linear molecule there is one. Rotational
    diffusion is the slope of the mean squared turn about an axis of the body, sums over the turns between frames.
    Raises OutputError.
    """
    kinds = _turning(history)
    interval, lags = evenly(history, "an orientational correlation")
    time = interval * np.arange(lags)
    found = Finding("orientation", "orientational correlation")
    curve = Curve("orientation", ("Time (ps)", time), "C(t)", {}, level=0.0)
    found.curves.append(curve)
    for kind in kinds:
        if note := _axes_in_words(kind):
            found.notes.append(note)
        for axis in _axes(kind):

            def seen(part: History, own: Kind, axis=axis) -> np.ndarray:
                both = _legendre(part, own, axis, lags)
                return np.concatenate([both, [[_integral(c, interval)] for c in both]], axis=1)

            values, errors = over_parts(history, kind, seen)
            for l in (0, 1):  # noqa: E741
                C, doubt = values[l, :-1], errors[l, :-1]
                curve.add(f"C{l + 1} {kind.name} axis {axis + 1}", C, doubt)
                tau, error = float(values[l, -1]), float(errors[l, -1])
                name = f"tau{l + 1} of {kind.name}, axis {axis + 1}"
                if C[-1] > HIGH:
                    # an exponential falls to HIGH at a lag, and a run is 2 BLOCKS times as long as its longest lag
                    need = 2 * BLOCKS * time[-1] * np.log(HIGH) / np.log(min(float(C[-1]), SLOWEST))
                    told = (
                        f"C{l + 1} is still {C[-1]:.2f} after {time[-1]:.3g} ps, too short for a value; it needs "
                        f"{'about' if C[-1] < SLOWEST else 'more than'} {need:.2g} ps. {so_far(tau, None, 'ps')}"
                    )
                    found.values.append(Value(name, "ps", None, None, None, told))
                    continue
                low, told = int(C.argmin()), ""
                if C[low] < -max(TAIL, 3 * float(np.nan_to_num(doubt[low]))):
                    told = f"to where C{l + 1} first falls below {TAIL:g}; at {time[low]:.3g} ps it is {C[low]:.2f}"
                found.values.append(settled(name, "ps", tau, error, history.span, tau, told, LEAST_EACH))
        found.values += _rotational_diffusion(history, kind, interval, lags)
    return found


def _axes_in_words(kind: Kind) -> str:
    """Which axis of a molecule is its dipole's."""
    dipole = kind.molecule.charges @ kind.molecule.positions_body
    size = float(np.linalg.norm(dipole))
    if kind.molecule.charge or not kind.molecule.has_dipole:
        return ""
    along = int(np.abs(dipole).argmax())
    if abs(dipole[along]) < (1 - 1e-6) * size:
        return ""
    return f"axis {along + 1} of {kind.name} is that of its dipole"


def _legendre(history: History, kind: Kind, axis: int, lags: int) -> np.ndarray:
    """C1 and C2 (2, lags) of one axis."""
    u = history.Q[..., axis][:, kind.index]
    first = 3 * correlation(u, lags)
    squares = np.stack([u[..., i] * u[..., i] for i in range(3)], axis=-1)
    mixed = np.stack([u[..., i] * u[..., (i + 1) % 3] for i in range(3)], axis=-1)
    return np.stack([first, 1.5 * 3 * (correlation(squares, lags) + 2 * correlation(mixed, lags)) - 0.5])


def _integral(values: np.ndarray, interval: float) -> float:
    """Integral of a correlation function that begins at 1: to where it has decayed, then an exponential."""
    below = np.flatnonzero(values < TAIL)
    end = int(below[0]) if len(below) else len(values) - 1
    body = float(np.trapezoid(values[: end + 1], dx=interval))
    half = np.flatnonzero(values < np.sqrt(max(values[end], 1e-3)))
    start = int(half[0]) if len(half) else 0
    if end <= start or values[end] <= 0 or values[start] <= values[end]:
        return body
    decay = interval * (end - start) / np.log(values[start] / values[end])
    return body + float(values[end] * decay)


def _turns(history: History, kind: Kind) -> np.ndarray:
    """Turns between frames along the body's axes (f - 1, k, 3), rad."""
    Q = history.Q[:, kind.index]
    between = np.einsum("fnji,fnjk->fnik", Q[:-1], Q[1:])
    skew = 0.5 * np.stack(
        [between[..., (i + 2) % 3, (i + 1) % 3] - between[..., (i + 1) % 3, (i + 2) % 3] for i in range(3)], axis=-1
    )
    sine = np.linalg.norm(skew, axis=-1)
    angle = np.arctan2(sine, 0.5 * (np.einsum("fnii->fn", between) - 1))
    return skew * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 1.0)[..., None]


def _rotational_diffusion(history: History, kind: Kind, interval: float, lags: int) -> list[Value]:
    if len(_axes(kind)) == 1:
        return []
    turns = _turns(history, kind)
    rms = float(np.sqrt(np.mean(np.sum(turns**2, axis=-1))))
    names = [f"D_rot of {kind.name}, axis {k + 1}" for k in range(3)]
    if rms > LARGEST_TURN:
        told = f"molecules turn by {np.degrees(rms):.0f}° between frames, {interval:g} ps apart: write them more often"
        return [Value(name, "1/ps", None, None, None, told) for name in names]
    first = max(1, lags // 5)
    time = interval * np.arange(first, lags)
    if len(time) < 2:
        return []

    def slopes(part: History, own: Kind) -> np.ndarray:
        turned = _turns(part, own)
        path = np.concatenate([np.zeros_like(turned[:1]), np.cumsum(turned, axis=0)])
        seen = np.stack([squared_displacement(path[..., k : k + 1], lags)[first:] for k in range(3)], axis=1)
        return (time - time.mean()) @ seen / np.sum((time - time.mean()) ** 2) / 2

    values, errors = over_parts(history, kind, slopes)
    decay = 1 / (2 * max(float(values.mean()), 1e-300))
    return [
        settled(name, "1/ps", float(D), float(error), history.span, decay, least=LEAST_EACH)
        for name, D, error in zip(names, values, errors, strict=True)
    ]


@built_in("spectra and correlations of velocities, angular velocities and angular momenta")
def spectrum(history: History) -> Finding:
    """Densities of states (cm) of translation and of rotation about each body axis, from the power of velocities and
    angular velocities, and their correlation functions. The integral over wave numbers is the number of degrees of
    freedom of a molecule. Needs frames with velocities, few fs apart. Raises OutputError."""
    if history.velocities is None or history.L is None:
        raise OutputError("a spectrum needs velocities in the frames: output.trajectory = 'trajectory.trr' keeps them")
    interval, lags = evenly(history, "a spectrum")
    size = len(history) // BLOCKS
    found = Finding("spectrum", "densities of states")
    wave_numbers = np.fft.rfftfreq(size, interval) / PER_CM
    power = Curve("spectrum", ("wave number (1/cm)", wave_numbers), "density of states (cm)", {})
    memory = Curve("velocity_correlation", ("Time (ps)", interval * np.arange(lags)), "correlation", {}, level=0.0)
    found.curves += [power, memory]
    for kind in history.moving:
        if kind.molecule.degrees_of_freedom > 3:
            title = f"correlation L {kind.name}"
            memory.add(title, *over_parts(history, kind, lambda part, own: _normalised(_lab_momenta(part, own), lags)))
        for title, (weight, of) in _rates(kind).items():
            seen, errors = over_parts(history, kind, lambda part, own, of=of: _normalised(of(part, own), lags))
            if not seen[1] > CLOSE:
                raise OutputError(
                    f"frames {interval:g} ps apart are too far from each other for a spectrum: {title} forgets itself "
                    "between them; output.trajectory_interval_ps = 0.004 suits water"
                )
            memory.add(f"correlation {title}", seen, errors)

            def states(part: History, own: Kind, of=of, weight=weight / history.thermal_energy) -> np.ndarray:
                return _density_of_states(of(part, own), interval, size, weight)

            power.add(title, *over_parts(history, kind, states))
            top = int(np.argmax(power.columns[title][1:])) + 1
            at, half = float(wave_numbers[top]), float(wave_numbers[1] / 2)
            found.values.append(Value(f"highest peak of {title}", "1/cm", at, half, None, "half the resolution"))
    highest, fine = 1 / (2 * interval * PER_CM), wave_numbers[1]
    found.notes.append(f"frames {interval:g} ps apart tell wave numbers up to {highest:.4g}/cm, {fine:.2g}/cm apart")
    return found


def _rates(kind: Kind) -> dict[str, tuple[float, Callable[[History, Kind], Any]]]:
    """The velocities of a species by name: mass or moment of inertia, and a function that makes their series."""
    name, moments = kind.name, kind.molecule.inertia.tolist()
    found: dict[str, Any] = {f"V {name}": (kind.molecule.mass, lambda part, own: part.velocities[:, own.index])}
    if kind.molecule.degrees_of_freedom <= 3:
        return found
    if len(_axes(kind)) == 1:  # which of its two other axes is which has no meaning
        found[f"omega {name}"] = moments[2], lambda part, own: _lab_momenta(part, own) / moments[2]
    else:
        for k, moment in enumerate(moments):
            of = lambda part, own, k=k, moment=moment: part.L[:, own.index, k : k + 1] / moment  # noqa: E731
            found[f"omega {name} axis {k + 1}"] = moment, of
    return found


def _lab_momenta(history: History, kind: Kind) -> np.ndarray:
    """Angular momenta (f, k, 3) along the axes of the lab."""
    assert history.L is not None
    return np.einsum("fnij,fnj->fni", history.Q[:, kind.index], history.L[:, kind.index])


def _normalised(values: np.ndarray, lags: int) -> np.ndarray:
    seen = correlation(values, lags)
    return seen / seen[0]


def _density_of_states(values: np.ndarray, interval: float, size: int, weight: float) -> np.ndarray:
    """2 weight times the power of series (f, n, d) a wave number, sum over d and mean over n; cm."""
    total, n = 0.0, values.shape[1]
    for first in range(0, n, 256):
        part = values[:, first : first + 256].reshape(len(values), -1)
        no: Any = False  # which the types of SciPy do not know
        _, density = signal.welch(part, 1 / interval, "hann", size, detrend=no, axis=0)
        total = total + density.sum(axis=1)
    return weight * np.asarray(total) * PER_CM / n
