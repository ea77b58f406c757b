"""Neighbour lists: for each site of one law the clusters that may hold a site inside its cut-off.

A list is good until any site has moved more than half the skin since it was built, whether its body shifted or turned.
That is checked at every force evaluation, before the list is used, so no pair is ever missed. In each row the clusters
stand in shells by their distance, and what sites have moved so far says how many shells can matter: a new list is
worked through as if it had no skin.

Each pair of clusters stands in one of its two rows: that of the one behind, clusters being thought of as a ring. The
list is cut into blocks of rows, filled by whichever thread takes them, so the list and everything summed from it has the
same bits for any number of threads.
"""

from math import ceil, inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import prange

from rigidmd.forces.boxes import box_tree, within_reach
from rigidmd.forces.clusters import Clusters, clusters_of, follow, sort_into_clusters
from rigidmd.forces.lanes import bits, larger, load, load_beside, lowest_bit, smallest, width_of
from rigidmd.forces.space import Space
from rigidmd.forces.terms import LIST_FULL, NOT_FINITE, OK
from rigidmd.jit import PAIR_FLAGS, kernel, opened, packed

SHELLS = 5  # the first holds what is inside the cut-off when the list is built, the others a quarter of the skin each
LOST = 1e12  # list radii from the origin: there a float64 has no digits left for where in its box a site is
ROUNDING = 1e-5  # relative; float32 distances are good to 1e-6


class PairList(NamedTuple):
    """Rows of clusters for the sites of one law.

    An entry is 32 * cluster + image, the image one of 27 (-1, 0, 1 boxes along x, y, z).
    """

    cutoff: float  # Å
    skin: float  # Å
    group: np.ndarray  # (s,) pairs inside one group are left out
    clusters: Clusters
    shift: np.ndarray  # (4 * 27,) x, y, z, 0 of each image, Å
    row: np.ndarray  # (slots, SHELLS + 1) shell k of slot i: entries[b, row[i, k]:row[i, k + 1]]
    entries: np.ndarray  # (blocks, capacity) int32
    special: np.ndarray  # (slots, 2) entries with a mask: masked[b, special[i, 0]:special[i, 1]]
    masked: np.ndarray  # (blocks, capacity, 2) entry, and as bits the lanes that count
    needed: np.ndarray  # (blocks, 3) room the last build asked for: entries, masked entries, window
    counters: np.ndarray  # (3,) usable (0 or 1); builds so far; shells that matter now


def empty_list(space: Space, group: np.ndarray, cutoff: float, skin: float, dtype: type) -> PairList:
    """A list that will be built at its first use, which finds out how much room it needs."""
    clusters = clusters_of(len(group), dtype)
    blocks, slots = len(clusters.moved2), len(clusters.order)
    return PairList(
        cutoff=cutoff,
        skin=min(skin, 0.5 * min(space)) if cutoff < inf else inf,  # else second images could come near between builds
        group=group,
        clusters=clusters,
        shift=np.zeros(4 * 27),
        row=np.zeros((slots, SHELLS + 1), np.int32),
        entries=np.empty((blocks, 0), np.int32),
        special=np.zeros((slots, 2), np.int32),
        masked=np.empty((blocks, 0, 2), np.int32),
        needed=np.zeros((blocks, 3), np.int64),
        counters=np.zeros(3, np.int64),
    )


def enlarged(pairs: PairList) -> PairList:
    """The same list with the room its last build asked for, and a tenth more."""
    entries, masked, _ = (int(1.1 * n) + 16 for n in pairs.needed.max(axis=0))
    blocks = len(pairs.needed)
    return pairs._replace(
        entries=np.empty((blocks, entries), np.int32), masked=np.empty((blocks, masked, 2), np.int32)
    )


