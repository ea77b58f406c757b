"""Laws between pairs of sites from outside: a formula with parameters of its own, ended and mixed like Lennard-Jones.

A formula is a NamedTuple class, whose fields are the parameters of a pair of sites, and an `@implements(of_distance)`
for it, which `formulas` writes. The parameters may be numbers or vectors: one formula serves a single kind of sites,
whose parameters are numbers, and many kinds, whose parameters the loop loads from a table.
"""

from collections.abc import Callable
from math import inf, pi
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import quad

from rigidmd.compile import implements, is_a
from rigidmd.compile.simd import cubic_at, inverse, inverse_root, load, select, zeros
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.potentials.truncation import POLYNOMIALS, Bent, Plain, Polynomial, Shape, added, ended


class OwnLaw(NamedTuple):
    """A formula between kinds of sites; its energy is 0 between kinds whose `acts` is 0."""

    cutoff: float  # Å
    shape: Shape
    formula: NamedTuple  # parameters of one kind with itself; of the formula's own class
    shared: tuple  # what a formula needs besides, the same for all kinds
    kind: np.ndarray  # (s,) kind of each site
    parameters: np.ndarray  # (parameters, kinds, kinds)
    ends: np.ndarray  # (4, kinds, kinds) see endings.ending; all 0 between kinds that do not interact
    acts: np.ndarray  # (kinds, kinds) 1 or 0

    def room(self, slots: int, dtype: type) -> "OwnOfOneKind | OwnOfManyKinds":
        """What the loop reads: numbers if all sites are of one kind, else tables with room for all slots."""
        head, kinds = self[:4], self.parameters.shape[1]
        if kinds == 1:
            return OwnOfOneKind(*head, tuple(float(x) for x in self.ends[:, 0, 0]))
        count = len(self.parameters) + 5
        return OwnOfManyKinds(*head, np.zeros(slots, np.int32), zeros(count * kinds * slots, dtype), kinds * slots)


class OwnOfOneKind(NamedTuple):
    """The law for sites of a single kind."""

    cutoff: float
    shape: Shape
    formula: NamedTuple
    shared: tuple
    end: Polynomial


class OwnOfManyKinds(NamedTuple):
    """The law with all numbers between each kind and the site in each slot, so that the loop needs no gathers."""

    cutoff: float
    shape: Shape
    formula: NamedTuple
    shared: tuple
    kind: np.ndarray  # (slots,)
    table: np.ndarray  # (numbers kinds slots,): whether the pair acts, four numbers of its ending, its parameters
    stride: int  # kinds slots


def of_distance(formula, shared, r2, inverse1, inverse2):
    """(energy, force/r) of a formula at squared distances r2, with 1/r and 1/r²; u Å²/ps², scalars or vectors.

    inverse1 is 0 where neither the formula nor its ending uses it.
    """
    raise TypeError(f"{type(formula).__name__} is not a formula, or this was called outside compiled code")


def uses_root(formula: Any, shape: Any) -> bool:
    """Whether a law needs 1/r besides 1/r², by the Numba types of its formula and ending."""
    return not is_a(shape, Plain) or getattr(formula.instance_class, "uses_root", True)


@implements(pairs.pair, inline=True)
def _pair(law, i, j, r2):
    if is_a(law, OwnOfOneKind):
        return lambda law, i, j, r2: energy_and_force(law, law.formula, law.end, r2)
    if not is_a(law, OwnOfManyKinds):
        return None
    of_law = dict(zip(OwnOfManyKinds._fields, law.types, strict=True))
    formula, shape = of_law["formula"].instance_class, of_law["shape"]
    names = [f"load(law.table, at + {5 + p} * law.stride)" for p in range(len(formula._fields))]
    end = ["0.0"] * 4
    for k in range(1 if is_a(shape, Plain) else 4 if is_a(shape, Bent) else 0):
        end[k] = f"load(law.table, at + {1 + k} * law.stride)"
    source = "\n".join(
        (
            "def pair(law, i, j, r2):",
            "    at = law.kind[i] * len(law.kind) + j",
            f"    formula = Formula({', '.join(names)})",
            f"    u, w = energy_and_force(law, formula, ({', '.join(end)}), r2)",
            "    acts = load(law.table, at) > 0.5",  # a formula may be no number where it does not act
            "    return select(acts, u, 0.0), select(acts, w, 0.0)",
        )
    )
    names_in = {"Formula": formula, "load": load, "select": select, "energy_and_force": energy_and_force}
    exec(source, names_in)
    return names_in["pair"]


