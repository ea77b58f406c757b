"""The integral of a correlation function from the spectrum of its series at low frequencies.

The spectral density S(f) of a series is the Fourier transform of its correlation function, so that
S(0) is twice the integral from 0 to infinity. A periodogram is S times independent random numbers
of known distribution at all frequencies, however slowly the correlation decays. A fit of a model of
relaxations to it therefore has no time to which an integral would have to be cut off (compare
Ercole, Marcolongo & Baroni 2017, Sci. Rep. 7, 15835).
"""

from typing import NamedTuple

import numpy as np

#: Maximum number of relaxations of a model.
MOST = 3
#: Bands: the first frequencies are by themselves, later ones together with others within this
#: ratio.
ALONE, RATIO = 20, 1.08
#: Minimum number of bands of a fit, and groups of bands whose sums of residuals give chi².
LEAST_BANDS, GROUPS = 15, 12
#: Parts of the highest frequency, up to which a model is fitted. The first that it describes is
#: used.
PARTS = (0.5, 0.25, 0.125, 0.0625, 0.03125)
#: Longest relaxation time of a fit, as fractions of the sum of all runs and of one of them. Longer
#: ones are fits to the noise of the lowest frequencies.
LONGEST, LONGEST_OF_RUN = 0.05, 0.25
#: Iterations of a fit, and the change of the likelihood at which it ends.
ITERATIONS, CLOSE = 200, 1e-6
#: Factor on the error, which accounts for the choice among models and frequencies. Measured with
#: relaxations of 0.03 to 2.5 ps in series of 40 to 800 ps.
ERROR_FACTOR = 1.15


class Bands(NamedTuple):
    """A spectral density in bands of frequencies, each array (b,)."""

    frequency: np.ndarray  # mean of each band, 1/ps
    density: np.ndarray  # mean of each band: twice the integral of the correlation at frequency 0
    #: Half the number of degrees of freedom of the chi² distribution of each mean
    half_freedom: np.ndarray


class Relaxations(NamedTuple):
    """integral(t) = fast + sum of part (1 - exp(-t/time))."""

    fast: float  # of what decays faster than the highest frequency shows
    parts: np.ndarray
    times: np.ndarray
    error: float  # of the limit
    score: float  # Akaike's criterion, the smaller the better
    chi2: float

    @property
    def limit(self) -> float:
        return float(self.fast + self.parts.sum())

    def integral(self, time: np.ndarray) -> np.ndarray:
        return self.fast + (self.parts * (1 - np.exp(-time[:, None] / self.times))).sum(axis=1)


class Limit(NamedTuple):
    """The integral of a correlation function to infinity."""

    value: float
    error: float
    best: Relaxations  # the most likely model
    highest: float  # frequency of the fit


def longest_time(runs: int, length: float) -> float:
    """The longest relaxation time that a number of runs of this length can show."""
    return length * min(LONGEST * runs, LONGEST_OF_RUN)


def spectral_bands(runs: list[np.ndarray], interval: float) -> Bands:
    """The mean spectral density of series (n, d) of several runs, sampled at an interval, in bands.

    The means of the series are known to be 0, so that frequency 0 counts. Longer runs are cut to
    the shortest.
    """
    count = min(map(len, runs))
    powers = [np.mean(np.abs(np.fft.rfft(series[:count], axis=0)) ** 2, axis=1) for series in runs]
    density = np.mean(powers, axis=0) * interval / count
    freedom = sum(series.shape[1] for series in runs)
    first = 1
    edges = [0]
    while first < len(density):
        edges.append(first)
        first = max(first + 1, int(first * RATIO)) if first >= ALONE else first + 1
    sizes = np.diff([*edges, len(density)])
    frequency = np.add.reduceat(np.fft.rfftfreq(count, interval), edges) / sizes
    weights = freedom * sizes.astype(float)
    weights[0] *= 0.5  # real numbers, not complex ones
    return Bands(frequency, np.add.reduceat(density, edges) / sizes, weights)


