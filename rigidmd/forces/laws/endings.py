"""Truncation of a radial law at its cut-off: plain, shift, force_shift, force_switch, switch or smooth_switch.

A law is a sum of radial parts v(r). Inside the cut-off, v(r) becomes

    v(r) + constant - integral of p(x) dx,   x = r - start,   p(x) = linear + quadratic x² + cubic x³   (r > start)

so p is added to the force -v'; or, for `switch` and `smooth_switch`, v(r) S(r) with S falling from 1 to 0.

| name | what it does | continuous at the cut-off |
|---|---|---|
| plain | nothing | nothing |
| shift | adds a constant (GROMACS potential-shift) | energy |
| force_shift | subtracts a linear term from the start | energy, force |
| force_switch | adds a cubic to the force beyond `start` (GROMACS) | energy, force, its derivative |
| switch | multiplies the energy by a quintic beyond `start` (OpenMM) | energy, force, its derivative |
| smooth_switch | multiplies the energy by a polynomial of degree 9 beyond `start` | also three more derivatives |

An integrator reaches its order only if the forces have enough derivatives. In liquid water, integrators of order 4 and
6 fall to about order 3 with `switch`; with `smooth_switch` from 5 to 9 Å they keep 4.0 and 6.
"""

from collections.abc import Callable
from math import inf
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.polynomial import chebyshev

from rigidmd.compile import implements, is_a, kernel
from rigidmd.compile.lanes import inverse_root, larger, polynomial

Name = Literal["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
NAMES: tuple[str, ...] = get_args(Name)


class Plain(NamedTuple):
    """No change of the force inside the cut-off; `plain` and `shift`."""

    cutoff: float  # Å, may be infinite


class Bent(NamedTuple):
    """A polynomial is added to the force beyond the start; `force_shift` and `force_switch`."""

    cutoff: float  # Å
    start: float  # Å


class Switched(NamedTuple):
    """The energy is multiplied by a polynomial of degree 5, from 1 at the start to 0 at the cut-off; `switch`."""

    cutoff: float  # Å
    start: float  # Å


class SmoothlySwitched(NamedTuple):
    """The energy is multiplied by a polynomial of degree 9, from 1 at the start to 0; `smooth_switch`."""

    cutoff: float  # Å
    start: float  # Å


Shape = Plain | Bent | Switched | SmoothlySwitched
Polynomial = tuple[float, float, float, float]
SWITCHES = {"switch": Switched, "smooth_switch": SmoothlySwitched}


def shape_of(name: Name, cutoff: float, start: float) -> Shape:
    """The shape of the ending `name`; `start` (Å) matters for force_switch, switch and smooth_switch only."""
    if cutoff == inf or name in ("plain", "shift"):
        return Plain(cutoff)
    if name in SWITCHES:
        return SWITCHES[name](cutoff, start)
    return Bent(cutoff, 0.0 if name == "force_shift" else start)


def ending(name: Name, shape: Shape, at_cutoff: Callable[[float], tuple[float, float, float]]) -> Polynomial:
    """(constant, linear, quadratic, cubic) for a radial part; at_cutoff(r) gives its energy v, force -v' and -v''."""
    if shape.cutoff == inf or name == "plain" or name in SWITCHES:
        return (0.0, 0.0, 0.0, 0.0)
    v, force, slope = at_cutoff(shape.cutoff)
    if name == "shift":
        return (-v, 0.0, 0.0, 0.0)
    d = shape.cutoff - shape.start
    if name == "force_shift":
        return (-v - force * d, -force, 0.0, 0.0)
    quadratic = (slope - 3 * force / d) / d
    cubic = (2 * force / d - slope) / d**2
    return (quadratic * d**3 / 3 + cubic * d**4 / 4 - v, 0.0, quadratic, cubic)


#: The error of a correction, relative to its largest value, and the most coefficients that it may take.
CORRECTION_ERROR, MOST_COEFFICIENTS = 2e-7, 18


def correction_of(
    shape: Shape, at: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]], dtype: type
) -> tuple[float, ...]:
    """Coefficients c0, c1, ... of what `switch` adds to force/r beyond its start: (x + 1)² (c0 + c1 x + c2 x² + ...).

    x goes from -1 at the start to 1 at the cut-off, evenly in r², so that forces need no root and no energy. In powers
    of x + 1 the terms would be thousands of times their sum. at(r) gives energy and force/r of the law without its
    ending. There are none, (), in double precision, which would take so many that little is gained; of other endings;
    and of a switch that is too wide.
    """
    if not isinstance(shape, Switched) or dtype != np.float32:
        return ()
    width, square = shape.cutoff - shape.start, shape.cutoff**2 - shape.start**2

    def over_square(x: np.ndarray) -> np.ndarray:
        r = np.sqrt(shape.start**2 + (x + 1) / 2 * square)
        per_x = square / (2 * (r + shape.start) * width)  # t = (r - start)/width is per_x (x + 1)
        t = per_x * (x + 1)
        u, w = at(r)
        return per_x**2 * (30 * (1 - t) ** 2 / width * u / r - t * (10 - t * (15 - 6 * t)) * w)

    with np.errstate(all="ignore"):  # a switch from 0 on is too wide
        found = chebyshev.chebinterpolate(over_square, 2 * MOST_COEFFICIENTS)
        x = np.linspace(-1, 1, 200)
        largest = np.abs((x + 1) ** 2 * over_square(x)).max()
    left_out = 4 * np.abs(found[::-1]).cumsum()[::-1]  # at most, without this coefficient and those after it
    count = int(np.argmax(left_out < CORRECTION_ERROR * largest))
    return tuple(chebyshev.cheb2poly(found[:count]).tolist()) if 0 < count <= MOST_COEFFICIENTS else ()


