"""Forces between pairs of bodies from an energy of their relative position and orientations: the
term, its neighbour list and its loop.

A formula is a NamedTuple class with an `@implements(pair_slopes)`, which `formulas` writes. Each
pair is listed once. Every row of the list is sorted, so that sums do not depend on when it was
built, and its bits are not stored in checkpoints.
"""

from math import floor, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, kernel, load_arguments, task
from rigidmd.core.state import CELL_CHANGED, LIST_FULL, NOT_FINITE, OK, TALLY_SIZE
from rigidmd.errors import SimulationError
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.forces.terms import FORCES_ONLY, TALLIED, Evaluation, Setup
from rigidmd.mechanics.translation import body_vector, lab_vector

#: Blocks in which pairs are summed, each into forces of its own.
BLOCKS = 16
#: Columns of `BodyPairList.counters`.
MUST_BUILD, BUILDS = 0, 1
#: The skin is at most this fraction of the cutoff.
LONGEST_SKIN = 0.5


class BodyPairs(NamedTuple):
    """U = sum over pairs of bodies of a formula of their relative pose."""

    formula: NamedTuple  # its class chooses the code
    kind: np.ndarray  # (n,) int64 kind of each body; -1 for one that takes no part
    group: np.ndarray  # (n,) int64 bodies of one group do not interact
    reference: np.ndarray  # (kinds, 3) reference point from the centre of mass, body frame, Å
    frame: np.ndarray  # (kinds, 3, 3) from the coordinates of the model's file to the body frame
    parameters: np.ndarray  # (kinds, kinds, parameters) of the first kind with the second
    switch_start: float  # Å, where the energy begins to be switched to 0; `cutoff` for a jump
    cutoff: float  # Å, between reference points

    changes_momentum = (False, False, False)

    def workspace(self, setup: Setup) -> "BodyPairsWorkspace":
        n = len(self.kind)
        pairs = BodyPairList(
            skin=min(setup.skin, LONGEST_SKIN * self.cutoff),
            point=np.zeros((n, 3)),
            pose=np.zeros((n, 3, 3)),
            built=np.zeros((n, 3)),
            built_cell=np.zeros((3, 3)),
            bin=np.zeros(n, np.int64),
            order=np.zeros(n, np.int64),
            bin_first=np.zeros(n + 2, np.int64),
            bins=np.ones(3, np.int64),
            end=np.zeros(n, np.int64),
            entries=np.zeros((BLOCKS, 64), np.int64),
            needed=np.zeros(BLOCKS, np.int64),
            counters=np.array([1, 0]),
        )
        loads = np.zeros((BLOCKS, n, 6))
        return BodyPairsWorkspace(self, pairs, loads, np.zeros((BLOCKS, TALLY_SIZE)))


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


class BodyPairsWorkspace(NamedTuple):
    term: BodyPairs
    pairs: BodyPairList
    loads: np.ndarray  # (blocks, n, 6) forces on reference points and torques, lab frame
    tallies: np.ndarray  # (blocks, 10)

    def passes(self, into: Evaluation) -> list[Pass]:
        """Reference points; the list; pairs; sums on bodies."""
        blocks = blocks_of(len(self.term.kind))
        plain, tallied = (self, into.state, None), (self, into.state, self.tallies)
        return [
            Pass("reference points of bodies", _place_points, (self, into.state), blocks),
            Pass("whether the list is valid", _sort_points, (self, into.state, into.status)),
            Pass("pairs of bodies, if it is not", _list_pairs, (self, into.state), BLOCKS),
            Pass("whether they fit in memory", _finish_list, (self, into.status)),
            Pass("forces of pairs of bodies", _add_pairs, plain, BLOCKS, FORCES_ONLY),
            Pass("forces and energies of pairs of bodies", _add_pairs, tallied, BLOCKS, TALLIED),
            Pass("sum forces on bodies", _sum_loads, (self, into.state, into.load), blocks),
            Pass("sum energies", _sum_tallies, (self, into.tally), when=TALLIED),
        ]

    def with_capacity(self, cell: np.ndarray) -> "BodyPairsWorkspace":
        if 2 * self.term.cutoff > cell.diagonal().min():
            raise SimulationError(
                f"the box has become too small for the cutoff of {self.term.cutoff:g} Å: half its"
                f" smallest edge is {cell.diagonal().min() / 2:.4g} Å. Begin with a larger box, or"
                " take a shorter cutoff"
            )
        capacity = int(1.1 * self.pairs.needed.max()) + 64
        if capacity <= self.pairs.entries.shape[1]:
            return self
        pairs = self.pairs._replace(entries=np.zeros((BLOCKS, capacity), np.int64))
        pairs.counters[MUST_BUILD] = 1
        return self._replace(pairs=pairs)


