"""Keeping a neighbour list: its sites are moved with the bodies, and the list is rebuilt when it is no longer valid."""

from math import ceil, floor, inf, sqrt

from rigidmd.compile import Code, call, call_blocks, kernel, opened, packed, task
from rigidmd.core.state import CELL_CHANGED, EXAMPLE, LIST_FULL, NOT_FINITE, NOW, OK
from rigidmd.forces.neighbors.clusters import (
    bin_block,
    follow_block,
    hold,
    place_block,
    settle_again,
    settle_block,
    sort_into_clusters,
    wrap_block,
)
from rigidmd.forces.neighbors.lists import (  # fmt: skip
    AHEAD,
    BUILDS,
    BUILT,
    ENTRIES,
    IMAGES_FOUND,
    LONGEST_SKIN,
    MASKED,
    MET,
    MET_BY_ONE,
    MOST_MET,
    STATUS,
    USABLE,
    PairList,
    farthest,
    most_needed,
)
from rigidmd.forces.neighbors.rows import fill_block, part_block
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.forces.neighbors.space import follow_cell
from rigidmd.forces.neighbors.tree import grow

#: A list is built for places that are ahead of the present ones by this share of the time that the last one served:
#: its sites come nearer to them before they go away. It serves longer by a fifth (water) or a half (nitrogen). With a
#: larger share the sites are farther from their places on average, and more shells of clusters have to be worked
#: through.
LEAD = 0.25
LOST = 1e9  # list radii from the origin; no radius is longer than a box, so 32 bits can count the boxes on the way


def list_code(pairs: PairList, sites: BodySites | CentralSites) -> Code:
    """The machine code of the tasks that keep a list."""
    placed = (pairs, sites, EXAMPLE[0])
    return Code(
        part=(_part, pairs),
        place=(_place, placed),
        follow=(_follow, pairs),
        wrap=(_wrap, placed),
        bin=(_bin, placed),
        prepare=(_prepare, pairs),
        settle=(_settle, placed),
        grow=(_grow, pairs),
        fill=(_fill, pairs),
    )


@kernel(counted=False)
def update_list(pairs, code, sites, state):
    """Move the clusters with the molecules, and rebuild the list if it is no longer valid; a status code."""
    blocks = len(pairs.needed)
    parcel = packed(pairs)
    placed = packed((pairs, sites, state))
    if follow_cell(state.cell, pairs.cell):
        if not _is_known(pairs.cell):
            pairs.counters[USABLE] = 0
            return NOT_FINITE
        if pairs.counters[USABLE] == 1:
            if _move_images(pairs):
                call_blocks(code, "part", parcel, blocks)
            else:
                pairs.counters[USABLE] = 0
    if pairs.counters[USABLE] == 1:
        call_blocks(code, "place", placed, blocks)
        call_blocks(code, "follow", parcel, blocks)
        if farthest(pairs) < inf:
            return OK
    pairs.counters[USABLE] = 0
    if not _fits(pairs):
        return CELL_CHANGED
    now = state.time[NOW]
    lead = LEAD * (now - pairs.times[BUILT])
    # the second time where some site is too far from its place ahead
    for ahead in (lead if abs(lead) < inf else 0.0), 0.0:
        pairs.times[AHEAD] = ahead
        call_blocks(code, "wrap", placed, blocks)
        call_blocks(code, "bin", placed, blocks)
        call(code, "prepare", parcel)
        if pairs.counters[STATUS] == OK:
            call_blocks(code, "settle", placed, blocks)
            call_blocks(code, "place", placed, blocks)
            if ahead == 0.0:
                hold(pairs.clusters)
            call_blocks(code, "follow", parcel, blocks)
            if farthest(pairs) < inf:
                break
    if pairs.counters[STATUS] != OK:
        return pairs.counters[STATUS]
    call(code, "grow", parcel)
    call_blocks(code, "fill", parcel, blocks)
    status = _judged(pairs)
    if status == OK:
        pairs.times[BUILT] = now
    return status


@kernel(counted=False)
def refill(pairs, code):
    """Build the list again from the clusters that `lists.recalled` has put in; a status code."""
    settle_again(pairs.clusters)
    _find_images(pairs)
    parcel = packed(pairs)
    call(code, "grow", parcel)
    call_blocks(code, "fill", parcel, len(pairs.needed))
    return _judged(pairs)


@kernel(counted=False)
def _judged(pairs):
    """Whether a list that has been filled is whole, into its counters; a status code."""
    if (
        most_needed(pairs, ENTRIES) > pairs.entries.shape[1]
        or most_needed(pairs, MASKED) > pairs.masked.shape[1]
        or most_needed(pairs, MET) > pairs.met.shape[1]
        or most_needed(pairs, MET_BY_ONE) > MOST_MET
    ):
        return LIST_FULL
    pairs.counters[USABLE] = 1
    pairs.counters[BUILDS] += 1
    return OK


