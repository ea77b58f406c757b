"""Drift: the slope of a conserved quantity, with an error for the kind of noise that such quantities have."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

#: In the reason of a choice: what it keeps. A summary adds the error that the run had.
OF_ENERGY = "error of the energy"
FEW, MANY = 8, 64  # numbers of blocks that separate slow noise from fast
#: What the walk is multiplied by, which seven differences give, and the least walk, as a fraction of what the slow
#: noise would be if all of it were one.
SPREAD, LEAST = 1.4, 0.15


class Slope(NamedTuple):
    """Least-squares slope, in units of value per time."""

    value: float
    error: float  # standard error; NaN with less than 16 samples
    rms: float  # of the residual


def slope(time: ArrayLike, value: ArrayLike) -> Slope:
    """Slope of value (n,) against evenly spaced time (n,).

    The energy of a symplectic run is not a line in white noise. Its fast part, of order dt², comes from the scheme. Its
    slow part is a random walk, because potentials are smooth only to some order at their cut-off. The least-squares
    error for white noise was too small by a factor 2.2 in 16 runs of 20 ps (64 waters, 1 fs). So both parts are
    measured, from the Allan variances of few and of many block means,

        A(m) = white/m + walk m/3,    error² = 12 white/n³ + 6 walk/(5 n)    (per sample spacing)

    The walk comes from seven differences of eight blocks, and is multiplied by 1.4, the variance of their Student
    distribution. Under white noise it cannot be told from none, and it is taken as a fraction of the slow noise at
    least. So slope/error has a standard deviation of 0.5 in white noise, 1.1 to 1.5 in walks with and without it.
    """
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
    if n < 2 * FEW:
        return Slope(gradient, np.nan, rms)
    short, long = max(1, n // MANY), n // FEW
    fast, slow = _allan(left, short), _allan(left, long)
    walk = max(0.0, 3 * (slow * long - fast * short) / (long**2 - short**2))
    white = max(0.0, short * (fast - walk * short / 3))
    walk = max(SPREAD * walk, LEAST * 3 * slow * long / (long**2 - short**2))
    spacing = (time[-1] - time[0]) / (n - 1)
    return Slope(gradient, float(np.sqrt(12 * white / n**3 + 6 * walk / (5 * n)) / spacing), rms)


def _allan(value: np.ndarray, m: int) -> float:
    """Allan variance: half the variance of the differences of successive means of m samples."""
    blocks = len(value) // m
    return float(0.5 * np.diff(value[: blocks * m].reshape(blocks, m).mean(axis=1)).var(ddof=1))
