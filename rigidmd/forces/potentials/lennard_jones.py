"""Lennard-Jones: 4 epsilon ((sigma/r)¹² - (sigma/r)⁶), with endings at the cut-off, mixing rules, tail correction."""

from math import pi
from typing import Literal, NamedTuple

import numpy as np
from scipy.integrate import quad

from rigidmd.compile import implements, is_a, kernel
from rigidmd.compile.simd import inverse, inverse_root, load, zeros
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.potentials.truncation import (  # fmt: skip
    NO_SWITCH,
    POLYNOMIALS,
    Addend,
    Bent,
    Correction,
    Name,
    Plain,
    Polynomial,
    Shape,
    added,
    addend,
    addend_of,
    correction,
    correction_of,
    ended,
    ending,
    needs_root,
    shape_of,
)

Mixing = Literal["lorentz-berthelot", "geometric"]


class LennardJones(NamedTuple):
    """c12/r¹² - c6/r⁶ between kinds of sites; each power has its own ending."""

    cutoff: float  # Å
    shape: Shape
    end12: Polynomial  # see endings.ending
    end6: Polynomial
    kind: np.ndarray  # (s,) kind of each site, index into c6 and c12
    c12: np.ndarray  # (kinds, kinds) u Å¹⁴/ps²
    c6: np.ndarray  # (kinds, kinds) u Å⁸/ps²

    def room(self, slots: int, dtype: type) -> "OneKind | ManyKinds":
        """What the loop reads: numbers if all sites are of one kind, else a table with room for all slots."""
        head, kinds = self[:4], len(self.c12)
        if kinds == 1:
            c12, c6 = float(self.c12[0, 0]), float(self.c6[0, 0])
            if found := correction_of(self.shape, {12: c12, 6: -c6}, dtype):
                return OneKind(*head, c12, c6, NO_SWITCH, NO_SWITCH, found)
            return OneKind(*head, c12, c6, *_addends(self.shape, c12, c6, dtype), NO_SWITCH)
        table = zeros((2, kinds * slots), dtype)
        return ManyKinds(*head, np.zeros(slots, np.int32), *table, *_addends(self.shape, 1.0, 1.0, dtype))


def _addends(shape: Shape, c12: float, c6: float, dtype: type) -> tuple[Addend | tuple[()], Addend | tuple[()]]:
    """What a switch adds to the forces of c12/r¹² and c6/r⁶."""
    return addend_of(shape, {12: c12}, dtype), addend_of(shape, {6: c6}, dtype)


class OneKind(NamedTuple):
    """The law for sites of a single kind."""

    cutoff: float
    shape: Shape
    end12: Polynomial
    end6: Polynomial
    c12: float
    c6: float
    addend12: Addend | tuple[()]  # of c12/r¹² and c6/r⁶
    addend6: Addend | tuple[()]
    correction: Correction | tuple[()]  # in their place


class ManyKinds(NamedTuple):
    """The law with coefficients between each kind and the site in each slot, so that the loop needs no gathers."""

    cutoff: float
    shape: Shape
    end12: Polynomial
    end6: Polynomial
    kind: np.ndarray  # (slots,)
    c12: np.ndarray  # (kinds slots,)
    c6: np.ndarray  # (kinds slots,)
    addend12: Addend | tuple[()]  # of 1/r¹² and 1/r⁶
    addend6: Addend | tuple[()]


def lennard_jones(
    kind: np.ndarray,
    sigma: np.ndarray,
    epsilon: np.ndarray,
    cutoff: float,
    name: Name = "plain",
    start: float = 0.0,
    mixing: Mixing = "lorentz-berthelot",
    special: dict[tuple[int, int], tuple[float, float]] | None = None,
) -> LennardJones:
    """The law for sites of kinds (s,) with sigma (kinds,) in Å and epsilon (kinds,) in u Å²/ps².

    special : (kind, kind) -> (sigma, epsilon) instead of the mixing rule, for both orders of the kinds
    """
    shape = shape_of(name, cutoff, start)
    sigma_ij = (sigma[:, None] + sigma) / 2 if mixing == "lorentz-berthelot" else np.sqrt(sigma[:, None] * sigma)
    epsilon_ij = np.sqrt(epsilon[:, None] * epsilon)
    for (i, j), (own_sigma, own_epsilon) in (special or {}).items():
        sigma_ij[[i, j], [j, i]] = own_sigma
        epsilon_ij[[i, j], [j, i]] = own_epsilon
    return LennardJones(
        cutoff,
        shape,
        ending(name, shape, _inverse_power(12)),
        ending(name, shape, _inverse_power(6)),
        kind,
        4 * epsilon_ij * sigma_ij**12,
        4 * epsilon_ij * sigma_ij**6,
    )


def _inverse_power(p: int):
    """Function of r that gives r⁻ᵖ, its force and the derivative of its force."""
    return lambda r: (r**-p, p * r ** -(p + 1), -p * (p + 1) * r ** -(p + 2))


@implements(pairs.pair, inline=True)
def _pair(law, i, j, r2):
    if is_a(law, OneKind):
        return lambda law, i, j, r2: energy_and_force(law, law.c12, law.c6, r2)
    if not is_a(law, ManyKinds):
        return None

    def pair(law, i, j, r2):
        at = law.kind[i] * len(law.kind) + j
        return energy_and_force(law, load(law.c12, at), load(law.c6, at), r2)

    return pair


def energy_and_force(law, c12, c6, r2):
    """(energy, force/r) of sites with c12/r¹² - c6/r⁶ at squared distances r2."""
    raise TypeError("compiled code only")


