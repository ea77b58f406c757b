"""Ewald sums of a scene, electrostatics = "ewald" and "pme": settings, terms, constants of rigid
molecules."""

from math import inf, pi, prod, sqrt

import numpy as np

from rigidmd.core.state import State
from rigidmd.errors import SceneError
from rigidmd.forces.ewald import corrections, direct_sum
from rigidmd.forces.ewald.errors import (
    COARSE_SPACING,
    MAX_ALPHA_CUTOFF,
    MAX_GRID_POINTS,
    alpha_for,
    charges_in,
    fastest_cutoff,
    k_cutoff_for,
    left_out_error,
    pme_error,
    pme_grid_for,
)
from rigidmd.forces.ewald.smooth import InverseR
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.forces.neighbors.space import Space, cell_of
from rigidmd.forces.parts import Interactions, KeysAndValues, Settings, SystemParts
from rigidmd.forces.potentials.screened_coulomb import screened_coulomb, screening_errors
from rigidmd.scene.forces import Forces
from rigidmd.units import COULOMB, COULOMB_CHARGE, KJ_PER_MOL

#: Default of forces.ewald_accuracy: for SPC/E at 9 Å GROMACS' defaults have 9e-5 and OpenMM's 8e-5
#: by `errors`.
ACCURACY = 5e-5
#: Longest real-space cutoff that PME chooses in a liquid, Å, and as a fraction of half an edge of
#: the box, which may shrink. In a dilute box it is longer, as distances between molecules are.
LONGEST_CUTOFF, SHRINKAGE = 14.0, 0.9
#: Largest number of k-vectors along an edge, as for forces.ewald_k_max: more would take all memory.
MOST_K_VECTORS = 1000
MOST_K_VECTORS_IN_ALL = 2e7  # with which a step with 1000 sites takes half a minute
#: A net charge below this fraction of the sum of |q| is rounding.
NEUTRAL = 1e-10
#: Least empty part of the box along the normal of a slab, as a fraction of the longest edge across.
LEAST_VACUUM = 0.5
#: Largest error of the polynomials in single precision between unit charges, as a fraction of the
#: real-space error. With it the measured error of PME on 4096 waters, 3.3e-5 e²/Å², is the same as
#: with all terms of the polynomials.
FIT_ERROR_FRACTION = 0.02


def setting_errors(forces: Forces, space: Space, cutoff: float) -> list[str]:
    """Messages on keys of [forces] that this box does not allow."""
    if space.volume == inf:
        instead = "use coulomb, the sum over all pairs"
        return [
            f"forces.electrostatics = {forces.electrostatics!r} needs a periodic box; {instead}"
        ]
    return screening_errors("ewald_alpha_per_A", forces.ewald_alpha_per_A, cutoff)


def settings(forces: Forces, parts: SystemParts, cutoff: float, is_external: bool) -> Settings:
    """The keys of [forces] that follow from the accuracy. ewald_accuracy becomes None when all of
    them are set.

    cutoff : of Lennard-Jones, Å; is_external : whether another program computes the forces
    """
    usual = "plain" if forces.truncation == "plain" or is_external else "shift"
    numbers: KeysAndValues = {"ewald_truncation": forces.ewald_truncation or usual}
    charges = parts.charges
    cell = cell_of(parts.space)
    if charges.count == 0:
        return Settings(numbers, [])
    accuracy = forces.ewald_accuracy or ACCURACY
    filled = parts.filled
    # of the real-space and of the reciprocal error, at the mean density
    part = accuracy * sqrt(filled / 2)
    free = (forces.ewald_cutoff_A, forces.ewald_alpha_per_A, forces.pme_order, forces.pme_grid) == (
        None,
    ) * 4
    if forces.electrostatics == "pme" and free and not is_external:
        longest = min(LONGEST_CUTOFF * filled ** (-1 / 3), SHRINKAGE * min(parts.space.edges) / 2)
        cutoff = fastest_cutoff(charges, cell, longest, part, filled) or cutoff
    cutoff = numbers["ewald_cutoff_A"] = forces.ewald_cutoff_A or cutoff
    unreachable = (
        f"forces.ewald_accuracy = {accuracy:g}{_default(forces.ewald_accuracy)} cannot be reached"
    )
    alpha = float(forces.ewald_alpha_per_A or alpha_for(charges, cutoff, parts.space.volume, part))
    if alpha * cutoff > MAX_ALPHA_CUTOFF:
        return Settings(numbers, [f"{unreachable} with a cutoff of {cutoff:g} Å. Use a longer one"])
    numbers |= {"ewald_alpha_per_A": alpha, "ewald_accuracy": None}
    if forces.electrostatics == "ewald":
        return _settings_of_vectors(forces, parts, alpha, part, numbers)
    return _settings_of_grid(forces, parts, alpha, part, numbers, accuracy, unreachable)


