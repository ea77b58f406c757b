"""The rows of a neighbour list: which clusters go into which row and shell, and which of them need a mask."""

from math import ceil, inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import PAIR_FLAGS, kernel
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
)  # fmt: skip
from rigidmd.forces.pairs.lists import (
    ENTRIES,
    IMAGES,
    IMAGES_FOUND,
    MASK_BITS,
    MASKED,
    MET,
    MET_BY_ONE,
    MOST_BEYOND,
    ROUNDING,
    SHELLS,
    WINDOW,
    cluster_of,
    number_of,
)  # fmt: skip
from rigidmd.forces.pairs.tree import within_reach


class Scratch(NamedTuple):
    """Scratch arrays for the rows of one cluster."""

    stack: np.ndarray  # (levels, 2) for within_reach
    low: np.ndarray  # (3,) box of the cluster, moved by an image
    high: np.ndarray  # (3,)
    candidate: np.ndarray  # (room,) images of clusters that may be met, at last those that are
    shell: np.ndarray  # (room * lanes,) shell, not rounded, of entry n in the row of site i, at n * lanes + i
    end: np.ndarray  # (SHELLS,) end of each shell of a row
    inner: np.ndarray  # (rows of a cluster, room) entries of the first shell
    outer: np.ndarray  # (rows of a cluster, room) entries of the other shells
    special: np.ndarray  # (rows of a cluster, room) entries that need a mask
    count: np.ndarray  # (3, rows of a cluster) number in inner, outer, special of each row
    filled: np.ndarray  # (5,) of the block so far, see PairList.needed


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
        np.zeros(5, np.int64),
    )


@kernel(inline=True)
def fill_block(pairs, block, room):
    """Fill the rows of one block. Entries beyond the room are counted but not stored.

    Returns 0, or the room needed for candidates if it is too small; the rows are then incomplete.
    """
    clusters = pairs.clusters
    scratch = _scratch(pairs, room)
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        candidates = _find_candidates(pairs, c, scratch)
        if candidates > room:
            return 2 * candidates
        _fill_rows(pairs, block, c, scratch, candidates)
    for k in range(len(scratch.filled)):
        pairs.needed[block, k] = scratch.filled[k]
    return 0


@kernel(fastmath=PAIR_FLAGS, inline=True, counted=False)
def _find_candidates(pairs, c, scratch):
    """Candidates for a cluster's rows: clusters and images whose box is within reach of its box. Returns their number.

    The number may exceed the room.
    """
    tree = pairs.tree
    count = len(pairs.clusters.origin) // 4
    radius = (pairs.cutoff + pairs.skin) * (1 + ROUNDING)
    into = scratch.candidate
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
        found = within_reach(tree, scratch.low, scratch.high, radius * radius, c, count, scratch.stack, into, first)
        if found > len(into):
            return found
        for n in range(first, found):
            ahead = into[n] - c
            if ahead < 0:
                ahead += count
            if 2 * ahead < count or (2 * ahead == count and c < into[n]):
                into[candidates] = IMAGES * into[n] + image
                candidates += 1
    return candidates


@kernel(fastmath=PAIR_FLAGS, inline=True, counted=False)
def _fill_rows(pairs, block, c, scratch, candidates):
    """Fill the rows of a cluster from its candidates."""
    width = width_of(pairs.clusters.local)
    rows = width // 2
    masked, filled = pairs.masked[block], scratch.filled
    radius2 = ((pairs.cutoff + pairs.skin) * (1 + ROUNDING)) ** 2
    scratch.count[:] = 0
    met = 0
    for n in range(candidates):
        if _measure(pairs, c, scratch, scratch.candidate[n], met):
            scratch.candidate[met] = scratch.candidate[n]
            met += 1
    _meet(pairs, block, c, scratch, met)
    for own in range(rows):
        r = rows * c + own
        _fill_row(pairs.beyond[r], pairs.entries[block], scratch, own, width)
        pairs.row[r] = min(filled[ENTRIES], pairs.entries.shape[1])
        for n in range(scratch.count[2, own]):
            entry = scratch.special[own, n]
            first_of_row = _mask_of_lanes(pairs, 2 * r, scratch.candidate[entry], radius2)
            second = _mask_of_lanes(pairs, 2 * r + 1, scratch.candidate[entry], radius2)
            if first_of_row | second:
                if filled[MASKED] < len(masked):
                    masked[filled[MASKED], 0] = entry
                    masked[filled[MASKED], 1] = first_of_row | second << MASK_BITS
                filled[MASKED] += 1
        pairs.special[r] = min(filled[MASKED], len(masked))


