"""Elliptic integrals in Carlson's forms, by his duplication theorem (Numerical Algorithms 10, 13,
1995), for real arguments. SciPy has them too, and takes longer to import than a top to run."""

from math import atan, atanh, inf, sqrt

#: Relative error of the truncated series.
SERIES_ERROR = 1e-17


def rf(x: float, y: float, z: float) -> float:
    """R_F of three numbers of which at most one is 0: the integral of the first kind."""
    if [x, y, z].count(0.0) > 1:
        return inf
    mean = start = (x + y + z) / 3
    spread = (3 * SERIES_ERROR) ** (-1 / 6) * max(abs(start - one) for one in (x, y, z))
    a = x
    b = y
    c = z
    scale = 1.0
    while scale * spread > abs(mean):
        shift = sqrt(a) * sqrt(b) + sqrt(a) * sqrt(c) + sqrt(b) * sqrt(c)
        a, b, c, mean = ((one + shift) / 4 for one in (a, b, c, mean))
        scale /= 4
    u, v = ((start - one) * scale / mean for one in (x, y))
    w = -u - v
    second = u * v - w * w
    third = u * v * w
    series = 1 - second / 10 + third / 14 + second**2 / 24 - 3 * second * third / 44
    return series / sqrt(mean)


def rj(x: float, y: float, z: float, p: float) -> float:
    """R_J of three numbers of which at most one is 0, and p > 0: the integral of the third kind.
    Infinite for other p."""
    if p <= 0 or [x, y, z].count(0.0) > 1:
        return inf
    mean = start = (x + y + z + 2 * p) / 5
    product = (p - x) * (p - y) * (p - z)
    spread = (SERIES_ERROR / 4) ** (-1 / 6) * max(abs(start - one) for one in (x, y, z, p))
    a = x
    b = y
    c = z
    d = p
    scale, total = 1.0, 0.0
    while scale * spread > abs(mean):
        roots = [sqrt(one) for one in (a, b, c)]
        shift = roots[0] * roots[1] + roots[0] * roots[2] + roots[1] * roots[2]
        factor = (sqrt(d) + roots[0]) * (sqrt(d) + roots[1]) * (sqrt(d) + roots[2])
        total += scale / factor * _rc(scale**3 * product / factor**2)
        a, b, c, d, mean = ((one + shift) / 4 for one in (a, b, c, d, mean))
        scale /= 4
    u, v, w = ((start - one) * scale / mean for one in (x, y, z))
    q = -(u + v + w) / 2
    second = u * v + u * w + v * w - 3 * q * q
    third = u * v * w + 2 * second * q + 4 * q**3
    fourth = (2 * u * v * w + second * q + 3 * q**3) * q
    fifth = u * v * w * q * q
    series = 1 - 3 * second / 14 + third / 6 + 9 * second**2 / 88 - 3 * fourth / 22
    series += -9 * second * third / 52 + 3 * fifth / 26
    return scale * series / mean**1.5 + 6 * total


def _rc(excess: float) -> float:
    """R_C(1, 1 + excess)."""
    root = sqrt(abs(excess))
    if root == 0:
        return 1.0
    return atan(root) / root if excess > 0 else atanh(root) / root


def complete(complement: float) -> float:
    """K, the complete integral of the first kind, of the parameter m = 1 - `complement`."""
    return rf(0.0, complement, 1.0)