def _settings_of_vectors(
    forces: Forces, parts: SystemParts, alpha: float, part: float, numbers: KeysAndValues
) -> Settings:
    """The radius of the k-vectors of a plain Ewald sum for an error `part`."""
    cell = cell_of(parts.space)
    radius = forces.ewald_k_radius_per_A
    if not forces.sets_k_vectors:
        inverse = 2 * pi * np.linalg.inv(cell).T
        radius = float(k_cutoff_for(parts.charges, alpha, inverse, part))
    longest = np.linalg.norm(cell, axis=1).max()
    if (
        radius is not None
        and forces.ewald_k_max is None
        and radius * longest > 2 * pi * MOST_K_VECTORS
    ):
        error = (
            f"forces.ewald_k_radius_per_A = {radius:g}{_default(forces.ewald_k_radius_per_A)} is"
            f" more than {MOST_K_VECTORS} k-vectors along an edge of the box"
        )
        return Settings(numbers, [error])
    count = _number_of_k_vectors(forces, radius, parts.space.volume)
    if count > MOST_K_VECTORS_IN_ALL:
        error = f"needs about {count:.2g} k-vectors, more than {MOST_K_VECTORS_IN_ALL:.2g}"
        advice = "use pme, a lower accuracy, fewer k-vectors or a smaller box"
        return Settings(numbers, [f"forces.electrostatics = 'ewald' {error}: {advice}"])
    return Settings(numbers | {"ewald_k_radius_per_A": radius}, [])


def _settings_of_grid(
    forces: Forces,
    parts: SystemParts,
    alpha: float,
    part: float,
    numbers: KeysAndValues,
    accuracy: float,
    unreachable: str,
) -> Settings:
    """The grid and the order of PME for an error `part`.

    unreachable : the beginning of the sentence if there are none
    """
    cell = cell_of(parts.space)
    grid, order = forces.pme_grid, forces.pme_order
    has_given_cell = np.array_equal(parts.basis, direct_sum.SAME_BASIS)
    if grid is not None and len(set(grid)) > 1 and not has_given_cell:
        error = (
            f"forces.pme_grid = {list(grid)} refers to the edges of a cell with a large tilt. The"
            f" box is the equivalent cell with {parts.cell_text}. Give this cell as the box, or"
            " three equal numbers, or leave pme_grid out"
        )
        return Settings(numbers, [error])
    if grid is None or order is None:
        longest = np.linalg.norm(cell, axis=1).max()
        grid_and_order = pme_grid_for(parts.charges, alpha, cell, part, order, grid)
        if grid_and_order is None and longest > MAX_GRID_POINTS * COARSE_SPACING:
            error = f"an edge of {longest:.4g} Å is too long for a grid of {MAX_GRID_POINTS} points"
            return Settings(numbers, [f"forces.electrostatics = 'pme': {error}"])
        if grid_and_order is None:
            settings_used = " with the given forces.pme_order or pme_grid" if order or grid else ""
            error = (
                f"{unreachable}{settings_used} at alpha = {alpha:.3g} 1/Å. Use a lower accuracy or"
                " a longer cutoff"
            )
            return Settings(numbers, [error])
        grid, order = grid_and_order
    numbers["pme_order"] = order
    if has_given_cell or forces.pme_grid is not None:
        numbers["pme_grid"] = grid
    else:
        numbers["ewald_accuracy"] = accuracy
    return Settings(numbers, [], grid)


def _default(value: object) -> str:
    return "" if value else " (the default)"


def _number_of_k_vectors(forces: Forces, radius: float | None, volume: float) -> float:
    """Approximate number of k-vectors within a radius (1/Å) and the limits of [forces]."""
    limit = forces.ewald_k_max
    boxed = (
        inf
        if limit is None
        else prod(2.0 * n + 1 for n in (limit if isinstance(limit, tuple) else (limit,) * 3))
    )
    return min(boxed, inf if radius is None else radius**3 * volume / (6 * pi**2))


