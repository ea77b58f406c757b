"""Finds overlaps: sites of different molecules that are too close."""

from collections.abc import Callable, Iterator
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import State
from rigidmd.dynamics.momenta import mobile
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.io.formats.cells import pairs_within
from rigidmd.scene.models import Molecule

if TYPE_CHECKING:
    from rigidmd.engines.system import System

#: Lennard-Jones sites of different molecules closer than this fraction of their diameter overlap: the repulsion there
#: is 1750 epsilon, which does not occur in liquids.
OVERLAP = 0.6
#: Sites of different molecules closer than this fraction of the smallest molecular radius overlap too.
INSIDE = 0.2


def overlaps(system: "System") -> list[str]:
    """Messages on overlapping molecules, at most five of them."""
    inside = INSIDE * min([m.radius for m in system.species if m.radius > 0], default=0.0)
    cores = [np.where(m.epsilon > 0, m.sigma, 0.0) for m in system.species]
    widest = max((sigma.max() for sigma in cores), default=0.0)
    wanted = (inside, every_site), (OVERLAP * widest, lambda m: np.flatnonzero(m.epsilon > 0))
    near = close_pairs(system, system.state, *wanted)
    sigma = gather_per_molecule(cores, system.model.species) if near else np.zeros(0)
    faults = []
    for i, j, distance in near:
        both = sigma[i] > 0 and sigma[j] > 0
        if distance <= max(inside, OVERLAP * (sigma[i] + sigma[j]) / 2 if both else 0.0):
            a, b = system.sites.molecule[[i, j]]
            names = " and ".join(str(system.sites.name[k]) for k in (i, j))
            faults.append(f"molecules {a + 1} and {b + 1} overlap: {names} have a distance of {distance:.3f} Å")
    return faults[:5] + ([f"and {len(faults) - 5} more"] if len(faults) > 5 else [])


def every_site(molecule: Molecule) -> np.ndarray:
    """Indices of all sites of a molecule."""
    return np.arange(len(molecule.masses))


def close_pairs(
    system: "System", state: State, *wanted: tuple[float, Callable[[Molecule], np.ndarray]]
) -> list[tuple[int, int, float]]:
    """Sites (i, j) of different molecules, not both frozen, within a radius, and their distances, Å. `wanted` are
    radii, and functions for the indices of the sites of a molecule to which they apply."""
    species, reach = system.species, 0.0
    for radius, sites_of in wanted:
        arm = max(np.linalg.norm(m.positions_body[sites_of(m)], axis=1).max(initial=0.0) for m in species)
        reach = max(reach, radius + 2 * arm if arm <= system.smallest_diameter else inf)
    crowded = np.arange(len(state.position))
    if reach < inf:  # few centres are so close; a search among all sites would take five times as long
        crowded = np.unique(np.concatenate(pairs_within(state.position, _cell(state), reach)[:2]))
    near: dict[tuple[int, int], float] = {}
    for radius, sites_of in wanted if len(crowded) else ():
        for i, j, distance in _close_among(system, state, crowded, radius, [sites_of(m) for m in species]):
            pair = min(i, j), max(i, j)
            near[pair] = min(distance, near.get(pair, inf))
    return [(*pair, near[pair]) for pair in sorted(near)]


def _close_among(
    system: "System", state: State, molecules: np.ndarray, radius: float, indices: list[np.ndarray]
) -> Iterator[tuple[int, int, float]]:
    """The pairs of `close_pairs` among some molecules and the sites indices[k] of species k."""
    kinds, counts = system.model.species[molecules], system.sites_per_molecule
    owner = np.repeat(molecules, np.array([len(sites) for sites in indices])[kinds])
    site = (np.cumsum(counts) - counts)[owner] + gather_per_molecule(indices, kinds)
    offset = gather_per_molecule(
        [m.positions_body[sites] for m, sites in zip(system.species, indices, strict=True)], kinds
    )
    i, j, distance = pairs_within(system.positions_of(state, owner, offset), _cell(state), radius)
    a, b, free = owner[i], owner[j], mobile(system.model)
    kept = (a != b) & (free[a] | free[b])
    return zip(site[i[kept]].tolist(), site[j[kept]].tolist(), distance[kept].tolist(), strict=True)


def _cell(state: State) -> np.ndarray | None:
    return state.cell if state.volume < inf else None
