"""Overlaps: sites of different molecules that are too close."""

from collections.abc import Callable, Iterator
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import State
from rigidmd.dynamics.momenta import mobile
from rigidmd.io.cells import pairs_within
from rigidmd.scene.models import Molecule, gather_per_molecule

if TYPE_CHECKING:
    from rigidmd.engines.system import System

#: Lennard-Jones sites of different molecules closer than this fraction of their diameter overlap: the repulsion there
#: is 1750 epsilon, which does not occur in liquids.
OVERLAP = 0.6
#: Sites of different molecules closer than this fraction of the smallest molecular radius overlap too.
INSIDE = 0.2


def overlaps(system: "System") -> list[str]:
    """Faults: overlapping molecules, at most five of them named."""
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
            faults.append(
                f"molecules {a + 1} and {b + 1} overlap: {system.sites.name[i]} and {system.sites.name[j]} "
                f"are {distance:.3f} Å apart"
            )
    return faults[:5] + ([f"and {len(faults) - 5} more"] if len(faults) > 5 else [])


def every_site(molecule: Molecule) -> np.ndarray:
    """The sites of a molecule, as indices."""
    return np.arange(len(molecule.masses))


def close_pairs(
    system: "System", state: State, *wanted: tuple[float, Callable[[Molecule], np.ndarray]]
) -> list[tuple[int, int, float]]:
    """Sites (i, j) of different molecules, not both frozen, that are close to each other, and their distances, Å.

    wanted : radii, and the sites of a molecule (indices) of which those within a radius are close
    """
    species, reach = system.species, 0.0
    for radius, sites_of in wanted:
        arm = max(np.linalg.norm(m.positions_body[sites_of(m)], axis=1).max(initial=0.0) for m in species)
        reach = max(reach, radius + 2 * arm if arm <= system.smallest_diameter else inf)
    crowded = np.arange(len(state.position))
    if reach < inf:  # then few centres are as near as that; all sites would take five times as long
        crowded = np.unique(np.concatenate(pairs_within(state.position, _cell(state), reach)[:2]))
    near: dict[tuple[int, int], float] = {}
    for radius, sites_of in wanted if len(crowded) else ():
        for i, j, apart in _close_among(system, state, crowded, radius, [sites_of(m) for m in species]):
            pair = min(i, j), max(i, j)
            near[pair] = min(apart, near.get(pair, inf))
    return [(*pair, near[pair]) for pair in sorted(near)]


def _close_among(
    system: "System", state: State, molecules: np.ndarray, radius: float, chosen: list[np.ndarray]
) -> Iterator[tuple[int, int, float]]:
    """The pairs of `close_pairs` among some molecules, of the sites chosen[k] (indices) of species k."""
    kinds, counts = system.model.species[molecules], system.sites_per_molecule
    owner = np.repeat(molecules, np.array([len(own) for own in chosen])[kinds])
    site = (np.cumsum(counts) - counts)[owner] + gather_per_molecule(chosen, kinds)
    offset = gather_per_molecule([m.positions_body[own] for m, own in zip(system.species, chosen, strict=True)], kinds)
    i, j, distance = pairs_within(system.positions_of(state, owner, offset), _cell(state), radius)
    a, b, free = owner[i], owner[j], mobile(system.model)
    kept = (a != b) & (free[a] | free[b])
    return zip(site[i[kept]].tolist(), site[j[kept]].tolist(), distance[kept].tolist(), strict=True)


def _cell(state: State) -> np.ndarray | None:
    return state.cell if state.volume < inf else None
