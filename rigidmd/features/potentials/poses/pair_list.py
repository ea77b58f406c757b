"""The neighbour list of pairs of bodies.

Each pair is listed once. Every row of the list is sorted, so that sums do not depend on when it was
built, and its bits are not stored in checkpoints.
"""

from math import floor, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel, load_arguments, task
from rigidmd.core.state import CELL_CHANGED, LIST_FULL, NOT_FINITE, OK

#: Blocks in which pairs are summed, each into forces of its own.
BLOCKS = 16
#: Columns of `BodyPairList.counters`.
MUST_BUILD, BUILDS = 0, 1


class BodyPairList(NamedTuple):
    """Pairs of bodies whose reference points may be within the cutoff.

    Row i has the other bodies of its pairs, entries[b, first:end] with end = end[i] and first =
    end[i - 1], or 0 for the first body of block b. Body j > i is in row i if i + j is even, i is in
    row j otherwise: then rows are of one length.
    """

    skin: float  # Å
    point: np.ndarray  # (n, 3) reference points, lab frame, Å
    pose: np.ndarray  # (n, 3, 3) from the coordinates of the model's file to the lab
    built: np.ndarray  # (n, 3) those for which the list was built
    built_cell: np.ndarray  # (3, 3)
    bin: np.ndarray  # (n,) of each body
    order: np.ndarray  # (n,) bodies by their bins
    bin_first: np.ndarray  # (n + 2,) first index in `order` of each bin
    bins: np.ndarray  # (3,) numbers of bins along the edges
    end: np.ndarray  # (n,)
    entries: np.ndarray  # (blocks, capacity)
    needed: np.ndarray  # (blocks,) capacity that the last build needed
    counters: np.ndarray  # (2,) whether it has to be built; number of builds


def empty_list(bodies: int, skin: float) -> BodyPairList:
    """A list that has to be built."""
    return BodyPairList(
        skin=skin,
        point=np.zeros((bodies, 3)),
        pose=np.zeros((bodies, 3, 3)),
        built=np.zeros((bodies, 3)),
        built_cell=np.zeros((3, 3)),
        bin=np.zeros(bodies, np.int64),
        order=np.zeros(bodies, np.int64),
        bin_first=np.zeros(bodies + 2, np.int64),
        bins=np.ones(3, np.int64),
        end=np.zeros(bodies, np.int64),
        entries=np.zeros((BLOCKS, 64), np.int64),
        needed=np.zeros(BLOCKS, np.int64),
        counters=np.array([1, 0]),
    )


@kernel(inline=True)
def rows_of_block(bodies, block):
    return bodies * block // BLOCKS, bodies * (block + 1) // BLOCKS


@kernel(inline=True)
def nearest_image(cell, x, y, z):
    """The shortest image of a vector in a cell (3, 3) with a along x and b in the xy plane, Å; for
    vectors within half of the shortest edge."""
    if cell[2, 2] < inf:
        n = floor(z / cell[2, 2] + 0.5)
        x, y, z = x - n * cell[2, 0], y - n * cell[2, 1], z - n * cell[2, 2]
    if cell[1, 1] < inf:
        n = floor(y / cell[1, 1] + 0.5)
        x, y = x - n * cell[1, 0], y - n * cell[1, 1]
    if cell[0, 0] < inf:
        x -= floor(x / cell[0, 0] + 0.5) * cell[0, 0]
    return x, y, z


