"""The interactions of a resolved scene: terms, constants, tail correction."""

from math import inf

import numpy as np

from rigidmd.assemble.electrostatics import ChargedSites, Interactions, electrostatics
from rigidmd.core.state import State
from rigidmd.dynamics.model import Model
from rigidmd.errors import SceneError
from rigidmd.forces.neighbors.pair_loop import pair_forces
from rigidmd.forces.neighbors.sites import exclusion_groups, sites_of
from rigidmd.forces.neighbors.space import Space
from rigidmd.forces.potentials.lennard_jones import LennardJones, lennard_jones, tail
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.scene import MolecularScene
from rigidmd.scene.forces import MINIMUM_TOLERANCE, short_cutoff_note
from rigidmd.scene.models import Molecule, gather_per_molecule, sites_named
from rigidmd.units import KJ_PER_MOL


def _sites_of(species: list[Molecule], model: Model, indices: list[np.ndarray]):
    """The sites on which a pair potential acts; indices[k] (s,) are its sites of species k."""
    offsets = [m.positions_body[c] for m, c in zip(species, indices, strict=True)]
    return sites_of(model.species, offsets, model.inverse_inertia)


def _named_pairs(scene: MolecularScene, species: list[Molecule]) -> list[np.ndarray]:
    """Masks (pairs, 2, sites) for each species: whether the first or second name of forces.pairs means the site. Raises
    SceneError."""
    found = [np.zeros((len(scene.forces.pairs), 2, len(m.site_names)), bool) for m in species]
    faults = []
    for n, entry in enumerate(scene.forces.pairs):
        for side, text in enumerate(entry.sites):
            masks = sites_named(species, text)
            for k, mask in enumerate(masks):
                found[k][n, side] = mask
            if not any(mask.any() for mask in masks):
                known = dict.fromkeys(f"{m.name}.{site}" for m in species for site in m.site_names)
                faults.append(f"forces.pairs.{n}.sites: no site is {text!r}; there are {', '.join(known)}")
    if faults:
        raise SceneError(scene.source, faults)
    return found


def interactions(
    scene: MolecularScene, species: list[Molecule], model: Model, space: Space, state: State, basis: np.ndarray,
    pme_grid: tuple[int, int, int] | None,
) -> Interactions:  # fmt: skip
    """The interactions of a resolved scene. Raises SceneError. basis, pme_grid: see `electrostatics`."""
    found, index = Interactions({}, {}), model.species
    frozen = (model.inverse_mass == 0)[index]
    named = _named_pairs(scene, species)
    indices = [np.flatnonzero((m.epsilon > 0) | named[k].any(axis=(0, 1))) for k, m in enumerate(species)]
    if scene.forces.lennard_jones and any(len(c) for c in indices):
        potential = _lennard_jones(scene, species, index, named, indices)
        sites = _sites_of(species, model, indices)
        found.terms["lennard_jones"] = pair_forces(potential, sites, exclusion_groups(sites, frozen))
        found = found._replace(
            tail=tail(potential) if scene.forces.tail_correction else None,
            notes=_short_cutoff_notes(potential, species, index, indices),
        )
    indices = [np.flatnonzero(m.charges != 0) for m in species]
    if scene.forces.electrostatics == "none" or not any(len(c) for c in indices):
        return found
    sites = _sites_of(species, model, indices)
    charged = ChargedSites(species, index, frozen, indices, sites, exclusion_groups(sites, frozen))
    added = electrostatics(scene, charged, space, state, basis, pme_grid)
    return added._replace(terms=found.terms | added.terms, tail=found.tail, notes=found.notes + added.notes)


