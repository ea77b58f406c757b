"""Screened Coulomb potential q_i q_j erfc(alpha r)/r: the real-space part of Ewald sums, and damped
shifted forces.

The pair loop computes neither erfc nor exp: erf(alpha r)/r, and its force over r, are polynomials
in r², fitted when the potential is created. A vector of pairs then costs one inverse square root
and one multiply-add per term. In vectors of 16 float32 the force is a table of cubics in r², whose
lookups run in parallel with the multiply-adds. See the theory chapter `interactions`.
"""

from functools import lru_cache
from math import exp, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import erfc, ive

from rigidmd.compile import chosen_by_type, implements, is_a, kernel
from rigidmd.compile.simd import (
    HAS_AVX512,
    inverse_root_and_cube,
    inverse_square_root,
    load,
    permute_two,
    polynomial,
    split_integer_part,
    zeros,
)
from rigidmd.forces.ewald.errors import MAX_ALPHA_CUTOFF
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.neighbors.space import Space
from rigidmd.forces.parts import Interactions, SystemParts
from rigidmd.scene.forces import Forces
from rigidmd.units import COULOMB_CHARGE

#: Largest error of a polynomial, relative to the function at r = 0, by precision: below the
#: rounding error of its evaluation, 5e-15 and 1.5e-7 for alpha times the cutoff up to 4.
FIT_ERROR = {np.dtype(np.float64): 1e-15, np.dtype(np.float32): 3e-8}
#: Numbers of terms of the energy and of the force, by precision, because each number compiles other
#: code: enough for alpha times the cutoff up to 3.1. Beyond, it grows by STEP.
TERMS_OF_ENERGY = {np.dtype(np.float64): 24, np.dtype(np.float32): 16}
TERMS_OF_FORCE = {np.dtype(np.float64): 24, np.dtype(np.float32): 12}
STEP = 8
#: Intervals of a table, and coefficients of each.
INTERVALS, TERMS = 32, 4
#: Largest error of a table, relative like FIT_ERROR: the rounding error of the polynomial that it
#: replaces.
TABLE_ERROR = 1.5e-7


class Screening(NamedTuple):
    """erf(alpha r)/r and its force over r, as polynomials in t = scale r² - 1, from -1 to 1 inside
    the cutoff."""

    scale: float  # 2/cutoff², 1/Å²
    energy: tuple[float, ...]  # coefficients of erf(alpha r)/r, 1/Å
    force: tuple[float, ...]  # coefficients of -(d/dr erf(alpha r)/r)/r, 1/Å³


@lru_cache(maxsize=64)
def screening(
    alpha: float, cutoff: float, dtype: type = np.float64, error: float = 0.0
) -> Screening:
    """The polynomials for screening by alpha (1/Å) up to a cutoff (Å), for lanes of a NumPy dtype.
    Each series is truncated where the rest is below FIT_ERROR of the value at r = 0, or where the
    error of the force between unit charges is below `error` (1/Å²)."""
    kind = np.dtype(dtype)
    strength = 2 / sqrt(pi) * alpha
    energy = _cut(_series(alpha * cutoff, 0), 0.0, kind, TERMS_OF_ENERGY[kind])
    of_unit = strength * 2 * alpha**2 * cutoff  # 0 without screening
    force = _cut(
        _series(alpha * cutoff, 2), error / of_unit if of_unit else 0.0, kind, TERMS_OF_FORCE[kind]
    )
    energy, force = strength * energy, strength * 2 * alpha**2 * force
    return Screening(
        kind.type(2 / cutoff**2), tuple(map(kind.type, energy)), tuple(map(kind.type, force))
    )


def dispersion_screening(beta: float, cutoff: float, dtype: type = np.float64) -> Screening:
    """As `screening`, for (1 - g(beta r))/r⁶ of `lennard_jones.ScreenedDispersion`, 1/Å⁶, and its
    force over r."""
    kind = np.dtype(dtype)
    energy = beta**6 * _cut(_series(beta * cutoff, 5), 0.0, kind, TERMS_OF_ENERGY[kind])
    force = 2 * beta**8 * _cut(_series(beta * cutoff, 7), 0.0, kind, TERMS_OF_FORCE[kind])
    return Screening(
        kind.type(2 / cutoff**2), tuple(map(kind.type, energy)), tuple(map(kind.type, force))
    )


