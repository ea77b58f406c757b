"""Dispersion by Ewald sums, forces.dispersion = "ewald" and "pme": settings, terms, constants of
rigid molecules.

The pairs within the cutoff are in the Lennard-Jones potential, see
`potentials.lennard_jones.ScreenedDispersion`.
"""

from collections.abc import Sequence
from math import inf, pi, sqrt

import numpy as np

from rigidmd.forces.ewald import corrections, direct_sum
from rigidmd.forces.ewald.errors import (
    MAX_ALPHA_CUTOFF,
    Dispersing,
    alpha_for,
    charges_in,
    k_cutoff_for,
    pme_error,
    pme_grid_for,
)
from rigidmd.forces.ewald.smooth import InverseR6
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.parts import (
    Interactions,
    KeysAndValues,
    Settings,
    SystemParts,
    gather_per_molecule,
)
from rigidmd.scene.forces import Forces
from rigidmd.scene.models import Molecule
from rigidmd.units import KJ_PER_MOL

#: Default of forces.dispersion_accuracy, with which the pairs that are omitted change the pressure
#: of water by 1 bar.
ACCURACY = 5e-5
MOST_K_VECTORS_IN_ALL = 2e7  #: as for charges


def dispersing_in(species: Sequence[Molecule], counts: np.ndarray) -> Dispersing:
    """The strengths c of molecules, for estimates of errors."""
    return charges_in(species, counts, lambda m: m.dispersion, Dispersing)


def settings(forces: Forces, parts: SystemParts, cutoff: float | None) -> Settings:
    """The keys of [forces] that follow from the accuracy. cutoff : of Lennard-Jones, Å"""
    space, species, counts = parts.space, parts.species, parts.counts
    where = f"forces.dispersion = {forces.dispersion!r}"
    sites = dispersing_in(species, counts)
    if space.volume == inf or cutoff is None:
        return Settings({}, [f"{where} needs a periodic box. Use cutoff"])
    if sites.count == 0:
        return Settings({}, [f"{where}, and no site has Lennard-Jones parameters. Use cutoff"])
    accuracy = forces.dispersion_accuracy or ACCURACY
    cell = cell_of(space)
    # of the real-space and of the reciprocal error
    part = _error(accuracy, species, counts) * sqrt(parts.filled / 2)
    beta = float(forces.dispersion_beta_per_A or alpha_for(sites, cutoff, space.volume, part))
    numbers: KeysAndValues = {"dispersion_accuracy": accuracy, "dispersion_beta_per_A": beta}
    unreachable = (
        f"forces.dispersion_accuracy = {accuracy:g} cannot be reached at beta = {beta:.3g} 1/Å"
    )
    if beta * cutoff > MAX_ALPHA_CUTOFF:
        return Settings(
            numbers,
            [f"{unreachable} with a cutoff of {cutoff:g} Å. Use a longer one or a smaller beta"],
        )
    if forces.dispersion == "ewald":
        radius = k_cutoff_for(sites, beta, 2 * pi * np.linalg.inv(cell).T, part)
        if (count := radius**3 * space.volume / (6 * pi**2)) > MOST_K_VECTORS_IN_ALL:
            return Settings(
                numbers, [f"{where} needs about {count:.2g} k-vectors: use pme or a lower accuracy"]
            )
        return Settings(numbers, [])
    grid, order = forces.dispersion_grid, forces.dispersion_order
    is_given_cell = np.array_equal(parts.basis, direct_sum.SAME_BASIS)
    if grid is not None and len(set(grid)) > 1 and not is_given_cell:
        error = f"the box is the equivalent cell with {parts.cell_text}: give three equal numbers"
        return Settings(
            numbers,
            [f"forces.dispersion_grid = {list(grid)} refers to a cell with a large tilt; {error}"],
        )
    if grid is None or order is None:
        grid_and_order = pme_grid_for(sites, beta, cell, part, order, grid)
        if grid_and_order is None:
            return Settings(
                numbers, [f"{unreachable} on a grid. Use a lower accuracy or a longer cutoff"]
            )
        grid, order = grid_and_order
        grid = grid if is_given_cell else (max(grid),) * 3
    return Settings(numbers | {"dispersion_order": order, "dispersion_grid": grid}, [])


def _error(accuracy: float, species: Sequence[Molecule], counts: np.ndarray) -> float:
    """The error of a force (u Å/ps²) that is meant by an accuracy."""
    force_scales = [
        m.epsilon[m.epsilon > 0] / m.sigma[m.epsilon > 0]
        for m, n in zip(species, counts, strict=True)
        if n
    ]
    return accuracy * 24 * float(np.concatenate(force_scales).max())


def interactions(parts: SystemParts) -> Interactions:
    """The sum over k-vectors, and its constants."""
    forces = parts.scene.forces
    species = parts.species
    counts = parts.counts
    volume = parts.space.volume
    present = [np.flatnonzero(m.dispersion) for m in species]
    strengths = [m.dispersion[i] for m, i in zip(species, present, strict=True)]
    strength = gather_per_molecule(strengths, parts.model.species)
    sites = parts.sites(present)
    beta = forces.dispersion_beta_per_A
    cell = cell_of(parts.space)
    cutoff = forces.cutoff_A
    accuracy = forces.dispersion_accuracy
    # they are defaults, or keys of the scene
    assert beta is not None and cutoff is not None and accuracy is not None
    smooth = InverseR6(beta)
    dispersing = dispersing_in(species, counts)
    k_space = _error(accuracy, species, counts) * sqrt(parts.filled / 2)
    if forces.dispersion == "ewald":
        reciprocal = 2 * pi * np.linalg.inv(cell).T
        vectors = direct_sum.k_vectors_within(
            reciprocal, k_cutoff_for(dispersing, beta, reciprocal, k_space)
        )
        term = direct_sum.EwaldSum(smooth, strength, sites, vectors)
        how = f"{vectors.total} k-vectors"
    else:
        from rigidmd.forces.ewald.pme import Pme  # rocket-fft is for scenes with PME only

        grid, order = forces.dispersion_grid, forces.dispersion_order
        assert grid is not None and order is not None
        term = Pme(smooth, strength, sites, grid, order)
        how = f"grid {' x '.join(map(str, grid))}, splines of order {order}"
        k_space = pme_error(dispersing, beta, cell, grid, order)
    inside = 0.0
    for m, n in zip(species, counts, strict=True):
        i, j = np.triu_indices(len(m.masses), 1)
        r = np.linalg.norm(m.positions_body[i] - m.positions_body[j], axis=1)
        inside -= float(n * np.sum(m.dispersion[i] * m.dispersion[j] * smooth.energy(r)))
    terms = {
        "dispersion_reciprocal": term,
        "dispersion_mean": corrections.MeanDispersion(
            -(pi**1.5) * beta**3 / 6 * float(strength.sum()) ** 2
        ),
    }
    constants = {
        "dispersion_self": beta**6 / 12 * float(strength @ strength),
        "dispersion_intramolecular": inside,
    }
    error = (
        np.hypot(k_space, dispersing.beyond(beta, cutoff, volume)) / sqrt(parts.filled) / KJ_PER_MOL
    )
    note = (
        f"dispersion by {forces.dispersion}: beta {beta:.6g} 1/Å, {how}. "
        f"Estimated rms error of its force on a site: {error:.2g} kJ/(mol Å)"
    )
    return Interactions(terms, constants, notes=(note,))
