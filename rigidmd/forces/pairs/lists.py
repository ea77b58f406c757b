"""Neighbour lists: for each row of sites of one law the clusters that may hold a site inside their cut-off.

A row is two sites that are near one another, so that what is loaded of a cluster serves both of them.

A list is good until any site has moved more than half the skin since it was built, whether its body shifted or turned.
That is checked at every force evaluation, before the list is used, so no pair is ever missed. In each row the clusters
stand in shells by their distance, and what sites have moved so far says how many shells can matter: a new list is
worked through as if it had no skin.

Each pair of clusters stands in one of its two rows: that of the one behind, clusters being thought of as a ring. The
list is cut into blocks of rows, filled by whichever thread takes them, so the list and everything summed from it has
the same bits for any number of threads.
"""

from math import ceil, floor, inf, pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import PAIR_FLAGS, Code, call, call_blocks, kernel, opened, packed, task
from rigidmd.compile.lanes import (
    bits,
    fill,
    larger,
    load,
    load_beside,
    root,
    smaller,
    smaller_of_two,
    spread,
    store,
    width_of,
    zeros,
)  # fmt: skip
from rigidmd.core.state import CELL_CHANGED, EXAMPLE, LIST_FULL, NOT_FINITE, OK
from rigidmd.errors import SimulationError
from rigidmd.forces.pairs.clusters import (
    Clusters,
    bin_block,
    clusters_of,
    follow_block,
    place_block,
    settle_block,
    sort_into_clusters,
    wrap_block,
)
from rigidmd.forces.pairs.sites import BodySites, CentralSites
from rigidmd.forces.pairs.space import follow_cell
from rigidmd.forces.pairs.tree import BoxTree, box_tree, grow, within_reach

IMAGE_BITS = 6
IMAGES = 1 << IMAGE_BITS  # room for those of a box that can be within reach
MASK_BITS = 16  # of one site; no vector has more lanes
SHELLS = 15  # the first holds what is inside the cut-off when the list is built, the others parts of the skin
MOST_BEYOND = 2**16 - 1
LONGEST_SKIN = 0.45  # of the smallest edge
LOST = 1e9  # list radii from the origin, none longer than a box: so many boxes can be counted in 32 bits
ROUNDING = 1e-5  # relative; float32 distances are good to 1e-6


# Columns of PairList.needed and PairList.counters.
ENTRIES, MASKED, WINDOW = 0, 1, 2
USABLE, BUILDS, STATUS, IMAGES_FOUND = 0, 1, 2, 3


class PairList(NamedTuple):
    """Rows of clusters for the sites of one law.

    An entry is IMAGES * cluster + image; `shift` says where the image is.
    """

    cutoff: float  # Å
    skin: float  # Å
    shells_per_A: float  # beyond the cut-off
    reach2: float  # squared distance within which sites of one group lie, Å²; may be infinite
    group: np.ndarray  # (s,) pairs inside one group are left out
    cell: np.ndarray  # (3, 3) the cell that it was last used with, Å
    clusters: Clusters
    tree: BoxTree
    shift: np.ndarray  # (4 * IMAGES,) x, y, z, 0 of each image, Å
    row: np.ndarray  # (rows,) int32 row r, of slots 2 r and 2 r + 1, ends in entries[b] at row[r], where r + 1 begins
    beyond: np.ndarray  # (rows, SHELLS) uint16 so many of its entries, at its end, are beyond shell k
    entries: np.ndarray  # (blocks, capacity) int32
    special: np.ndarray  # (rows,) int32 as `row`, in masked[b]
    masked: np.ndarray  # (blocks, capacity, 2) int32 entry, and as bits the lanes that count for each site of the row
    needed: np.ndarray  # (blocks, 3) room expected or asked for: entries, masked entries, clusters from the first on
    counters: np.ndarray  # (4,) usable (0 or 1); builds; status of the last update; images


@kernel(inline=True)
def cluster_of(entry):
    """The cluster that an entry names."""
    return entry >> IMAGE_BITS


@kernel(inline=True)
def image_of(entry):
    """The image of it."""
    return entry & (IMAGES - 1)