def pair_slopes(formula, p, r, a, b):
    """Energy of a pair, its slopes (3,) by r, and the torques (3,) on both bodies; lab frame, u
    Å²/ps².

    p : (parameters,). r : vector (3,) between the reference points, Å. a, b : rotation matrices (3,
        3)
    """
    raise TypeError(f"{type(formula).__name__} is not a formula of two poses")


@kernel(inline=True)
def _rows_of_block(bodies, block):
    return bodies * block // BLOCKS, bodies * (block + 1) // BLOCKS


@task()
def _place_points(arguments, block):
    work, state = load_arguments(arguments)
    first, end = molecules_of_block(len(work.term.kind), block, 1)
    for m in range(first, end):
        x = y = z = 0.0
        kind = work.term.kind[m]
        if kind >= 0:
            offset = work.term.reference[kind]
            x, y, z = lab_vector(state.rotation[m], offset[0], offset[1], offset[2])
            frame = work.term.frame[kind]
            for k in range(3):
                column = lab_vector(state.rotation[m], frame[0, k], frame[1, k], frame[2, k])
                for i in range(3):
                    work.pairs.pose[m, i, k] = column[i]
        work.pairs.point[m, 0] = state.position[m, 0] + x
        work.pairs.point[m, 1] = state.position[m, 1] + y
        work.pairs.point[m, 2] = state.position[m, 2] + z


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
    built, strain2 = pairs.built_cell, 0.0
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
def _sort_points(arguments, block):
    """Whether the list has to be built, and then the bins of its points."""
    work, state, status = load_arguments(arguments)
    pairs, n = work.pairs, len(work.term.kind)
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
    """Range of fractions along the box edges, 0 to 1, or without a box the range of positions."""
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
    bins, reach = work.pairs.bins, work.term.cutoff + work.pairs.skin
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
def _list_pairs(arguments, block):
    """The rows of a block, if the list has to be built."""
    work, state = load_arguments(arguments)
    term, pairs, cell = work.term, work.pairs, state.cell
    if pairs.counters[MUST_BUILD] == 0:
        return
    bins, point = pairs.bins, pairs.point
    periodic = cell[0, 0] < inf
    reach2 = (term.cutoff + pairs.skin) ** 2
    entries, capacity = pairs.entries[block], pairs.entries.shape[1]
    first, last = _rows_of_block(len(term.kind), block)
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
def _finish_list(arguments, block):
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


@kernel(inline=True)
def _switch(term, r):
    """Factor of the energy at a distance, and its slope: 1 up to `switch_start`, from there a
    polynomial of degree 5 with two continuous derivatives to 0 at the cutoff."""
    if r <= term.switch_start:
        return 1.0, 0.0
    width = term.cutoff - term.switch_start
    x = (r - term.switch_start) / width
    return 1 - x**3 * (10 - 15 * x + 6 * x * x), -30 * (x * (1 - x)) ** 2 / width


@task()
def _add_pairs(arguments, block):
    work, state, tallies = load_arguments(arguments)
    _pairs_of_block(work, state, tallies, block)


