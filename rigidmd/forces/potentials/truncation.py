"""Truncation of a pair potential at its cutoff: plain, shift, force_shift, force_switch, switch or
smooth_switch.

Inside the cutoff a radial part v(r) becomes v(r) S(r) with a switch S, or else, with p added to the
force -v',

    v(r) + constant - integral of p(x) dx   (r > start),
    x = r - start,   p(x) = linear + quadratic x² + cubic x³

See the theory chapter `interactions` for the formulas and for what is continuous, and `dynamics`
for the order that integrators keep.
"""

from collections.abc import Callable
from fractions import Fraction
from math import inf
from typing import NamedTuple, get_args

import numpy as np
from numpy.polynomial import Polynomial as Polynomials
from numpy.polynomial import chebyshev

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.compile.simd import inverse_square_root, polynomial
from rigidmd.scene.truncation import TruncationName

TRUNCATIONS: tuple[str, ...] = get_args(TruncationName)


class Unmodified(NamedTuple):
    """The force inside the cutoff is not changed. `plain` and `shift`."""

    cutoff: float  # Å, may be infinite


class ForceShifted(NamedTuple):
    """A polynomial is added to the force beyond the start. `force_shift` and `force_switch`."""

    cutoff: float  # Å
    start: float  # Å


class Switched(NamedTuple):
    """The energy is multiplied by a polynomial of degree 5, from 1 at the start to 0 at the cutoff.
    `switch`."""

    cutoff: float  # Å
    start: float  # Å


class SmoothlySwitched(NamedTuple):
    """The energy is multiplied by a polynomial of degree 9, from 1 at the start to 0.
    `smooth_switch`."""

    cutoff: float  # Å
    start: float  # Å


Truncation = Unmodified | ForceShifted | Switched | SmoothlySwitched
TruncationTerms = tuple[float, float, float, float]
SWITCHES = {"switch": Switched, "smooth_switch": SmoothlySwitched}


def truncation_of(name: TruncationName, cutoff: float, start: float) -> Truncation:
    """The truncation with this name. `start` (Å) matters for force_switch, switch and smooth_switch
    only."""
    if cutoff == inf or name in ("plain", "shift"):
        return Unmodified(cutoff)
    if name in SWITCHES:
        return SWITCHES[name](cutoff, start)
    return ForceShifted(cutoff, 0.0 if name == "force_shift" else start)


def truncation_terms(
    name: TruncationName,
    truncation: Truncation,
    at_cutoff: Callable[[float], tuple[float, float, float]],
) -> TruncationTerms:
    """(constant, linear, quadratic, cubic) for a radial part. at_cutoff(r) gives its energy v,
    force -v' and -v''."""
    if truncation.cutoff == inf or name == "plain" or name in SWITCHES:
        return (0.0, 0.0, 0.0, 0.0)
    v, force, slope = at_cutoff(truncation.cutoff)
    if name == "shift":
        return (-v, 0.0, 0.0, 0.0)
    d = truncation.cutoff - truncation.start
    if name == "force_shift":
        return (-v - force * d, -force, 0.0, 0.0)
    quadratic = (slope - 3 * force / d) / d
    cubic = (2 * force / d - slope) / d**2
    return (quadratic * d**3 / 3 + cubic * d**4 / 4 - v, 0.0, quadratic, cubic)


#: k and c of a switch S = 1 + t^(k+1) (c0 + c1 t + c2 t² + ...), t = (r - start)/(cutoff - start).
#: Its derivative by t is (k + 1) c0 t^k (1 - t)^k.
SWITCH_SERIES = {Switched: (2, (-10, 15, -6)), SmoothlySwitched: (4, (-126, 420, -540, 315, -70))}


class SwitchTerm(NamedTuple):
    """t^k (b0 + b1 t + b2 t² + ...), which a switch adds to p in p/r^(p+2), the force/r of
    1/r^p."""

    coefficients: tuple[float, ...]


class SwitchCorrection(NamedTuple):
    """(x + 1)² (b0 + b1 x + b2 x² + ...), which `switch` adds to force/r. It needs no square root.
    x is linear in r², from -1 at the start to 1 at the cutoff. In powers of x + 1 the terms would
    be thousands of times their sum."""

    coefficients: tuple[float, ...]


#: Instead of a `SwitchTerm` or `SwitchCorrection`, for other truncations.
NO_SWITCH = ()
#: The error of a `SwitchCorrection`, relative to its largest value, and its numbers of
#: coefficients: each compiles other code, and the first is enough for a switch over the last sixth
#: of the cutoff.
CORRECTION_ERROR = 2e-7
COEFFICIENTS = (12, 18)


