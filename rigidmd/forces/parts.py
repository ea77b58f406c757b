"""What force terms are made of: the parts of a system, and the interactions that are made from
them.

A factory in this package makes the terms for one scene key: `interactions` of a pair potential or
of a method of electrostatics, `term` of a field.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.core.state import State
from rigidmd.forces.ewald.errors import FINE, Charges, charges_in, filled_fraction
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import BodySites, CentralSites, exclusion_groups, sites_of
from rigidmd.forces.neighbors.space import Space
from rigidmd.formats.cells import describe_basis, describe_cell
from rigidmd.scene.models import Molecule
from rigidmd.scene.molecules import MolecularScene
from rigidmd.units import COULOMB_CHARGE

#: Numbers of grid points along three edges.
Grid = tuple[int, int, int]
#: Keys of [forces] and their values.
KeysAndValues = dict[str, float | str | Grid | None]


class Masses(Protocol):
    """The masses and moments of inertia of n molecules, of a `dynamics.model.Model`."""

    @property
    def species(self) -> np.ndarray: ...  # (n,) species of each molecule
    @property
    def mass(self) -> np.ndarray: ...  # (species,) u
    @property
    def inverse_mass(self) -> np.ndarray: ...  # (species,) 1/u; 0 for a frozen species
    @property
    def inverse_inertia(self) -> np.ndarray: ...  # (species, 3) 1/(u Å²); 0 where the moment is 0


class SystemParts(NamedTuple):
    """The parts of a system on which its terms depend."""

    scene: MolecularScene
    species: Sequence[Molecule]
    model: Masses
    space: Space
    state: State  # the start
    number: np.ndarray  # (n,) residue numbers, by which a scene selects molecules
    # (3, 3) integers: the edges of the box in terms of the edges of the given cell
    basis: np.ndarray
    grid: Grid | None  # of PME, along the edges of the box

    @property
    def moves(self) -> np.ndarray:
        """Whether each species (species,) moves."""
        return self.model.inverse_mass > 0

    def sites(self, indices: list[np.ndarray]) -> BodySites | CentralSites:
        """The sites indices[k] of each species k."""
        offsets = [m.positions_body[c] for m, c in zip(self.species, indices, strict=True)]
        return sites_of(self.model.species, offsets, self.model.inverse_inertia)

    def pair_forces(self, potential: NamedTuple, sites: BodySites | CentralSites) -> PairForces:
        """The term of a pair potential between sites of different molecules, not both frozen."""
        return PairForces(
            potential, sites, exclusion_groups(sites, ~self.moves[self.model.species])
        )

    @property
    def counts(self) -> np.ndarray:
        """Molecules of each species (species,)."""
        return np.bincount(self.model.species, minlength=len(self.species))

    @property
    def filled(self) -> float:
        """See `errors.filled_fraction`."""
        return filled_fraction(self.species, self.counts, self.space, self.state.position)

    @property
    def charges(self) -> Charges:
        return charges_in(self.species, self.counts)

    @property
    def cell_text(self) -> str:
        """The cell of the box in terms of the given cell, for messages."""
        return f"{describe_cell(self.state.cell)}, {describe_basis(self.basis)}"

    def charged(self) -> tuple[BodySites | CentralSites, np.ndarray]:
        """The charged sites, and their charges (s,) in e."""
        charges = gather_per_molecule(
            [m.charges[m.charges != 0] for m in self.species], self.model.species
        )
        return self.sites([np.flatnonzero(m.charges != 0) for m in self.species]), charges

    def sum_over_molecules(self, energy: Callable[[np.ndarray, np.ndarray], float]) -> float:
        """Sum of energy(charges (s,) in energy units, positions (s, 3)) over the molecules that are
        not frozen, of their charged sites."""
        total = 0.0
        for m, moves, count in zip(self.species, self.moves, self.counts, strict=True):
            if moves and count:
                charge, position = m.charges[m.charges != 0], m.positions_body[m.charges != 0]
                total += int(count) * energy(charge * COULOMB_CHARGE, position)
        return total


class InnerPairs(NamedTuple):
    """Pairs of sites of one molecule: each pair in both orders, and each site with itself. Equal
    pairs are one row."""

    one: np.ndarray  # (p,) kind of a site
    other: np.ndarray  # (p,) kind of the other
    distance: np.ndarray  # (p,) Å
    count: np.ndarray  # (p,) in the whole system

    def between(self, i: int, j: int) -> "InnerPairs":
        """The pairs of two kinds, in both orders."""
        rows = ((self.one == i) & (self.other == j)) | ((self.one == j) & (self.other == i))
        return InnerPairs(*(column[rows] for column in self))


def inner_pairs(
    kinds: list[np.ndarray], positions: list[np.ndarray], counts: np.ndarray
) -> InnerPairs:
    """The pairs inside molecules, from the kinds (s_k,) and the positions (s_k, 3) of the sites of
    each species k, and the number of its molecules."""
    rows = [np.zeros((0, 3))]
    count = [np.zeros(0)]
    for of_sites, position, molecules in zip(kinds, positions, counts, strict=True):
        distance = np.linalg.norm(position[:, None] - position, axis=2).round(FINE)
        one, other = np.broadcast_arrays(of_sites[:, None], of_sites)
        of_species = np.stack([one, other, distance], axis=-1).reshape(-1, 3)
        of_species, repeats = np.unique(of_species, axis=0, return_counts=True)
        rows.append(of_species)
        count.append(float(molecules) * repeats)
    one, other, distance = np.concatenate(rows).T
    return InnerPairs(one.astype(int), other.astype(int), distance, np.concatenate(count))


class Tail(NamedTuple):
    """Tail correction: the energy and pressure that truncation takes away, at any volume."""

    energy_volume: (
        float  # the part of the energy that is inverse to the volume, times the volume, u Å⁵/ps²
    )
    pressure_square: float  # pressure times the volume squared, u Å⁵/ps²
    constant: float = 0.0  # the part of the energy that does not depend on the volume, u Å²/ps²

    def energy(self, volume: float) -> float:
        """u Å²/ps²"""
        return self.energy_volume / volume + self.constant

    def pressure(self, volume: float) -> float:
        """u/(Å ps²)"""
        return self.pressure_square / volume**2


def sum_of_tails(tails: list[Tail]) -> Tail | None:
    """Sum of the tail corrections, or None if there are none."""
    return Tail(*np.sum(tails, axis=0).tolist()) if tails else None


class Interactions(NamedTuple):
    """The terms, constants and corrections of interactions between molecules."""

    terms: dict[str, NamedTuple]
    constants: dict[str, float]  # constant energies, u Å²/ps²
    pressure: float = 0.0  # a constant part of the pressure, u/(Å ps²)
    tail: Tail | None = None  # if the scene has forces.tail_correction
    force_error: float | None = (
        None  # estimated rms error of the Coulomb force on a site, u Å/ps²; with Ewald sums
    )
    notes: tuple[str, ...] = ()


class Settings(NamedTuple):
    """Settings of a method of electrostatics that follow from the system."""

    numbers: KeysAndValues
    errors: list[str]
    grid: Grid | None = None  # of PME, along the edges of the box


def select_by_number(
    ranges: list[tuple[int, int]], name: str, of_species: np.ndarray, number: np.ndarray
) -> Iterator[tuple[str, np.ndarray, str]]:
    """For each range of molecule numbers of a species: its text, its mask (n,), and a message on
    missing numbers."""
    for first, last in ranges:
        text = f"{first}" if first == last else f"{first}-{last}"
        mask = of_species & (first <= number) & (number <= last)
        error = ""
        present = number[of_species]
        if not mask.any() or last > present.max():
            existing = (
                f"they have {present.min()} to {present.max()}"
                if len(present)
                else "there are none"
            )
            error = f"no {name} has the number {text}; {existing}"
        yield text, mask, error


def gather_per_molecule(values: list[np.ndarray], species: np.ndarray) -> np.ndarray:
    """values[k], an array (s_k, ...) of each species k, repeated for each molecule in order.
    Species (n,)."""
    sizes = np.array([len(array) for array in values])
    begin = np.cumsum(sizes) - sizes
    count = sizes[species]
    rows = np.repeat(begin[species] - np.cumsum(count) + count, count)
    rows += np.arange(len(rows))
    return np.concatenate(values)[rows]


def sites_named(species: Sequence[Molecule], name: str) -> list[np.ndarray]:
    """Masks of the sites of each species with this name, or else this element. SPECIES.NAME for one
    species."""
    owner, _, site = name.rpartition(".")
    for attribute in ("site_names", "elements"):
        masks = [
            np.array([owner in ("", m.name) and other == site for other in getattr(m, attribute)])
            for m in species
        ]
        if any(mask.any() for mask in masks):
            break
    return masks