def energy_and_force(law, formula, end, r2):
    """(energy, force/r) of a law with the parameters and the ending of a pair."""
    raise TypeError("compiled code only")


@implements(energy_and_force, inline=True)
def _energy_and_force(law, formula, end, r2):
    shape = law.types[law.fields.index("shape")]
    if uses_root(formula, shape):

        def with_root(law, formula, end, r2):
            inverse1 = inverse_root(r2)
            u, w = of_distance(formula, law.shared, r2, inverse1, inverse1 * inverse1)
            return ended(law.shape, end, (), r2, inverse1, u + end[0], w)

        return with_root

    def without_root(law, formula, end, r2):
        u, w = of_distance(formula, law.shared, r2, 0.0, inverse(r2))
        return u + end[0], w

    return without_root


@implements(pairs.arrange)
def _arrange(law, arranged, order):
    if not is_a(law, OwnLaw):
        return None
    if is_a(arranged, OwnOfOneKind):
        return lambda law, arranged, order: None

    def arrange(law, arranged, order):
        slots = len(order)
        for slot, i in enumerate(order):
            kind = law.kind[i]
            arranged.kind[slot] = kind
            for k in range(len(law.acts)):
                at = k * slots + slot
                arranged.table[at] = law.acts[k, kind]
                for e in range(4):
                    arranged.table[at + (1 + e) * arranged.stride] = law.ends[e, k, kind]
                for p in range(len(law.parameters)):
                    arranged.table[at + (5 + p) * arranged.stride] = law.parameters[p, k, kind]

    return arrange


def tail_of(radial: Callable[[float], tuple], end: np.ndarray, shape: Shape) -> tuple[float, float]:
    """What a cut-off takes from the energy, times the volume, and from the pressure, times its square; of one pair.

    2 pi J with J = integral of r² (full - truncated), and 2 pi (J + R³ U/3) with the energy U at which it is cut off,
    see `lennard_jones.tail`. Raises ArithmeticError where the energy falls too slowly.
    """
    cutoff = shape.cutoff
    far = [abs(radial(share * cutoff)[0]) * share**3 for share in (1.0, 1e3)]
    if far[1] > 0.1 * far[0]:
        raise ArithmeticError("its energy falls too slowly with the distance for tail_correction")
    start = getattr(shape, "start", cutoff)

    def lost(r: float) -> float:
        if isinstance(shape, Plain | Bent):
            return -(r**2) * (end[0] + (added(tuple(end), r - start)[0] if r > start else 0.0))
        return r**2 * radial(r)[0] * (1 - POLYNOMIALS[type(shape)](shape, r)[0])

    inside = -end[0] * start**3 / 3 + (quad(lost, start, cutoff)[0] if start < cutoff else 0.0)
    beyond = quad(lambda r: r**2 * radial(r)[0], cutoff, inf, limit=200)[0]
    jump = (radial(cutoff)[0] + end[0]) * cutoff**3 / 3 if isinstance(shape, Plain) else 0.0
    return 2 * pi * (inside + beyond), 2 * pi * (inside + beyond + jump)


class Table(NamedTuple):
    """An energy as cubic polynomials of r² between equally spaced values of it."""

    first: float  # the least r², Å²
    per_step: float  # 1/(step of r²), 1/Å²
    coefficients: np.ndarray  # (4 steps,) u Å²/ps²; of each step c0 ... c3, energy = sum of ck x^k, 0 <= x <= 1


class Tabulated(NamedTuple):
    """The formula of a table, which is what its kinds share."""

    scale: float  # factor of the energy

    uses_root = False


@implements(of_distance, Tabulated, inline=True)
def _of_table(formula, shared, r2, inverse1, inverse2):
    u, slope = cubic_at(shared.coefficients, (r2 - shared.first) * shared.per_step)
    return formula.scale * u, formula.scale * (-2.0 * shared.per_step) * slope
