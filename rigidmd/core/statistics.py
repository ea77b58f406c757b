"""Means and slopes of correlated samples with standard errors, for logs, summaries, analyses,
sweeps and studies."""

from math import floor, isnan, log10, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

#: A series has an error if it has at least 8 samples and is at least 3 times as long as its longest
#: correlated lag.
FEWEST_SAMPLES, LEAST_WINDOWS = 8, 3.0
#: Number of batches, and the factor on the variance of their means. A Student distribution of 4
#: degrees of freedom has a variance of 2; taking the larger of two estimates already gives a part
#: of that.
BATCHES, BATCH_FACTOR = 5, 1.5
#: Degrees of freedom subtracted in the window's estimate, f/(f - 2.5). A Student distribution would
#: need f/(f - 2) if f did not depend on the estimate; here a short window and a small estimate
#: coincide.
LOST_FREEDOM = 2.5
#: The beginning of a series is cut off if chance explains its difference from the rest with less
#: than this two-sided probability. It is small, because the cut was chosen among many, and the
#: quiet part that it may leave has too small an error. The second number is subtracted from the
#: degrees of freedom, as the correlation of few independent samples is underestimated.
CUT_CHANCE, CUT_FREEDOM = 1e-4, 2.0
#: Standard errors between the beginning of a series and the rest that a user should know of.
SUSPECT = 4.0


def mean_and_error(values: ArrayLike) -> tuple[float | None, float | None]:
    """Mean and standard error of evenly spaced samples (n,). None, None if a value is NaN. The
    error accounts for correlation (theory chapter `errors`). It is None if the samples are too few,
    or all of them correlated."""
    array = np.array(values, dtype=float)
    n = len(array)
    if n == 0 or np.isnan(array).any():
        return None, None
    average = float(array.mean())
    if n < FEWEST_SAMPLES:
        return average, None
    if np.ptp(array) <= 4 * np.finfo(float).eps * np.abs(array).max():
        return average, 0.0
    centred = array - average
    ratio, last = _window(centred)
    if (freedom := n / last) < LEAST_WINDOWS:
        return average, None
    variance = centred @ centred / (n - 1)
    window = variance * ratio * freedom / (freedom - LOST_FREEDOM)
    # fraction of the variance about the true mean that is left about the sample mean
    variance_fraction = max(0.25, 1 - ratio / n)
    return average, sqrt(
        max(window, BATCH_FACTOR * _batch_variance(centred)) / variance_fraction / n
    )


def standard_error(values: ArrayLike) -> np.ndarray:
    """Standard error (...) of the mean of independent runs (n, ...), n > 1: their standard
    deviation over sqrt(n)."""
    return np.std(np.asarray(values, float), axis=0, ddof=1) / sqrt(len(np.asarray(values)))


def error_of_mean(parts: ArrayLike) -> np.ndarray:
    """Standard error (...) of the mean of few independent values (n, ...), n > 1, see the theory
    chapter `errors`."""
    return standard_error(parts) * student_factor(len(np.asarray(parts)) - 1)


def student_factor(freedom: int) -> float:
    """Half the range that holds 68 % of Student's distribution with these degrees of freedom."""
    from scipy import special  # slow to import

    return float(special.stdtrit(freedom, special.ndtr(1.0)))


def format_with_error(value: float, error: float | None) -> str:
    """Such as 2.51 ± 0.04: two digits of the error."""
    if error is None or not np.isfinite(error):
        return f"{value:.4g}"
    if error <= 0:
        return f"{value:.6g}"
    places = 1 - int(np.floor(np.log10(error)))
    if -6 <= places <= 8 and abs(value) < 1e6:
        return f"{value:.{max(0, places)}f} ± {error:.{max(0, places)}f}"
    return f"{value:.4g} ± {error:.1e}"


#: Stands for the error of a value that is made of too few samples for one.
NO_ERROR = "too short for an error"


def format_signed(value: float, error: float | None) -> str:
    """value ± error with the sign of the value, rounded to two digits of the error."""
    if error is None or isnan(error):
        return f"{value:+.3g} ({NO_ERROR})"
    digits = max(0, 1 - floor(log10(error))) if error > 0 else 3
    return f"{value:+.{digits}f} ± {error:.{digits}f}"


def inefficiency(centred: np.ndarray) -> float:
    """Statistical inefficiency of samples (n,) of mean zero: the number of samples per independent
    one."""
    return _window(centred)[0]


def correlation_time(values: np.ndarray, interval: float) -> float:
    """Integrated correlation time of a series, in units of `interval`: half its inefficiency."""
    return 0.5 * interval * inefficiency(values - values.mean())


def steady_from(values: np.ndarray) -> int:
    """Index in the first half of a series (n,) from which on it is steady: that of
    `least_error_from`, if the mean of the samples before it differs from the mean of the others by
    more than their errors explain, else 0."""
    start = least_error_from(values)
    if start:
        difference, limit = _difference_of_beginning(values, start)
        return start if difference > limit else 0
    return 0


