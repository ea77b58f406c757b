"""The rows of a neighbour list: which clusters go into which row and shell, and which of them need
a mask."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel, load_arguments, task
from rigidmd.compile.simd import (
    broadcast,
    lanes_of,
    load,
    load_broadcast,
    load_scalar,
    load_with_lanes_of,
    mask_bits,
    pairwise_minimum,
    square_root,
    store_even_lanes,
)
from rigidmd.forces.neighbors.lists import (
    ENTRIES,
    IMAGES,
    IMAGES_FOUND,
    MASK_BITS,
    MASKED,
    MAX_BEYOND,
    NEIGHBORS,
    NEIGHBORS_OF_ONE,
    ROUNDING,
    SHELLS,
    WINDOW,
    behind_block,
    cluster_of,
    image_number,
)
from rigidmd.forces.neighbors.tree import ahead, families_within_reach, near

OUT_OF_REACH = SHELLS  # kind of a candidate that a row does not need; kinds below are shells
NEEDS_MASK = SHELLS + 1  # kind of a candidate that needs a mask
KINDS = SHELLS + 2


class Scratch(NamedTuple):
    stack: np.ndarray  # (levels, 2) for families_within_reach
    low: np.ndarray  # (3,) of a box, shifted by an image
    high: np.ndarray  # (3,)
    # (capacity,) families of clusters near some clusters, as IMAGES * family + number of the image
    family: np.ndarray
    # (capacity + arity,) images of clusters that may be neighbours; finally the neighbours
    candidate: np.ndarray
    close: np.ndarray  # (capacity,) those of them that may need a mask
    # ((capacity + 1) * rows,) uint8 kind of candidate n in row k of the cluster, at n * rows + k
    kind: np.ndarray
    # (rows, KINDS) uint32 entries of each kind, then the next index (unsigned: not tested)
    kind_offset: np.ndarray
    sorted: np.ndarray  # (rows of a cluster, capacity) uint16 entries in the order of their kinds
    filled: np.ndarray  # (5,) of the block so far, see PairList.needed


@task()
def fill_rows(arguments, block):
    """Fill the rows of one block."""
    pairs = load_arguments(arguments)
    capacity = 256
    while capacity > 0:
        capacity = _fill_block(pairs, block, capacity)


@kernel(inline=True)
def _fill_block(pairs, block, capacity):
    """Fill the rows of one block. Entries beyond the capacity are counted but not stored. Returns
    0, or the capacity needed for candidates if it is too small. The rows are then incomplete."""
    clusters = pairs.clusters
    arity = lanes_of(pairs.tree.low)
    rows = lanes_of(clusters.local) // 2
    scratch = Scratch(
        np.empty((len(pairs.tree.level), 2), np.int64),
        np.empty(3),
        np.empty(3),
        np.empty(capacity, np.int64),
        np.empty(capacity + arity, np.int64),
        np.empty(capacity, np.int64),
        np.empty(rows * (capacity + 1), np.uint8),
        np.empty((rows, KINDS), np.uint32),
        np.empty((rows, capacity), np.uint16),
        np.zeros(5, np.int64),
    )
    end = clusters.bounds[block + 1]
    for first in range(clusters.bounds[block], end, arity):
        last = min(first + arity, end)
        families = _find_families(pairs, first, last, scratch)
        if families > capacity:
            return 2 * families
        for c in range(first, last):
            candidates = _find_candidates(pairs, c, scratch, families)
            if candidates > capacity:
                return 2 * candidates
            _fill_rows(pairs, block, c, scratch, candidates)
    for k in range(len(scratch.filled)):
        pairs.needed[block, k] = scratch.filled[k]
    return 0


@kernel(inline=True, count_references=False)
def _find_families(pairs, first, end, scratch):
    """Find families of clusters that may be within reach of clusters first ... end - 1. Returns
    their number, which may exceed the capacity."""
    tree = pairs.tree
    into = scratch.family
    low = scratch.low
    high = scratch.high
    radius = _reach(pairs)
    families = 0
    for image in range(pairs.counters[IMAGES_FOUND]):
        reaches = True
        for k in range(3):
            shift = pairs.shift[4 * image + k]
            low[k], high[k] = inf, -inf
            for c in range(first, end):
                low[k] = min(low[k], tree.low[k, c] - shift)
                high[k] = max(high[k], tree.high[k, c] - shift)
            if shift != 0.0:
                reaches &= high[k] > -radius and low[k] < pairs.cell[k, k] + radius
        if not reaches:
            continue
        count = len(pairs.clusters.origin) // 4
        stack = scratch.stack
        radius2 = radius * radius
        found = families_within_reach(
            tree, low, high, radius2, first, end, count, stack, into, families
        )
        for n in range(families, min(found, len(into))):
            into[n] = IMAGES * into[n] + image
        families = found
    return families


@kernel(inline=True)
def _reach(pairs):
    """The distance within which a list has sites, Å, with an allowance for rounding."""
    return (pairs.cutoff + pairs.skin) * (1 + ROUNDING)


@kernel(inline=True, count_references=False)
def _find_candidates(pairs, c, scratch, families):
    """Find candidates for the rows of a cluster: clusters and images whose box is within reach of
    its box. Returns their number, which may exceed the capacity. There are no branches: a candidate
    out of reach is overwritten by the next one."""
    tree, into, shift = pairs.tree, scratch.candidate, pairs.shift
    arity = lanes_of(tree.low)
    count = len(pairs.clusters.origin) // 4
    radius = _reach(pairs)
    candidates = 0
    for n in range(families):
        first = arity * cluster_of(scratch.family[n])
        image = image_number(scratch.family[n])
        at = 4 * image
        low = (
            tree.low[0, c] - shift[at],
            tree.low[1, c] - shift[at + 1],
            tree.low[2, c] - shift[at + 2],
        )
        high = (
            tree.high[0, c] - shift[at],
            tree.high[1, c] - shift[at + 1],
            tree.high[2, c] - shift[at + 2],
        )
        found = near(tree, first, low, high, radius * radius) & ahead(c, count, first, arity)
        for k in range(arity):
            into[candidates] = IMAGES * (first + k) + image
            candidates += found >> k & 1
        if candidates > len(into) - arity:
            break
    return candidates


@kernel(inline=True, count_references=False)
def _fill_rows(pairs, block, c, scratch, candidates):
    width = lanes_of(pairs.clusters.local)
    rows = width // 2
    entries = pairs.entries[block]
    masked = pairs.masked[block]
    filled = scratch.filled
    radius2 = _reach(pairs) ** 2
    count = _find_kinds(pairs, c, scratch, candidates)
    _store_neighbors(pairs, block, c, scratch, count)
    _sort_by_kind(pairs, c, scratch, count)
    for row in range(rows):
        r = rows * c + row
        here = scratch.sorted[row]
        begin = filled[ENTRIES]
        size = scratch.kind_offset[row, SHELLS - 1]
        filled[ENTRIES] += size
        if filled[ENTRIES] <= len(entries):
            for n in range(size):
                entries[begin + n] = here[n]
        pairs.row_end[r] = min(filled[ENTRIES], len(entries))
        for n in range(
            scratch.kind_offset[row, OUT_OF_REACH], scratch.kind_offset[row, NEEDS_MASK]
        ):
            entry = np.int64(here[n])
            first_of_row = _mask_of_lanes(pairs, 2 * r, scratch.candidate[entry], radius2)
            second = _mask_of_lanes(pairs, 2 * r + 1, scratch.candidate[entry], radius2)
            if first_of_row | second:
                if filled[MASKED] < len(masked):
                    masked[filled[MASKED], 0] = entry
                    masked[filled[MASKED], 1] = first_of_row | second << MASK_BITS
                filled[MASKED] += 1
        pairs.masked_end[r] = min(filled[MASKED], len(masked))


@kernel(inline=True)
def _store_neighbors(pairs, block, c, scratch, count):
    """Store the neighbours of a cluster: the first of the candidates."""
    there = pairs.neighbors[block]
    origin_vector = pairs.origin_vector[block]
    filled = scratch.filled
    first = filled[NEIGHBORS]
    for n in range(count):
        other, image = cluster_of(scratch.candidate[n]), image_number(scratch.candidate[n])
        if first + n < len(there):
            there[first + n] = scratch.candidate[n]
            if len(origin_vector) > 0:
                for k in range(3):
                    origin_vector[3 * (first + n) + k] = _origin_vector(pairs, c, other, image, k)
        filled[WINDOW] = max(filled[WINDOW], behind_block(pairs.clusters.bounds, block, other) + 1)
    filled[NEIGHBORS] += count
    filled[NEIGHBORS_OF_ONE] = max(filled[NEIGHBORS_OF_ONE], count)
    pairs.neighbor_end[c] = min(filled[NEIGHBORS], len(there))


@kernel(inline=True)
def _sort_by_kind(pairs, c, scratch, count):
    """Write the entries of each row of a cluster by their kinds, by a counting sort. `kind_offset`
    then has the end of each kind. The rows are done together: while an entry of one row waits for
    the entry before it, the other rows proceed."""
    rows = lanes_of(pairs.clusters.local) // 2
    kind_offset, kind = scratch.kind_offset, scratch.kind
    kind_offset[:] = 0
    # 1. Count the entries of each kind.
    for n in range(count):
        for row in range(rows):
            kind_offset[row, load_scalar(kind, n * rows + row)] += 1
    # 2. From the counts, find the start of each kind.
    for row in range(rows):
        _first_of_kinds(pairs.beyond[rows * c + row], kind_offset[row])
    # 3. Write each entry at the offset of its kind, which moves from the start to the end.
    for n in range(count):
        for row in range(rows):
            k = load_scalar(kind, n * rows + row)
            scratch.sorted[row, kind_offset[row, k]] = n
            kind_offset[row, k] += 1


@kernel(inline=True)
def _first_of_kinds(beyond, kind_offset):
    """Replace the numbers of each kind in a row by their exclusive prefix sum, where the entries
    of each kind start. Store how many are beyond each shell. `beyond` is limited
    by its type: entries above the limit are treated as if they were inside the shell."""
    inside = 0
    for k in range(SHELLS):
        inside += kind_offset[k]
    begin = 0
    for k in range(KINDS):
        size = kind_offset[k]
        kind_offset[k] = begin
        begin += size
        if k < SHELLS:
            beyond[k] = min(inside - begin, MAX_BEYOND)


@kernel(inline=True)
def _find_kinds(pairs, c, scratch, candidates):
    """Reduce the candidates to those that a row of the cluster needs, and find their kinds. Returns
    their number. There are no unpredictable branches, so the processor works on several candidates
    at a time."""
    rows = lanes_of(pairs.clusters.local) // 2
    candidate, close = scratch.candidate, scratch.close
    last = len(pairs.clusters.origin) // 4 - 1  # the cluster that may have slots without a site
    count = close_count = 0
    for n in range(candidates):
        image = candidate[n]
        other = cluster_of(image)
        has_row, is_close = _find_kinds_of_candidate(pairs, c, scratch.kind, image, rows * count)
        candidate[count] = image
        close[close_count] = count
        count += has_row
        close_count += is_close | (other == c) | (other == last) | (c == last)
    for n in range(close_count):
        if close[n] < count:
            _mark_entries_to_mask(pairs, c, scratch.kind, candidate[close[n]], rows * close[n])
    return count


@kernel(inline=True)
def _find_kinds_of_candidate(pairs, c, kind, candidate, at):
    """Write the kind of a candidate in each row of a cluster, from kind[at] on, as if no entry
    needed a mask. Returns whether a row needs it, and whether some sites are as near as sites of
    one group can be. The sites of the cluster are the lanes, and the loop runs over the sites of
    the candidate: there are no sums across lanes."""
    clusters = pairs.clusters
    reference = clusters.reference
    width = lanes_of(reference)
    other, image = cluster_of(candidate), image_number(candidate)
    begin = 3 * width * c
    x = load(reference, begin) + _origin_vector(pairs, c, other, image, 0)
    y = load(reference, begin + width) + _origin_vector(pairs, c, other, image, 1)
    z = load(reference, begin + 2 * width) + _origin_vector(pairs, c, other, image, 2)
    # |x - y|²/2 = |x|²/2 - x y + |y|²/2: three multiply-adds for each y. Their rounding error,
    # bounded by |x|² + |y|², is subtracted. Two minima are independent of each other, which is
    # faster.
    one, two = broadcast(inf, reference), broadcast(inf, reference)
    for lane in range(0, width, 2):
        one = min(one, _half_square_less_product(clusters, other, lane, x, y, z))
        two = min(two, _half_square_less_product(clusters, other, lane + 1, x, y, z))
    nearest2 = 2.0 * min(one, two) + (x * x + y * y + z * z) * (1 - 0.1 * ROUNDING)
    kinds = broadcast(0.0, reference)
    if pairs.cutoff < inf:
        distance = square_root(max(pairwise_minimum(nearest2), 0.0))
        scale = pairs.shells_per_A
        # 1 to 2 in the first beyond
        shell = distance * (scale * (1 - ROUNDING)) + (1 - pairs.cutoff * scale)
        kinds = min(max(shell, 0.0), float(OUT_OF_REACH))
    store_even_lanes(kind, at, kinds)
    return mask_bits(kinds < float(OUT_OF_REACH)) != 0, mask_bits(nearest2 <= pairs.reach2) != 0


@kernel(inline=True)
def _half_square_less_product(clusters, other, lane, x, y, z):
    """|y|²/2 - x y for one site y of another cluster."""
    reference = clusters.reference
    width = lanes_of(reference)
    at = 3 * width * other + lane
    rest = load_broadcast(clusters.half_square, width * other + lane) - z * load_broadcast(
        reference, at + 2 * width
    )
    return rest - y * load_broadcast(reference, at + width) - x * load_broadcast(reference, at)


@kernel(inline=True)
def _mark_entries_to_mask(pairs, c, kind, candidate, at):
    """Set the kind of a candidate to NEEDS_MASK in the rows for which it needs a mask."""
    clusters = pairs.clusters
    width = lanes_of(clusters.local)
    other = cluster_of(candidate)
    last = len(clusters.origin) // 4 - 1
    all_lanes = (1 << width) - 1
    special = all_lanes
    if other != c and c != last and other != last:
        group = load_with_lanes_of(clusters.group, width * c, clusters.local)
        mates = group < group
        for lane in range(width):
            mates = mates | (group == clusters.group[width * other + lane])
        special = mask_bits(mates)
    for row in range(width // 2):
        # always written: no branch
        kind[at + row] = NEEDS_MASK if special >> 2 * row & 3 else kind[at + row]


@kernel(inline=True)
def _mask_of_lanes(pairs, i, candidate, radius2):
    """The sites of a candidate that interact with the site in slot i, as bits, 0 if none is inside
    the radius."""
    if i >= len(pairs.group):
        return 0
    clusters = pairs.clusters
    reference = clusters.reference
    width = lanes_of(reference)
    all_lanes = (1 << width) - 1
    c = i // width
    other = cluster_of(candidate)
    image = image_number(candidate)
    at = 2 * width * c + i
    start = 3 * width * other
    dx = reference[at] + _origin_vector(pairs, c, other, image, 0) - load(reference, start)
    dy = (
        reference[at + width]
        + _origin_vector(pairs, c, other, image, 1)
        - load(reference, start + width)
    )
    dz = (
        reference[at + 2 * width]
        + _origin_vector(pairs, c, other, image, 2)
        - load(reference, start + 2 * width)
    )
    left_out = mask_bits(
        load_with_lanes_of(clusters.group, width * other, reference) == clusters.group[i]
    )
    if other == c:
        left_out |= (2 << (i - width * c)) - 1  # each pair once
    if other == len(clusters.origin) // 4 - 1:
        # slots without a site
        left_out |= all_lanes ^ (all_lanes >> (len(clusters.order) - len(pairs.group)))
    meets = all_lanes & ~left_out
    return meets if mask_bits(dx * dx + dy * dy + dz * dz <= radius2) & meets else 0


@task(count_references=False)
def update_origin_vectors(arguments, block):
    """Recompute the vectors between origins of a block, for the images that have moved."""
    pairs = load_arguments(arguments)
    origin_vector = pairs.origin_vector[block]
    if len(origin_vector) == 0:
        return
    first = 0
    for c in range(pairs.clusters.bounds[block], pairs.clusters.bounds[block + 1]):
        for n in range(first, pairs.neighbor_end[c]):
            other, image = (
                cluster_of(pairs.neighbors[block, n]),
                image_number(pairs.neighbors[block, n]),
            )
            if image != 0:
                for k in range(3):
                    origin_vector[3 * n + k] = _origin_vector(pairs, c, other, image, k)
        first = pairs.neighbor_end[c]


@kernel(inline=True)
def _origin_vector(pairs, c, other, image, k):
    """Component k of the vector to the origin of cluster c from the image of another cluster's
    origin, Å."""
    clusters = pairs.clusters
    return clusters.origin[4 * c + k] - pairs.shift[4 * image + k] - clusters.origin[4 * other + k]
