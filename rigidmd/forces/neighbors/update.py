"""Update of a neighbour list: its sites move with the bodies, and it is rebuilt when it is not
valid any longer."""

from math import ceil, floor, inf, sqrt

from rigidmd.compile import Code, Pass, call_blocks, kernel, load_arguments, pack_arguments, task
from rigidmd.core.state import CELL_CHANGED, EXAMPLE, LIST_FULL, NOT_FINITE, NOW, OK
from rigidmd.forces.neighbors.clusters import (
    BUILT,
    LEAD_TIME,
    bin_sites,
    measure_displacements,
    restore_half_squares,
    set_local,
    set_origins,
    sort_into_clusters,
    wrap_sites,
)
from rigidmd.forces.neighbors.lists import (
    BUILDS,
    ENTRIES,
    IMAGES_FOUND,
    LONGEST_SKIN,
    MASKED,
    MAX_NEIGHBORS,
    NEIGHBORS,
    NEIGHBORS_OF_ONE,
    STATUS,
    USABLE,
    PairList,
    largest_displacement,
    most_needed,
)
from rigidmd.forces.neighbors.rows import fill_rows, update_origin_vectors
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.forces.neighbors.space import follow_cell
from rigidmd.forces.neighbors.tree import fit_boxes
from rigidmd.forces.terms import Evaluation, TermPasses, copy

#: A list is built for positions predicted ahead by this fraction of the lifetime of the last list.
#: With a larger one sites are farther from the predictions on average, and the loop has to work
#: through more shells.
LEAD_FRACTION = 0.25


def list_code(pairs: PairList, sites: BodySites | CentralSites) -> Code:
    """The machine code of the tasks that update a list."""
    site_arguments = (pairs, sites, EXAMPLE[0])
    return Code(
        origin_vectors=(update_origin_vectors, pairs),
        local=(set_local, site_arguments),
        displacements=(measure_displacements, pairs),
        wrap=(wrap_sites, site_arguments),
        bin=(bin_sites, site_arguments),
        sort=(_sort_sites, pairs),
        origins=(set_origins, site_arguments),
        boxes=(fit_boxes, pairs),
        fill=(fill_rows, pairs),
    )


def list_passes(
    pairs: PairList, code: Code | None, sites: BodySites | CentralSites, into: Evaluation
) -> TermPasses:
    """The passes that move the clusters with the cell and the molecules, and build the list if it
    is not valid. Before the first build nothing reads the positions, which all have one slot."""
    blocks, of_state = len(pairs.needed), (pairs, sites, into.state)
    moved = code, pairs, into.state, into.status
    build = code, *of_state, into.status
    return TermPasses(
        cell=[Pass("images of the neighbour list, if the cell has changed", _move_list, moved)],
        positions=[
            Pass("positions of sites", set_local, of_state, blocks),
            Pass("their displacements", measure_displacements, pairs, blocks),
        ],
        lists=[Pass("build the neighbour list, if it is not valid", build_if_invalid, build)],
    )