@kernel
def update_list(pairs, space, position):
    """Bring clusters to the site positions (s, 3), and build the list anew if it is no longer good. A status code."""
    if pairs.counters[0] == 1:
        moved2 = follow(pairs.clusters, position, (0.5 * pairs.skin) ** 2)
        if moved2 < inf:
            pairs.counters[2] = 1 + ceil(2 * sqrt(moved2) * (SHELLS - 1) / pairs.skin)
            return OK
    pairs.counters[0] = 0
    radius = pairs.cutoff + pairs.skin
    for x in position.flat:
        if not abs(x) < LOST * radius:
            return NOT_FINITE
    sort_into_clusters(pairs.clusters, space, position, pairs.group)
    for image in range(27):
        for k, length in enumerate((space.x, space.y, space.z)):
            boxes = image // 3 ** (2 - k) % 3 - 1
            pairs.shift[4 * image + k] = boxes * length if boxes != 0 else 0.0
    tree = box_tree(pairs.clusters)
    if len(pairs.needed) == 1:
        _fill_block(pairs, space, tree, 0)
    else:
        _fill_threaded(packed((pairs, space, tree)), len(pairs.needed))
    if pairs.needed[:, 0].max() > pairs.entries.shape[1] or pairs.needed[:, 1].max() > pairs.masked.shape[1]:
        return LIST_FULL
    pairs.counters[2] = 1
    pairs.counters[0] = 1
    pairs.counters[1] += 1
    return OK


@kernel(parallel=True)
def _fill_threaded(parcel, blocks):
    for block in prange(blocks):
        _fill_block(*opened(parcel), block)