@kernel
def _is_valid(work, state):
    """Whether no pair that is not listed can be within the cutoff: bodies have moved by at most d
    in the cell of the build, which has been strained by at most e since, and (1 - e) (cutoff + skin
    - 2 d) is above the cutoff."""
    pairs, cell = work.pairs, state.cell
    cutoff = work.term.cutoff
    if pairs.counters[MUST_BUILD] != 0:
        return False
    if cutoff == inf:
        return True
    built = pairs.built_cell
    strain2 = 0.0
    periodic = cell[0, 0] < inf
    changed = False
    if periodic:
        for i in range(3):
            for k in range(3):
                changed |= built[i, k] != cell[i, k]
    if changed:
        # the strain maps edges of the build to present edges, row by row
        xx, yy, zz = cell[0, 0] / built[0, 0], cell[1, 1] / built[1, 1], cell[2, 2] / built[2, 2]
        xy = (cell[1, 0] - built[1, 0] * xx) / built[1, 1]
        yz = (cell[2, 1] - built[2, 1] * yy) / built[2, 2]
        xz = (cell[2, 0] - built[2, 0] * xx - built[2, 1] * xy) / built[2, 2]
        strain2 = (xx - 1) ** 2 + (yy - 1) ** 2 + (zz - 1) ** 2 + xy**2 + yz**2 + xz**2
    farthest2 = 0.0
    for m in range(len(pairs.point)):
        x, y, z = pairs.point[m, 0], pairs.point[m, 1], pairs.point[m, 2]
        if changed:
            c = z / cell[2, 2]
            b = (y - c * cell[2, 1]) / cell[1, 1]
            a = (x - b * cell[1, 0] - c * cell[2, 0]) / cell[0, 0]
            x = a * built[0, 0] + b * built[1, 0] + c * built[2, 0]
            y = b * built[1, 1] + c * built[2, 1]
            z = c * built[2, 2]
        x, y, z = x - pairs.built[m, 0], y - pairs.built[m, 1], z - pairs.built[m, 2]
        moved2 = x * x + y * y + z * z
        if not moved2 <= farthest2:
            farthest2 = moved2
            if moved2 != moved2:
                return False
    reach = (1 - sqrt(strain2)) * (cutoff + pairs.skin - 2 * sqrt(farthest2))
    return reach > cutoff


@task()
def sort_points(arguments, block):
    """Whether the list has to be built, and then the bins of its points."""
    work, state, status = load_arguments(arguments)
    pairs = work.pairs
    n = len(work.term.kind)
    if _is_valid(work, state):
        return
    pairs.counters[MUST_BUILD] = 1
    cell = state.cell
    if work.term.cutoff < inf and 2 * work.term.cutoff > min(cell[0, 0], cell[1, 1], cell[2, 2]):
        status[0] = CELL_CHANGED
        return
    for m in range(n):
        for k in range(3):
            if not abs(pairs.point[m, k]) < 1e150:
                status[0] = NOT_FINITE
                return
            pairs.built[m, k] = pairs.point[m, k]
    for i in range(3):
        for k in range(3):
            pairs.built_cell[i, k] = cell[i, k]
    low, high = _bounds(pairs.point, cell)
    _choose_bins(work, cell, low, high)
    bins = pairs.bins
    count = bins[0] * bins[1] * bins[2]
    for k in range(count + 1):
        pairs.bin_first[k] = 0
    for m in range(n):
        pairs.bin[m] = _bin_of(pairs.point[m], cell, low, high, bins)
        pairs.bin_first[pairs.bin[m] + 1] += 1
    for k in range(count):
        pairs.bin_first[k + 1] += pairs.bin_first[k]
    for m in range(n - 1, -1, -1):  # ends become starts
        pairs.bin_first[pairs.bin[m] + 1] -= 1
        pairs.order[pairs.bin_first[pairs.bin[m] + 1]] = m
    for k in range(count):
        pairs.bin_first[k] = pairs.bin_first[k + 1]
    pairs.bin_first[count] = n