def integral_of(runs: list[np.ndarray], interval: float) -> Limit | None:
    """Correlation function of series (n, d) with mean 0, integrated from 0 to infinity, mean over d
    and runs. None if the series are too short for a fit.

    Models of one to three relaxations and a constant are fitted by their likelihood. Their limits
    are averaged with Akaike's weights, and differences between them are a part of the error.
    """
    bands = spectral_bands(runs, interval)
    span = interval * min(map(len, runs))
    longest = longest_time(len(runs), span)
    limit = None
    for part in PARTS:
        highest = part / (2 * interval)
        some = Bands(*(values[: np.searchsorted(bands.frequency, highest)] for values in bands))
        if len(some.frequency) < LEAST_BANDS:
            break
        fits = [_fit(some, count, longest) for count in range(1, MOST + 1)]
        best = min(fits, key=lambda fit: fit.score)
        weights = np.exp([0.5 * (best.score - fit.score) for fit in fits])
        limits, errors = (
            np.array(values)
            for values in zip(*((fit.limit, fit.error) for fit in fits), strict=True)
        )
        value = float(np.average(limits, weights=weights))
        error = float(np.sqrt(np.average(errors**2 + (limits - value) ** 2, weights=weights)))
        limit = Limit(value, ERROR_FACTOR * error, best, highest)
        if best.chi2 <= GROUPS + 2 * np.sqrt(2 * GROUPS):
            break
    return limit


def _fit(bands: Bands, count: int, longest: float) -> Relaxations:
    """The most likely model with a number of relaxations, by Fisher's scoring in the logarithms of
    its parameters, with the damping of Levenberg and Marquardt."""
    squares = (2 * np.pi * bands.frequency) ** 2
    top = float(np.average(bands.density[:6], weights=bands.half_freedom[:6]))
    low = float(bands.density[-1])
    shortest = 0.5 / (2 * np.pi * float(bands.frequency[-1]))
    times = np.geomspace(4 * shortest, max(8 * shortest, longest / 3), count + 2)[1:-1]
    bottom = np.log([*[1e-4 * top] * count, *[shortest] * count, 1e-5 * top])
    ceiling = np.log([*[20 * top] * count, *[longest] * count, 5 * top])
    start = np.log([*[top / count] * count, *times, max(0.5 * low, 2e-5 * top)])

    def model(parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Density (b,) and its relative slopes with all parameters (b, p)."""
        parts = np.exp(parameters[:count])
        times = np.exp(parameters[count:-1])
        plateau = np.exp(parameters[-1])
        below = 1 + squares[:, None] * times**2
        density = (parts / below).sum(axis=1) + plateau
        slopes = np.column_stack(
            [
                parts / below,
                -2 * parts * squares[:, None] * times**2 / below**2,
                0 * squares + plateau,
            ]
        )
        return density, slopes / density[:, None]

    def surprise(density: np.ndarray) -> float:
        """Minus the logarithm of the likelihood, except for a constant."""
        return float(bands.half_freedom @ (np.log(density) + bands.density / density))

    parameters = np.clip(start, bottom, ceiling)
    damping = 1e-2
    density, slopes = model(parameters)
    before = surprise(density)
    for _ in range(ITERATIONS):
        weighted = slopes * bands.half_freedom[:, None]
        downhill = weighted.T @ (bands.density / density - 1)
        fisher = weighted.T @ slopes
        step = np.linalg.lstsq(
            fisher + damping * np.diag(np.diag(fisher) + 1e-9), downhill, rcond=None
        )[0]
        tried = np.clip(parameters + np.clip(step, -1.0, 1.0), bottom, ceiling)
        density_there, slopes_there = model(tried)
        after = surprise(density_there)
        if after > before:
            damping = min(10 * damping, 1e6)
            if damping >= 1e6:
                break
            continue
        gain = before - after
        before = after
        parameters, density, slopes = tried, density_there, slopes_there
        damping = max(0.2 * damping, 1e-7)
        if gain < CLOSE:
            break
    weighted = slopes * bands.half_freedom[:, None]
    parts = np.exp(parameters[:count])
    times = np.exp(parameters[count:-1])
    plateau = float(np.exp(parameters[-1]))
    of_limit = np.concatenate([parts, np.zeros(count), [plateau]])
    variance = float(of_limit @ np.linalg.pinv(weighted.T @ slopes, hermitian=True) @ of_limit)
    residual = bands.half_freedom * (bands.density / density - 1)
    groups = np.array_split(np.arange(len(residual)), GROUPS)
    chi2 = sum(
        float(residual[group].sum() ** 2 / bands.half_freedom[group].sum()) for group in groups
    )
    score = 2 * before + 2 * (2 * count + 1)
    return Relaxations(
        0.5 * plateau, 0.5 * parts, times, 0.5 * np.sqrt(max(0.0, variance)), score, chi2
    )
