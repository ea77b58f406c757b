"""Sites sorted in space into clusters as large as a vector, so that pair loops load neighbours with one instruction.

A slot is a place in that order. Positions are kept relative to the origin of their cluster, where a float32 has digits
enough: 2e-7 Å for sites in each other's reach. Arrays of positions and forces hold x, y, z of a cluster as three
vectors one after the other; slot k of cluster c has its x at `3 * width * c + k`.
"""

from math import ceil, floor, inf
from typing import NamedTuple

import numpy as np

from rigidmd.forces.lanes import bits, lane_count, largest, load, root, store, width_of, zeros
from rigidmd.jit import BLOCKS, PAIR_FLAGS, kernel

SERIAL_SITES = 1000  # up to this many there is one block, and no thread is started


class Clusters(NamedTuple):
    """The sites of one law in clusters. The last cluster is filled up with copies of the last site."""

    bounds: np.ndarray  # (blocks + 1,) block b holds clusters bounds[b] ... bounds[b + 1] - 1
    order: np.ndarray  # (slots,) int32 the site in each slot
    group: np.ndarray  # (slots,) int32 group of the site in each slot
    anchor: np.ndarray  # (slots, 3) what to subtract from positions: origin and image, Å
    origin: np.ndarray  # (4 clusters,) x, y, z, 0 in the box, Å
    local: np.ndarray  # (3 slots,) positions relative to the origins, Å
    square: np.ndarray  # (slots,) squared distances from the origins when last sorted, Å²
    reference: np.ndarray  # (3 slots,) `local` when last sorted
    moved: np.ndarray  # (slots,) how far each has gone since, Å
    farthest: np.ndarray  # (blocks,) the largest of them; infinite where that is too far for a list, Å


def clusters_of(sites: int, dtype: type) -> Clusters:
    """Room for clusters of this many sites with positions of a NumPy dtype."""
    width = lane_count(dtype)
    count = max(1, ceil(sites / width))
    blocks = min(BLOCKS, count) if sites > SERIAL_SITES else 1
    slots = count * width
    return Clusters(
        bounds=np.linspace(0, count, blocks + 1).astype(np.int64),
        order=np.zeros(slots, np.int32),
        group=zeros(slots, np.int32),
        anchor=np.zeros((slots, 3)),
        origin=zeros(4 * count, np.float64),
        local=zeros(3 * slots, dtype),
        square=zeros(slots, dtype),
        reference=zeros(3 * slots, dtype),
        moved=zeros(slots, dtype),
        farthest=np.zeros(blocks),
    )


