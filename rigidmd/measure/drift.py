"""Drift: the slope of a conserved quantity, with an error that knows that neighbouring samples are alike."""

from typing import NamedTuple

import numpy as np


class Slope(NamedTuple):
    """Least-squares slope, in units of value per time."""

    value: float
    error: float  # standard error; NaN with fewer than three samples
    rms: float  # of what is left when the line is taken away


def slope(time: np.ndarray, value: np.ndarray) -> Slope:
    """Slope of value (n,) against time (n,).

    The standard error of ordinary least squares is multiplied by the square root of the statistical inefficiency
    1 + 2 sum C(k) of the residuals, summed to the first k with C(k) <= 0 (Chodera et al. 2007, J. Chem. Theory Comput.
    3, 26, eq. 25).
    """
    time = np.asarray(time, dtype=float)
    value = np.asarray(value, dtype=float)
    if len(time) < 3:
        return Slope(np.nan, np.nan, np.nan)
    centred = time - time.mean()
    spread = centred @ centred
    gradient = centred @ (value - value.mean()) / spread
    left = value - value.mean() - gradient * centred
    variance = left @ left / (len(time) - 2)
    return Slope(
        float(gradient), float(np.sqrt(variance * inefficiency(left) / spread)), float(np.sqrt(np.mean(left**2)))
    )


def inefficiency(value: np.ndarray) -> float:
    """Statistical inefficiency of samples (n,) of mean zero: how many of them are worth one independent sample."""
    n = len(value)
    power = np.abs(np.fft.rfft(value, 2 * n)) ** 2
    correlation = np.fft.irfft(power)[:n]
    if correlation[0] <= 0:
        return 1.0
    correlation = correlation / correlation[0]
    negative = np.flatnonzero(correlation <= 0)
    end = negative[0] if len(negative) else n
    return float(1 + 2 * correlation[1:end].sum())
