"""Neighbour lists: the pairs of sites of one law that may lie inside its cut-off.

Built from cells in O(N), with a skin; used until any site has moved more than half the skin since, whether its body
shifted or turned. That is checked at every force evaluation, before the list is used, so no pair is ever missed.

The list is cut into a fixed number of blocks of sites. Each block has its own room, filled by whichever thread takes
it, so the list and everything summed from it has the same bits for any number of threads. Each pair stands once: (i, j)
in the row of the smaller index if i + j is odd, else of the larger, which makes all rows about equally long.
"""

from math import ceil, floor, inf
from typing import NamedTuple

import numpy as np
from numba import prange

from rigidmd.forces.space import Space, nearest_image, wrap_index
from rigidmd.forces.terms import LIST_FULL, NOT_FINITE, OK
from rigidmd.jit import kernel

BLOCKS = 16  # enough for 16 threads; every block adds one array of site forces
SITES_PER_BLOCK = 32  # small systems get fewer blocks, the smallest one, and then no thread is started

LOST = 1e12  # list radii from the origin: there a float64 has no digits left for where in its cell a site is


class PairList(NamedTuple):
    """Pairs of sites of different groups closer than `radius` when the list was built."""

    radius: float  # cut-off + skin, Å
    skin: float  # Å
    group: np.ndarray  # (s,) molecule, one number for all that is frozen; pairs inside a group are left out
    bounds: np.ndarray  # (blocks + 1,) block b holds rows of sites bounds[b] ... bounds[b + 1] - 1
    start: np.ndarray  # (s,) row of site i: partner[b, start[i]:stop[i]]
    stop: np.ndarray  # (s,)
    partner: np.ndarray  # (blocks, capacity) int32
    needed: np.ndarray  # (blocks,) room the last build asked for
    reference: np.ndarray  # (s, 3) site positions of the last build
    counters: np.ndarray  # (2,) usable (0 or 1); builds so far


