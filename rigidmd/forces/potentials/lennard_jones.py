"""Lennard-Jones: 4 epsilon ((sigma/r)¹² - (sigma/r)⁶), with truncation, mixing rules and tail
correction."""

from collections.abc import Callable, Sequence
from math import inf, pi
from typing import NamedTuple

import numpy as np
from numba import types

from rigidmd.compile import chosen_by_type, implements, is_a, kernel
from rigidmd.compile.simd import inverse, inverse_square_root, load, polynomial, zeros
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.smooth import InverseR6
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.parts import (
    InnerPairs,
    Interactions,
    SystemParts,
    Tail,
    gather_per_molecule,
    inner_pairs,
    sites_named,
)
from rigidmd.forces.potentials.screened_coulomb import Screening, dispersion_screening
from rigidmd.forces.potentials.truncation import (
    MINIMUM_TOLERANCE,
    NO_SWITCH,
    SwitchCorrection,
    SwitchTerm,
    Truncation,
    TruncationTerms,
    Unmodified,
    correction,
    integral_of_removed_energy,
    needs_root,
    removed_energy,
    short_cutoff_note,
    switch_correction_of,
    switch_term,
    switch_term_of,
    truncated,
    truncation_of,
    truncation_terms,
)
from rigidmd.scene.models import Mixing
from rigidmd.scene.truncation import TruncationName
from rigidmd.units import KJ_PER_MOL


class ScreenedDispersion(NamedTuple):
    """c_i c_j [(1 - g(beta r))/r⁶ - shift], added to Lennard-Jones within the cutoff where a sum
    over k-vectors has the dispersion -c_i c_j (1 - g(beta r))/r⁶ of all pairs; g(x) = exp(-x²)(1 +
    x² + x⁴/2)."""

    beta: float  # 1/Å
    shift: float  # 1/Å⁶
    screening: Screening
    strength: np.ndarray | float  # (s,) or (slots,) c of each site; c² if all sites are of one kind


class LennardJones(NamedTuple):
    """c12/r¹² - c6/r⁶ between kinds of sites. Each power is truncated by itself."""

    cutoff: float  # Å
    truncation: Truncation
    terms12: TruncationTerms  # see truncation.truncation_terms
    terms6: TruncationTerms
    kind: np.ndarray  # (s,) kind of each site, index into c6 and c12
    c12: np.ndarray  # (kinds, kinds) u Å¹⁴/ps²
    c6: np.ndarray  # (kinds, kinds) u Å⁸/ps²
    dispersion: ScreenedDispersion | tuple[()] = ()

    def for_slots(self, slots: int, dtype: type) -> "LennardJonesOneKind | LennardJonesManyKinds":
        """What the pair loop reads: numbers if all sites are of one kind, else a table for all
        slots."""
        head = self[:4]
        kinds = len(self.c12)
        c12, c6 = (float(self.c12[0, 0]), float(self.c6[0, 0])) if kinds == 1 else (1.0, 1.0)
        dispersion = self.dispersion
        if isinstance(dispersion, ScreenedDispersion):
            strength = zeros(slots, dtype) if kinds > 1 else float(dispersion.strength[0] ** 2)
            fitted = dispersion_screening(dispersion.beta, self.cutoff, dtype)
            dispersion = dispersion._replace(screening=fitted, strength=strength)
        addends = [
            switch_term_of(self.truncation, {power: c}, dtype) for power, c in ((12, c12), (6, c6))
        ]
        if kinds > 1:
            return LennardJonesManyKinds(
                *head,
                np.zeros(slots, np.int32),
                *zeros((2, kinds * slots), dtype),
                *addends,
                dispersion,
            )
        if correction := switch_correction_of(self.truncation, {12: c12, 6: -c6}, dtype):
            return LennardJonesOneKind(*head, c12, c6, NO_SWITCH, NO_SWITCH, correction, dispersion)
        return LennardJonesOneKind(*head, c12, c6, *addends, NO_SWITCH, dispersion)