@task(count_references=False)
def _move_list(arguments, block):
    """Move the images of a list with the cell, which has to be finite."""
    code, pairs, state, status = load_arguments(arguments)
    if not follow_cell(state.cell, pairs.cell):
        return
    for k in range(9):
        # NaN, which comparisons do not detect
        if pairs.cell[k // 3, k % 3] != pairs.cell[k // 3, k % 3]:
            pairs.counters[USABLE] = 0
            pairs.counters[STATUS] = status[0] = NOT_FINITE
            return
    if pairs.counters[USABLE] == 1:
        if _move_images(pairs):
            call_blocks(code, "origin_vectors", pack_arguments(pairs), len(pairs.needed))
        else:
            pairs.counters[USABLE] = 0


@kernel(count_references=False)
def build_list(pairs, code, sites, state):
    """Build the list, unless it is valid for the present positions. A status code."""
    if pairs.counters[USABLE] == 1 and largest_displacement(pairs) < inf:
        return OK
    blocks = len(pairs.needed)
    arguments = pack_arguments(pairs)
    site_arguments = pack_arguments((pairs, sites, state))
    pairs.counters[USABLE] = 0
    if not _cell_fits(pairs):
        return CELL_CHANGED
    now = state.time[NOW]
    lead = LEAD_FRACTION * (now - pairs.times[BUILT])
    # the second time only if a site is too far from its predicted position
    for ahead in (lead if abs(lead) < inf else 0.0), 0.0:
        pairs.times[LEAD_TIME] = ahead
        call_blocks(code, "wrap", site_arguments, blocks)
        call_blocks(code, "bin", site_arguments, blocks)
        call_blocks(code, "sort", arguments, 1)
        if pairs.counters[STATUS] == OK:
            call_blocks(code, "origins", site_arguments, blocks)
            call_blocks(code, "local", site_arguments, blocks)
            if ahead == 0.0:
                # the current positions: a skin may be smaller than their rounding
                copy(pairs.clusters.local, pairs.clusters.reference)
            call_blocks(code, "displacements", arguments, blocks)
            if largest_displacement(pairs) < inf:
                break
    if pairs.counters[STATUS] != OK:
        return pairs.counters[STATUS]
    call_blocks(code, "boxes", arguments, 1)
    call_blocks(code, "fill", arguments, blocks)
    status = _finish_build(pairs)
    if status == OK:
        pairs.times[BUILT] = now
    return status


@task()
def build_if_invalid(arguments, block):
    """`build_list`, with its status code."""
    code, pairs, sites, state, status = load_arguments(arguments)
    pairs.counters[STATUS] = status[0] = build_list(pairs, code, sites, state)


@kernel(count_references=False)
def refill(pairs, code):
    """Build the list again from the clusters that `lists.restored` has set. A status code."""
    restore_half_squares(pairs.clusters)
    _find_images(pairs)
    arguments = pack_arguments(pairs)
    call_blocks(code, "boxes", arguments, 1)
    call_blocks(code, "fill", arguments, len(pairs.needed))
    return _finish_build(pairs)


@kernel(count_references=False)
def _finish_build(pairs):
    """Check that a list has not exceeded its capacities, and set its counters. A status code."""
    if (
        most_needed(pairs, ENTRIES) > pairs.entries.shape[1]
        or most_needed(pairs, MASKED) > pairs.masked.shape[1]
        or most_needed(pairs, NEIGHBORS) > pairs.neighbors.shape[1]
        or most_needed(pairs, NEIGHBORS_OF_ONE) > MAX_NEIGHBORS
    ):
        return LIST_FULL
    pairs.counters[USABLE] = 1
    pairs.counters[BUILDS] += 1
    return OK


@kernel(inline=True)
def _shortest(cell):
    return min(cell[0, 0], cell[1, 1], cell[2, 2])


@kernel
def _cell_fits(pairs):
    """Whether the cell is large enough for the cutoff and the skin."""
    shortest = _shortest(pairs.cell)
    return pairs.cutoff == inf or (
        2 * pairs.cutoff <= shortest and pairs.skin <= LONGEST_SKIN * shortest
    )


@kernel
def _max_slack(pairs):
    """How far images may move until the list is built again, Å. Images are sought within a radius
    that is larger by this: an image that was omitted, and may move by twice as much as those that
    were found, stays out of reach. 0 if such a search could find more images than the capacity."""
    is_short = pairs.cutoff < inf and 2.5 * pairs.skin <= _shortest(pairs.built)
    return 0.25 * pairs.skin if is_short else 0.0


@kernel
def _move_images(pairs):
    """Move the images with the cell. Whether the list is still valid. `update_origin_vectors` must
    follow."""
    farthest2 = 0.0
    for n in range(pairs.counters[IMAGES_FOUND]):
        moved2 = 0.0
        for k in range(3):
            before = _displacement(pairs.built, pairs.multiple[n], k)
            pairs.shift[4 * n + k] = _displacement(pairs.cell, pairs.multiple[n], k)
            moved2 += (pairs.shift[4 * n + k] - before) ** 2
        farthest2 = max(farthest2, moved2)
    pairs.slack[0] = sqrt(farthest2)
    return _cell_fits(pairs) and pairs.slack[0] <= _max_slack(pairs)


@kernel(inline=True)
def _displacement(cell, multiple, k):
    """Component k of a sum of edges. An edge that does not occur in it may be infinite."""
    total = 0.0
    for vector in range(3):
        if multiple[vector] != 0:
            total += multiple[vector] * cell[vector, k]
    return total


@task()
def _sort_sites(arguments, block):
    """Sort the sites for a new list. A status code into counters[STATUS]."""
    pairs = load_arguments(arguments)
    pairs.counters[STATUS] = OK if sort_into_clusters(pairs.clusters) else NOT_FINITE
    _find_images(pairs)


@kernel
def _find_images(pairs):
    """Find the images of the brick (see `clusters`) near it in the current cell. Shift 0 is the
    first. Bricks are stacked in layers along c and in rows along b. The radius is not longer than
    any edge, so there are 27 images in an orthorhombic box and up to 48 in a triclinic one."""
    cell, multiple = pairs.cell, pairs.multiple
    copy(cell, pairs.built)
    pairs.slack[0] = 0.0
    # rounding may exceed it
    radius = min(pairs.cutoff + pairs.skin + _max_slack(pairs), _shortest(cell))
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
    """First and last multiple of edge k that brings a brick at an offset within a radius of the
    brick at 0."""
    edge = cell[k, k]
    if edge == inf:
        return 0, 0
    return floor((-radius - offset) / edge), ceil((edge + radius - offset) / edge) - 1