@kernel(inline=True)
def _meet(pairs, block, c, scratch, met):
    """List what the rows of a cluster meet: the first of the candidates."""
    count = len(pairs.clusters.origin) // 4
    there, apart, filled = pairs.met[block], pairs.apart[block], scratch.filled
    first = filled[MET]
    for n in range(met):
        other, image = cluster_of(scratch.candidate[n]), number_of(scratch.candidate[n])
        if first + n < len(there):
            there[first + n] = scratch.candidate[n]
            if len(apart) > 0:
                for k in range(3):
                    apart[3 * (first + n) + k] = _apart(pairs, c, other, image, k)
        ahead = other - c
        if ahead < 0:
            ahead += count
        filled[WINDOW] = max(filled[WINDOW], min(ahead + c - pairs.clusters.bounds[block] + 1, count))
    filled[MET] += met
    filled[MET_BY_ONE] = max(filled[MET_BY_ONE], met)
    pairs.near[c] = min(filled[MET], len(there))


@kernel(inline=True)
def _fill_row(beyond, entries, scratch, own, width):
    """Write the entries of a row, shell by shell.

    `beyond` is limited by its type: entries above that limit count as if they were inside the shell.
    """
    inner, outer, end = scratch.inner[own], scratch.outer[own], scratch.end
    inners, outers = scratch.count[0, own], scratch.count[1, own]
    filled = scratch.filled[ENTRIES]
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
            entries[end[k]] = outer[n]
            end[k] += 1
    scratch.filled[ENTRIES] = last


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _measure(pairs, c, scratch, candidate, n):
    """Add a candidate, as entry n, to a shell of each row of a cluster, or to the entries that need a mask.

    Returns whether a row has it.

    The sites of the cluster are the lanes, and the loop runs over the candidate's sites: there are no sums across lanes
    and no unpredictable branches.
    """
    clusters = pairs.clusters
    local = clusters.local
    width = width_of(local)
    count = len(clusters.origin) // 4
    other, image = cluster_of(candidate), number_of(candidate)
    at = 3 * width * c
    x = load(local, at) + _apart(pairs, c, other, image, 0)
    y = load(local, at + width) + _apart(pairs, c, other, image, 1)
    z = load(local, at + 2 * width) + _apart(pairs, c, other, image, 2)
    # |x|² - 2 x y + |y|²: three multiply-adds for each y. Their rounding error, bounded by |x|² + |y|², is subtracted.
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
    _append(scratch.inner, scratch.count, 0, n, inner, width)
    _append(scratch.outer, scratch.count, 1, n, outer, width)
    if special != 0:
        _append(scratch.special, scratch.count, 2, n, special, width)
    return inner | outer | special != 0


@kernel(inline=True)
def _append(rows, count, k, value, which, width):
    """Append a value to the lists of some rows of a cluster, without branches: half of them would be mispredicted."""
    for own in range(width // 2):
        rows[own, count[k, own]] = value
        count[k, own] += which >> 2 * own & 1


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _mask_of_lanes(pairs, i, candidate, radius2):
    """The sites of a candidate that interact with site i, as bits; 0 if none is inside the radius."""
    if i >= len(pairs.group):
        return 0
    clusters = pairs.clusters
    local = clusters.local
    width = width_of(local)
    everyone = (1 << width) - 1
    c, other, image = i // width, cluster_of(candidate), number_of(candidate)
    at = 2 * width * c + i
    start = 3 * width * other
    dx = local[at] + _apart(pairs, c, other, image, 0) - load(local, start)
    dy = local[at + width] + _apart(pairs, c, other, image, 1) - load(local, start + width)
    dz = local[at + 2 * width] + _apart(pairs, c, other, image, 2) - load(local, start + 2 * width)
    left_out = bits(load_beside(clusters.group, width * other, local) == clusters.group[i])
    if other == c:
        left_out |= (2 << (i - width * c)) - 1  # each pair once
    if other == len(clusters.origin) // 4 - 1:
        left_out |= everyone ^ (everyone >> _filler(pairs))
    meets = everyone & ~left_out
    return meets if bits(dx * dx + dy * dy + dz * dz <= radius2) & meets else 0


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _apart(pairs, c, other, image, k):
    """Component k of the vector from the image of another cluster's origin to the origin of cluster c, Å."""
    clusters = pairs.clusters
    return clusters.origin[4 * c + k] - pairs.shift[4 * image + k] - clusters.origin[4 * other + k]


@kernel(inline=True)
def _filler(pairs):
    """Number of slots in the last cluster that hold no site."""
    return len(pairs.clusters.order) - len(pairs.group)