def ended(shape, end, correction, r2, inverse, u, w):
    """(energy, force/r) with the ending, from u, w without it at squared distances r2; scalars or vectors.

    u already includes the constant of `end`. inverse : 1/r, where `needs_root` says so. For `correction` see
    `correction_of`.
    """
    raise TypeError("compiled code only")


def needs_root(shape, correction) -> bool:
    """Whether a force with an ending needs 1/r, by their Numba types."""
    return not is_a(shape, Plain) and len(correction) == 0


@implements(ended, inline=True)
def _ended(shape, end, correction, r2, inverse, u, w):
    if is_a(shape, Plain):
        return lambda shape, end, correction, r2, inverse, u, w: (u, w)
    if is_a(shape, Bent):

        def bent(shape, end, correction, r2, inverse, u, w):
            du, df = added(end, larger(r2 * inverse - shape.start, 0.0))
            return u + du, w + df * inverse

        return bent

    factor = quintic if is_a(shape, Switched) else nonic
    if len(correction) == 0:

        def switched(shape, end, correction, r2, inverse, u, w):
            s, slope = factor(shape, r2 * inverse)
            return s * u, s * w - slope * u * inverse

        return switched

    def corrected(shape, end, correction, r2, inverse, u, w):
        first, last = shape.start * shape.start, shape.cutoff * shape.cutoff
        x = larger(r2 * (2 / (last - first)) - (last + first) / (last - first), -1.0)
        beyond = x + 1.0
        s, _ = quintic(shape, r2 * inverse_root(r2))  # for the energy alone
        return s * u, w + beyond * beyond * polynomial(correction, x)

    return corrected


@kernel(inline=True, outer=True)
def added(end, x):
    """(energy, force) that an ending adds at x = r - start >= 0, without its constant."""
    linear = end[1]
    quadratic = end[2]
    cubic = end[3]
    x2 = x * x
    return -1.0 * x * (linear + x2 * (quadratic / 3 + x * (cubic / 4))), linear + x2 * (quadratic + x * cubic)


@kernel(inline=True, outer=True)
def quintic(shape, r):
    """(S, dS/dr) of S = 1 - 10 t³ + 15 t⁴ - 6 t⁵, t = (r - start)/(cutoff - start); S = 1 below the start."""
    per_width = 1 / (shape.cutoff - shape.start)
    t = larger((r - shape.start) * per_width, 0.0)
    left = 1.0 - t
    return 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t)), t * t * left * left * (-30.0 * per_width)


@kernel(inline=True, outer=True)
def nonic(shape, r):
    """(S, dS/dr) of S = 1 - 126 t⁵ + 420 t⁶ - 540 t⁷ + 315 t⁸ - 70 t⁹, with t as in `quintic`."""
    per_width = 1 / (shape.cutoff - shape.start)
    t = larger((r - shape.start) * per_width, 0.0)
    four = t * t * t * t
    left2 = (1.0 - t) * (1.0 - t)
    s = 1.0 - four * t * (126.0 - t * (420.0 - t * (540.0 - t * (315.0 - 70.0 * t))))
    return s, four * left2 * left2 * (-630.0 * per_width)


POLYNOMIALS = {Switched: quintic, SmoothlySwitched: nonic}
