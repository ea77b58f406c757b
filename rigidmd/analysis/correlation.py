"""Correlation functions over all origins, by fast Fourier transforms."""

from typing import Any

import numpy as np
from scipy import fft

#: Numbers that are transformed at a time.
AT_ONCE = 4_000_000


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
    """<|x(t) - x(0)|²> at the first `lags` lags, mean over origins and molecules; path (f, n, d).

    From sums of squares and the correlation of positions (Calandrini et al. 2011, Collection SFN 12, 201).
    """
    path = path - path.mean(axis=0)
    squares = np.einsum("fnd,fnd->f", path, path)
    n, frames = path.shape[1], len(path)
    before, after = np.cumsum(squares), np.cumsum(squares[::-1])
    lag = np.arange(lags)
    both = (before[frames - 1 - lag] + after[frames - 1 - lag]) / (frames - lag) / n
    return np.maximum(both - 2 * correlation(path, lags) * path.shape[2], 0.0)