@kernel
def sort_into_clusters(clusters, cell, position):
    """Sort sites at positions (s, 3) in a box of this cell (3, 3) into clusters; they must then be settled there.

    They are brought into an upright brick with the cell's diagonal for edges, which fills space as well as the cell.

    Columns along z as wide as a cluster, up one and down the next, so that a cluster that begins in one column and ends
    in the next is compact too.
    """
    s = len(position)
    width = width_of(clusters.local)
    low = np.full(3, inf)
    high = np.full(3, -inf)
    for i in range(s):
        wrapped = _in_brick(cell, position, i)
        for k in range(3):
            low[k] = min(low[k], wrapped[k])
            high[k] = max(high[k], wrapped[k])
    extent = high - low
    edge = (extent[0] * extent[1] * extent[2] * width / s) ** (1 / 3)
    nx = max(1, min(s, round(extent[0] / edge))) if edge > 0 else 1
    ny = max(1, min(s // nx, round(extent[1] / edge))) if edge > 0 else 1
    nz = max(1, s // (nx * ny))
    place = np.empty(s, np.int64)
    height = np.empty(s)
    start = np.zeros(nx * ny * nz + 1, np.int64)
    for i in range(s):
        wrapped = _in_brick(cell, position, i)
        x = _bin(wrapped[0] - low[0], extent[0], nx)
        y = _bin(wrapped[1] - low[1], extent[1], ny)
        z = _bin(wrapped[2] - low[2], extent[2], nz)
        column = x * ny + (y if x % 2 == 0 else ny - 1 - y)
        up = column % 2 == 0
        height[i] = wrapped[2] if up else -wrapped[2]
        place[i] = column * nz + (z if up else nz - 1 - z)
        start[place[i] + 1] += 1
    for p in range(1, len(start)):
        start[p] += start[p - 1]
    order = clusters.order
    for i in range(s):
        order[start[place[i]]] = i
        start[place[i]] += 1
    # now start[p] is where place p ends; sites of a place are in the order of their indices and few
    for a in range(1, s):
        i = order[a]
        b = a
        while b > 0 and place[order[b - 1]] == place[i] and height[order[b - 1]] > height[i]:
            order[b] = order[b - 1]
            b -= 1
        order[b] = i
    order[s:] = order[s - 1]


@kernel(inline=True)
def _in_brick(cell, position, i):
    """Where site i is once it has been brought into the brick, (x, y, z) in Å."""
    x, y, z = position[i, 0], position[i, 1], position[i, 2]
    boxes = floor(z / cell[2, 2]) if cell[2, 2] < inf else 0.0
    if boxes != 0.0:
        x, y, z = x - boxes * cell[2, 0], y - boxes * cell[2, 1], z - boxes * cell[2, 2]
    boxes = floor(y / cell[1, 1]) if cell[1, 1] < inf else 0.0
    if boxes != 0.0:
        x, y = x - boxes * cell[1, 0], y - boxes * cell[1, 1]
    boxes = floor(x / cell[0, 0]) if cell[0, 0] < inf else 0.0
    if boxes != 0.0:
        x -= boxes * cell[0, 0]
    return x, y, z


@kernel(inline=True)
def _bin(x, extent, count):
    return min(count - 1, int(x / extent * count)) if extent > 0 else 0


@kernel(counted=False)
def settle_block(clusters, cell, position, group, block):
    """Origins, anchors and places of newly sorted clusters; their origin is the middle of their box."""
    width = width_of(clusters.local)
    clusters.farthest[block] = 0.0
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        for slot in range(width * c, width * (c + 1)):
            wrapped = _in_brick(cell, position, clusters.order[slot])
            for k in range(3):
                clusters.anchor[slot, k] = wrapped[k]  # for now
        _pair_up(clusters, width * c, min(width * (c + 1), len(position)))
        for k in range(3):
            low, high = inf, -inf
            for slot in range(width * c, width * (c + 1)):
                x = clusters.anchor[slot, k]
                low = min(low, x)
                high = max(high, x)
            clusters.origin[4 * c + k] = 0.5 * (low + high)
        for slot in range(width * c, width * (c + 1)):
            i = clusters.order[slot]
            clusters.group[slot] = group[i]
            clusters.moved[slot] = 0.0
            clusters.square[slot] = 0.0
            for k in range(3):
                at = slot + 2 * width * c + k * width
                clusters.anchor[slot, k] = position[i, k] - (clusters.anchor[slot, k] - clusters.origin[4 * c + k])
                clusters.local[at] = position[i, k] - clusters.anchor[slot, k]
                clusters.reference[at] = clusters.local[at]
                clusters.square[slot] += clusters.local[at] ** 2


@kernel(inline=True)
def _pair_up(clusters, first, end):
    """Change the order of slots first ... end - 1 so that the two sites of each row are near one another.

    Their places in the brick stand in `anchor`, and follow them.
    """
    order, place = clusters.order, clusters.anchor
    for a in range(first, end - 2, 2):
        nearest, nearest2 = a + 1, inf
        for b in range(a + 1, end):
            d2 = 0.0
            for k in range(3):
                d2 += (place[a, k] - place[b, k]) ** 2
            if d2 < nearest2:
                nearest, nearest2 = b, d2
        order[a + 1], order[nearest] = order[nearest], order[a + 1]
        for k in range(3):
            place[a + 1, k], place[nearest, k] = place[nearest, k], place[a + 1, k]


@kernel(fastmath=PAIR_FLAGS, inline=True, counted=False)
def follow_block(clusters, position, limit, block):
    """Bring `local` of a block to the positions (s, 3), and `moved` and `farthest`, for which the limit holds."""
    width = width_of(clusters.local)
    local, reference = clusters.local, clusters.reference
    full = (1 << width) - 1
    worst = 0.0
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        at = 3 * width * c
        for k in range(width):
            slot = width * c + k
            i = clusters.order[slot]
            local[at + k] = position[i, 0] - clusters.anchor[slot, 0]
            local[at + width + k] = position[i, 1] - clusters.anchor[slot, 1]
            local[at + 2 * width + k] = position[i, 2] - clusters.anchor[slot, 2]
        dx = load(local, at) - load(reference, at)
        dy = load(local, at + width) - load(reference, at + width)
        dz = load(local, at + 2 * width) - load(reference, at + 2 * width)
        moved = root(dx * dx + dy * dy + dz * dz)
        store(clusters.moved, width * c, moved)
        worst = max(worst, largest(moved)) if bits(moved <= limit) == full else inf
    clusters.farthest[block] = worst