@kernel(inline=True)
def _bounds(point, cell):
    """Range of fractions along the edges of a box, 0 to 1, or of positions without one."""
    if cell[0, 0] < inf:
        return (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    low, high = (inf, inf, inf), (-inf, -inf, -inf)
    for m in range(len(point)):
        x, y, z = point[m, 0], point[m, 1], point[m, 2]
        low = (min(low[0], x), min(low[1], y), min(low[2], z))
        high = (max(high[0], x), max(high[1], y), max(high[2], z))
    return low, high


@kernel
def _choose_bins(work, cell, low, high):
    """Bins at least as wide as the reach of the list, and no more than there are bodies."""
    bins = work.pairs.bins
    reach = work.term.cutoff + work.pairs.skin
    n = len(work.term.kind)
    for k in range(3):
        # the cell is close to right angles: edges along the axes are its widths but for its slant
        width = _width(cell, k) if cell[0, 0] < inf else high[k] - low[k]
        bins[k] = 1 if reach == inf else max(1, min(n, int(width / reach)))
    while bins[0] * bins[1] * bins[2] > max(n, 1):
        largest = 0
        for k in range(1, 3):
            if bins[k] > bins[largest]:
                largest = k
        bins[largest] -= 1


@kernel
def _width(cell, k):
    """Distance of the faces of a cell (3, 3) across edge k."""
    if k == 2:
        return cell[2, 2]
    if k == 1:
        return cell[1, 1] * cell[2, 2] / sqrt(cell[2, 2] ** 2 + cell[2, 1] ** 2)
    # b x c
    x = cell[1, 1] * cell[2, 2]
    y = -cell[1, 0] * cell[2, 2]
    z = cell[1, 0] * cell[2, 1] - cell[1, 1] * cell[2, 0]
    return cell[0, 0] * x / sqrt(x * x + y * y + z * z)


@kernel(inline=True)
def _bin_of(point, cell, low, high, bins):
    x, y, z = point[0], point[1], point[2]
    if cell[0, 0] < inf:
        c = z / cell[2, 2]
        b = (y - c * cell[2, 1]) / cell[1, 1]
        a = (x - b * cell[1, 0] - c * cell[2, 0]) / cell[0, 0]
        x, y, z = a - floor(a), b - floor(b), c - floor(c)
    i = _part_of(x, low[0], high[0], bins[0])
    j = _part_of(y, low[1], high[1], bins[1])
    return (i * bins[1] + j) * bins[2] + _part_of(z, low[2], high[2], bins[2])


@kernel(inline=True)
def _part_of(x, low, high, parts):
    if parts == 1:
        return 0
    return min(max(int((x - low) / (high - low) * parts), 0), parts - 1)


@task()
def list_pairs(arguments, block):
    """The rows of a block, if the list has to be built."""
    work, state = load_arguments(arguments)
    term, pairs, cell = work.term, work.pairs, state.cell
    if pairs.counters[MUST_BUILD] == 0:
        return
    bins, point = pairs.bins, pairs.point
    periodic = cell[0, 0] < inf
    reach2 = (term.cutoff + pairs.skin) ** 2
    entries = pairs.entries[block]
    capacity = pairs.entries.shape[1]
    first, last = rows_of_block(len(term.kind), block)
    count = 0
    for i in range(first, last):
        begin = count
        kind = term.kind[i]
        at = pairs.bin[i]
        z = at % bins[2]
        y = at // bins[2] % bins[1]
        x = at // bins[2] // bins[1]
        for dx in range(-1 if bins[0] > 2 else 0, 2 if bins[0] > 1 else 1):
            for dy in range(-1 if bins[1] > 2 else 0, 2 if bins[1] > 1 else 1):
                for dz in range(-1 if bins[2] > 2 else 0, 2 if bins[2] > 1 else 1):
                    other = (
                        _neighbour_bin(x, dx, bins[0], periodic),
                        _neighbour_bin(y, dy, bins[1], periodic),
                    )
                    layer = _neighbour_bin(z, dz, bins[2], periodic)
                    if kind < 0 or other[0] < 0 or other[1] < 0 or layer < 0:
                        continue
                    there = (other[0] * bins[1] + other[1]) * bins[2] + layer
                    for k in range(pairs.bin_first[there], pairs.bin_first[there + 1]):
                        j = pairs.order[k]
                        if i == j or (j > i) != ((i + j) % 2 == 0):
                            continue
                        if term.kind[j] < 0 or term.group[i] == term.group[j]:
                            continue
                        rx, ry, rz = nearest_image(
                            cell,
                            point[j, 0] - point[i, 0],
                            point[j, 1] - point[i, 1],
                            point[j, 2] - point[i, 2],
                        )
                        if rx * rx + ry * ry + rz * rz <= reach2:
                            if count < capacity:
                                entries[count] = j
                            count += 1
        if count <= capacity:
            entries[begin:count].sort()
        pairs.end[i] = count
    pairs.needed[block] = count


@kernel(inline=True)
def _neighbour_bin(at, step, count, periodic):
    """The neighbour of a bin; -1 for none. Two bins are each other's neighbour once."""
    other = at + step
    if periodic or count == 2:
        return other % count
    return other if 0 <= other < count else -1


@task()
def finish_list(arguments, block):
    work, status = load_arguments(arguments)
    pairs = work.pairs
    if pairs.counters[MUST_BUILD] == 0:
        return
    for b in range(BLOCKS):
        if pairs.needed[b] > pairs.entries.shape[1]:
            status[0] = LIST_FULL
    if status[0] == OK:
        pairs.counters[MUST_BUILD] = 0
        pairs.counters[BUILDS] += 1