class LennardJonesOneKind(NamedTuple):
    cutoff: float
    truncation: Truncation
    terms12: TruncationTerms
    terms6: TruncationTerms
    c12: float
    c6: float
    addend12: SwitchTerm | tuple[()]  # of c12/r¹² and c6/r⁶
    addend6: SwitchTerm | tuple[()]
    correction: SwitchCorrection | tuple[()]  # used instead of both
    dispersion: ScreenedDispersion | tuple[()]


class LennardJonesManyKinds(NamedTuple):
    """Lennard-Jones with coefficients for each kind and the site in each slot, so that the loop
    needs no gathers."""

    cutoff: float
    truncation: Truncation
    terms12: TruncationTerms
    terms6: TruncationTerms
    kind: np.ndarray  # (slots,)
    c12: np.ndarray  # (kinds slots,)
    c6: np.ndarray  # (kinds slots,)
    addend12: SwitchTerm | tuple[()]  # of 1/r¹² and 1/r⁶
    addend6: SwitchTerm | tuple[()]
    dispersion: ScreenedDispersion | tuple[()]


def lennard_jones(
    kind: np.ndarray,
    sigma: np.ndarray,
    epsilon: np.ndarray,
    cutoff: float,
    name: TruncationName = "plain",
    start: float = 0.0,
    mixing: Mixing = "lorentz-berthelot",
    special: dict[tuple[int, int], tuple[float, float]] | None = None,
) -> LennardJones:
    """The potential for sites of kinds (s,) with sigma (kinds,) in Å and epsilon (kinds,) in u
    Å²/ps². special : (kind, kind) -> (sigma, epsilon), instead of the mixing rule, for both orders
    of the kinds"""
    truncation = truncation_of(name, cutoff, start)
    sigma_ij = (
        (sigma[:, None] + sigma) / 2
        if mixing == "lorentz-berthelot"
        else np.sqrt(sigma[:, None] * sigma)
    )
    epsilon_ij = np.sqrt(epsilon[:, None] * epsilon)
    for (i, j), (pair_sigma, pair_epsilon) in (special or {}).items():
        sigma_ij[[i, j], [j, i]] = pair_sigma
        epsilon_ij[[i, j], [j, i]] = pair_epsilon
    return LennardJones(
        cutoff,
        truncation,
        truncation_terms(name, truncation, _inverse_power(12)),
        truncation_terms(name, truncation, _inverse_power(6)),
        kind,
        4 * epsilon_ij * sigma_ij**12,
        4 * epsilon_ij * sigma_ij**6,
    )


class LennardJonesSites(NamedTuple):
    """The Lennard-Jones sites of a system."""

    potential: LennardJones
    is_separate: np.ndarray  # (kinds,) see `sites_of_scene`
    indices: list[np.ndarray]  # of the sites of each species
    inner: InnerPairs | None  # the pairs inside molecules, where the scene has a tail correction
    notes: tuple[str, ...]


def interactions(parts: SystemParts) -> Interactions:
    """The Lennard-Jones forces of a scene, with forces.lennard_jones. Raises SceneError."""
    if (found := sites_of_scene(parts)) is None:
        return Interactions({}, {})
    return Interactions(
        {"lennard_jones": parts.pair_forces(found.potential, parts.sites(found.indices))},
        {},
        tail=None if found.inner is None else tail(found.potential, found.inner),
        notes=found.notes,
    )