class TabledScreening(NamedTuple):
    """`Screening` with the force over r as a cubic in x = s - k from s = k to k + 1, with s =
    density r²."""

    scale: float  # as in Screening
    energy: tuple[float, ...]
    density: float  # intervals per Å²
    # (TERMS INTERVALS,) float32, 1/Å³: coefficients of x^0 for all intervals, then of x^1, ...
    table: np.ndarray


def screening_of_lanes(
    alpha: float, cutoff: float, dtype: type, error: float = 0.0
) -> Screening | TabledScreening:
    """The faster form for lanes of a NumPy dtype: a table, if this machine supports it and it is
    accurate enough. The error of a table grows with alpha times the cutoff. It is used up to about
    3.2, or more if `error` (see `screening`) allows it."""
    by_formula = screening(alpha, cutoff, dtype, error)
    if not HAS_AVX512 or dtype != np.float32:
        return by_formula
    density, table, off = force_table(alpha, cutoff)
    at_zero = 4 * alpha**3 / (3 * sqrt(pi))
    if off > max(error, TABLE_ERROR * at_zero * cutoff):
        return by_formula
    aligned = zeros(table.size, np.float32)
    aligned[:] = table.ravel()
    return TabledScreening(by_formula.scale, by_formula.energy, density, aligned)


def force_table(alpha: float, cutoff: float) -> tuple[np.float32, np.ndarray, float]:
    """Density, coefficients (TERMS, INTERVALS) in single precision, and largest error of the force,
    1/Å². Each cubic meets the function at four Chebyshev nodes of its interval. Neighbours differ
    at the knot between them by up to twice the error."""
    # The last interval ends a little beyond the cutoff: a pair that rounding puts there must not
    # get the first cubic.
    density = np.float32(INTERVALS / cutoff**2 * (1 - 8 * np.finfo(np.float32).eps))
    node, weight = np.polynomial.legendre.leggauss(64 + int(8 * alpha * cutoff))
    s = 0.5 * (1 + node)
    weight = 0.5 * weight

    def exact(x):
        """Force over r, (..., INTERVALS), at x within all intervals."""
        r2 = np.add.outer(x, np.arange(INTERVALS)) / float(density)
        return (
            4
            * alpha**3
            / sqrt(pi)
            * (np.exp(-np.multiply.outer(r2, (alpha * s) ** 2)) @ (weight * s**2)),
            r2,
        )

    nodes = 0.5 + 0.5 * np.cos(pi * (np.arange(TERMS) + 0.5) / TERMS)
    powers = np.vander(nodes, increasing=True)
    table = np.linalg.solve(powers, exact(nodes)[0]).astype(np.float32)
    x = np.linspace(0, 1, 33)
    force, r2 = exact(x)
    off = np.abs(np.vander(x, TERMS, increasing=True) @ table.astype(float) - force) * np.sqrt(r2)
    return density, table, float(off.max())