def empty_list(cell: np.ndarray, group: np.ndarray, reach: float, cutoff: float, skin: float, dtype: type) -> PairList:
    """A list that will be built at its first use, with about the room that sites spread evenly would need.

    cell : (3, 3). reach : how far apart sites of one group can be, Å, infinite if nobody knows
    """
    clusters = clusters_of(len(group), dtype)
    blocks, slots = len(clusters.farthest), len(clusters.order)
    rows = slots // 2
    count = len(clusters.origin) // 4
    room = ceil(_clusters_met(cell, count, cutoff + skin) * rows / blocks)
    needed = np.zeros((blocks, 3), np.int64)
    needed[:, WINDOW] = _clusters_ahead(cell, count, blocks, cutoff + skin)
    skin = _fitting_skin(cell, cutoff, skin)
    return PairList(
        cutoff=cutoff,
        skin=skin,
        shells_per_A=(SHELLS - 1) / skin,
        reach2=(reach + ROUNDING * (cutoff + skin)) ** 2,
        group=group,
        cell=cell.copy(),
        clusters=clusters,
        tree=box_tree(count),
        shift=zeros(4 * IMAGES, np.float64),
        row=np.zeros(rows, np.int32),
        beyond=np.zeros((rows, SHELLS), np.uint16),
        entries=np.empty((blocks, room), np.int32),
        special=np.zeros(rows, np.int32),
        masked=np.empty((blocks, ceil(1.5 * rows / blocks), 2), np.int32),  # 1.1 (argon) to 1.5 (water) a row: measured
        needed=needed,
        counters=np.zeros(4, np.int64),
    )


def _fitting_skin(cell: np.ndarray, cutoff: float, skin: float) -> float:
    """The skin, or less: longer, second images could come near between builds, and IMAGES would be too few."""
    return min(skin, LONGEST_SKIN * cell.diagonal().min()) if cutoff < inf else inf


def _clusters_met(cell: np.ndarray, count: int, radius: float) -> float:
    """Entries of a row to be expected; 0 where nobody knows the density, so that the first build finds out."""
    if radius == inf:
        return count / 2 + 1
    volume = cell.diagonal().prod()
    if volume == inf:
        return 0.0
    edge = np.cbrt(volume / count)
    near = edge**3 + 6 * edge**2 * radius + 3 * pi * edge * radius**2 + 4 / 3 * pi * radius**3  # Steiner's formula
    return min(0.42 * near / edge**3, count / 2) + 1  # half of them, a sixth less: measured, cubes touch with corners


def _clusters_ahead(cell: np.ndarray, count: int, blocks: int, radius: float) -> int:
    """Clusters from the first of a block to the last that its rows are expected to meet."""
    volume = cell.diagonal().prod()
    if volume == inf or radius == inf:
        return 0
    layers = (radius + 2 * np.cbrt(volume / count)) / cell[0, 0]  # clusters are sorted along x first
    return min(count, ceil(count * (min(layers, 0.5) + 1 / blocks)))


def list_code(pairs: PairList, sites: BodySites | CentralSites) -> Code:
    """The machine code that keeps a list of sites."""
    placed = (pairs, sites, EXAMPLE[0])
    return Code(
        place=(_place, placed),
        follow=(_follow, pairs),
        wrap=(_wrap, placed),
        bin=(_bin, placed),
        prepare=(_prepare, pairs),
        settle=(_settle, placed),
        grow=(_grow, pairs),
        fill=(_fill, pairs),
    )


def with_room(pairs: PairList, cell: np.ndarray) -> PairList:
    """The list with, and a tenth to spare, the room its last build asked for, and a skin that the cell has room for.

    Raises SimulationError where the cell has become too small for the cut-off.
    """
    if pairs.counters[STATUS] == CELL_CHANGED:
        if 2 * pairs.cutoff > cell.diagonal().min():
            raise SimulationError(
                f"the box has become too small for the cut-off of {pairs.cutoff:g} Å: half its smallest edge is "
                f"{cell.diagonal().min() / 2:.4g} Å. Begin with a larger box, or take a shorter cut-off"
            )
        skin = _fitting_skin(cell, pairs.cutoff, pairs.skin)
        pairs = pairs._replace(skin=skin, shells_per_A=(SHELLS - 1) / skin)
    blocks = len(pairs.needed)
    entries, masked, _ = pairs.needed.max(axis=0)
    if entries > pairs.entries.shape[1]:
        pairs = pairs._replace(entries=np.empty((blocks, int(1.1 * entries) + 16), np.int32))
    if masked > pairs.masked.shape[1]:
        pairs = pairs._replace(masked=np.empty((blocks, int(1.1 * masked) + 16, 2), np.int32))
    return pairs