def sites_of_scene(
    parts: SystemParts, separate: Sequence[bool] | None = None
) -> LennardJonesSites | None:
    """The Lennard-Jones sites of a scene. None without them. Raises SceneError.

    separate : whether the sites of each species are of kinds that no other species has, which
        come last. Default: of no species
    """
    forces = parts.scene.forces
    species = parts.species
    index = parts.model.species
    named = _sites_of_pairs(parts)
    indices = [
        np.flatnonzero((m.epsilon > 0) | named[k].any(axis=(0, 1))) for k, m in enumerate(species)
    ]
    if not forces.lennard_jones or not any(len(c) for c in indices):
        return None
    separate = separate or [False] * len(species)
    entries = [
        [(separate[k], m.sigma[i], m.epsilon[i], tuple(named[k][:, :, i].ravel())) for i in c]
        for k, (m, c) in enumerate(zip(species, indices, strict=True))
    ]
    kinds = sorted({entry for of_species in entries for entry in of_species})
    of_species = [
        np.array([kinds.index(entry) for entry in of_sites], np.int32) for of_sites in entries
    ]
    kind = gather_per_molecule(of_species, index)
    sigma, epsilon = np.array([entry[1:3] for entry in kinds]).T
    special = {
        (i, j): (entry.sigma_A, entry.epsilon_kJ_mol * KJ_PER_MOL)
        for n, entry in enumerate(forces.pairs)
        for i, (*_, one) in enumerate(kinds)
        for j, (*_, other) in enumerate(kinds)
        if one[2 * n] and other[2 * n + 1]
    }
    cutoff = forces.cutoff_A or inf
    start = forces.switch_start_A or cutoff
    with np.errstate(over="ignore", invalid="ignore"):  # checked below
        potential = lennard_jones(
            kind, sigma, epsilon, cutoff, forces.truncation, start, forces.mixing, special
        )
    if not (np.isfinite(potential.c12).all() and np.isfinite(potential.c6).all()):
        raise SceneError(
            parts.scene.source,
            [f"sigma_A of {sigma.max():g} Å with epsilon overflows 4 epsilon sigma¹²"],
        )
    if forces.dispersion != "cutoff":
        strength = gather_per_molecule(
            [m.dispersion[i] for m, i in zip(species, indices, strict=True)], index
        )
        added = screened_dispersion(
            strength, forces.dispersion_beta_per_A, cutoff, shifted=forces.truncation == "shift"
        )
        potential = potential._replace(dispersion=added)
    names = [
        np.array([f"{m.name}.{m.site_names[i]}" for i in c], object)
        for m, c in zip(species, indices, strict=True)
    ]
    positions = [m.positions_body[i] for m, i in zip(species, indices, strict=True)]
    notes = _short_cutoff_notes(potential, gather_per_molecule(names, index))
    inner = None
    if forces.tail_correction:
        inner = inner_pairs(of_species, positions, parts.counts)
    is_separate = np.array([entry[0] for entry in kinds])
    return LennardJonesSites(potential, is_separate, indices, inner, notes)


def _sites_of_pairs(parts: SystemParts) -> list[np.ndarray]:
    """Masks (pairs, 2, sites) for each species: whether the first or second name of forces.pairs
    means the site. Raises SceneError."""
    entries = parts.scene.forces.pairs
    species = parts.species
    errors = []
    is_meant = [np.zeros((len(entries), 2, len(m.site_names)), bool) for m in species]
    for n, entry in enumerate(entries):
        for side, text in enumerate(entry.sites):
            masks = sites_named(species, text)
            for k, mask in enumerate(masks):
                is_meant[k][n, side] = mask
            if not any(mask.any() for mask in masks):
                known = dict.fromkeys(f"{m.name}.{site}" for m in species for site in m.site_names)
                errors.append(
                    f"forces.pairs.{n}.sites: no site is {text!r}; there are {', '.join(known)}"
                )
    if errors:
        raise SceneError(parts.scene.source, errors)
    return is_meant


def _short_cutoff_notes(potential: LennardJones, name: np.ndarray) -> tuple[str, ...]:
    """A note if the cutoff is below the minimum of an energy, on the pair with the most distant
    minimum. name (s,) : of the sites"""
    with np.errstate(divide="ignore", invalid="ignore"):
        minimum = np.nan_to_num((2 * potential.c12 / potential.c6) ** (1 / 6), posinf=0.0)
    i, j = np.unravel_index(minimum.argmax(), minimum.shape)
    if not potential.cutoff < (1 - MINIMUM_TOLERANCE) * minimum[i, j]:
        return ()
    first, second = (name[np.flatnonzero(potential.kind == kind)[0]] for kind in (i, j))
    return (short_cutoff_note(potential.cutoff, f"{first} and {second}", float(minimum[i, j])),)


