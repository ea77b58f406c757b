"""What is summed over k-vectors: the smooth part of a pair potential, c_i c_j times a function of r
for strengths c.

The direct sum and PME are the same for each kernel, which is chosen at compile time.
"""

from math import erfc, exp, pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import erf, gammainc

from rigidmd.compile import implements

LARGEST_B = 8.0  # exp(-b²) is 2e-28 there


class InverseR(NamedTuple):
    """erf(alpha r)/r, of charges."""

    alpha: float  # 1/Å

    def force_over_r(self, r: np.ndarray) -> np.ndarray:
        """-(du/dr)/r at r > 0."""
        return (
            erf(self.alpha * r) / r**3
            - 2 * self.alpha / sqrt(pi) * np.exp(-((self.alpha * r) ** 2)) / r**2
        )


class InverseR6(NamedTuple):
    """-(1 - g(alpha r))/r⁶ with g(x) = exp(-x²)(1 + x² + x⁴/2), of dispersion."""

    alpha: float  # 1/Å

    def energy(self, r: np.ndarray) -> np.ndarray:
        return -gammainc(3, (self.alpha * r) ** 2) / r**6

    def force_over_r(self, r: np.ndarray) -> np.ndarray:
        """-(du/dr)/r at r > 0."""
        return -6 * gammainc(4, (self.alpha * r) ** 2) / r**8


Smooth = InverseR | InverseR6


def strength_times_square(smooth, k2, volume):
    """k² times the energy of k and -k together over |S(k)|²."""
    raise TypeError("strength_times_square is for compiled code only")


def slope(smooth, k2):
    """-2 times the derivative of the logarithm of the energy by k², for the virial."""
    raise TypeError("slope is for compiled code only")


@implements(strength_times_square, InverseR, inline=True)
def _of_charges(smooth, k2, volume):
    return 4 * pi / volume * exp(-k2 / (4 * smooth.alpha * smooth.alpha))


@implements(slope, InverseR, inline=True)
def _slope_of_charges(smooth, k2):
    return 2 / k2 + 1 / (2 * smooth.alpha * smooth.alpha)


@implements(strength_times_square, InverseR6)
def _of_dispersion(smooth, k2, volume):
    b = sqrt(k2) / (2 * smooth.alpha)
    if b > LARGEST_B:
        return 0.0
    shape = (1 - 2 * b * b) * exp(-b * b) + 2 * b**3 * sqrt(pi) * erfc(b)
    return -(pi**1.5) * smooth.alpha**3 / (3 * volume) * shape * k2


@implements(slope, InverseR6)
def _slope_of_dispersion(smooth, k2):
    b = sqrt(k2) / (2 * smooth.alpha)
    if b > LARGEST_B:
        return 0.0
    fall = exp(-b * b)
    rest = sqrt(pi) * b * erfc(b)
    return (
        3
        * (fall - rest)
        / ((1 - 2 * b * b) * fall + 2 * b * b * rest)
        / (2 * smooth.alpha * smooth.alpha)
    )