def _cut(series: np.ndarray, error: float, kind: np.dtype, terms: int) -> np.ndarray:
    """Coefficients in powers of t for a Chebyshev series, truncated at an error to a number of
    terms, or STEP more."""
    left = np.cumsum(np.abs(series[::-1]))[::-1]
    needed = int(np.sum(left > max(error, FIT_ERROR[kind] * left[0])))
    count = terms + max(0, -(-(needed - terms) // STEP)) * STEP
    powers = np.polynomial.chebyshev.cheb2poly(series[:count])
    return np.pad(powers, (0, count - len(powers)))


def _series(x: float, power: int) -> np.ndarray:
    """Chebyshev coefficients over t, -1 ... 1, of the integral over s from 0 to 1 of s^power
    exp(-x² s² (1 + t)/2).

    With x = alpha cutoff this is erf(alpha r)/r for power 0, and its force over r for power 2,
    apart from a factor. The coefficients of the exponential are Bessel functions of one sign under
    the integral, so that even the smallest is accurate to rounding and the series can be converted
    to powers of t.
    """
    node, weight = np.polynomial.legendre.leggauss(64 + int(8 * x))
    s = 0.5 * (1 + node)
    weight = 0.5 * weight
    k = np.arange(16 + int(8 * x))
    bessel = ive(k[:, None], 0.5 * (x * s) ** 2) @ (weight * s**power)
    return np.where(k == 0, 1, 2) * (-1.0) ** k * bessel


class ScreenedCoulomb(NamedTuple):
    """q_i q_j [erfc(alpha r)/r - shift], truncated at the cutoff R: the pair part of an Ewald sum.
    shift is erfc(alpha R)/R, or 0: the energy then jumps when a pair crosses the cutoff, which is
    most of its noise at small steps."""

    cutoff: float  # Å
    alpha: float  # 1/Å
    shift: float  # 1/Å
    error: float  # allowed for forces between unit charges in single precision, 1/Å²
    screening: Screening | TabledScreening
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²

    acts_on_charges = True

    def for_slots(self, slots: int, dtype: type) -> "ScreenedCoulomb":
        """The potential with an array for the charges in slots, in the precision of the pair
        loop."""
        error = self.error if dtype == np.float32 else 0.0
        fitted = screening_of_lanes(self.alpha, self.cutoff, dtype, error)
        return self._replace(charge=zeros(slots, dtype), screening=fitted)


def screened_coulomb(
    charge_e: np.ndarray, cutoff: float, alpha: float, *, shifted: bool = False, error: float = 0.0
) -> ScreenedCoulomb:
    """The potential for sites with charges (s,) in e.

    shifted : whether the energy is 0 at the cutoff
    error : allowed for forces between unit charges in single precision, 1/Å²
    """
    shift = float(erfc(alpha * cutoff)) / cutoff if shifted else 0.0
    return ScreenedCoulomb(
        cutoff, alpha, shift, error, screening(alpha, cutoff), charge_e * COULOMB_CHARGE
    )


class DampedShiftedForce(NamedTuple):
    """Damped shifted force (Fennell & Gezelter 2006, J. Chem. Phys. 124, 234104, eq. 18), see the
    theory chapter `interactions`. The same as coul/dsf of LAMMPS."""

    cutoff: float  # Å
    alpha: float  # 1/Å
    screening: Screening | TabledScreening
    slope: float  # 1/Å²
    shift: float  # 1/Å, the constant part
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²

    acts_on_charges = True

    def for_slots(self, slots: int, dtype: type) -> "DampedShiftedForce":
        """The potential with an array for the charges in slots, in the precision of the pair
        loop."""
        fitted = screening_of_lanes(self.alpha, self.cutoff, dtype)
        return self._replace(charge=zeros(slots, dtype), screening=fitted)


def damped_shifted_force(charge_e: np.ndarray, cutoff: float, alpha: float) -> DampedShiftedForce:
    """The potential for sites with charges (s,) in e; alpha in 1/Å, 0 for no damping."""
    x = alpha * cutoff
    slope = float(erfc(x)) / cutoff**2 + 2 * alpha / sqrt(pi) * exp(-(x**2)) / cutoff
    shift = -float(erfc(x)) / cutoff - slope * cutoff
    return DampedShiftedForce(
        cutoff, alpha, screening(alpha, cutoff), slope, shift, charge_e * COULOMB_CHARGE
    )


def setting_errors(forces: Forces, space: Space, cutoff: float) -> list[str]:
    """Messages on the keys of [forces] of electrostatics = "damped_shifted_force"."""
    if cutoff == inf:
        return [
            "forces.electrostatics = 'damped_shifted_force' needs a cutoff. Give forces.cutoff_A"
        ]
    return screening_errors("damping_per_A", forces.damping_per_A, cutoff)


def screening_errors(key: str, alpha: float | None, cutoff: float) -> list[str]:
    """A message on a key of [forces] that screens charges by alpha (1/Å) far below rounding at a
    cutoff (Å)."""
    if alpha is None or not alpha * cutoff > MAX_ALPHA_CUTOFF:
        return []
    return [
        f"forces.{key} = {alpha:g} with a cutoff of {cutoff:g} Å screens charges there by"
        f" erfc({alpha * cutoff:.3g}), far below rounding. At most {MAX_ALPHA_CUTOFF / cutoff:.3g}"
        " is of use"
    ]


def interactions(parts: SystemParts) -> Interactions:
    """The charges of a scene with electrostatics = "damped_shifted_force"."""
    forces, (sites, charge) = parts.scene.forces, parts.charged()
    potential = damped_shifted_force(charge, forces.cutoff_A or inf, forces.damping_per_A)
    constant = parts.sum_over_molecules(
        lambda q, x: damped_self_energy(potential._replace(charge=q), x)
    )
    return Interactions({"coulomb": parts.pair_forces(potential, sites)}, {"damped_self": constant})


@chosen_by_type(inline=True)
def screened(screening, inverse, cube, r2):
    """(energy, force/r) of two unit charges with erfc(alpha r)/r, from 1/r, two factors of 1/r³,
    and r². For scalars `screening` must not be a table. Valid up to the cutoff."""
    if is_a(screening, Screening):

        def by_polynomials(screening, inverse, cube, r2):
            t = screening.scale * r2 - 1.0
            u = inverse - polynomial(screening.energy, t)
            w = cube[0] * cube[1] - polynomial(screening.force, t)
            return u, w

        return by_polynomials
    if not is_a(screening, TabledScreening):
        return None

    def by_table(screening, inverse, cube, r2):
        u = inverse - polynomial(screening.energy, screening.scale * r2 - 1.0)
        k, x = split_integer_part(screening.density * r2)
        force = _coefficient(screening.table, 3, k)
        for term in (2, 1, 0):
            force = force * x + _coefficient(screening.table, term, k)
        return u, cube[0] * cube[1] - force

    return by_table


@kernel(inline=True)
def _coefficient(table, term, k):
    """Coefficients of x^term in intervals k."""
    return permute_two(load(table, INTERVALS * term), load(table, INTERVALS * term + 16), k)


@implements(pairs.pair, ScreenedCoulomb, inline=True)
def _screened_pair(potential, i, j, r2):
    qq = potential.charge[i] * load(potential.charge, j)
    inverse, one, two = inverse_root_and_cube(r2)
    u, w = screened(potential.screening, inverse, (one, two), r2)
    return qq * (u - potential.shift), qq * w


@implements(pairs.pair, DampedShiftedForce, inline=True)
def _shifted_pair(potential, i, j, r2):
    qq = potential.charge[i] * load(potential.charge, j)
    inverse = inverse_square_root(r2)
    u, w = screened(potential.screening, inverse, (inverse, inverse * inverse), r2)
    return qq * (u + potential.slope * (r2 * inverse) + potential.shift), qq * (
        w - potential.slope * inverse
    )


def damped_self_energy(potential: DampedShiftedForce, position: np.ndarray) -> float:
    """Energy (u Å²/ps²) of the charges of one molecule with the neutralising images of damped
    shifted force. position (s, 3) of the charged sites of the molecule, in the order of the first s
    of potential.charge."""
    charge = potential.charge[: len(position)]
    energy = (0.5 * potential.shift - potential.alpha / sqrt(pi)) * charge @ charge
    for i in range(len(position)):
        for j in range(i):
            r = float(np.linalg.norm(position[i] - position[j]))
            inside = r < potential.cutoff
            u = (
                float(erfc(potential.alpha * r)) / r + potential.slope * r + potential.shift
                if inside
                else 0.0
            )
            energy += charge[i] * charge[j] * (u - 1 / r)
    return float(energy)