@kernel(counted=False)
def update_list(pairs, code, sites, state):
    """Bring clusters to where the molecules are, and build the list anew if it is no longer good. A status code."""
    blocks = len(pairs.needed)
    parcel = packed(pairs)
    placed = packed((pairs, sites, state))
    if follow_cell(state.cell, pairs.cell):
        pairs.counters[USABLE] = 0
    if pairs.counters[USABLE] == 1:
        call_blocks(code, "place", placed, blocks)
        call_blocks(code, "follow", parcel, blocks)
        if farthest(pairs) < inf:
            return OK
    pairs.counters[USABLE] = 0
    shortest = min(pairs.cell[0, 0], pairs.cell[1, 1], pairs.cell[2, 2])
    if pairs.cutoff < inf and (2 * pairs.cutoff > shortest or pairs.skin > LONGEST_SKIN * shortest):
        return CELL_CHANGED
    call_blocks(code, "wrap", placed, blocks)
    call_blocks(code, "bin", placed, blocks)
    call(code, "prepare", parcel)
    if pairs.counters[STATUS] != OK:
        return pairs.counters[STATUS]
    call_blocks(code, "settle", placed, blocks)
    call(code, "grow", parcel)
    call_blocks(code, "fill", parcel, blocks)
    if most_needed(pairs, ENTRIES) > pairs.entries.shape[1] or most_needed(pairs, MASKED) > pairs.masked.shape[1]:
        return LIST_FULL
    pairs.counters[USABLE] = 1
    pairs.counters[BUILDS] += 1
    return OK


@kernel
def most_needed(pairs, k):
    """The most that any block needs of what `needed[:, k]` counts."""
    most = 0
    for block in range(len(pairs.needed)):
        most = max(most, pairs.needed[block, k])
    return most


@kernel(inline=True)
def farthest(pairs):
    """How far the site that went farthest has gone since the list was built, Å; infinite if the list is not good."""
    found = 0.0
    for block in range(len(pairs.needed)):
        found = max(found, pairs.clusters.farthest[block])
    return found


@kernel(inline=True)
def end_of_row(pairs, r, farthest):
    """Where those entries of a row end that can hold a site inside the cut-off when none has gone farther."""
    moved = max(pairs.clusters.moved[2 * r], pairs.clusters.moved[2 * r + 1])
    shell = min(SHELLS - 1, ceil((moved + farthest) * pairs.shells_per_A))
    return pairs.row[r] - pairs.beyond[r, shell]


@kernel(inline=True)
def lanes_of_first(bits):
    """The lanes of a masked entry that count for the first site of the row."""
    return bits & ((1 << MASK_BITS) - 1)


@kernel(inline=True)
def lanes_of_second(bits):
    """Those that count for the second."""
    return bits >> MASK_BITS


@task(counted=False)
def _place(parcel, block):
    pairs, sites, state = opened(parcel)
    place_block(pairs.clusters, pairs.cell, sites, state, block)


@task(counted=False)
def _follow(parcel, block):
    pairs = opened(parcel)
    follow_block(pairs.clusters, 0.5 * pairs.skin, block)


@task(counted=False)
def _wrap(parcel, block):
    pairs, sites, state = opened(parcel)
    wrap_block(pairs.clusters, pairs.cell, sites, state, LOST * (pairs.cutoff + pairs.skin), block)


@task(counted=False)
def _bin(parcel, block):
    pairs, sites, state = opened(parcel)
    bin_block(pairs.clusters, pairs.cell, sites, state, block)


@task()
def _prepare(parcel, block):
    """Sort the sites for a new list; a status code into counters[2]."""
    pairs = opened(parcel)
    pairs.counters[STATUS] = OK if sort_into_clusters(pairs.clusters) else NOT_FINITE
    pairs.counters[IMAGES_FOUND] = _find_images(pairs.cell, pairs.cutoff + pairs.skin, pairs.shift)