def _inverse_power(p: int):
    """Function of r that gives r⁻ᵖ, its force and the derivative of its force."""
    return lambda r: (r**-p, p * r ** -(p + 1), -p * (p + 1) * r ** -(p + 2))


@implements(pairs.pair, LennardJonesOneKind, inline=True)
def _pair_of_one_kind(potential, i, j, r2):
    u, w = energy_and_force(potential, potential.c12, potential.c6, r2)
    return with_dispersion(potential.dispersion, i, j, r2, u, w)


@implements(pairs.pair, LennardJonesManyKinds, inline=True)
def _pair(potential, i, j, r2):
    at = potential.kind[i] * len(potential.kind) + j
    u, w = energy_and_force(potential, load(potential.c12, at), load(potential.c6, at), r2)
    return with_dispersion(potential.dispersion, i, j, r2, u, w)


def screened_dispersion(
    strength: np.ndarray, beta: float, cutoff: float, *, shifted: bool
) -> ScreenedDispersion:
    """What is added for sites with c (s,), square root of u Å⁸/ps². shifted : whether it is 0 at
    the cutoff"""
    shift = float(-InverseR6(beta).energy(np.array(cutoff))) if shifted else 0.0
    return ScreenedDispersion(beta, shift, dispersion_screening(beta, cutoff), strength)


@chosen_by_type(inline=True)
def with_dispersion(dispersion, i, j, r2, u, w):
    """(energy, force/r) with the part of a sum of dispersion, if there is one."""
    if not is_a(dispersion, ScreenedDispersion):
        return lambda dispersion, i, j, r2, u, w: (u, w)
    if isinstance(dispersion.types[3], types.Array):

        def of_many(dispersion, i, j, r2, u, w):
            return _added(
                dispersion, dispersion.strength[i] * load(dispersion.strength, j), r2, u, w
            )

        return of_many
    return lambda dispersion, i, j, r2, u, w: _added(dispersion, dispersion.strength, r2, u, w)


@kernel(inline=True)
def _added(dispersion, cc, r2, u, w):
    t = dispersion.screening.scale * r2 - 1.0
    energy = polynomial(dispersion.screening.energy, t) - dispersion.shift
    return u + cc * energy, w + cc * polynomial(dispersion.screening.force, t)


@chosen_by_type(inline=True)
def energy_and_force(potential, c12, c6, r2):
    """(energy, force/r) of sites with c12/r¹² - c6/r⁶ at squared distances r2."""
    if is_a(potential, LennardJonesManyKinds):

        def of_many(potential, c12, c6, r2):
            inverse2, inverse1 = inverses(potential.truncation, potential.addend12, r2)
            six = inverse2 * inverse2 * inverse2
            terms = mixed(potential.terms12, potential.terms6, c12, c6)
            of12 = c12 * (12 + switch_term(potential.truncation, potential.addend12, r2 * inverse1))
            of6 = c6 * (6 + switch_term(potential.truncation, potential.addend6, r2 * inverse1))
            u, w = (c12 * six - c6) * six + terms[0], (of12 * six - of6) * six * inverse2
            return truncated(potential.truncation, terms, potential.addend12, r2, inverse1, u, w)

        return of_many

    if is_a(potential.types[potential.fields.index("correction")], SwitchCorrection):

        def with_correction(potential, c12, c6, r2):
            inverse2 = inverse(r2)
            six = inverse2 * inverse2 * inverse2
            terms = mixed(potential.terms12, potential.terms6, c12, c6)
            u, w = (c12 * six - c6) * six + terms[0], (12 * c12 * six - 6 * c6) * six * inverse2
            w = w + correction(potential.truncation, potential.correction, r2)
            return truncated(potential.truncation, terms, potential.correction, r2, 0.0, u, w)

        return with_correction

    def of_one(potential, c12, c6, r2):
        inverse2, inverse1 = inverses(potential.truncation, potential.addend12, r2)
        six = inverse2 * inverse2 * inverse2
        terms = mixed(potential.terms12, potential.terms6, c12, c6)
        of12 = 12 * c12 + switch_term(potential.truncation, potential.addend12, r2 * inverse1)
        of6 = 6 * c6 + switch_term(potential.truncation, potential.addend6, r2 * inverse1)
        u, w = (c12 * six - c6) * six + terms[0], (of12 * six - of6) * six * inverse2
        return truncated(potential.truncation, terms, potential.addend12, r2, inverse1, u, w)

    return of_one