def may_be_unsteady(values: np.ndarray) -> bool:
    """Whether the beginning of a series (n,) differs from the rest by more than `SUSPECT` of their
    errors, and independent samples are too few to exclude chance."""
    start = least_error_from(values)
    if start:
        difference, limit = _difference_of_beginning(values, start)
        return SUSPECT < difference <= limit
    return False


def least_error_from(values: np.ndarray) -> int:
    """Index in the first half of a series (n,) from which on its mean has the smallest standard
    error of independent values: the marginal standard error rule (White 1997, Simulation 69,
    323)."""
    left = np.arange(len(values), 0, -1)
    sums, squares = (
        np.cumsum(x[::-1])[::-1] for x in (values - values.mean(), (values - values.mean()) ** 2)
    )
    error = (squares - sums**2 / left) / left.astype(float) ** 2
    return int(np.argmin(error[: len(values) // 2 + 1]))


def _difference_of_beginning(values: np.ndarray, start: int) -> tuple[float, float]:
    """The difference of the mean before an index from the mean after it, in units of its error from
    the variance and the correlation of the second half of the series, and the limit of a test of
    Student."""
    from scipy import special  # slow to import

    late = values[len(values) // 2 :]
    samples = inefficiency(late - late.mean())  # per independent one
    freedom = len(late) / samples
    variance = late.var(ddof=1) / max(0.25, 1 - 1 / freedom)
    error = sqrt(variance * (min(1.0, samples / start) + samples / (len(values) - start)))
    limit = -float(special.stdtrit(max(freedom - CUT_FREEDOM, 0.5), CUT_CHANCE / 2))
    difference = abs(float(values[:start].mean() - values[start:].mean()))
    return (difference / error if error else np.inf * difference), limit


def _window(centred: np.ndarray) -> tuple[float, int]:
    """1 + 2 sum C(k) for samples (n,) with mean zero, and the last k of the sum: the initial
    monotone sequence (Geyer 1992), corrected for the sample mean (Wolff 2004, eq. 49). See the
    theory chapter `errors`."""
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


def _batch_variance(centred: np.ndarray) -> float:
    """n times the variance of the mean, from batch means and the correlation between neighbouring
    batches."""
    size = len(centred) // BATCHES
    means = centred[len(centred) - size * BATCHES :].reshape(BATCHES, size).mean(axis=1)
    means -= means.mean()
    square = float(means @ means)
    if not square > 0:
        return 0.0
    shared = float(means[1:] @ means[:-1]) / square + 1 / BATCHES
    return size * square / (BATCHES - 1) * (1 + 2 * min(max(shared, 0.0), 0.5))


#: The error that a choice of an integrator limits, in its reason. A summary adds the error of the
#: run.
ENERGY_ERROR = "error of the energy"
FEW_BLOCKS, MANY_BLOCKS = 8, 64  # for slow and for fast noise
#: Factor on the random walk, which is estimated from seven differences, and the least walk as a
#: fraction of the walk that would explain all slow noise.
WALK_FACTOR, LEAST_WALK = 1.4, 0.15


class Slope(NamedTuple):
    """Least-squares slope, in units of value per time."""

    value: float
    error: float  # standard error; NaN with less than 16 samples
    rms: float  # residual


def slope(time: ArrayLike, value: ArrayLike) -> Slope:
    """Slope of value (n,) against evenly spaced time (n,), with an error that accounts for a random
    walk as well as for white noise: see "Energy drift and its error" in the theory chapter
    `errors`."""
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    n = len(time)
    if n < 3:
        return Slope(np.nan, np.nan, np.nan)
    centred = time - time.mean()
    spread = centred @ centred
    gradient = float(centred @ (value - value.mean()) / spread)
    left = value - value.mean() - gradient * centred
    rms = float(np.sqrt(np.mean(left**2)))
    if n < 2 * FEW_BLOCKS:
        return Slope(gradient, np.nan, rms)
    short = max(1, n // MANY_BLOCKS)
    long = n // FEW_BLOCKS
    fast, slow = _allan(left, short), _allan(left, long)
    walk = max(0.0, 3 * (slow * long - fast * short) / (long**2 - short**2))
    white = max(0.0, short * (fast - walk * short / 3))
    walk = max(WALK_FACTOR * walk, LEAST_WALK * 3 * slow * long / (long**2 - short**2))
    spacing = (time[-1] - time[0]) / (n - 1)
    return Slope(gradient, float(np.sqrt(12 * white / n**3 + 6 * walk / (5 * n)) / spacing), rms)


def _allan(value: np.ndarray, m: int) -> float:
    """Allan variance: half the variance of the difference between successive means over m
    samples."""
    blocks = len(value) // m
    return float(0.5 * np.diff(value[: blocks * m].reshape(blocks, m).mean(axis=1)).var(ddof=1))
