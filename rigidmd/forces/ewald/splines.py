"""Cardinal B-splines, which spread charges over the points of a grid, and their effect on Fourier components.

M_p is a polynomial of degree p - 1 between neighbouring points, p points wide and p - 2 times differentiable (Essmann
et al. 1995, J. Chem. Phys. 103, 8577, eq. 4.1). A grid of K points cannot distinguish a Fourier component n from its
aliases n + m K. Spreading multiplies these by U(n + m K) = sinc((n + m K)/K)^p.
"""

from math import factorial
from typing import NamedTuple

import numpy as np
from scipy.interpolate import BSpline

ALIASES = 30  # largest |m| in sums; its term is 1e-7 of the first for order 3, less for higher orders


def weights(order: int) -> np.ndarray:
    """(order, order) coefficients [j, t] of u'^j in the weight of grid point floor(x) + t, u' = x - floor(x) - 1/2."""
    spline = BSpline.basis_element(np.arange(order + 1), extrapolate=False)
    middle = order - 0.5 - np.arange(order)
    return np.array([spline.derivative(j)(middle) / factorial(j) if j else spline(middle) for j in range(order)])


class Aliases(NamedTuple):
    """Sums over the aliases of each Fourier component along one axis (points,), in the order of an FFT."""

    n: np.ndarray  # -K/2 < n <= K/2
    odd: np.ndarray  # n, but 0 where n and -n are the same component
    unaliased: np.ndarray  # U(n)²
    all: np.ndarray  # sum over m of U(n + m K)²
    first: np.ndarray  # sum of (n + m K) U²
    second: np.ndarray  # sum of (n + m K)² U²


def aliases(points: int, order: int) -> Aliases:
    n = np.arange(points)
    n = np.where(2 * n > points, n - points, n)
    every = n[:, None] + points * np.arange(-ALIASES, ALIASES + 1)
    squared = np.sinc(every / points) ** (2 * order)
    nyquist = 2 * n == points
    first = np.where(nyquist, 0.0, (every * squared).sum(axis=1))
    return Aliases(
        n, np.where(nyquist, 0, n), np.sinc(n / points) ** (2 * order), squared.sum(axis=1), first,
        (every**2 * squared).sum(axis=1),
    )  # fmt: skip