def _errors(parts: SystemParts) -> tuple[float, float, direct_sum.KVectors | None]:
    """Errors of real space and of k-space (e²/Å², see `ewald.errors`), and the k-vectors. With PME
    these are only for the interactions of frozen molecules, and None without any. Raises
    SceneError."""
    forces = parts.scene.forces
    volume = parts.space.volume
    cell = cell_of(parts.space)
    alpha, cutoff, order = forces.ewald_alpha_per_A, forces.ewald_cutoff_A, forces.pme_order
    assert alpha is not None and cutoff is not None  # they are defaults, or keys of the scene
    charges = charges_in(parts.species, parts.counts)
    real, reciprocal = (
        charges.beyond(alpha, cutoff, volume),
        2 * pi * np.linalg.inv(cell).T,
    )
    if parts.grid is not None:
        assert order is not None
        error = pme_error(charges, alpha, cell, parts.grid, order)
        vectors = None
        if not parts.moves[parts.model.species].all():
            vectors = direct_sum.k_vectors_within(
                reciprocal, k_cutoff_for(charges, alpha, reciprocal, 1e-3 * error)
            )
        return real, error, vectors
    limit, radius = forces.ewald_k_max, forces.ewald_k_radius_per_A
    if isinstance(limit, int):
        limit = (limit, limit, limit)
    if radius is None:
        assert limit is not None  # one of both is set
        vectors = direct_sum.k_vectors_up_to(limit, forces.ewald_k2_max, parts.basis)
    else:
        vectors = direct_sum.k_vectors_within(reciprocal, radius, limit, parts.basis)
    if vectors.total == 0:
        raise SceneError(
            parts.scene.source, ["forces.ewald_k_max or ewald_k_radius_per_A leaves no k-vector"]
        )
    return real, left_out_error(charges, alpha, vectors, cell), vectors


def interactions(parts: SystemParts) -> Interactions:
    """The charges of a scene with an Ewald sum. Raises SceneError."""
    forces, (sites, charge_e), (real, k_space, vectors) = (
        parts.scene.forces,
        parts.charged(),
        _errors(parts),
    )
    real, k_space = real / sqrt(parts.filled), k_space / sqrt(parts.filled)
    alpha = forces.ewald_alpha_per_A
    cutoff = forces.ewald_cutoff_A
    charge = charge_e * COULOMB_CHARGE
    assert alpha is not None and cutoff is not None
    shifted = forces.ewald_truncation == "shift"
    potential = screened_coulomb(
        charge_e, cutoff, alpha, shifted=shifted, error=FIT_ERROR_FRACTION * real
    )
    if parts.grid is None:
        assert vectors is not None  # with PME only, there may be none
        reciprocal = direct_sum.EwaldSum(InverseR(alpha), charge, sites, vectors)
        how = f"{vectors.total} k-vectors, |n| up to {' '.join(map(str, vectors.most))}"
        if forces.ewald_k_max is not None and not np.array_equal(
            parts.basis, direct_sum.SAME_BASIS
        ):
            how += ". They are the k-vectors that ewald_k_max means in the given cell"
    else:
        from rigidmd.forces.ewald.pme import Pme  # rocket-fft is for scenes with PME only

        assert forces.pme_order is not None
        reciprocal = Pme(InverseR(alpha), charge, sites, parts.grid, forces.pme_order)
        how = f"grid {' x '.join(map(str, parts.grid))}, splines of order {forces.pme_order}"
    terms = {"coulomb_real": parts.pair_forces(potential, sites), "coulomb_reciprocal": reciprocal}
    constants = {
        # The shift applies to all charges within the cutoff of a charge, which together are nearly
        # neutral, including the charge itself and its molecule. The pair loop leaves these out;
        # this constant adds them.
        "coulomb_self": parts.sum_over_molecules(
            lambda q, x: (
                corrections.self_energy(q, alpha) - 0.5 * potential.shift * float(q.sum()) ** 2
            )
        ),
        "coulomb_intramolecular": parts.sum_over_molecules(
            lambda q, x: corrections.intramolecular_energy(q, x, alpha)
        ),
    }
    error = float(np.hypot(real, k_space))
    notes = [
        f"{forces.electrostatics}: alpha {alpha:.6g} 1/Å, cutoff {cutoff:g} Å, {how}"
        + ("" if potential.shift == 0 else ", shifted energies"),
        (
            f"estimated rms error of the force on a site: {error:.2g} e²/Å² ="
            f" {error * COULOMB / KJ_PER_MOL:.2g} kJ/(mol Å)"
        ),
    ]
    frozen_sites = ~parts.moves[parts.model.species][sites.molecule]
    net = charge.sum()
    net_frozen = charge[frozen_sites].sum()
    neutral = abs(net) <= NEUTRAL * np.abs(charge).sum()
    if not neutral:
        terms["coulomb_background"] = corrections.background(net**2 - net_frozen**2, alpha)
        notes.append(
            f"the box has a net charge of {charge_e.sum():+.6g} e. An even background of the"
            " opposite charge makes it neutral, and energies and pressure depend on the size of"
            " the box"
        )
    if any(strength := _surface_strength(forces)):
        key = "ewald_slab" if forces.ewald_slab else "ewald_surface_permittivity"
        if not neutral:
            why = "the dipole of a box with a net charge is not defined. Leave it out"
            raise SceneError(parts.scene.source, [f"forces.{key}: {why}"])
        terms["coulomb_surface"] = corrections.SurfaceDipole(strength, charge, sites)
        if forces.ewald_slab:
            notes.append(_checked_slab(parts, sites, charge))
    pressure = 0.0
    if frozen_sites.any():
        assert vectors is not None  # with frozen molecules there are some
        constants["coulomb_frozen"], pressure = _frozen_correction(
            parts, sites, charge * frozen_sites, vectors
        )
    return Interactions(terms, constants, pressure, None, error * COULOMB, tuple(notes))


