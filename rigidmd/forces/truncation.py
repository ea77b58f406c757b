"""How a radial law ends at its cut-off: plain, shift, force_shift, force_switch, switch or smooth_switch.

A law is a sum of radial parts v(r). Inside the cut-off a part becomes

    v(r) + constant - integral of p(x) dx,   x = r - start,   p(x) = linear + quadratic x² + cubic x³   (r > start)

so p is what is added to the force -v'; or, for `switch` and `smooth_switch`, v(r) S(r) with S falling from 1 to 0.

| name | what it does | continuous at the cut-off |
|---|---|---|
| plain | nothing | nothing |
| shift | adds a constant (GROMACS potential-shift) | energy |
| force_shift | subtracts a linear term from the start | energy, force |
| force_switch | adds a cubic to the force beyond `start` (GROMACS) | energy, force, its derivative |
| switch | multiplies the energy by a quintic beyond `start` (OpenMM) | energy, force, its derivative |
| smooth_switch | multiplies the energy by a polynomial of degree 9 beyond `start` | also three more derivatives |

An integrator has its order only where forces have as many derivatives: with `switch` those of order 4 and 6 fall off to
about 3 in liquid water, with `smooth_switch` from 5 to 9 Å they have 4.0 and 6.
"""

from collections.abc import Callable
from math import inf
from typing import Literal, NamedTuple, get_args

import numpy as np

from rigidmd.jit import PAIR_FLAGS, kernel

Name = Literal["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
NAMES: tuple[str, ...] = get_args(Name)
#: Endings that multiply -> degree of the polynomial.
SWITCHES = {"switch": 5, "smooth_switch": 9}


class Shape(NamedTuple):
    """Where the ending begins and whether it multiplies (switch) or adds."""

    cutoff: float  # Å, may be infinite
    start: float  # Å; equal to the cut-off where nothing happens before it
    switched: int  # degree of the polynomial that multiplies; 0 where none does


def shape_of(name: Name, cutoff: float, start: float) -> Shape:
    """The shape of the ending called `name`; `start` (Å) counts for force_switch and the switches only."""
    if cutoff == inf:
        return Shape(inf, inf, 0)
    if name == "force_shift":
        return Shape(cutoff, 0.0, 0)
    if name == "force_switch" or name in SWITCHES:
        return Shape(cutoff, start, SWITCHES.get(name, 0))
    return Shape(cutoff, cutoff, 0)


def ending(name: Name, shape: Shape, at_cutoff: Callable[[float], tuple[float, float, float]]) -> np.ndarray:
    """(constant, linear, quadratic, cubic) for a radial part; at_cutoff(r) is its energy v, force -v' and -v''."""
    if shape.cutoff == inf or name == "plain" or name in SWITCHES:
        return np.zeros(4)
    v, force, slope = at_cutoff(shape.cutoff)
    if name == "shift":
        return np.array([-v, 0.0, 0.0, 0.0])
    d = shape.cutoff - shape.start
    if name == "force_shift":
        return np.array([-v - force * d, -force, 0.0, 0.0])
    quadratic = (slope - 3 * force / d) / d
    cubic = (2 * force / d - slope) / d**2
    return np.array([quadratic * d**3 / 3 + cubic * d**4 / 4 - v, 0.0, quadratic, cubic])


@kernel(fastmath=PAIR_FLAGS, inline=True)
def added(end, x):
    """(energy, force) that an ending adds at x = r - start > 0, its constant not counted."""
    linear = end[1]
    quadratic = end[2]
    cubic = end[3]
    x2 = x * x
    return -x * (linear + x2 * (quadratic / 3 + x * cubic / 4)), linear + x2 * (quadratic + x * cubic)


@kernel(fastmath=PAIR_FLAGS, inline=True)
def switching(degree, cutoff, start, r):
    """(S, dS/dr) of the polynomial of degree 5 or 9 in t = (r - start)/(cutoff - start) that is flattest at both ends:

    1 - 10 t³ + 15 t⁴ - 6 t⁵, or 1 - 126 t⁵ + 420 t⁶ - 540 t⁷ + 315 t⁸ - 70 t⁹.
    """
    width = cutoff - start
    t = (r - start) / width
    if degree == 9:
        four = t * t * t * t
        return (
            1 - four * t * (126 - t * (420 - t * (540 - t * (315 - 70 * t)))),
            -630 * four * (1 - t) ** 4 / width,
        )
    return 1 - t * t * t * (10 - t * (15 - 6 * t)), -30 * t * t * (1 - t) ** 2 / width