@kernel
def _is_known(cell):
    """Whether no component of a cell is NaN: comparisons and extremes would pass over it."""
    for vector in range(3):
        for k in range(3):
            if cell[vector, k] != cell[vector, k]:
                return False
    return True


@kernel(inline=True)
def _shortest(cell):
    return min(cell[0, 0], cell[1, 1], cell[2, 2])


@kernel
def _fits(pairs):
    """Whether the cell has room for the cut-off and the skin."""
    shortest = _shortest(pairs.cell)
    return pairs.cutoff == inf or (2 * pairs.cutoff <= shortest and pairs.skin <= LONGEST_SKIN * shortest)


@kernel
def _most_slack(pairs):
    """How far images may move until the list is built again, Å.

    Images are sought so much farther than sites: one that was left out, and may move by twice as much as those that
    were found, is out of reach meanwhile. No slack if such a search could find more images than there is room for.
    """
    is_short = pairs.cutoff < inf and 2.5 * pairs.skin <= _shortest(pairs.built)
    return 0.25 * pairs.skin if is_short else 0.0


@kernel
def _move_images(pairs):
    """Move the images with the cell. Whether the list still serves; `part_block` must then follow."""
    farthest2 = 0.0
    for n in range(pairs.counters[IMAGES_FOUND]):
        moved2 = 0.0
        for k in range(3):
            before = _displacement(pairs.built, pairs.multiple[n], k)
            pairs.shift[4 * n + k] = _displacement(pairs.cell, pairs.multiple[n], k)
            moved2 += (pairs.shift[4 * n + k] - before) ** 2
        farthest2 = max(farthest2, moved2)
    pairs.slack[0] = sqrt(farthest2)
    return _fits(pairs) and pairs.slack[0] <= _most_slack(pairs)


@kernel(inline=True)
def _displacement(cell, multiple, k):
    """Component k of a sum of edges; an edge may be infinite where there is none of it."""
    total = 0.0
    for vector in range(3):
        if multiple[vector] != 0:
            total += multiple[vector] * cell[vector, k]
    return total


@task(counted=False)
def _part(parcel, block):
    pairs = opened(parcel)
    part_block(pairs, block)


@task(counted=False)
def _place(parcel, block):
    pairs, sites, state = opened(parcel)
    place_block(pairs.clusters, pairs.cell, sites, state, block)


@task(counted=False)
def _follow(parcel, block):
    pairs = opened(parcel)
    follow_block(pairs.clusters, 0.5 * (pairs.skin - pairs.slack[0]), block)


@task(counted=False)
def _wrap(parcel, block):
    pairs, sites, state = opened(parcel)
    lost = LOST * (pairs.cutoff + pairs.skin)
    wrap_block(pairs.clusters, pairs.cell, sites, state, pairs.times[AHEAD], lost, block)


@task(counted=False)
def _bin(parcel, block):
    pairs, sites, _ = opened(parcel)
    bin_block(pairs.clusters, sites, block)


@task()
def _prepare(parcel, block):
    """Sort the sites for a new list; a status code into counters[STATUS]."""
    pairs = opened(parcel)
    pairs.counters[STATUS] = OK if sort_into_clusters(pairs.clusters) else NOT_FINITE
    _find_images(pairs)


@kernel
def _find_images(pairs):
    """Find the images of the brick (see `clusters`) near it in the present cell. Shift 0 is the first.

    Bricks are stacked in layers along c and in rows along b. The radius is not longer than any edge, so there are 27
    images in an orthorhombic box and up to 48 in a triclinic one.
    """
    cell, multiple = pairs.cell, pairs.multiple
    for vector in range(3):
        for k in range(3):
            pairs.built[vector, k] = cell[vector, k]
    pairs.slack[0] = 0.0
    radius = min(pairs.cutoff + pairs.skin + _most_slack(pairs), _shortest(cell))  # rounding may exceed it
    multiple[0, 0] = multiple[0, 1] = multiple[0, 2] = 0
    found = 1
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
                multiple[found, 0], multiple[found, 1], multiple[found, 2] = x, y, z
                found += 1
    for n in range(found):
        for k in range(3):
            pairs.shift[4 * n + k] = _displacement(cell, multiple[n], k)
    pairs.counters[IMAGES_FOUND] = found


@kernel
def _images_along(cell, k, offset, radius):
    """First and last multiple of edge k that brings a brick at an offset within a radius of the brick at 0."""
    edge = cell[k, k]
    if edge == inf:
        return 0, 0
    return floor((-radius - offset) / edge), ceil((edge + radius - offset) / edge) - 1


@task(counted=False)
def _settle(parcel, block):
    pairs, sites, state = opened(parcel)
    settle_block(pairs.clusters, pairs.cell, sites, state, pairs.times[AHEAD], pairs.group, block)


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