def switch_term_of(
    truncation: Truncation, powers: dict[int, float], dtype: type
) -> SwitchTerm | tuple[()]:
    """The switch term of a power c/r^p, given as {p: c}, or of a sum of powers, for the coefficient
    of the highest.

    It is exact: force/r of r^-p becomes r^-(p+2) (p S - r S'), and S is a polynomial in t, as r is.
    Fractions keep all digits where powers cancel, as in a reaction field. There is none for
    `smooth_switch` in single precision, where its terms are up to 1e4 times their sum.
    """
    if type(truncation) not in SWITCH_SERIES or (
        isinstance(truncation, SmoothlySwitched) and dtype == np.float32
    ):
        return NO_SWITCH
    k, series = SWITCH_SERIES[type(truncation)]
    start = Fraction(truncation.start)
    width = Fraction(truncation.cutoff) - Fraction(truncation.start)
    t, left = Polynomials([Fraction(0), Fraction(1)]), Polynomials([Fraction(1), Fraction(-1)])
    r = start + width * t
    fall = sum((c * t ** (n + 1) for n, c in enumerate(series)), t * 0)  # of S, less 1, over t^k
    slope = (k + 1) * series[0] * left**k / width
    of_powers = [
        Fraction(c) * r ** (max(powers) - p) * (p * fall - r * slope) for p, c in powers.items()
    ]
    return SwitchTerm(tuple(float(b) for b in sum(of_powers).coef))


def switch_correction_of(
    truncation: Truncation, powers: dict[int, float], dtype: type
) -> SwitchCorrection | tuple[()]:
    """The switch correction of a sum of powers, given as for `switch_term_of`, in single precision.
    There is none in double precision, where it would have too many coefficients, for a switch that
    is too wide, and for `smooth_switch`, whose terms would be a thousand times their sum."""
    if not isinstance(truncation, Switched) or dtype != np.float32 or truncation.start == 0:
        return NO_SWITCH
    of_highest = Polynomials(switch_term_of(truncation, powers, np.float64).coefficients)

    def over_square(x: np.ndarray) -> np.ndarray:
        square = truncation.cutoff**2 - truncation.start**2
        r = np.sqrt(truncation.start**2 + (x + 1) / 2 * square)
        # t is per_x (x + 1)
        per_x = square / (2 * (r + truncation.start) * (truncation.cutoff - truncation.start))
        return per_x**2 * of_highest(per_x * (x + 1)) * r ** -(max(powers) + 2.0)

    x = np.linspace(-1, 1, 200)
    with np.errstate(all="ignore"):  # a switch that starts near 0 is too wide
        coefficients = chebyshev.chebinterpolate(over_square, 2 * COEFFICIENTS[-1])
        largest = np.abs((x + 1) ** 2 * over_square(x)).max()
    # at most, without this coefficient and those after it
    left_out = 4 * np.abs(coefficients[::-1]).cumsum()[::-1]
    needed = int(np.argmax(left_out < CORRECTION_ERROR * largest))
    counts = [count for count in COEFFICIENTS if 0 < needed <= count]
    if not counts:
        return NO_SWITCH
    powers = chebyshev.cheb2poly(coefficients[: counts[0]])
    return SwitchCorrection(tuple(np.pad(powers, (0, counts[0] - len(powers))).tolist()))


@chosen_by_type(inline=True)
def switch_term(truncation, switched, r):
    """A `SwitchTerm` at distances r, 0 below the start, and for anything else."""
    if not is_a(switched, SwitchTerm):
        return lambda truncation, switched, r: 0.0
    is_quintic = is_a(truncation, Switched)

    def switch_term(truncation, switched, r):
        t = switch_coordinate(truncation, r)
        square = t * t
        return (square if is_quintic else square * square) * polynomial(switched.coefficients, t)

    return switch_term


@chosen_by_type(inline=True)
def correction(truncation, switched, r2):
    """A `SwitchCorrection` at squared distances r2, 0 below the start, and for anything else."""
    if not is_a(switched, SwitchCorrection):
        return lambda truncation, switched, r2: 0.0

    def correction(truncation, switched, r2):
        first, last = truncation.start * truncation.start, truncation.cutoff * truncation.cutoff
        x = max(r2 * (2 / (last - first)) - (last + first) / (last - first), -1.0)
        return (x + 1.0) * (x + 1.0) * polynomial(switched.coefficients, x)

    return correction


@kernel(inline=True, from_python=True)
def switch_coordinate(truncation, r):
    """t of a switch: 0 up to the start, 1 at the cutoff."""
    return max((r - truncation.start) * (1 / (truncation.cutoff - truncation.start)), 0.0)


def needs_root(truncation, switched) -> bool:
    """Whether a truncated force needs 1/r, by the Numba types."""
    return not is_a(truncation, Unmodified) and not is_a(switched, SwitchCorrection)


