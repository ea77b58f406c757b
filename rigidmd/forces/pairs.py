"""Forces between pairs of sites: the one loop for every such law.

A law says only what two sites at a distance do: an `@implements(pair)` for its NamedTuple. This loop finds the pairs,
takes the nearest image, sums energies, virial and forces, and hands the forces to the bodies.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from rigidmd.forces import terms
from rigidmd.forces.neighbors import PairList, empty_list, enlarged, update_list
from rigidmd.forces.sites import BodySites, CentralSites, load_from_sites, place_sites, virial_of_offsets
from rigidmd.forces.space import Space, nearest_image
from rigidmd.forces.terms import OK, TALLY_SIZE
from rigidmd.jit import PAIR_FLAGS, implements, is_a, kernel


class PairForces(NamedTuple):
    """A pair law, the sites that take part in it, and the work arrays to evaluate it."""

    law: NamedTuple
    space: Space
    sites: BodySites | CentralSites
    pairs: PairList
    position: np.ndarray  # (s, 3) lab frame
    force: np.ndarray  # (blocks, s, 3) lab frame; blocks are summed in order
    tallies: np.ndarray  # (blocks, 10)


def pair_forces(
    law: NamedTuple, space: Space, sites: BodySites | CentralSites, skin: float, group: np.ndarray | None = None
) -> PairForces:
    """The term for a law with a `cutoff`; its neighbour list is built at the first use.

    group (s,) : sites of one group do not act on one another; the sites' molecules when not given
    """
    s = len(sites.molecule)
    pairs = empty_list(space, sites.molecule if group is None else group, law.cutoff, skin)
    blocks = len(pairs.needed)
    return PairForces(
        law, space, sites, pairs, np.zeros((s, 3)), np.zeros((blocks, s, 3)), np.zeros((blocks, TALLY_SIZE))
    )


def with_room(term: NamedTuple) -> NamedTuple:
    """The term with as much room in its neighbour list as the last build asked for; other terms as they are."""
    if isinstance(term, PairForces) and term.pairs.needed.max(initial=0) > term.pairs.partner.shape[1]:
        return term._replace(pairs=enlarged(term.pairs))
    return term


def forget_list(term: NamedTuple) -> None:
    """Have the term's neighbour list built anew at its next use, in place."""
    if isinstance(term, PairForces):
        term.pairs.counters[0] = 0


def pair(law, i, j, r2):
    """(energy, force/r) of sites i and j of a law at squared distance r2 below cutoff²; force > 0 repels."""
    raise TypeError(f"{type(law).__name__} is no pair law, or this was called outside compiled code")


@implements(terms.add_forces)
def _add_pair_forces(term, state, load, tally):
    if not is_a(term, PairForces):
        return None

    def add_pair_forces(term, state, load, tally):
        place_sites(term.sites, state, term.position)
        status = update_list(term.pairs, term.space, term.position)
        if status != OK:
            return status
        if tally is None:
            site_forces(term.law, term.space, term.pairs, term.position, term.force, None)
        else:
            site_forces(term.law, term.space, term.pairs, term.position, term.force, term.tallies)
            for block in range(len(term.tallies)):
                for k in range(len(tally)):
                    tally[k] += term.tallies[block, k]
            virial_of_offsets(term.sites, state, term.position, term.force, tally)
        load_from_sites(term.sites, state, load, term.force)
        return OK

    return add_pair_forces


@kernel
def site_forces(law, space, pairs, position, force, tallies):
    """Forces on sites into force (blocks, s, 3); energy and site virial of each block into tallies unless None."""
    if len(force) == 1:
        _block_forces(law, space, pairs, position, force, tallies, 0)
    else:
        _site_forces_threaded(law, space, pairs, position, force, tallies)


@kernel(parallel=True)
def _site_forces_threaded(law, space, pairs, position, force, tallies):
    for block in prange(len(force)):
        _block_forces(law, space, pairs, position, force, tallies, block)


@kernel(fastmath=PAIR_FLAGS)
def _block_forces(law, space, pairs, position, force, tallies, block):
    partner = pairs.partner[block]
    f = force[block]
    f[:] = 0.0
    cutoff2 = law.cutoff * law.cutoff
    energy = xx = xy = xz = yy = yz = zz = 0.0
    for i in range(pairs.bounds[block], pairs.bounds[block + 1]):
        x = position[i, 0]
        y = position[i, 1]
        z = position[i, 2]
        fx = fy = fz = 0.0
        for slot in range(pairs.start[i], pairs.stop[i]):
            j = partner[slot]
            dx, dy, dz = nearest_image(space, x - position[j, 0], y - position[j, 1], z - position[j, 2])
            r2 = dx * dx + dy * dy + dz * dz
            if r2 < cutoff2:
                u, w = pair(law, i, j, r2)
                gx = w * dx
                gy = w * dy
                gz = w * dz
                fx += gx
                fy += gy
                fz += gz
                f[j, 0] -= gx
                f[j, 1] -= gy
                f[j, 2] -= gz
                if tallies is not None:
                    energy += u
                    xx += gx * dx
                    xy += gx * dy
                    xz += gx * dz
                    yy += gy * dy
                    yz += gy * dz
                    zz += gz * dz
        f[i, 0] += fx
        f[i, 1] += fy
        f[i, 2] += fz
    if tallies is not None:
        for k, value in enumerate((energy, xx, xy, xz, xy, yy, yz, xz, yz, zz)):
            tallies[block, k] = value