@kernel(inline=True)
def _pairs_of_block(work, state, tallies, block):
    """Forces and torques into the loads of a block, energy and virial into its tally."""
    term, pairs, cell = work.term, work.pairs, state.cell
    load, entries, point = work.loads[block], pairs.entries[block], pairs.point
    first, last = _rows_of_block(len(term.kind), block)
    for m in range(len(load)):
        for k in range(6):
            load[m, k] = 0.0
    if tallies is not None:
        tallies[block] = 0.0
    n = 0
    for i in range(first, last):
        while n < pairs.end[i]:
            j = entries[n]
            n += 1
            x, y, z = nearest_image(
                cell,
                point[j, 0] - point[i, 0],
                point[j, 1] - point[i, 1],
                point[j, 2] - point[i, 2],
            )
            r = sqrt(x * x + y * y + z * z)
            if r >= term.cutoff:
                continue
            # the kind that is named first is the first body, so that a pair has one energy
            if term.kind[i] <= term.kind[j]:
                one, other = i, j
            else:
                one, other = j, i
                x, y, z = -x, -y, -z
            energy, slope, torque, torque_of_other = pair_slopes(
                term.formula,
                term.parameters[term.kind[one], term.kind[other]],
                (x, y, z),
                pairs.pose[one],
                pairs.pose[other],
            )
            factor, change = _switch(term, r)
            along = change * energy / r
            force = (
                factor * slope[0] + along * x,
                factor * slope[1] + along * y,
                factor * slope[2] + along * z,
            )
            for k in range(3):
                load[one, k] += force[k]
                load[other, k] -= force[k]
                load[one, 3 + k] += factor * torque[k]
                load[other, 3 + k] += factor * torque_of_other[k]
            if tallies is not None:
                tally = tallies[block]
                tally[0] += factor * energy
                # between centres of mass: F on the other body (x) its position from the first
                centre = (
                    x
                    - (point[other, 0] - state.position[other, 0])
                    + (point[one, 0] - state.position[one, 0]),
                    y
                    - (point[other, 1] - state.position[other, 1])
                    + (point[one, 1] - state.position[one, 1]),
                    z
                    - (point[other, 2] - state.position[other, 2])
                    + (point[one, 2] - state.position[one, 2]),
                )
                for k in range(3):
                    for component in range(3):
                        tally[1 + 3 * k + component] -= force[k] * centre[component]


@task()
def _sum_loads(arguments, block):
    """Forces on reference points and torques as forces on centres of mass and torques about
    them."""
    work, state, load = load_arguments(arguments)
    term, loads = work.term, work.loads
    first, end = molecules_of_block(len(term.kind), block, 1)
    for m in range(first, end):
        kind = term.kind[m]
        if kind < 0:
            continue
        fx = fy = fz = tx = ty = tz = 0.0
        for b in range(BLOCKS):
            fx += loads[b, m, 0]
            fy += loads[b, m, 1]
            fz += loads[b, m, 2]
            tx += loads[b, m, 3]
            ty += loads[b, m, 4]
            tz += loads[b, m, 5]
        load.force[m, 0] += fx
        load.force[m, 1] += fy
        load.force[m, 2] += fz
        if len(load.torque_body) == 0:
            continue
        ux, uy, uz = body_vector(state.rotation[m], (fx, fy, fz))
        vx, vy, vz = body_vector(state.rotation[m], (tx, ty, tz))
        x, y, z = term.reference[kind, 0], term.reference[kind, 1], term.reference[kind, 2]
        load.torque_body[m, 0] += vx + y * uz - z * uy
        load.torque_body[m, 1] += vy + z * ux - x * uz
        load.torque_body[m, 2] += vz + x * uy - y * ux


@task()
def _sum_tallies(arguments, block):
    work, tally = load_arguments(arguments)
    for b in range(BLOCKS):
        for k in range(len(tally)):
            tally[k] += work.tallies[b, k]
