"""Sites sorted in space into clusters as large as a vector, so that pair loops load neighbours with
one instruction.

A slot is a position in that order. Coordinates are stored relative to the origin of their cluster,
so that float32 is accurate enough: 2e-7 Å for sites within reach of one another. Arrays of
positions and forces hold x, y, z of a cluster as three consecutive vectors. Slot k of cluster c has
its x at `3 * width * c + k`. Tasks have the arguments (pairs, sites, state) with a
`lists.PairList`, or `pairs` alone.
"""

from math import ceil, floor, inf, nan
from typing import NamedTuple

import numpy as np

from rigidmd.compile import BLOCKS, MOST_BLOCKS, kernel, load_arguments, task
from rigidmd.compile.simd import (
    lane_count,
    lanes_of,
    largest_lane,
    load,
    load_scalar,
    mask_bits,
    square_root,
    store,
    zeros,
)
from rigidmd.forces.neighbors.sites import index_of_x, locate_site, predict_site

BUILT, LEAD_TIME = 0, 1  # columns of PairList.times
MAX_SERIAL_SITES = 128  # in one block
#: in list radii from the origin, which are no longer than a box: 32 bits can count the boxes
MAX_DISTANCE = 1e9


class Clusters(NamedTuple):
    """The sites of one potential in clusters. The last cluster is padded with copies of the last
    site."""

    bounds: np.ndarray  # (blocks + 1,) block b has clusters bounds[b] ... bounds[b + 1] - 1
    slot: np.ndarray  # (s,) int32 the slot of each site
    boxes: np.ndarray  # (s, 3) int32 number of edges by which a site is shifted into the brick
    origin: np.ndarray  # (4 clusters,) x, y, z, 0 of each cluster, in the box, Å
    # (3 slots,) positions relative to the origins, Å; scratch while sites are sorted
    local: np.ndarray
    # (3 slots,) memory of the next three, which are used only while a list is built
    scratch: np.ndarray
    order: np.ndarray  # (slots,) int32 the site in each slot
    group: np.ndarray  # (slots,) int32 group of the site in each slot
    half_square: np.ndarray  # (slots,) half the squares of `reference` as vectors, Å²
    reference: np.ndarray  # (3 slots,) the positions for which the sites were sorted, as `local`
    moved: np.ndarray  # (slots,) distance of each site from there, Å
    # (blocks,) the largest displacement, Å; infinite if it is too large for a list
    largest_displacement: np.ndarray
    # (blocks, 6) lowest, highest x, y, z in the brick of the sites of a block of molecules, Å
    extent: np.ndarray


def clusters_of(sites: int, dtype: type) -> Clusters:
    """Arrays for the clusters of `sites` sites, with positions of a NumPy dtype."""
    width = lane_count(dtype)
    count = max(1, ceil(sites / width))
    # Each block has sums for the clusters that its rows reach, a layer of the box about as thick as
    # the cutoff. The number of blocks grows like the edge of the box, so that the memory for the
    # sums is proportional to the sites.
    blocks = (
        min(max(BLOCKS, min(MOST_BLOCKS, int(0.2 * np.cbrt(sites)))), count)
        if sites > MAX_SERIAL_SITES
        else 1
    )
    slots = count * width
    scratch = zeros(3 * slots, dtype)
    half_square, order, group = scratch.reshape(3, slots)
    return Clusters(
        bounds=np.linspace(0, count, blocks + 1).astype(np.int64),
        slot=np.zeros(sites, np.int32),
        boxes=np.zeros((sites, 3), np.int32),
        origin=zeros(4 * count, np.float64),
        local=zeros(3 * slots, dtype),
        scratch=scratch,
        order=order.view(np.int32)[:slots],
        group=group.view(np.int32)[:slots],
        half_square=half_square,
        reference=zeros(3 * slots, dtype),
        moved=zeros(slots, dtype),
        extent=np.zeros((blocks, 6)),
        largest_displacement=np.zeros(blocks),
    )


def order_of(clusters: Clusters) -> np.ndarray:
    """`Clusters.order` after the build, when its memory is used for something else."""
    order = np.empty_like(clusters.order)
    order[clusters.slot] = np.arange(len(clusters.slot))
    order[len(clusters.slot) :] = order[len(clusters.slot) - 1]
    return order