def _arms(state: State, sites: BodySites | CentralSites) -> np.ndarray:
    """Positions (s, 3) of sites from the centres of mass, lab frame."""
    if not len(state.rotation):
        return np.zeros((len(sites.molecule), 3))
    return np.einsum("sij,sj->si", state.rotation[sites.molecule], sites.offsets())


def _surface_strength(forces: Forces) -> tuple[float, float, float]:
    """See `corrections.SurfaceDipole`."""
    if forces.ewald_slab is None:
        return (2 * pi / (2 * forces.ewald_surface_permittivity + 1),) * 3
    x, y, z = (2 * pi if axis == forces.ewald_slab else 0.0 for axis in "xyz")
    return x, y, z


def _checked_slab(parts: SystemParts, sites: BodySites | CentralSites, charge: np.ndarray) -> str:
    """A note on the vacuum around a slab. Raises SceneError where it is too thin, and for other
    wrong geometries."""
    k = "xyz".index(parts.scene.forces.ewald_slab)
    cell = cell_of(parts.space)
    errors = []
    across = [i for i in range(3) if i != k]
    if cell[k, across].any() or cell[across, k].any():
        errors.append("the edge along the normal must be at right angles to the others")
    height = cell[k, k]
    lateral = float(np.linalg.norm(cell[across], axis=1).max())
    centre = parts.state.position[:, k]
    sorted_at = np.sort((centre[sites.molecule] + _arms(parts.state, sites)[:, k]) % height)
    gaps = np.diff(sorted_at, append=sorted_at[0] + height)
    gap = float(gaps.max())
    boundary = sorted_at[gaps.argmax()] + gaps.max() / 2
    note = (
        f"{gap:.3g} Å along {parts.scene.forces.ewald_slab} are empty, {gap / lateral:.2g} of the"
        " longest edge across"
    )
    if gap < LEAST_VACUUM * lateral:
        errors.append(
            f"{note}, which has to be at least {LEAST_VACUUM:g}: add vacuum, or leave"
            " ewald_slab out"
        )
    net = np.abs(np.bincount(sites.molecule, charge)) > NEUTRAL * np.abs(charge).max()
    if len(set(np.floor((centre[np.flatnonzero(net)] - boundary) / height))) > 1:
        errors.append(
            "charged molecules are in different images of the slab: shift the structure until it is"
            " whole"
        )
    if errors:
        raise SceneError(parts.scene.source, [f"forces.ewald_slab: {error}" for error in errors])
    left = np.exp(-2 * pi * gap / lateral)
    return (
        f"ewald_slab: {note}; of the field at the surface, images along it have at most {left:.1g}"
    )


def _frozen_correction(
    parts: SystemParts,
    sites: BodySites | CentralSites,
    charge: np.ndarray,
    vectors: direct_sum.KVectors,
) -> tuple[float, float]:
    """Constant energy and pressure that cancel the interactions between frozen molecules in sums
    over images. charge (s,) is 0 for sites that move."""
    state = parts.state
    forces = parts.scene.forces
    volume = parts.space.volume
    assert forces.ewald_alpha_per_A is not None
    arms = _arms(state, sites)
    position = state.position[sites.molecule] + arms
    energy, force, virial = direct_sum.ewald_sum_in_numpy(
        charge, position, cell_of(parts.space), forces.ewald_alpha_per_A, vectors
    )
    dipole = charge @ position
    surface = np.array(_surface_strength(forces)) / volume
    force -= 2 * surface * charge[:, None] * dipole
    of_surface = float(surface @ dipole**2)
    energy += of_surface
    trace = float(virial.trace()) + of_surface - float((force * arms).sum())
    return -energy, -trace / (3 * volume)