def empty_list(space: Space, group: np.ndarray, cutoff: float, skin: float) -> PairList:
    """A list that will be built at its first use, with room for about what a uniform density needs."""
    s = len(group)
    blocks = max(1, min(BLOCKS, s // SITES_PER_BLOCK))
    bounds = np.linspace(0, s, blocks + 1).astype(np.int64)
    radius = cutoff + skin if cutoff < inf else inf
    partners = s if space.volume == inf else min(s, s / space.volume * 4 / 3 * np.pi * radius**3)
    capacity = int(1.2 * np.diff(bounds).max() * 0.5 * partners) + 16
    return PairList(
        radius=radius,
        skin=skin,
        group=group,
        bounds=bounds,
        start=np.zeros(s, np.int64),
        stop=np.zeros(s, np.int64),
        partner=np.empty((blocks, capacity), np.int32),
        needed=np.zeros(blocks, np.int64),
        reference=np.zeros((s, 3)),
        counters=np.zeros(2, np.int64),
    )


def enlarged(pairs: PairList) -> PairList:
    """The same list with the room its last build asked for, and a tenth more."""
    return pairs._replace(partner=np.empty((len(pairs.partner), int(1.1 * pairs.needed.max()) + 16), np.int32))


@kernel
def is_usable(pairs, position):
    """Whether no site has moved more than half the skin since the last build; False too if one is not a number."""
    if pairs.counters[0] == 0:
        return False
    limit = (0.5 * pairs.skin) ** 2
    for i in range(len(position)):
        d2 = 0.0
        for k in range(3):
            d2 += (position[i, k] - pairs.reference[i, k]) ** 2
        if not d2 <= limit:
            return False
    return True


@kernel
def update_list(pairs, space, position):
    """Build the list anew if it is no longer good for these site positions (s, 3). A status code."""
    if is_usable(pairs, position):
        return OK
    pairs.counters[0] = 0
    for x in position.flat:
        if not abs(x) < LOST * pairs.radius:
            return NOT_FINITE
    origin, size, shape, reach = _grid(space, position, pairs.radius)
    cell, cell_start, order = _sort_into_cells(space, position, origin, size, shape)
    _fill(pairs, space, position, cell, cell_start, order, shape, reach)
    if pairs.needed.max() > pairs.partner.shape[1]:
        return LIST_FULL
    pairs.reference[:] = position
    pairs.counters[0] = 1
    pairs.counters[1] += 1
    return OK


@kernel
def _grid(space, position, radius):
    """Cells about half the list radius wide, no more than about eight for each site: origin, size, shape, reach."""
    origin = np.zeros(3)
    size = np.zeros(3)
    shape = np.ones(3, np.int64)
    reach = np.zeros(3, np.int64)
    most = 2 * ceil(len(position) ** (1 / 3))
    lengths = (space.x, space.y, space.z)
    for k in range(3):
        length = lengths[k]
        if length == inf:
            origin[k] = position[:, k].min()
            length = position[:, k].max() - origin[k]
        shape[k] = max(1, int(min(float(most), floor(2 * length / radius))))
        size[k] = length / shape[k]
        reach[k] = shape[k] if radius == inf or size[k] == 0 else int(min(float(shape[k]), ceil(radius / size[k])))
    return origin, size, shape, reach


@kernel
def _sort_into_cells(space, position, origin, size, shape):
    """Counting sort: cell (s, 3) of each site; the sites of cell c are order[cell_start[c]:cell_start[c + 1]]."""
    cell = np.empty((len(position), 3), np.int64)
    flat = np.empty(len(position), np.int64)
    cell_start = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    lengths = (space.x, space.y, space.z)
    for i in range(len(position)):
        for k in range(3):
            x = position[i, k] - origin[k]
            if lengths[k] < inf:
                x -= lengths[k] * floor(x / lengths[k])
            cell[i, k] = min(shape[k] - 1, int(x / size[k])) if size[k] > 0 else 0
        flat[i] = (cell[i, 0] * shape[1] + cell[i, 1]) * shape[2] + cell[i, 2]
        cell_start[flat[i] + 1] += 1
    cell_start[:] = np.cumsum(cell_start)
    filled = cell_start[:-1].copy()
    order = np.empty(len(position), np.int64)
    for i in range(len(position)):
        order[filled[flat[i]]] = i
        filled[flat[i]] += 1
    return cell, cell_start, order


@kernel(parallel=True)
def _fill(pairs, space, position, cell, cell_start, order, shape, reach):
    for block in prange(len(pairs.needed)):
        _fill_block(pairs, space, position, cell, cell_start, order, shape, reach, block)


@kernel
def _fill_block(pairs, space, position, cell, cell_start, order, shape, reach, block):
    """Rows of one block. Pairs beyond the room are counted, not stored."""
    partner = pairs.partner[block]
    radius2 = pairs.radius**2
    count = 0
    low = np.empty(3, np.int64)
    high = np.empty(3, np.int64)
    for i in range(pairs.bounds[block], pairs.bounds[block + 1]):
        pairs.start[i] = min(count, len(partner))
        for k in range(3):
            # With few cells the neighbourhood would meet itself round the box: visit each cell once.
            every = 2 * reach[k] + 1 >= shape[k]
            low[k] = 0 if every else cell[i, k] - reach[k]
            high[k] = shape[k] - 1 if every else cell[i, k] + reach[k]
        for cx in range(low[0], high[0] + 1):
            x = wrap_index(space, cx, shape[0])
            for cy in range(low[1], high[1] + 1):
                y = wrap_index(space, cy, shape[1])
                for cz in range(low[2], high[2] + 1):
                    z = wrap_index(space, cz, shape[2])
                    if x < 0 or y < 0 or z < 0:
                        continue
                    c = (x * shape[1] + y) * shape[2] + z
                    for slot in range(cell_start[c], cell_start[c + 1]):
                        j = order[slot]
                        if (j > i) != ((i + j) % 2 == 1) or pairs.group[i] == pairs.group[j]:
                            continue
                        dx, dy, dz = nearest_image(
                            space,
                            position[i, 0] - position[j, 0],
                            position[i, 1] - position[j, 1],
                            position[i, 2] - position[j, 2],
                        )
                        if dx * dx + dy * dy + dz * dz <= radius2:
                            if count < len(partner):
                                partner[count] = j
                            count += 1
        pairs.stop[i] = min(count, len(partner))
    pairs.needed[block] = count