@chosen_by_type(inline=True)
def inverses(truncation, switched, r2):
    """(1/r², 1/r) at squared distances r2, 1/r is 0 if it is not needed, to save the square
    root."""
    if not needs_root(truncation, switched):
        return lambda truncation, switched, r2: (inverse(r2), 0.0)

    def with_root(truncation, switched, r2):
        inverse1 = inverse_square_root(r2)
        return inverse1 * inverse1, inverse1

    return with_root


@kernel(inline=True)
def mixed(terms12, terms6, c12, c6):
    """The truncation terms of the potential from those of its two powers."""
    return (
        c12 * terms12[0] - c6 * terms6[0],
        c12 * terms12[1] - c6 * terms6[1],
        c12 * terms12[2] - c6 * terms6[2],
        c12 * terms12[3] - c6 * terms6[3],
    )


@implements(pairs.arrange, LennardJonesManyKinds)
def _arrange(slot_potential, potential, order):
    for slot, i in enumerate(order):
        slot_potential.kind[slot] = potential.kind[i]
        for k in range(len(potential.c12)):
            slot_potential.c12[k * len(order) + slot] = potential.c12[k, potential.kind[i]]
            slot_potential.c6[k * len(order) + slot] = potential.c6[k, potential.kind[i]]
    _arrange_strengths(slot_potential.dispersion, potential.dispersion, order)


@chosen_by_type
def _arrange_strengths(in_slots, dispersion, order):
    if not is_a(dispersion, ScreenedDispersion):
        return lambda in_slots, dispersion, order: None

    def arrange(in_slots, dispersion, order):
        for slot, i in enumerate(order):
            in_slots.strength[slot] = dispersion.strength[i]

    return arrange


def tail(potential: LennardJones, inner: InnerPairs | None = None) -> Tail:
    """The tail correction, for g(r) = 1 where the truncation changes the potential, see the theory
    chapter `interactions` (Allen & Tildesley 2017, 2.8). inner : the pairs that are not
    interactions. None of points without"""
    count = np.bincount(potential.kind, minlength=len(potential.c6))
    energy = pressure = constant = 0.0
    for sign, c, p, terms in (
        (1, potential.c12, 12, potential.terms12),
        (-1, potential.c6, 6, potential.terms6),
    ):
        power = _power(p)
        beyond = potential.cutoff ** (3 - p) / (p - 3)
        removed = beyond + integral_of_removed_energy(power, potential.truncation, terms)
        # The pressure follows from the force alone: a jump of the energy at the cutoff (plain) does
        # not contribute.
        jumps = terms[0] == 0 and isinstance(potential.truncation, Unmodified)
        jump = potential.cutoff ** (3 - p) / 3 if jumps else 0.0
        strength = sign * count @ c @ count
        energy += 2 * pi * strength * removed
        pressure += 2 * pi * strength * (removed + jump)
        if (
            inner is not None
        ):  # the molecule itself is part of the uniform liquid, but not among its own neighbours
            of_pairs = removed_energy(power, potential.truncation, terms, inner.distance)
            constant -= sign * float(inner.count * c[inner.one, inner.other] @ of_pairs) / 2
    return Tail(energy, pressure, constant)


def _power(p: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda r: r ** -float(p)