def _lennard_jones(
    scene: MolecularScene, species: list[Molecule], index: np.ndarray, named: list[np.ndarray],
    indices: list[np.ndarray],
) -> LennardJones:  # fmt: skip
    """The Lennard-Jones potential of the sites `indices` of each species. Raises SceneError."""
    forces, cutoff = scene.forces, scene.forces.cutoff_A or inf
    pairs = [
        [(m.sigma[i], m.epsilon[i], tuple(named[k][:, :, i].ravel())) for i in c]
        for k, (m, c) in enumerate(zip(species, indices, strict=True))
    ]
    kinds = sorted({pair for of_species in pairs for pair in of_species})
    of_species = [np.array([kinds.index(pair) for pair in entries], np.int32) for entries in pairs]
    kind = gather_per_molecule(of_species, index)
    sigma, epsilon = np.array([pair[:2] for pair in kinds]).T
    special = {
        (i, j): (entry.sigma_A, entry.epsilon_kJ_mol * KJ_PER_MOL)
        for n, entry in enumerate(forces.pairs)
        for i, (_, _, one) in enumerate(kinds)
        for j, (_, _, other) in enumerate(kinds)
        if one[2 * n] and other[2 * n + 1]
    }
    start = forces.switch_start_A or cutoff
    with np.errstate(over="ignore", invalid="ignore"):  # checked below
        potential = lennard_jones(kind, sigma, epsilon, cutoff, forces.truncation, start, forces.mixing, special)
    if not (np.isfinite(potential.c12).all() and np.isfinite(potential.c6).all()):
        raise SceneError(scene.source, [f"sigma_A of {sigma.max():g} Å with epsilon overflows 4 epsilon sigma¹²"])
    return potential


def _short_cutoff_notes(
    potential: LennardJones, species: list[Molecule], index: np.ndarray, indices: list[np.ndarray]
) -> tuple[str, ...]:
    """A note if the cutoff is below the minimum of an energy, on the pair with the most distant minimum."""
    with np.errstate(divide="ignore", invalid="ignore"):
        minimum = np.nan_to_num((2 * potential.c12 / potential.c6) ** (1 / 6), posinf=0.0)
    i, j = np.unravel_index(minimum.argmax(), minimum.shape)
    if not potential.cutoff < (1 - MINIMUM_TOLERANCE) * minimum[i, j]:
        return ()
    names = [
        np.array([f"{m.name}.{m.site_names[k]}" for k in c], object) for m, c in zip(species, indices, strict=True)
    ]
    of_sites = gather_per_molecule(names, index)
    first, second = (of_sites[np.flatnonzero(potential.kind == kind)[0]] for kind in (i, j))
    return (short_cutoff_note(potential.cutoff, f"{first} and {second}", float(minimum[i, j])),)


def left_out(scene: MolecularScene, terms: dict, model: Model, space: Space) -> list[str]:
    """What is not compiled for this scene, and why."""
    method, has_images = scene.forces.electrostatics, "coulomb_reciprocal" in terms
    has_charges = any(name.startswith("coulomb") for name in terms)
    no_lennard_jones = "no site has it" if scene.forces.lennard_jones else "lennard_jones is false"
    no_charges = "electrostatics is none" if method == "none" else "no site has one"
    reasons = {
        f"Lennard-Jones: {no_lennard_jones}": "lennard_jones" not in terms,
        f"charges: {no_charges}": not has_charges,
        f"sums over periodic images, Fourier transforms: electrostatics is {method}": has_charges and not has_images,
        "Fourier transforms: electrostatics is ewald, a direct sum over k-vectors": has_images and method == "ewald",
        "rotation and torques: every molecule is a point": isinstance(model.rotor, NoRotor),
        "periodic images: no box": space.volume == inf,
        "thermostat: no NVT or NPT stage": not any(stage.has_thermostat for stage in scene.stages),
        "barostat: no NPT or NPH stage": not any(stage.has_barostat for stage in scene.stages),
        "removal of the total momentum: run.remove_momentum_interval_ps is false": (
            scene.run.remove_momentum_interval_ps is False
        ),
        "tail correction: not requested": not scene.forces.tail_correction,
    }
    return [reason for reason, applies in reasons.items() if applies]