@kernel(inline=True)
def _molecules_of_block(sites, blocks, block):
    """The first molecule of a block, and the first after it."""
    n = len(sites.first) - 1
    return n * block // blocks, n * (block + 1) // blocks


@task(count_references=False)
def wrap_sites(arguments, block):
    """Write positions in the brick of the sites of a block of molecules into `local`, for
    `bin_sites`.

    The brick is an orthorhombic box whose edges are the diagonal of the cell (3, 3). It tiles space
    like the cell. The positions are predicted for the lead time of the list, see `predict_site`.
    `extent` gets their extent, or NaN if a coordinate is farther from the origin than MAX_DISTANCE,
    or is not finite.
    """
    pairs, sites, state = load_arguments(arguments)
    clusters = pairs.clusters
    cell = pairs.cell
    lead = pairs.times[LEAD_TIME]
    max_distance = MAX_DISTANCE * (pairs.cutoff + pairs.skin)
    extent = clusters.extent[block]
    local = clusters.local
    for k in range(3):
        extent[k], extent[3 + k] = inf, -inf
    first, end = _molecules_of_block(sites, len(clusters.extent), block)
    for m in range(first, end):
        for i in range(sites.first[m], sites.first[m + 1]):
            at = _ahead(sites, state, m, i, lead)
            if not abs(at[0]) + abs(at[1]) + abs(at[2]) < max_distance:
                extent[0] = nan
                return
            _count_boxes(clusters.boxes, cell, i, at)
            at = _in_brick(clusters.boxes, cell, i, at)
            for k in range(3):
                local[3 * i + k] = at[k]
                extent[k] = min(extent[k], local[3 * i + k])
                extent[3 + k] = max(extent[3 + k], local[3 * i + k])


@task(count_references=False)
def bin_sites(arguments, block):
    """Write the bins for the sites of a block of molecules, and heights within bins, into `slot`
    and `moved`. Bins form columns along z, as wide as a cluster. They run up one column and down
    the next, so that a cluster that starts in one column and ends in the next is compact too."""
    pairs, sites, _ = load_arguments(arguments)
    clusters = pairs.clusters
    low, extent, (nx, ny, nz) = _bins(clusters)
    local = clusters.local
    first, end = _molecules_of_block(sites, len(clusters.extent), block)
    for i in range(sites.first[first], sites.first[end]):
        height = local[3 * i + 2]
        x = _bin(local[3 * i] - low[0], extent[0], nx)
        y = _bin(local[3 * i + 1] - low[1], extent[1], ny)
        z = _bin(height - low[2], extent[2], nz)
        column = x * ny + (y if x % 2 == 0 else ny - 1 - y)
        up = column % 2 == 0
        clusters.moved[i] = height if up else -height
        clusters.slot[i] = column * nz + (z if up else nz - 1 - z)


@kernel
def sort_into_clusters(clusters):
    """Sort sites by bin and height. `set_origins` must follow. False if the extent is not
    finite."""
    s = len(clusters.slot)
    _, extent, (nx, ny, nz) = _bins(clusters)
    if not extent[0] >= 0:
        clusters.slot[:] = 0  # no numbers of bins: `set_local` may follow before the next build
        return False
    order, bin_of, height = clusters.order, clusters.slot, clusters.moved
    start = np.zeros(nx * ny * nz + 1, np.int64)
    for i in range(s):
        start[bin_of[i] + 1] += 1
    for p in range(1, len(start)):
        start[p] += start[p - 1]
    for i in range(s):
        order[start[bin_of[i]]] = i
        start[bin_of[i]] += 1
    # now start[p] is the end of bin p; a bin has few sites, in the order of their indices
    for a in range(1, s):
        i = order[a]
        b = a
        while b > 0 and bin_of[order[b - 1]] == bin_of[i] and height[order[b - 1]] > height[i]:
            order[b] = order[b - 1]
            b -= 1
        order[b] = i
    for a in range(s, len(order)):
        order[a] = order[s - 1]
    return True


