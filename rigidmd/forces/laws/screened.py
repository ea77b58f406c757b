"""Charges whose Coulomb law is screened, erfc(alpha r)/r: the real-space part of Ewald sums, and damped shifted forces.

Neither erfc nor exp is computed in the pair loop. The part that screening takes away, erf(alpha r)/r, is a smooth
function of r², and so is what it adds to the force; each is a polynomial in r², fitted when the law is made, with as
many terms as the cut-off, alpha and the precision of the loop ask for. A vector of pairs then costs one inverse root
and one multiply-add a term, and the functions that exclusions inside molecules need are the same ones.
"""

from math import exp, pi, sqrt
from typing import NamedTuple

import numpy as np
from scipy.special import erfc, ive

from rigidmd.compile import PAIR_FLAGS, implements, is_a, kernel
from rigidmd.compile.lanes import inverse_root, load, polynomial, zeros
from rigidmd.forces.pairs import loop as pairs
from rigidmd.units import COULOMB_CHARGE

#: Largest error of a polynomial, relative to the function at r = 0, by the precision of the lanes: less than rounding
#: in its evaluation makes, 1.5e-7 and 5e-15 for alpha times the cut-off up to 4.
FIT_ERROR = {np.dtype(np.float64): 2e-16, np.dtype(np.float32): 3e-8}
STEP = {np.dtype(np.float64): 4, np.dtype(np.float32): 2}


class Screening(NamedTuple):
    """erf(alpha r)/r and its force over r, as polynomials in t = scale r² - 1, which is -1 ... 1 inside the cut-off."""

    scale: float  # 2/cutoff², 1/Å²
    energy: tuple[float, ...]  # coefficients of erf(alpha r)/r, 1/Å
    force: tuple[float, ...]  # coefficients of -(d/dr erf(alpha r)/r)/r, 1/Å³


def screening(alpha: float, cutoff: float, dtype: type = np.float64, error: float = 0.0) -> Screening:
    """The polynomials for screening by alpha (1/Å) up to a cut-off (Å), for lanes of a NumPy dtype.

    Series are cut where what is left is below FIT_ERROR of the value at r = 0, or where no force between unit charges
    is off by more than an `error` (1/Å²); each has a multiple of STEP terms, so that small changes of alpha meet the
    same compiled code.
    """
    kind = np.dtype(dtype)
    strength = 2 / sqrt(pi) * alpha
    energy = _cut(_series(alpha * cutoff, 0), 0.0, kind)
    force = _cut(_series(alpha * cutoff, 2), error / (strength * 2 * alpha**2 * cutoff), kind)
    return Screening(
        kind.type(2 / cutoff**2),
        tuple(map(kind.type, strength * energy)),
        tuple(map(kind.type, strength * 2 * alpha**2 * force)),
    )