@kernel
def _find_images(cell, radius, shift):
    """Shifts of the images of the brick (see clusters) that are within a radius of it; how many. No shift comes first.

    Bricks stand in layers along c, in rows along b; 27 in an upright box, up to 48 in a slanted one, the radius being
    no longer than any edge.
    """
    found = 1
    for n in range(3):
        shift[n] = 0.0
    for z in range(-1, 2):
        if z != 0 and cell[2, 2] == inf:
            continue
        first, last = _images_along(cell, 1, z * cell[2, 1] if z != 0 else 0.0, radius)
        for y in range(first, last + 1):
            x0 = (z * cell[2, 0] if z != 0 else 0.0) + (y * cell[1, 0] if y != 0 else 0.0)
            left, right = _images_along(cell, 0, x0, radius)
            for x in range(left, right + 1):
                if x == y == z == 0:
                    continue
                for k in range(3):
                    total = 0.0
                    for n, vector in ((x, 0), (y, 1), (z, 2)):
                        if n != 0:
                            total += n * cell[vector, k]
                    shift[4 * found + k] = total
                found += 1
    return found


@kernel
def _images_along(cell, k, offset, radius):
    """First and last multiple of edge k that brings a brick, now at an offset, within a radius of the one at 0."""
    edge = cell[k, k]
    if edge == inf:
        return 0, 0
    return floor((-radius - offset) / edge), ceil((edge + radius - offset) / edge) - 1


@task(counted=False)
def _settle(parcel, block):
    pairs, sites, state = opened(parcel)
    settle_block(pairs.clusters, pairs.cell, sites, state, pairs.group, block)


@task(counted=False)
def _grow(parcel, block):
    pairs = opened(parcel)
    grow(pairs.tree, pairs.clusters)


@task()
def _fill(parcel, block):
    pairs = opened(parcel)
    room = 256
    while room > 0:
        room = fill_block(pairs, block, room)


class Scratch(NamedTuple):
    """What the rows of one cluster are made with."""

    stack: np.ndarray  # (levels, 2) for within_reach
    low: np.ndarray  # (3,) box of the cluster, moved by an image
    high: np.ndarray  # (3,)
    entry: np.ndarray  # (room,) candidates
    shell: np.ndarray  # (room * lanes,) where candidate n is for the row of site i, at n * lanes + i: up to which shell
    end: np.ndarray  # (SHELLS,) of each shell of a row
    inner: np.ndarray  # (rows of a cluster, room) entries in the first shell of a row
    outer: np.ndarray  # (rows of a cluster, room) candidates in the others
    special: np.ndarray  # (rows of a cluster, room) entries that need a mask with a row
    count: np.ndarray  # (3, rows of a cluster) how many are in inner, outer, special of each row