@kernel(fastmath=PAIR_FLAGS)
def _fill_block(pairs, space, tree, block):
    """Rows of one block. Entries beyond the room are counted, not stored."""
    clusters = pairs.clusters
    width = width_of(clusters.local)
    everyone = (1 << width) - 1
    count = len(clusters.origin) // 4
    radius = (pairs.cutoff + pairs.skin) * (1 + ROUNDING)
    bounds2 = np.empty(SHELLS)
    for k in range(SHELLS):
        bounds2[k] = ((pairs.cutoff + k * pairs.skin / (SHELLS - 1)) * (1 + ROUNDING)) ** 2
    entries, masked = pairs.entries[block], pairs.masked[block]
    filled = filled_masked = window = 0
    room = min(27 * count, 1024)
    found, candidate = np.empty(room, np.int64), np.empty(room, np.int64)
    near = np.empty((6, room + width), clusters.local.dtype)
    apart = np.empty((3, room), clusters.local.dtype)
    row, shell = np.empty(room, np.int64), np.empty(room, np.int64)
    stack = np.empty((len(tree.level), 2), np.int64)
    low, high = np.empty(3), np.empty(3)
    filler = len(clusters.order) - len(pairs.group)  # slots of the last cluster that hold no site
    for c in range(pairs.clusters.bounds[block], pairs.clusters.bounds[block + 1]):
        candidates = 0
        for image in range(27):
            if not _reaches(space, tree, c, image, radius):
                continue
            for k in range(3):
                low[k] = tree.low[k, c] - pairs.shift[4 * image + k]
                high[k] = tree.high[k, c] - pairs.shift[4 * image + k]
            hits = within_reach(tree, low, high, radius * radius, stack, found, 0)
            if hits > len(found):
                found = np.empty(2 * hits, np.int64)
                hits = within_reach(tree, low, high, radius * radius, stack, found, 0)
            if candidates + hits > len(candidate):
                grown = 2 * (candidates + hits)
                before, candidate = candidate, np.empty(grown, np.int64)
                candidate[: len(before)] = before
                near = np.empty((6, grown + width), clusters.local.dtype)
                apart = np.empty((3, grown), clusters.local.dtype)
                row, shell = np.empty(grown, np.int64), np.empty(grown, np.int64)
            for k in range(hits):
                ahead = found[k] - c
                if ahead < 0:
                    ahead += count
                if 2 * ahead < count or 2 * ahead == count and c < found[k]:
                    candidate[candidates] = 32 * found[k] + image
                    candidates += 1
        for n in range(candidates):
            other, image = candidate[n] >> 5, candidate[n] & 31
            for k in range(3):
                offset = pairs.shift[4 * image + k] - clusters.origin[4 * c + k]
                near[k, n] = tree.low[k, other] + offset
                near[3 + k, n] = tree.high[k, other] + offset
                apart[k, n] = -offset - clusters.origin[4 * other + k]
        for own in range(width):
            i = width * c + own
            first = min(filled, len(entries))
            special = min(filled_masked, len(masked))
            in_row = 0
            if i < len(pairs.group):
                x = clusters.local[3 * width * c + own]
                y = clusters.local[3 * width * c + own + width]
                z = clusters.local[3 * width * c + own + 2 * width]
                for n0 in range(0, candidates, width):
                    dx = larger(larger(load(near[0], n0) - x, x - load(near[3], n0)), 0.0)
                    dy = larger(larger(load(near[1], n0) - y, y - load(near[4], n0)), 0.0)
                    dz = larger(larger(load(near[2], n0) - z, z - load(near[5], n0)), 0.0)
                    close = bits(dx * dx + dy * dy + dz * dz < radius * radius)
                    if candidates - n0 < width:
                        close &= (1 << (candidates - n0)) - 1
                    while close != 0:
                        n = n0 + lowest_bit(close)
                        close &= close - 1
                        other = candidate[n] >> 5
                        at = 3 * width * other
                        dx = x + apart[0, n] - load(clusters.local, at)
                        dy = y + apart[1, n] - load(clusters.local, at + width)
                        dz = z + apart[2, n] - load(clusters.local, at + 2 * width)
                        r2 = dx * dx + dy * dy + dz * dz
                        inside = bits(r2 < radius * radius)
                        if inside == 0:
                            continue
                        same = load_beside(clusters.group, width * other, clusters.local) == clusters.group[i]
                        left_out = bits(same)
                        if other == c:
                            left_out |= (1 << (own + 1)) - 1
                        if other == count - 1:
                            left_out |= everyone ^ (everyone >> filler)
                        if left_out == 0:
                            row[in_row] = candidate[n]
                            m = smallest(r2)
                            k = 0
                            while k < SHELLS - 1 and m > bounds2[k]:
                                k += 1
                            shell[in_row] = k
                            in_row += 1
                        elif inside & ~left_out:
                            if filled_masked < len(masked):
                                masked[filled_masked, 0] = candidate[n]
                                masked[filled_masked, 1] = everyone & ~left_out
                            filled_masked += 1
                        else:
                            continue
                        ahead = other - pairs.clusters.bounds[block]
                        window = max(window, ahead + count if ahead < 0 else ahead)
            pairs.special[i, 0] = special
            pairs.special[i, 1] = min(filled_masked, len(masked))
            pairs.row[i, 0] = first
            for k in range(SHELLS):
                for n in range(in_row):
                    if shell[n] == k:
                        if filled < len(entries):
                            entries[filled] = row[n]
                        filled += 1
                pairs.row[i, k + 1] = min(filled, len(entries))
    pairs.needed[block, 0] = filled
    pairs.needed[block, 1] = filled_masked
    pairs.needed[block, 2] = window + 1


@kernel(inline=True)
def _reaches(space, tree, c, image, radius):
    """Whether a cluster, moved by an image, can come near anything at all."""
    root = tree.level[-2]
    lengths = (space.x, space.y, space.z)
    for k in range(3):
        boxes = image // 3 ** (2 - k) % 3 - 1
        if boxes != 0:
            if lengths[k] == inf:
                return False
            low = tree.low[k, root:].min()
            high = tree.high[k, root:].max()
            if tree.low[k, c] - boxes * lengths[k] > high + radius or tree.high[k, c] - boxes * lengths[k] < low - radius:
                return False
    return True