def _cut(series: np.ndarray, error: float, kind: np.dtype) -> np.ndarray:
    """Coefficients of powers of t for as much of a Chebyshev series as its error asks for."""
    left = np.cumsum(np.abs(series[::-1]))[::-1]
    needed = int(np.sum(left > max(error, FIT_ERROR[kind] * left[0])))
    return np.polynomial.chebyshev.cheb2poly(series[: -(-max(needed, 1) // STEP[kind]) * STEP[kind]])


def _series(x: float, power: int) -> np.ndarray:
    """Chebyshev coefficients over t, -1 ... 1, of the integral over s from 0 to 1 of s^power exp(-x² s² (1 + t)/2).

    With x = alpha cutoff that is, but for its strength, erf(alpha r)/r for power 0 and its force over r for power 2.
    Those of the exponential are Bessel functions, all of one sign under the integral, so that even the smallest is good
    to rounding and powers of t can be had from them.
    """
    node, weight = np.polynomial.legendre.leggauss(64 + int(8 * x))
    s, weight = 0.5 * (1 + node), 0.5 * weight
    k = np.arange(16 + int(8 * x))
    bessel = ive(k[:, None], 0.5 * (x * s) ** 2) @ (weight * s**power)
    return np.where(k == 0, 1, 2) * (-1.0) ** k * bessel


class ScreenedCoulomb(NamedTuple):
    """q_i q_j [erfc(alpha r)/r - shift], ending plainly at the cut-off R: what Ewald sums leave to pairs of sites.

    With shift = erfc(alpha R)/R the energy is what the forces conserve: without it, it jumps where pairs cross the
    cut-off, which is most of its noise at small steps. Forces are the same.
    """

    cutoff: float  # Å
    alpha: float  # 1/Å
    shift: float  # 1/Å
    error: float  # of forces between unit charges that single precision may leave, 1/Å²
    screening: Screening
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²

    def room(self, slots: int, dtype: type) -> "ScreenedCoulomb":
        """The law with room for the charges in slots, in the precision of lanes."""
        error = self.error if dtype == np.float32 else 0.0
        return self._replace(charge=zeros(slots, dtype), screening=screening(self.alpha, self.cutoff, dtype, error))


def screened_coulomb(
    charge_e: np.ndarray, cutoff: float, alpha: float, shifted: bool = False, error: float = 0.0
) -> ScreenedCoulomb:
    """The law for sites with charges (s,) in e.

    shifted : whether the energy is 0 at the cut-off
    error : of forces between unit charges that may be left in single precision, where more terms of the polynomials
    would only take time; 1/Å²
    """
    shift = float(erfc(alpha * cutoff)) / cutoff if shifted else 0.0
    return ScreenedCoulomb(cutoff, alpha, shift, error, screening(alpha, cutoff), charge_e * COULOMB_CHARGE)


class DampedShiftedForce(NamedTuple):
    """q_i q_j [erfc(alpha r)/r - erfc(alpha R)/R + slope (r - R)]: energy and force reach 0 at the cut-off R.

    slope = erfc(alpha R)/R² + 2 alpha exp(-alpha² R²)/(sqrt(pi) R) (Fennell & Gezelter 2006, J. Chem. Phys. 124,
    234104, eq. 18); the same as coul/dsf of LAMMPS.
    """

    cutoff: float  # Å
    alpha: float  # 1/Å
    screening: Screening
    slope: float  # 1/Å²
    shift: float  # 1/Å, all that does not depend on r
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²

    def room(self, slots: int, dtype: type) -> "DampedShiftedForce":
        """The law with room for the charges in slots, in the precision of lanes."""
        return self._replace(charge=zeros(slots, dtype), screening=screening(self.alpha, self.cutoff, dtype))


def damped_shifted_force(charge_e: np.ndarray, cutoff: float, alpha: float) -> DampedShiftedForce:
    """The law for sites with charges (s,) in e; alpha in 1/Å, 0 for no damping."""
    x = alpha * cutoff
    slope = float(erfc(x)) / cutoff**2 + 2 * alpha / sqrt(pi) * exp(-(x**2)) / cutoff
    shift = -float(erfc(x)) / cutoff - slope * cutoff
    return DampedShiftedForce(cutoff, alpha, screening(alpha, cutoff), slope, shift, charge_e * COULOMB_CHARGE)


@kernel(fastmath=PAIR_FLAGS, inline=True)
def screened(screening, inverse, r2):
    """(energy, force/r) of two unit charges by erfc(alpha r)/r; 1/r and r² are given, numbers or vectors."""
    t = screening.scale * r2 - 1.0
    u = inverse - polynomial(screening.energy, t)
    w = inverse * inverse * inverse - polynomial(screening.force, t)
    return u, w


@implements(pairs.pair, PAIR_FLAGS, inline=True)
def _pair(law, i, j, r2):
    if is_a(law, ScreenedCoulomb):

        def ewald_pair(law, i, j, r2):
            qq = law.charge[i] * load(law.charge, j)
            u, w = screened(law.screening, inverse_root(r2), r2)
            return qq * (u - law.shift), qq * w

        return ewald_pair
    if not is_a(law, DampedShiftedForce):
        return None

    def shifted_pair(law, i, j, r2):
        qq = law.charge[i] * load(law.charge, j)
        inverse = inverse_root(r2)
        u, w = screened(law.screening, inverse, r2)
        return qq * (u + law.slope * (r2 * inverse) + law.shift), qq * (w - law.slope * inverse)

    return shifted_pair


@implements(pairs.arrange)
def _arrange(law, arranged, order):
    if not (is_a(law, ScreenedCoulomb) or is_a(law, DampedShiftedForce)):
        return None
    return lambda law, arranged, order: pairs.into_slots(law.charge, arranged.charge, order)


def damped_self_energy(law: DampedShiftedForce, position: np.ndarray) -> float:
    """Energy (u Å²/ps²) of one molecule's charges with the neutralising images of damped shifted force.

    position (s, 3) of the molecule's charged sites in the order of law.charge's first s. Each charge with its own
    image (Fennell & Gezelter 2006), and with those of its molecule, where the law has no pair: constant for a rigid
    body.
    """
    charge = law.charge[: len(position)]
    energy = (0.5 * law.shift - law.alpha / sqrt(pi)) * charge @ charge
    for i in range(len(position)):
        for j in range(i):
            r = float(np.linalg.norm(position[i] - position[j]))
            u = float(erfc(law.alpha * r)) / r + law.slope * r + law.shift if r < law.cutoff else 0.0
            energy += charge[i] * charge[j] * (u - 1 / r)
    return float(energy)