@kernel
def _scratch(pairs, room):
    width = width_of(pairs.clusters.local)
    return Scratch(
        np.empty((len(pairs.tree.level), 2), np.int64),
        np.empty(3),
        np.empty(3),
        np.empty(room, np.int64),
        np.empty(room * width, pairs.clusters.local.dtype),
        np.empty(SHELLS, np.int64),
        np.empty((width // 2, room), np.int32),
        np.empty((width // 2, room), np.int32),
        np.empty((width // 2, room), np.int32),
        np.empty((3, width // 2), np.int64),
    )


@kernel(inline=True)
def fill_block(pairs, block, room):
    """Rows of one block. Entries beyond the room are counted, not stored.

    Returns 0, or how much room is needed for candidates; then nothing has been done.
    """
    clusters = pairs.clusters
    scratch = _scratch(pairs, room)
    entries = masked = window = 0
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        candidates = _find_candidates(pairs, c, scratch)
        if candidates > room:
            return 2 * candidates
        entries, masked, ahead = _fill_rows(pairs, block, c, scratch, candidates, entries, masked)
        window = max(window, ahead + c - clusters.bounds[block] + 1)
    pairs.needed[block, ENTRIES] = entries
    pairs.needed[block, MASKED] = masked
    pairs.needed[block, WINDOW] = min(window, len(clusters.origin) // 4)
    return 0


@kernel(fastmath=PAIR_FLAGS, inline=True, counted=False)
def _find_candidates(pairs, c, scratch):
    """Clusters and images that stand in a cluster's rows and whose box is within reach of its box; how many.

    There may be more than there is room for.
    """
    tree = pairs.tree
    count = len(pairs.clusters.origin) // 4
    radius = (pairs.cutoff + pairs.skin) * (1 + ROUNDING)
    entry = scratch.entry
    candidates = 0
    for image in range(pairs.counters[IMAGES_FOUND]):
        reaches = True
        for k in range(3):
            shift = pairs.shift[4 * image + k]
            scratch.low[k] = tree.low[k, c] - shift
            scratch.high[k] = tree.high[k, c] - shift
            if shift != 0.0:
                reaches &= scratch.high[k] > -radius and scratch.low[k] < pairs.cell[k, k] + radius
        if not reaches:
            continue
        first = candidates
        found = within_reach(tree, scratch.low, scratch.high, radius * radius, c, count, scratch.stack, entry, first)
        if found > len(entry):
            return found
        for n in range(first, found):
            ahead = entry[n] - c
            if ahead < 0:
                ahead += count
            if 2 * ahead < count or (2 * ahead == count and c < entry[n]):
                entry[candidates] = IMAGES * entry[n] + image
                candidates += 1
    return candidates


@kernel(fastmath=PAIR_FLAGS, inline=True, counted=False)
def _fill_rows(pairs, block, c, scratch, candidates, filled, filled_masked):
    """Rows of a cluster from its candidates.

    Entries and masked entries of the block so far, and how far ahead on the ring the farthest cluster is.
    """
    width = width_of(pairs.clusters.local)
    rows = width // 2
    count = len(pairs.clusters.origin) // 4
    entries, masked = pairs.entries[block], pairs.masked[block]
    radius2 = ((pairs.cutoff + pairs.skin) * (1 + ROUNDING)) ** 2
    farthest = 0
    scratch.count[:] = 0
    for n in range(candidates):
        _measure(pairs, c, scratch, n)
        ahead = cluster_of(scratch.entry[n]) - c
        farthest = max(farthest, ahead + count if ahead < 0 else ahead)
    for own in range(rows):
        r = rows * c + own
        filled = _fill_row(pairs.beyond[r], entries, filled, scratch, own, width)
        pairs.row[r] = min(filled, len(entries))
        for n in range(scratch.count[2, own]):
            entry = scratch.special[own, n]
            first_of_row = _mask_of_lanes(pairs, 2 * r, entry, radius2)
            second = _mask_of_lanes(pairs, 2 * r + 1, entry, radius2)
            if first_of_row | second:
                if filled_masked < len(masked):
                    masked[filled_masked, 0] = entry
                    masked[filled_masked, 1] = first_of_row | second << MASK_BITS
                filled_masked += 1
        pairs.special[r] = min(filled_masked, len(masked))
    return filled, filled_masked, farthest


@kernel(inline=True)
def _fill_row(beyond, entries, filled, scratch, own, width):
    """Write the entries of a row, shell by shell; how many there are now in the block.

    Beyond a shell are at most so many as `beyond` can hold: any more of them count as if they were inside.
    """
    inner, outer, end = scratch.inner[own], scratch.outer[own], scratch.end
    inners, outers = scratch.count[0, own], scratch.count[1, own]
    for k in range(SHELLS):
        end[k] = 0
    for n in range(outers):
        end[ceil(scratch.shell[width * outer[n] + 2 * own])] += 1
    last = filled + inners
    beyond[0] = min(outers, MOST_BEYOND)
    for k in range(1, SHELLS):
        size = end[k]
        end[k] = last
        last += size
        beyond[k] = min(filled + inners + outers - last, MOST_BEYOND)
    if last <= len(entries):
        for n in range(inners):
            entries[filled + n] = inner[n]
        for n in range(outers):
            k = ceil(scratch.shell[width * outer[n] + 2 * own])
            entries[end[k]] = scratch.entry[outer[n]]
            end[k] += 1
    return last


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _measure(pairs, c, scratch, n):
    """In which shell of each row of a cluster candidate n is, or that they need a mask.

    The sites are the lanes here, and the candidate's sites come one after the other: no sums across lanes, no guesses.
    """
    clusters = pairs.clusters
    local = clusters.local
    width = width_of(local)
    count = len(clusters.origin) // 4
    entry = scratch.entry[n]
    other, image = cluster_of(entry), image_of(entry)
    at = 3 * width * c
    x = load(local, at) + apart(pairs, c, other, image, 0)
    y = load(local, at + width) + apart(pairs, c, other, image, 1)
    z = load(local, at + 2 * width) + apart(pairs, c, other, image, 2)
    # |x|² - 2 x y + |y|²: three multiply-adds for each y. What that rounds, a few digits of |x|² + |y|², is taken off.
    x2 = x * x + y * y + z * z
    x, y, z = -2.0 * x, -2.0 * y, -2.0 * z
    nearest2 = fill(inf, local)
    for lane in range(width):
        at = 3 * width * other + lane
        product = spread(clusters.square, width * other + lane) + z * spread(local, at + 2 * width)
        nearest2 = smaller(nearest2, product + y * spread(local, at + width) + x * spread(local, at))
    nearest2 = nearest2 + x2 * (1 - 0.1 * ROUNDING)
    everyone = (1 << width) - 1
    special = 0
    if other == c or c == count - 1 or other == count - 1:
        special = everyone
    elif bits(nearest2 <= pairs.reach2) != 0:
        group = load_beside(clusters.group, width * c, local)
        mates = group < group
        for lane in range(width):
            mates = mates | (group == clusters.group[width * other + lane])
        special = bits(mates)
        special = 3 * ((special | special >> 1) & everyone // 3)  # both sites of the row
    nearest = root(larger(smaller_of_two(nearest2), 0.0)) * (1 - ROUNDING)
    shell = fill(0.0, local)
    if pairs.cutoff < inf:
        shell = (nearest - pairs.cutoff) * pairs.shells_per_A
    store(scratch.shell, width * n, shell)
    inner = bits(shell <= 0.0) & ~special
    outer = bits(shell <= SHELLS - 1) & ~inner & ~special
    _append(scratch.inner, scratch.count, 0, entry, inner, width)
    _append(scratch.outer, scratch.count, 1, n, outer, width)
    if special != 0:
        _append(scratch.special, scratch.count, 2, entry, special, width)


@kernel(inline=True)
def _append(rows, count, k, value, which, width):
    """Add a value to the lists of some rows of a cluster without branches: half of them would be guessed wrong."""
    for own in range(width // 2):
        rows[own, count[k, own]] = value
        count[k, own] += which >> 2 * own & 1


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _mask_of_lanes(pairs, i, entry, radius2):
    """The sites of a cluster that site i may meet, as bits; 0 if none of them is inside the radius."""
    if i >= len(pairs.group):
        return 0
    clusters = pairs.clusters
    local = clusters.local
    width = width_of(local)
    everyone = (1 << width) - 1
    c, other, image = i // width, cluster_of(entry), image_of(entry)
    at = 2 * width * c + i
    start = 3 * width * other
    dx = local[at] + apart(pairs, c, other, image, 0) - load(local, start)
    dy = local[at + width] + apart(pairs, c, other, image, 1) - load(local, start + width)
    dz = local[at + 2 * width] + apart(pairs, c, other, image, 2) - load(local, start + 2 * width)
    left_out = bits(load_beside(clusters.group, width * other, local) == clusters.group[i])
    if other == c:
        left_out |= (2 << (i - width * c)) - 1  # each pair once
    if other == len(clusters.origin) // 4 - 1:
        left_out |= everyone ^ (everyone >> filler(pairs))
    meets = everyone & ~left_out
    return meets if bits(dx * dx + dy * dy + dz * dz <= radius2) & meets else 0


@kernel(fastmath=PAIR_FLAGS, inline=True)
def apart(pairs, c, other, image, k):
    """From the origin of another cluster to that of cluster c, moved by an image, Å."""
    clusters = pairs.clusters
    return clusters.origin[4 * c + k] - pairs.shift[4 * image + k] - clusters.origin[4 * other + k]


@kernel(inline=True)
def filler(pairs):
    """Slots of the last cluster that hold no site."""
    return len(pairs.clusters.order) - len(pairs.group)
