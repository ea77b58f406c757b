"""Overlaps: sites of different molecules that are too close."""

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.assemble.cells import pairs_within
from rigidmd.assemble.momenta import mobile
from rigidmd.core.state import State

if TYPE_CHECKING:
    from rigidmd.assemble.system import System

#: Lennard-Jones sites of different molecules closer than this fraction of their diameter overlap: the repulsion there
#: is 1750 epsilon, which does not occur in liquids.
OVERLAP = 0.6
#: Sites of different molecules closer than this fraction of the smallest molecular radius overlap too.
INSIDE = 0.2


def overlaps(system: "System") -> list[str]:
    """Faults: overlapping molecules, at most five of them named."""
    inside = INSIDE * min([m.radius for m in system.species if m.radius > 0], default=0.0)
    sigma = system.of_sites(lambda m: np.where(m.epsilon > 0, m.sigma, 0.0))
    faults = []
    for i, j, distance in close_pairs(system, system.state, max(OVERLAP * sigma.max(), inside)):
        a, b = system.sites.molecule[[i, j]]
        both = sigma[i] > 0 and sigma[j] > 0
        if distance <= max(inside, OVERLAP * (sigma[i] + sigma[j]) / 2 if both else 0.0):
            faults.append(
                f"molecules {a + 1} and {b + 1} overlap: {system.sites.name[i]} and {system.sites.name[j]} "
                f"are {distance:.3f} Å apart"
            )
    return faults[:5] + ([f"and {len(faults) - 5} more"] if len(faults) > 5 else [])


def close_pairs(system: "System", state: State, radius: float) -> list[tuple[int, int, float]]:
    """Sites (i, j) of different molecules, not both frozen, within `radius` of each other, and their distances, Å."""
    cell = state.cell if state.volume < inf else None
    i, j, distance = pairs_within(system.site_positions(state), cell, radius)
    a, b, free = system.sites.molecule[i], system.sites.molecule[j], mobile(system.model)
    kept = (a != b) & (free[a] | free[b])
    near = {}
    for one, other, apart in zip(i[kept].tolist(), j[kept].tolist(), distance[kept].tolist(), strict=True):
        pair = min(one, other), max(one, other)
        near[pair] = min(apart, near.get(pair, inf))
    return [(*pair, near[pair]) for pair in sorted(near)]