@chosen_by_type(inline=True)
def truncated(truncation, terms, switched, r2, inverse, u, w):
    """(energy, force/r) with the truncation, from u, w without it at squared distances r2. Scalars
    or vectors. u
    already includes the constant of `terms`. inverse : 1/r, if `needs_root`. switched : the switch
    term or correction that w already includes. Without one, a switch multiplies the energy here,
    for any potential"""
    if is_a(truncation, Unmodified):
        return lambda truncation, terms, switched, r2, inverse, u, w: (u, w)
    if is_a(truncation, ForceShifted):

        def bent(truncation, terms, switched, r2, inverse, u, w):
            du, df = truncation_polynomial(terms, max(r2 * inverse - truncation.start, 0.0))
            return u + du, w + df * inverse

        return bent

    factor = quintic if is_a(truncation, Switched) else nonic
    if len(switched) > 0:  # only the energy needs the root
        return lambda truncation, terms, switched, r2, inverse, u, w: (
            factor(truncation, r2 * inverse_square_root(r2))[0] * u,
            w,
        )

    def multiplied(truncation, terms, switched, r2, inverse, u, w):
        s, slope = factor(truncation, r2 * inverse)
        return s * u, s * w - slope * u * inverse

    return multiplied


@kernel(inline=True, from_python=True)
def truncation_polynomial(terms, x):
    """(energy, force) that truncation terms add at x = r - start >= 0, without the constant."""
    linear = terms[1]
    quadratic = terms[2]
    cubic = terms[3]
    x2 = x * x
    return -1.0 * x * (linear + x2 * (quadratic / 3 + x * (cubic / 4))), linear + x2 * (
        quadratic + x * cubic
    )


@kernel(inline=True, from_python=True)
def quintic(truncation, r):
    """(S, dS/dr) of S = 1 - 10 t³ + 15 t⁴ - 6 t⁵, with t of `switch_coordinate`."""
    t = switch_coordinate(truncation, r)
    left = 1.0 - t
    slope = t * t * left * left * (-30.0 / (truncation.cutoff - truncation.start))
    return 1.0 - t * t * t * (10.0 - t * (15.0 - 6.0 * t)), slope


@kernel(inline=True, from_python=True)
def nonic(truncation, r):
    """(S, dS/dr) of S = 1 - 126 t⁵ + 420 t⁶ - 540 t⁷ + 315 t⁸ - 70 t⁹, with t of
    `switch_coordinate`."""
    t = switch_coordinate(truncation, r)
    four = t * t * t * t
    left2 = (1.0 - t) * (1.0 - t)
    s = 1.0 - four * t * (126.0 - t * (420.0 - t * (540.0 - t * (315.0 - 70.0 * t))))
    return s, four * left2 * left2 * (-630.0 / (truncation.cutoff - truncation.start))


SWITCH_FUNCTIONS = {Switched: quintic, SmoothlySwitched: nonic}


def removed_energy(
    energy: Callable[[np.ndarray], np.ndarray],
    truncation: Truncation,
    terms: TruncationTerms,
    r: np.ndarray,
) -> np.ndarray:
    """The energy v(r) of a radial part less its truncated energy, at distances r (p,) in Å, 0
    included.

    energy : v, only called where it is needed, and not at 0 unless the truncation starts there
    """
    removed = np.full(r.shape, -terms[0])
    if isinstance(truncation, ForceShifted):
        polynomial_terms = tuple(float(x) for x in terms)
        removed -= [
            truncation_polynomial(polynomial_terms, max(x - truncation.start, 0.0))[0]
            for x in r.tolist()
        ]
    elif not isinstance(truncation, Unmodified):
        switched = r > truncation.start
        switch = SWITCH_FUNCTIONS[type(truncation)]
        removed[switched] = energy(r[switched]) * [
            1 - switch(truncation, x)[0] for x in r[switched].tolist()
        ]
    removed[r > truncation.cutoff] = energy(r[r > truncation.cutoff])
    return removed


def integral_of_removed_energy(
    energy: Callable[[np.ndarray], np.ndarray], truncation: Truncation, terms: TruncationTerms
) -> float:
    """Integral of r² (v(r) - truncated v(r)) from 0 to the cutoff."""
    start = truncation.cutoff if isinstance(truncation, Unmodified) else truncation.start

    def removed(r: float) -> float:
        return r**2 * float(removed_energy(energy, truncation, terms, np.array([r]))[0])

    inside = -terms[0] * start**3 / 3
    if start == truncation.cutoff:
        return inside
    from scipy.integrate import quad  # slow to import

    return inside + quad(removed, start, truncation.cutoff)[0]


#: A cutoff this close to the minimum of an energy, as a fraction, is the rounded minimum of a
#: repulsive potential.
MINIMUM_TOLERANCE = 0.01


def short_cutoff_note(cutoff: float, sites: str, minimum: float) -> str:
    """A note on a cutoff (Å) below the minimum of the energy of two sites."""
    unit = "Is it in nm? " if cutoff < 2 < minimum else ""
    return (
        f"a cutoff of {cutoff:g} Å is shorter than {minimum:.3g} Å, where the energy of {sites} has"
        f" its minimum: they only repel each other, and no liquid holds together. {unit}A usual"
        f" cutoff is {2.2 * minimum:.2g} Å or more"
    )


def default_switch_start(truncation: str, cutoff: float) -> float:
    """The default of switch_start_A, Å."""
    return 0.6 * cutoff if truncation == "smooth_switch" else max(0.9 * cutoff, cutoff - 1.0)
