"""User pair potentials: a formula with its parameters, truncated and mixed like Lennard-Jones.

A formula is a NamedTuple class, whose fields are the parameters of a pair of sites, with an
`@implements(energy_and_force_at)`, which `formulas` writes. The parameters are numbers if all sites
are of one kind, or vectors that the pair loop reads from a table.
"""

from collections.abc import Callable
from math import inf, pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, implements, is_a
from rigidmd.compile.simd import evaluate_cubic, inverse, inverse_square_root, load, select, zeros
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.parts import InnerPairs, Tail
from rigidmd.forces.potentials.truncation import (
    ForceShifted,
    Truncation,
    TruncationTerms,
    Unmodified,
    integral_of_removed_energy,
    removed_energy,
    truncated,
)


class CustomPotential(NamedTuple):
    """A formula between kinds of sites. The energy between kinds is 0 if their `interacts` is 0."""

    cutoff: float  # Å
    truncation: Truncation
    formula: NamedTuple  # parameters of one kind with itself
    shared: tuple  # what a formula needs in addition to its parameters, the same for all kinds
    kind: np.ndarray  # (s,) kind of each site
    parameters: np.ndarray  # (parameters, kinds, kinds)
    # (4, kinds, kinds) see truncation.truncation_terms; 0 without interaction
    terms_of_kinds: np.ndarray
    interacts: np.ndarray  # (kinds, kinds) 1 or 0

    def for_slots(self, slots: int, dtype: type) -> "CustomOneKind | CustomManyKinds":
        """What the pair loop reads: numbers if all sites are of one kind, else tables for all
        slots."""
        head = self[:4]
        kinds = self.parameters.shape[1]
        if kinds == 1:
            return CustomOneKind(*head, tuple(float(x) for x in self.terms_of_kinds[:, 0, 0]))
        count = len(self.parameters) + 5
        return CustomManyKinds(
            *head, np.zeros(slots, np.int32), zeros(count * kinds * slots, dtype), kinds * slots
        )


class CustomOneKind(NamedTuple):
    cutoff: float
    truncation: Truncation
    formula: NamedTuple
    shared: tuple
    terms: TruncationTerms


class CustomManyKinds(NamedTuple):
    """A user potential with its numbers for each kind and the site in each slot, so that the loop
    needs no gathers."""

    cutoff: float
    truncation: Truncation
    formula: NamedTuple
    shared: tuple
    kind: np.ndarray  # (slots,)
    # (numbers kinds slots,) of a pair: whether it interacts, 4 truncation terms, parameters
    table: np.ndarray
    stride: int  # kinds slots


def energy_and_force_at(formula, shared, r2, inverse1, inverse2):
    """(energy, force/r) of a formula at squared distances r2, with 1/r and 1/r²; u Å²/ps², scalars
    or vectors. inverse1 is 0 if neither the formula nor the truncation uses it."""
    raise TypeError(
        f"{type(formula).__name__} is not a formula, or this was called outside compiled code"
    )


@implements(pairs.pair, CustomOneKind, inline=True)
def _pair_of_one_kind(potential, i, j, r2):
    return energy_and_force(potential, potential.formula, potential.terms, r2)


@implements(pairs.pair, CustomManyKinds, chooses=True, inline=True)
def _pair(potential, i, j, r2):
    types = dict(zip(CustomManyKinds._fields, potential.types, strict=True))
    formula = types["formula"].instance_class
    truncation = types["truncation"]
    names = [
        f"load(potential.table, at + {5 + p} * potential.stride)"
        for p in range(len(formula._fields))
    ]
    terms = ["0.0"] * 4
    for k in range(
        1 if is_a(truncation, Unmodified) else 4 if is_a(truncation, ForceShifted) else 0
    ):
        terms[k] = f"load(potential.table, at + {1 + k} * potential.stride)"
    source = "\n".join(
        (
            "def pair(potential, i, j, r2):",
            "    at = potential.kind[i] * len(potential.kind) + j",
            f"    formula = Formula({', '.join(names)})",
            f"    u, w = energy_and_force(potential, formula, ({', '.join(terms)}), r2)",
            # a formula may be NaN without interaction
            "    interacts = load(potential.table, at) > 0.5",
            "    return select(interacts, u, 0.0), select(interacts, w, 0.0)",
        )
    )
    names_in = {
        "Formula": formula,
        "load": load,
        "select": select,
        "energy_and_force": energy_and_force,
    }
    exec(source, names_in)
    return names_in["pair"]


