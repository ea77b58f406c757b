"""Means of correlated samples with their standard errors: the one estimator of logs, analyses, sweeps and studies."""

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

#: Samples without which a series has no error, and its least length in units of the longest lag over which it is
#: correlated.
FEWEST, SHORTEST = 8, 3.0
#: Batches, and what their scatter is multiplied by: a Student distribution of 4 degrees of freedom has a variance of 2,
#: a part of which the larger of two estimates gives already.
BATCHES, OF_BATCHES = 5, 1.5
#: Degrees of freedom that the inflation of the window's estimate takes off: f/(f - 2) of a Student distribution has the
#: right variance if f does not depend on the estimate itself; here a short window and a small estimate come together.
TAKEN_OFF = 2.5


def mean(values: ArrayLike) -> tuple[float | None, float | None]:
    """Mean and standard error of evenly spaced samples (n,); None, None if a value is NaN.

    The error accounts for correlation; it is None if the samples are too few, or all of them correlated. It is the
    larger of two estimates: one from a window of the correlation function, which is precise but misses a slow part
    below fast noise, and one from batches, which see it. Both are widened by the uncertainty that they have themselves,
    so that (mean - truth)/error has a standard deviation of 1: of 0.8 (white noise) to 1.3 as measured, for n from 16
    to 2000 and lengths of 10 correlation times and more. Of an oscillation the error is up to 1.6 times too large.
    """
    array = np.array(values, dtype=float)
    n = len(array)
    if n == 0 or np.isnan(array).any():
        return None, None
    average = float(array.mean())
    if n < FEWEST:
        return average, None
    if np.ptp(array) <= 4 * np.finfo(float).eps * np.abs(array).max():
        return average, 0.0
    centred = array - average
    ratio, last = _window(centred)
    if (freedom := n / last) < SHORTEST:
        return average, None
    variance = centred @ centred / (n - 1)
    window = variance * ratio * freedom / (freedom - TAKEN_OFF)
    lost = max(0.25, 1 - ratio / n)  # of the variance about the true mean, about that of these samples
    return average, sqrt(max(window, OF_BATCHES * _of_batches(centred)) / lost / n)


def standard_error(values: ArrayLike) -> np.ndarray:
    """Standard error (...) of the mean of independent runs (n, ...), n > 1: their standard deviation over sqrt(n)."""
    return np.std(np.asarray(values, float), axis=0, ddof=1) / sqrt(len(np.asarray(values)))


def error_of_mean(parts: ArrayLike) -> np.ndarray:
    """Standard error (...) of the mean of few independent values (n, ...), n > 1: half the range that holds 68 % of
    their Student distribution, which is 1.84 times the usual one for two values, 1.14 times for five."""
    from scipy import special  # slow to import

    return standard_error(parts) * float(special.stdtrit(len(np.asarray(parts)) - 1, special.ndtr(1.0)))


def with_error(value: float, error: float | None) -> str:
    """Such as 2.51 ± 0.04: two digits of the error."""
    if error is None or not np.isfinite(error):
        return f"{value:.4g}"
    if error <= 0:
        return f"{value:.6g}"
    places = 1 - int(np.floor(np.log10(error)))
    if -6 <= places <= 8 and abs(value) < 1e6:
        return f"{value:.{max(0, places)}f} ± {error:.{max(0, places)}f}"
    return f"{value:.4g} ± {error:.1e}"


def inefficiency(centred: np.ndarray) -> float:
    """Statistical inefficiency of samples (n,) of mean zero: the number of samples per independent one."""
    return _window(centred)[0]


def correlation_time(values: np.ndarray, interval: float) -> float:
    """Integrated correlation time of a series, in units of `interval`: half its inefficiency."""
    return 0.5 * interval * inefficiency(values - values.mean())


def _window(centred: np.ndarray) -> tuple[float, int]:
    """1 + 2 sum C(k) of samples (n,) of mean zero, and the last k of the sum.

    Sums of C at two successive lags are positive and decrease, for a reversible process; the window ends before noise
    breaks the first rule and follows the second (Geyer 1992, Statist. Sci. 7, 473, the initial monotone sequence). As
    their own mean was taken off, each C is too low by the variance of that mean, which is corrected to first order
    (Wolff 2004, Comput. Phys. Commun. 156, 143, eq. 49).
    """
    n = len(centred)
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlation = np.fft.irfft(power)[:n]
    if n < 2 or correlation[0] <= 0:
        return 1.0, 1
    pairs = (correlation / correlation[0])[: n // 2 * 2].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    end = max(1, int(negative[0])) if len(negative) else len(pairs)
    last = 2 * end - 1
    total = 2 * float(np.minimum.accumulate(pairs[:end]).sum()) - 1
    return max(total, 1 / n) / max(0.25, 1 - (2 * last + 1) / n), last


def _of_batches(centred: np.ndarray) -> float:
    """n times the variance of the mean, from means of batches and the correlation of neighbouring ones."""
    size = len(centred) // BATCHES
    means = centred[len(centred) - size * BATCHES :].reshape(BATCHES, size).mean(axis=1)
    means -= means.mean()
    square = float(means @ means)
    if not square > 0:
        return 0.0
    shared = float(means[1:] @ means[:-1]) / square + 1 / BATCHES
    return size * square / (BATCHES - 1) * (1 + 2 * min(max(shared, 0.0), 0.5))