@implements(energy_and_force, inline=True)
def _energy_and_force(law, c12, c6, r2):
    if is_a(law, ManyKinds):

        def of_many(law, c12, c6, r2):
            inverse2, inverse1 = inverses(law.shape, law.addend12, r2)
            six, end = inverse2 * inverse2 * inverse2, mixed(law.end12, law.end6, c12, c6)
            of12 = c12 * (12 + addend(law.shape, law.addend12, r2 * inverse1))
            of6 = c6 * (6 + addend(law.shape, law.addend6, r2 * inverse1))
            u, w = (c12 * six - c6) * six + end[0], (of12 * six - of6) * six * inverse2
            return ended(law.shape, end, law.addend12, r2, inverse1, u, w)

        return of_many

    if is_a(law.types[law.fields.index("correction")], Correction):

        def with_correction(law, c12, c6, r2):
            inverse2 = inverse(r2)
            six, end = inverse2 * inverse2 * inverse2, mixed(law.end12, law.end6, c12, c6)
            u, w = (c12 * six - c6) * six + end[0], (12 * c12 * six - 6 * c6) * six * inverse2
            w = w + correction(law.shape, law.correction, r2)
            return ended(law.shape, end, law.correction, r2, 0.0, u, w)

        return with_correction

    def of_one(law, c12, c6, r2):
        inverse2, inverse1 = inverses(law.shape, law.addend12, r2)
        six, end = inverse2 * inverse2 * inverse2, mixed(law.end12, law.end6, c12, c6)
        of12 = 12 * c12 + addend(law.shape, law.addend12, r2 * inverse1)
        of6 = 6 * c6 + addend(law.shape, law.addend6, r2 * inverse1)
        u, w = (c12 * six - c6) * six + end[0], (of12 * six - of6) * six * inverse2
        return ended(law.shape, end, law.addend12, r2, inverse1, u, w)

    return of_one


def inverses(shape, switched, r2):
    """(1/r², 1/r) at squared distances r2; where 1/r is not needed it is 0, to save the square root."""
    raise TypeError("compiled code only")


@implements(inverses, inline=True)
def _inverses(shape, switched, r2):
    if not needs_root(shape, switched):
        return lambda shape, switched, r2: (inverse(r2), 0.0)

    def with_root(shape, switched, r2):
        inverse1 = inverse_root(r2)
        return inverse1 * inverse1, inverse1

    return with_root


@kernel(inline=True)
def mixed(end12, end6, c12, c6):
    """The ending of the whole potential from those of its two powers."""
    return (
        c12 * end12[0] - c6 * end6[0],
        c12 * end12[1] - c6 * end6[1],
        c12 * end12[2] - c6 * end6[2],
        c12 * end12[3] - c6 * end6[3],
    )


@implements(pairs.arrange)
def _arrange(law, arranged, order):
    if not is_a(law, LennardJones):
        return None
    if is_a(arranged, OneKind):
        return lambda law, arranged, order: None

    def arrange(law, arranged, order):
        for slot, i in enumerate(order):
            arranged.kind[slot] = law.kind[i]
            for k in range(len(law.c12)):
                arranged.c12[k * len(order) + slot] = law.c12[k, law.kind[i]]
                arranged.c6[k * len(order) + slot] = law.c6[k, law.kind[i]]

    return arrange


class Tail(NamedTuple):
    """Energy and pressure lost by the cut-off, at any volume."""

    energy_volume: float  # energy times the volume, u Å⁵/ps²
    pressure_square: float  # pressure times the volume squared, u Å⁵/ps²

    def energy(self, volume: float) -> float:
        """u Å²/ps²"""
        return self.energy_volume / volume

    def pressure(self, volume: float) -> float:
        """u/(Å ps²)"""
        return self.pressure_square / volume**2


def sum_of(tails: list[Tail]) -> Tail | None:
    """All of them together; None of none."""
    return Tail(*np.sum(tails, axis=0).tolist()) if tails else None


def tail(law: LennardJones) -> Tail:
    """Energy and pressure lost by the cut-off, for g(r) = 1 where the ending changes the potential.

    U = (2 pi / V) sum_ij N_i N_j J_ij with J = integral of r² (full - truncated). For endings that shift the whole
    potential the constant inside counts too, as in GROMACS' dispersion correction (Allen & Tildesley 2017, 2.8). All N²
    pairs are counted, also those of a molecule with itself: a relative error of 1/(number of molecules).
    """
    count = np.bincount(law.kind, minlength=len(law.c6))
    energy = pressure = 0.0
    for sign, c, p, end in ((1, law.c12, 12, law.end12), (-1, law.c6, 6, law.end6)):
        lost = _lost(law, end, p)
        # The pressure follows from the force alone: a jump of the energy at the cut-off (plain) does not contribute.
        jump = law.cutoff ** (3 - p) / 3 if end[0] == 0 and isinstance(law.shape, Plain) else 0.0
        strength = sign * count @ c @ count
        energy += 2 * pi * strength * lost
        pressure += 2 * pi * strength * (lost + jump)
    return Tail(energy, pressure)


def _lost(law: LennardJones, end: np.ndarray, p: int) -> float:
    """Integral of r² (r⁻ᵖ - truncated r⁻ᵖ) over all r."""
    beyond = law.cutoff ** (3 - p) / (p - 3)
    inside = -end[0] * law.cutoff**3 / 3
    if isinstance(law.shape, Plain):
        return beyond + inside
    start = law.shape.start

    def lost(r: float) -> float:
        if isinstance(law.shape, Bent):
            return -(r**2) * added(end, r - start)[0]
        return (1 - POLYNOMIALS[type(law.shape)](law.shape, r)[0]) * r ** (2 - p)

    return beyond + inside + quad(lost, start, law.cutoff)[0]