@chosen_by_type(inline=True)
def energy_and_force(potential, formula, terms, r2):
    """(energy, force/r) of a potential with the parameters and the truncation terms of a pair."""
    truncation = potential.types[potential.fields.index("truncation")]
    if not is_a(truncation, Unmodified) or getattr(formula.instance_class, "uses_root", True):

        def with_root(potential, formula, terms, r2):
            inverse1 = inverse_square_root(r2)
            u, w = energy_and_force_at(formula, potential.shared, r2, inverse1, inverse1 * inverse1)
            return truncated(potential.truncation, terms, (), r2, inverse1, u + terms[0], w)

        return with_root

    def without_root(potential, formula, terms, r2):
        u, w = energy_and_force_at(formula, potential.shared, r2, 0.0, inverse(r2))
        return u + terms[0], w

    return without_root


@implements(pairs.arrange, CustomManyKinds)
def _arrange(slot_potential, potential, order):
    table, stride = slot_potential.table, slot_potential.stride
    for slot, i in enumerate(order):
        kind = potential.kind[i]
        slot_potential.kind[slot] = kind
        for k in range(len(potential.interacts)):
            at = k * len(order) + slot
            table[at] = potential.interacts[k, kind]
            for e in range(4):
                table[at + (1 + e) * stride] = potential.terms_of_kinds[e, k, kind]
            for p in range(len(potential.parameters)):
                table[at + (5 + p) * stride] = potential.parameters[p, k, kind]


def tail_of_pair(
    radial: Callable[[float], tuple],
    terms: TruncationTerms,
    truncation: Truncation,
    inner: InnerPairs | None = None,
) -> Tail:
    """The tail correction for one pair of sites, with the constant of the `inner` pairs, which are
    all of these kinds. See `lennard_jones.tail`. Raises ArithmeticError if the energy falls too
    slowly."""
    from scipy.integrate import quad  # slow to import

    cutoff = truncation.cutoff
    far = [abs(radial(factor * cutoff)[0]) * factor**3 for factor in (1.0, 1e3)]
    if far[1] > 0.1 * far[0]:
        raise ArithmeticError("its energy falls too slowly with the distance for tail_correction")

    def energy(r: np.ndarray) -> np.ndarray:
        return np.array([radial(x)[0] for x in r.tolist()])

    beyond = quad(lambda r: r**2 * radial(r)[0], cutoff, inf, limit=200)[0]
    removed = beyond + integral_of_removed_energy(energy, truncation, terms)
    jump = (
        (radial(cutoff)[0] + terms[0]) * cutoff**3 / 3
        if isinstance(truncation, Unmodified)
        else 0.0
    )
    constant = 0.0
    if inner is not None:
        constant = (
            -float(inner.count @ removed_energy(energy, truncation, terms, inner.distance)) / 2
        )
    return Tail(2 * pi * removed, 2 * pi * (removed + jump), constant)


class Table(NamedTuple):
    """An energy as cubic polynomials of r² between equally spaced values of r²."""

    first: float  # the least r², Å²
    per_step: float  # 1/(step of r²), 1/Å²
    # (4 steps,) u Å²/ps²; of each step c0 ... c3, energy = sum of ck x^k, 0 <= x <= 1
    coefficients: np.ndarray


class Tabulated(NamedTuple):
    """The formula of a `Table`, which all kinds of sites have in common."""

    scale: float  # factor of the energy

    uses_root = False


@implements(energy_and_force_at, Tabulated, inline=True)
def _of_table(formula, shared, r2, inverse1, inverse2):
    u, slope = evaluate_cubic(shared.coefficients, (r2 - shared.first) * shared.per_step)
    return formula.scale * u, formula.scale * (-2.0 * shared.per_step) * slope