@kernel(inline=True)
def _bins(clusters):
    """Lowest corner of all sites in the brick, their extents, and the number of bins along each
    axis. The first extent is NaN if there is none."""
    low, high = (inf, inf, inf), (-inf, -inf, -inf)
    lost = False
    for block in range(len(clusters.extent)):
        of = clusters.extent[block]
        low = (min(low[0], of[0]), min(low[1], of[1]), min(low[2], of[2]))
        high = (max(high[0], of[3]), max(high[1], of[4]), max(high[2], of[5]))
        lost |= of[0] != of[0]
    x, y, z = nan if lost else high[0] - low[0], high[1] - low[1], high[2] - low[2]
    s = len(clusters.slot)
    edge = (x * y * z * lanes_of(clusters.local) / s) ** (1 / 3)
    nx = max(1, min(s, round(x / edge))) if edge > 0 else 1
    ny = max(1, min(s // nx, round(y / edge))) if edge > 0 else 1
    return low, (x, y, z), (nx, ny, max(1, s // (nx * ny)))


@kernel(inline=True)
def _count_boxes(boxes, cell, i, at):
    """Write the number of edges by which a site at (x, y, z) is shifted into the brick."""
    x, y, z = at
    c = floor(z / cell[2, 2]) if cell[2, 2] < inf else 0.0
    if c != 0.0:
        x, y = x - c * cell[2, 0], y - c * cell[2, 1]
    b = floor(y / cell[1, 1]) if cell[1, 1] < inf else 0.0
    if b != 0.0:
        x -= b * cell[1, 0]
    a = floor(x / cell[0, 0]) if cell[0, 0] < inf else 0.0
    boxes[i, 0], boxes[i, 1], boxes[i, 2] = a, b, c


@kernel(inline=True)
def _in_brick(boxes, cell, i, at):
    """Position of site i, at (x, y, z), with the shift into the brick of when sites were sorted,
    Å."""
    x, y, z = at
    back = boxes[np.uint64(i)]
    a, b, c = back[0], back[1], back[2]
    if c != 0:
        x, y, z = x - c * cell[2, 0], y - c * cell[2, 1], z - c * cell[2, 2]
    if b != 0:
        x, y = x - b * cell[1, 0], y - b * cell[1, 1]
    if a != 0:
        x -= a * cell[0, 0]
    return x, y, z


@kernel(inline=True)
def _bin(x, extent, count):
    return min(count - 1, int(x / extent * count)) if extent > 0 else 0


@task(count_references=False)
def set_origins(arguments, block):
    """Set origins and references of newly sorted clusters. The origin is the centre of the bounding
    box."""
    pairs, sites, state = load_arguments(arguments)
    clusters = pairs.clusters
    cell = pairs.cell
    lead = pairs.times[LEAD_TIME]
    width = lanes_of(clusters.local)
    order, origin, reference = clusters.order, clusters.origin, clusters.reference
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        base = _ahead_in_brick(clusters, cell, sites, state, order[width * c], lead)
        # relative to the first site, so that float32 is accurate
        low, high = (
            (0.0, 0.0, 0.0),
            (0.0, 0.0, 0.0),
        )
        for slot in range(width * c, width * (c + 1)):
            at = _ahead_in_brick(clusters, cell, sites, state, order[slot], lead)
            x, y, z = at[0] - base[0], at[1] - base[1], at[2] - base[2]
            low = (min(low[0], x), min(low[1], y), min(low[2], z))
            high = (max(high[0], x), max(high[1], y), max(high[2], z))
            n = slot + 2 * width * c
            reference[n], reference[n + width], reference[n + 2 * width] = x, y, z
        _pair_up(order, reference, width, width * c, min(width * (c + 1), len(clusters.slot)))
        for k in range(3):
            origin[4 * c + k] = base[k] + 0.5 * (low[k] + high[k])
        for slot in range(width * c, width * (c + 1)):
            i = order[slot]
            if slot < len(clusters.slot):
                clusters.slot[i] = slot
            clusters.group[slot] = pairs.group[i]
            clusters.half_square[slot] = 0.0
            for k in range(3):
                n = slot + 2 * width * c + k * width
                reference[n] -= 0.5 * (low[k] + high[k])
                clusters.half_square[slot] += 0.5 * reference[n] ** 2


@kernel(inline=True)
def _ahead_in_brick(clusters, cell, sites, state, i, lead):
    """The position of site i for which sites are sorted, in the brick, Å."""
    return _in_brick(clusters.boxes, cell, i, _ahead(sites, state, sites.molecule[i], i, lead))


@kernel(inline=True)
def _ahead(sites, state, m, i, lead):
    """`predict_site`. For lead = 0 the current position, which does not need finite velocities."""
    return (
        predict_site(sites, state, m, i, lead) if lead != 0.0 else locate_site(sites, state, m, i)
    )


@kernel(inline=True)
def _pair_up(order, at, width, first, end):
    """Reorder slots first ... end - 1 of a cluster so that the two sites of each row are near one
    another. `at` has their positions and is reordered with them."""
    vectors = 2 * (first // width) * width
    for a in range(first, end - 2, 2):
        nearest = a + 1
        nearest2 = inf
        for b in range(a + 1, end):
            d2 = 0.0
            for n in range(vectors, vectors + 3 * width, width):
                d2 += (at[n + a] - at[n + b]) ** 2
            if d2 < nearest2:
                nearest, nearest2 = b, d2
        order[a + 1], order[nearest] = order[nearest], order[a + 1]
        for n in range(vectors, vectors + 3 * width, width):
            at[n + a + 1], at[n + nearest] = at[n + nearest], at[n + a + 1]


@kernel(count_references=False)
def restore_half_squares(clusters):
    """Set `half_square` as `set_origins` does, from the references."""
    width = lanes_of(clusters.local)
    for slot in range(len(clusters.order)):
        clusters.half_square[slot] = 0.0
        for n in range(
            3 * width * (slot // width) + slot % width, 3 * width * (slot // width + 1), width
        ):
            clusters.half_square[slot] += 0.5 * clusters.reference[n] ** 2


@task(count_references=False)
def set_local(arguments, block):
    """Set `local` for the sites in a block of molecules to the current positions. Padding stays at
    its reference."""
    pairs, sites, state = load_arguments(arguments)
    clusters, cell = pairs.clusters, pairs.cell
    width = lanes_of(clusters.local)
    local, origin = clusters.local, clusters.origin
    first, end = _molecules_of_block(sites, len(clusters.extent), block)
    for m in range(first, end):
        for i in range(sites.first[m], sites.first[m + 1]):
            x, y, z = _in_brick(clusters.boxes, cell, i, locate_site(sites, state, m, i))
            slot = load_scalar(clusters.slot, i)
            at = index_of_x(slot, width)
            c = 4 * (np.uint32(slot) // np.uint32(width))
            local[np.uint64(at)] = x - load_scalar(origin, c)
            local[np.uint64(at + width)] = y - load_scalar(origin, c + 1)
            local[np.uint64(at + 2 * width)] = z - load_scalar(origin, c + 2)
    if block == len(clusters.extent) - 1:
        for slot in range(len(clusters.slot), len(clusters.order)):
            at = index_of_x(slot, width)
            for n in range(at, at + 3 * width, width):
                local[n] = clusters.reference[n]


@task(count_references=False)
def measure_displacements(arguments, block):
    """Set `moved`, and `largest_displacement` of a block, infinite if a displacement exceeds half
    the skin."""
    pairs = load_arguments(arguments)
    clusters = pairs.clusters
    limit = 0.5 * (pairs.skin - pairs.slack[0])
    width = lanes_of(clusters.local)
    local, reference = clusters.local, clusters.reference
    full = (1 << width) - 1
    worst = 0.0
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        at = 3 * width * c
        dx = load(local, at) - load(reference, at)
        dy = load(local, at + width) - load(reference, at + width)
        dz = load(local, at + 2 * width) - load(reference, at + 2 * width)
        moved = square_root(dx * dx + dy * dy + dz * dz)
        store(clusters.moved, width * c, moved)
        worst = max(worst, largest_lane(moved)) if mask_bits(moved <= limit) == full else inf
    clusters.largest_displacement[block] = worst
