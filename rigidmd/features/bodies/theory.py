"""Rates and periods of a single body in closed form: Lagrange's top, and bodies that no torque acts
on.

In consistent units. See "Tops in gravity" in the theory chapter `bodies`.
"""

from math import inf, pi, sqrt
from typing import NamedTuple

import numpy as np

#: The algorithm converges quadratically: the next step changes the last bit at most.
SQUARE_ROOT_OF_ROUNDING = 1e-8


def complete_integral(complement: float, p: float = 1.0) -> float:
    """The complete elliptic integral of the third kind, Π(n, m) with m = 1 - `complement` and n = 1
    - p, by Bulirsch's algorithm (Numerische Mathematik 13, 305, 1969). By default the integral of
    the first kind, K(m). Infinite unless both arguments are positive.

    SciPy has it too, and takes longer to import than a top to run.
    """
    if not (complement > 0 and p > 0):
        return inf
    p = sqrt(p)
    a, b = 1.0, 1 / p
    side = product = sqrt(complement)
    total = 1.0
    while True:
        before = a
        a += b / p
        b = 2 * (b + before * product / p)
        p += product / p
        before = total
        total += side
        if abs(before - side) <= SQUARE_ROOT_OF_ROUNDING * before:
            return pi / 2 * (b + a * total) / (total * (total + p))
        side = 2 * sqrt(product)
        product = side * total


class TopMotion(NamedTuple):
    """The motion of the axis of a heavy symmetric top: mean rate of precession about the vertical,
    over whole periods of nutation, and this period. For steady precession the period of a small
    nutation."""

    precession: float
    nutation_period: float


def heavy_top_motion(
    across: float, moment: float, momentum: float, cosine: float, transverse: float, vertical: float
) -> TopMotion:
    """The motion of a heavy symmetric top from its state at one time. NaN where numbers are too
    large or small for it.

    across : moment of inertia across the axis, about the pivot
    moment : weight times the distance of the centre of mass from the pivot, m g l > 0
    momentum : angular momentum along the axis, L3
    cosine : of the angle between the axis and the vertical, u0
    transverse : square of the angular momentum across the axis
    vertical : component of the angular momentum across the axis along the vertical, I1 phi' sin²
        theta

    u = cos theta oscillates between the lower two roots of a cubic (Whittaker, section 71), here in
    x = u - u0, in which fast tops have no cancellation. The angle of precession is a sum of
    elliptic integrals of the third kind, of 1/(1 - u) and 1/(1 + u).
    """
    alpha = 2 * moment / across
    kappa = transverse / across**2
    w = vertical / across
    c = momentum / across
    sine = 1 - cosine * cosine
    cubic = np.array(
        [
            alpha,
            2 * alpha * cosine - kappa - c * c,
            2 * (w * c - kappa * cosine) - alpha * sine,
            kappa * sine - w * w,
        ]
    )
    if not (alpha > 0 and np.isfinite(cubic / alpha).all()):
        return TopMotion(np.nan, np.nan)
    top = np.roots(cubic).real.max()
    q = -cubic[3] / (alpha * top)
    p = (q - cubic[2] / alpha) / top
    half = np.sqrt(max(0.25 * p * p - q, 0.0))  # rounding may make it negative at steady precession
    low, high = np.clip([cosine - 0.5 * p - half, cosine - 0.5 * p + half], -1.0, 1.0)
    top += cosine
    rate = np.sqrt(alpha * (top - low)) / 2
    parameter = (high - low) / (top - low)
    angle = 0.0
    complement = float(1 - parameter)
    for pole in (1.0, -1.0):
        weight = w + c * (cosine - pole)
        distance = 1 - pole * low
        # without weight the axis does not circle this pole
        if distance > 0 and abs(weight) > np.finfo(float).eps * (abs(w) + abs(c)):
            n = pole * (high - low) / distance
            angle += weight / distance * complete_integral(complement, float(1 - n))
    first = complete_integral(complement)
    return TopMotion(float(angle / first / 2), float(2 * first / rate))


def free_body_period(inertia: np.ndarray, omega: np.ndarray) -> float:
    """The period of omega in a body with three different moments that no torque acts on: 4 K(m)/p.

    inertia, omega (3,) : along the principal axes. Twice in a period the component along the axis
        of the middle moment is zero. Infinite for a motion that never returns, such as rotation
        about the middle axis.
    """
    order = np.argsort(inertia)
    (a, b, c), squares = inertia[order], omega[order] ** 2
    # L² - 2 E I_k without cancellation
    from_low, from_middle, from_high = (
        (inertia[order] * squares) @ (inertia[order] - moment) for moment in (a, b, c)
    )
    if from_middle >= 0:
        rate, complement = (c - b) * from_low, (c - a) * from_middle
    else:
        rate, complement = (a - b) * from_high, (a - c) * from_middle
    if not (complement > 0 and rate > 0):
        return float("inf")
    return float(4 * complete_integral(float(complement / rate)) / np.sqrt(rate / (a * b * c)))
