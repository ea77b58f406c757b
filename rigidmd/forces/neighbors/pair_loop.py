"""Forces between pairs of sites: the one loop for every pair potential. It finds the pairs and
their images, sums energies, virial and forces, and adds the forces to the bodies. A potential is an
`@implements(pair)` for its NamedTuple, which puts its numbers for each site into the order of the
slots (`arrange`)."""

from math import inf, nan
from typing import NamedTuple

import numpy as np
from numba import types

from rigidmd.compile import BoundTask, Code, Pass, chosen_by_type, kernel, load_arguments, task
from rigidmd.compile.simd import (
    add_lane_sums,
    align_stack,
    broadcast,
    convert_to,
    extract_lane,
    lane_count,
    lanes_of,
    load,
    load_broadcast,
    load_four,
    load_scalar,
    mask_from_bits,
    select,
    store,
    sum_lanes,
    to_double,
    zeros,
)
from rigidmd.core.state import LIST_FULL, OK, TALLY_SIZE
from rigidmd.forces.neighbors import lists
from rigidmd.forces.neighbors.clusters import BUILT
from rigidmd.forces.neighbors.lists import (
    BUILDS,
    MASK_BITS,
    STATUS,
    USABLE,
    WINDOW,
    PairList,
    behind_block,
    cluster_of,
    empty_list,
    end_of_row,
    image_number,
    largest_displacement,
    most_needed,
)
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    InSlots,
    load_pass,
    sum_passes,
    virial_buffer,
)
from rigidmd.forces.neighbors.update import list_code, list_passes, refill
from rigidmd.forces.terms import (
    FORCES_ONLY,
    TALLIED,
    WITH_ENERGIES,
    WITH_VIRIALS,
    Evaluation,
    Setup,
    TermPasses,
    trait,
)


class PairSums(NamedTuple):
    # (3 slots,) on each site, from the rows of its block, then from all; as Clusters.local
    forces: np.ndarray
    # (blocks, capacity) forces from the rows of a block on the clusters behind it
    forces_behind: np.ndarray
    # (blocks, 3 lanes) force on a row at the last change of image, see `_change_image`
    force_at_change: np.ndarray
    tallies: np.ndarray  # (blocks, 10)
    virial: np.ndarray  # see `virial_buffer`
    # (1,) the build of the list for which the numbers of the potential are in the slots
    arranged: np.ndarray


class PairForces(NamedTuple):
    """A pair potential between sites."""

    potential: NamedTuple  # its arrays are in the order of the sites
    sites: BodySites | CentralSites
    group: np.ndarray  # (s,) sites of one group do not interact

    @property
    def acts_on_charges(self) -> bool:
        """Whether its potential is an interaction of charges."""
        return trait(self.potential, "acts_on_charges")

    def workspace(self, setup: Setup) -> "PairWorkspace":
        potential, sites = self.potential, self.sites
        reach = _diameter(sites) if np.array_equal(self.group, sites.molecule) else inf
        pairs = empty_list(setup.cell, self.group, reach, potential.cutoff, setup.skin, setup.dtype)
        blocks = len(pairs.needed)
        slots = len(pairs.clusters.order)
        sums = PairSums(
            forces=pairs.clusters.scratch,  # no list is built while forces are summed
            forces_behind=_buffer_behind(pairs, blocks, int(pairs.needed[:, WINDOW].max())),
            force_at_change=zeros((blocks, 3 * lane_count(setup.dtype)), setup.dtype),
            tallies=np.zeros((blocks, TALLY_SIZE)),
            virial=virial_buffer(),
            arranged=np.zeros(1, np.int64),
        )
        of_slots = potential.for_slots(slots, setup.dtype)
        return PairWorkspace(potential, of_slots, sites, pairs, sums, setup.needs_virials)


class PairWorkspace(NamedTuple):
    potential: NamedTuple
    # the numbers of the potential in the order of slots, in the precision of the loop
    slot_potential: NamedTuple
    sites: BodySites | CentralSites
    pairs: PairList
    sums: PairSums
    needs_virials: bool  # whether there is code for virials without energies
    list_code: Code | None = None

    @property
    def site_force(self) -> np.ndarray:
        """Forces (s, 3) on its sites as last evaluated, lab frame, u Å/ps²."""
        return self.forces_in_slots.of_sites()

    @property
    def forces_in_slots(self) -> InSlots:
        """Forces on its sites as last evaluated, in slots."""
        return InSlots(self.sums.forces, self.pairs.clusters.slot)

    def with_code(self) -> "PairWorkspace":
        return self._replace(list_code=list_code(self.pairs, self.sites))

    def passes(self, into: Evaluation) -> TermPasses:
        """Update of the list. Forces of rows, with what else is needed. Their sums on sites and
        molecules."""
        pairs = self.pairs
        sums = self.sums
        sites = self.sites
        tallies = self.sums.tallies
        blocks = len(tallies)
        content = (self.slot_potential, pairs, sums)
        numbers = (self.potential, self.slot_potential, pairs, sums, into.status)
        of_list = list_passes(pairs, self.list_code, sites, into)
        arrange = Pass("numbers of sites in its order, if it is new", _arrange_numbers, numbers)
        passes = [Pass("forces of pairs", _sum_forces, (*content, None, None), blocks, FORCES_ONLY)]
        energies = (*content, tallies, tallies)
        virials = (*content, tallies, None)
        when = WITH_ENERGIES if self.needs_virials else TALLIED
        passes.append(Pass("forces and energies of pairs", _sum_forces, energies, blocks, when))
        if self.needs_virials:
            passes.append(
                Pass("forces and virials of pairs", _sum_forces, virials, blocks, WITH_VIRIALS)
            )
        passes += [
            Pass("sum forces on sites", _gather_forces, (pairs, sums, None), blocks, FORCES_ONLY),
            Pass("sum forces on sites", _gather_forces, (pairs, sums, tallies), blocks, TALLIED),
        ]
        of_sums = sum_passes(sites, into, self.forces_in_slots, sums)
        return of_list._replace(
            lists=[*of_list.lists, arrange],
            forces=passes + of_sums,
            loads=[load_pass(sites, into, self.forces_in_slots)],
        )

    def with_capacity(self, cell: np.ndarray) -> "PairWorkspace":
        """With the capacity that the last build of the list needed."""
        pairs = lists.with_capacity(self.pairs, cell)
        forces_behind = self.sums.forces_behind
        clusters = int(pairs.needed[:, WINDOW].max())
        if 3 * lane_count(forces_behind.dtype) * clusters > forces_behind.shape[1]:
            forces_behind = _buffer_behind(pairs, len(forces_behind), int(1.1 * clusters) + 1)
        return self._replace(pairs=pairs, sums=self.sums._replace(forces_behind=forces_behind))

    def renew_list(self) -> None:
        self.pairs.counters[USABLE], self.pairs.times[BUILT] = 0, nan

    def checkpoint_arrays(self) -> dict[str, np.ndarray]:
        return lists.checkpoint_arrays(self.pairs)

    def restore(self, arrays: dict[str, np.ndarray], skin: float) -> "PairWorkspace":
        """With the list of a checkpoint. Needs machine code. Raises ValueError if the arrays do not
        fit this term."""
        restored = self._replace(pairs=lists.restored(self.pairs, arrays, skin))
        while "order" in arrays and restored._refill() != OK:
            restored = restored.with_capacity(restored.pairs.cell)
        return restored

    def _refill(self) -> int:
        """Build the list again from its clusters. A status code."""
        status = np.zeros(1, np.int64)
        BoundTask(_refill_list, (self.list_code, self.pairs, status))()
        if status[0] == OK:
            BoundTask(
                _arrange_numbers,
                (self.potential, self.slot_potential, self.pairs, self.sums, status),
            )()
        return int(status[0])


def _buffer_behind(pairs: PairList, blocks: int, clusters: int) -> np.ndarray:
    dtype = pairs.clusters.local.dtype
    return zeros((blocks, 3 * lane_count(dtype) * clusters), dtype)


def pair_forces(
    potential: NamedTuple, sites: BodySites | CentralSites, group: np.ndarray | None = None
) -> PairForces:
    """The term of a potential with a `cutoff`. By default, sites of one molecule do not
    interact."""
    return PairForces(potential, sites, sites.molecule if group is None else group)


def _diameter(sites: BodySites | CentralSites) -> float:
    """An upper limit of the distance between sites of a molecule, Å: the longest diagonal of boxes
    around them."""
    if not isinstance(sites, BodySites) or not len(sites.molecule):
        return 0.0
    starts = np.unique(sites.kind[np.diff(sites.first) > 0])
    offsets = sites.offset_body
    extents = np.maximum.reduceat(offsets, starts) - np.minimum.reduceat(offsets, starts)
    return float(np.linalg.norm(extents, axis=1).max())


def pair(potential, i, j, r2):
    """(energy, force/r) of the site in slot i with those in slots j, j + 1, ... at squared
    distances r2, as vectors. Valid below cutoff². A positive force repels."""
    raise TypeError(
        f"{type(potential).__name__} is not a pair potential, or this was called outside compiled"
        " code"
    )


@chosen_by_type
def arrange(slot_potential, potential, order):
    """Write the numbers of the site in each slot into `slot_potential`. `order` has the site in
    each slot. Potentials with other numbers of sites than a charge implement it."""
    if "charge" in slot_potential.fields:

        def arrange_charges(slot_potential, potential, order):
            for slot, i in enumerate(order):
                slot_potential.charge[slot] = potential.charge[i]

        return arrange_charges
    if any(isinstance(of, types.Array) for of in slot_potential.types):
        return None
    return lambda slot_potential, potential, order: None


@task()
def _arrange_numbers(arguments, block):
    """Put the numbers of the potential into the slots of a new list."""
    potential, slot_potential, pairs, sums, status = load_arguments(arguments)
    if sums.arranged[0] == pairs.counters[BUILDS]:
        return
    arrange(slot_potential, potential, pairs.clusters.order)
    if 3 * lanes_of(sums.forces_behind) * most_needed(pairs, WINDOW) > sums.forces_behind.shape[1]:
        pairs.counters[USABLE] = 0
        pairs.counters[STATUS] = status[0] = LIST_FULL
        return
    sums.arranged[0] = pairs.counters[BUILDS]


@task()
def _refill_list(arguments, block):
    """`refill`, with its status code."""
    code, pairs, status = load_arguments(arguments)
    pairs.counters[STATUS] = status[0] = refill(pairs, code)


@task(count_references=False)
def _sum_forces(arguments, block):
    potential, pairs, sums, tallies, energies = load_arguments(arguments)
    block_forces(potential, pairs, sums, tallies, energies, block)


@task(count_references=False)
def _gather_forces(arguments, block):
    pairs, sums, tallies = load_arguments(arguments)
    gather_block(pairs, sums.forces, sums.forces_behind, tallies, block)


@kernel(inline=True, count_references=False)
def block_forces(potential, pairs, into, tallies, energies, block):
    """Forces from the rows of one block: on the sites of the block into `forces`, on others into
    `forces_behind`.

    into : `PairSums`. tallies : (blocks, 10) for a part of the virial, or None. energies : the same
        array, or None

    The distance of two sites is the difference of their positions in the box, less the shift of an
    image. So the virial is the sum over sites of f (x) position, see `gather_block`, less the sum
    over entries of the force on the row (x) shift. The latter is added here when the image changes
    along a row. That is rarely: in each shell the entries of one image are consecutive, and rows
    far from the edges have no other image.
    """
    align_stack()
    clusters = pairs.clusters
    width = lanes_of(clusters.local)
    forces = into.forces
    behind = into.forces_behind[block]
    force_at_change = into.force_at_change[block]
    bounds = (clusters.bounds[block], clusters.bounds[block + 1])
    forces[3 * width * bounds[0] : 3 * width * bounds[1]] = 0.0
    behind[: 3 * width * pairs.needed[block, WINDOW]] = 0.0
    if tallies is not None:
        tallies[block] = 0.0
    entries = pairs.entries[block]
    masked = pairs.masked[block]
    zero = broadcast(0.0, clusters.local)
    moved = largest_displacement(pairs)
    first_met = first_entry = first_special = 0
    for c in range(bounds[0], bounds[1]):
        neighbors = pairs.neighbors[block, first_met:]
        origin_vector = pairs.origin_vector[block, 3 * first_met :]
        for i in range(width * c, width * (c + 1), 2):
            at = 2 * width * c + i
            here = (
                (clusters.local[at], clusters.local[at + width], clusters.local[at + 2 * width]),
                (
                    clusters.local[at + 1],
                    clusters.local[at + width + 1],
                    clusters.local[at + 2 * width + 1],
                ),
            )
            still = (zero, zero, zero)
            sums = (still, still, zero)
            number = 0
            for n in range(first_special, pairs.masked_end[i // 2]):
                other, image, between = displacements(
                    pairs, c, here, neighbors, origin_vector, masked[n, 0]
                )
                if tallies is not None:
                    number = _change_image(
                        pairs, number, image_number(image), sums, force_at_change, tallies[block]
                    )
                masks = (masked[n, 1] & ((1 << MASK_BITS) - 1), masked[n, 1] >> MASK_BITS)
                sums = _interact(
                    potential,
                    pairs,
                    bounds,
                    i,
                    other,
                    between,
                    masks,
                    forces,
                    behind,
                    sums,
                    energies,
                )
            # Displacements are computed one entry ahead: otherwise instructions that wait for them
            # fill the queues of the processor before instructions of the next entry can enter.
            last = end_of_row(pairs, i // 2, moved) - 1
            other = image = np.int32(0)
            between = ((zero, zero, zero, zero), (zero, zero, zero, zero))
            if first_entry <= last:
                other, image, between = displacements(
                    pairs, c, here, neighbors, origin_vector, load_scalar(entries, first_entry)
                )
            for n in range(first_entry, last + 1):
                ahead, its_image, after = displacements(
                    pairs, c, here, neighbors, origin_vector, load_scalar(entries, min(n + 1, last))
                )
                if tallies is not None:
                    number = _change_image(
                        pairs, number, image_number(image), sums, force_at_change, tallies[block]
                    )
                unmasked = (None, None)
                sums = _interact(
                    potential,
                    pairs,
                    bounds,
                    i,
                    other,
                    between,
                    unmasked,
                    forces,
                    behind,
                    sums,
                    energies,
                )
                other, image, between = ahead, its_image, after
            if tallies is not None:
                _change_image(pairs, number, 0, sums, force_at_change, tallies[block])
            first_entry, first_special = pairs.row_end[i // 2], pairs.masked_end[i // 2]
            on_one, on_two, energy = sums
            add_lane_sums(forces, at, width, on_one, on_two)
            if energies is not None:
                energies[block, 0] += sum_lanes(energy)
        first_met = pairs.neighbor_end[c]


@kernel(inline=True)
def _change_image(pairs, number, now, sums, force_at_change, tally):
    """Account for the shift of an image, if the next entry has another image. Returns the next
    image number. The force on the row since the last change (x) the shift of the image is
    subtracted from the tally."""
    if now != number:
        width = lanes_of(force_at_change)
        on_one, on_two, _ = sums
        x, y, z = on_one[0] + on_two[0], on_one[1] + on_two[1], on_one[2] + on_two[2]
        if number != 0:
            at = 4 * number
            a, b, c = pairs.shift[at], pairs.shift[at + 1], pairs.shift[at + 2]
            fx = sum_lanes(x - load(force_at_change, 0))
            fy = sum_lanes(y - load(force_at_change, width))
            fz = sum_lanes(z - load(force_at_change, 2 * width))
            _add_symmetric_virial(tally, (-fx * a, -fx * b, -fx * c, -fy * b, -fy * c, -fz * c))
        store(force_at_change, 0, x)
        store(force_at_change, width, y)
        store(force_at_change, 2 * width, z)
    return now


@kernel(inline=True)
def _add_symmetric_virial(tally, virial):
    """Add a symmetric virial (six numbers) to the nine numbers of a tally."""
    for k, of in enumerate((0, 1, 2, 1, 3, 4, 2, 4, 5)):
        tally[1 + k] += virial[of]


@kernel(inline=True)
def displacements(pairs, c, here, neighbors, origin_vector, number):
    """The cluster and the image of an entry, and displacements from its sites, as vectors, to the
    two sites of the row. The displacements are as in `_separation`."""
    local = pairs.clusters.local
    width = lanes_of(local)
    image = load_scalar(neighbors, number)
    other = cluster_of(image)
    at = 3 * width * other
    dx, dy, dz = load_origin_vector(pairs, c, neighbors, origin_vector, number)
    x = load(local, at) - dx
    y = load(local, at + width) - dy
    z = load(local, at + 2 * width) - dz
    return other, image, (_separation(here[0], x, y, z), _separation(here[1], x, y, z))


@chosen_by_type(inline=True)
def load_origin_vector(pairs, c, neighbors, vectors, number):
    """Vector from the origin of a neighbour to the origin of cluster c, Å. In single precision it
    is stored: to compute it would take a sixth of the time of all pairs."""
    if vectors.dtype.bitwidth == 32:

        def stored(pairs, c, neighbors, vectors, number):
            at = 3 * number
            return (
                load_broadcast(vectors, at),
                load_broadcast(vectors, at + 1),
                load_broadcast(vectors, at + 2),
            )

        return stored

    def computed(pairs, c, neighbors, vectors, number):
        origin = pairs.clusters.origin
        image = load_scalar(neighbors, number)
        there = load_four(pairs.shift, 4 * image_number(image)) + load_four(
            origin, 4 * cluster_of(image)
        )
        vector = load_four(origin, 4 * c) - there
        x, y, z = extract_lane(vector, 0), extract_lane(vector, 1), extract_lane(vector, 2)
        local = pairs.clusters.local
        return broadcast(x, local), broadcast(y, local), broadcast(z, local)

    return computed


@kernel(inline=True)
def _separation(here, x, y, z):
    """Displacements of a site from a vector of others, and the squared distances."""
    dx, dy, dz = here[0] - x, here[1] - y, here[2] - z
    return dx, dy, dz, dx * dx + dy * dy + dz * dz


@kernel(inline=True)
def _interact(
    potential, pairs, bounds, i, other, between, masks, forces, forces_behind, sums, energies
):
    """Forces between the sites in slots i, i + 1 and those of a cluster, and energies unless None.
    They are added to `sums` and to `forces`, or to `forces_behind` if the cluster is not in the
    block. bounds : of the block, see `Clusters`"""
    width = lanes_of(pairs.clusters.local)
    on_one, on_two, energy = sums
    ax, ay, az, _ = between[0]
    bx, by, bz, _ = between[1]
    one, of_one = _masked_pair(potential, i, width * other, between[0][3], masks[0])
    two, of_two = _masked_pair(potential, i + 1, width * other, between[1][3], masks[1])
    first, end = bounds
    turn = len(pairs.clusters.origin) // 4 if other < end else 0
    at = other - end + turn
    there = forces_behind
    if (other >= first) & (other < end):
        at, there = other, forces
    at = 3 * width * at
    # Each product is in one expression with the sum to which it is added, so that they become one
    # multiply-add.
    store(there, at, load(there, at) - one * ax - two * bx)
    store(there, at + width, load(there, at + width) - one * ay - two * by)
    store(there, at + 2 * width, load(there, at + 2 * width) - one * az - two * bz)
    on_one = (on_one[0] + one * ax, on_one[1] + one * ay, on_one[2] + one * az)
    on_two = (on_two[0] + two * bx, on_two[1] + two * by, on_two[2] + two * bz)
    if energies is None:
        return on_one, on_two, energy
    return on_one, on_two, energy + (of_one + of_two)


@kernel(inline=True)
def _masked_pair(potential, i, j, r2, mask):
    """Force over distance on a site from each of a vector of others, and the energies, 0 where
    there is none."""
    counts = r2 < potential.cutoff * potential.cutoff
    if mask is not None:
        counts = counts & mask_from_bits(mask, r2)
    u, w = pair(potential, i, j, r2)
    return select(counts, w, 0.0), select(counts, u, 0.0)


@kernel(inline=True, count_references=False)
def gather_block(pairs, forces, forces_behind, tallies, block):
    """Forces on the sites of a block from its rows and from those of other blocks, added in a fixed
    order. With tallies, the rest of the virial is added: the sum over sites of f (x) position. All
    forces add up to zero, so positions may be relative to any cluster: with small positions, the
    rounding error of forces has little effect."""
    clusters = pairs.clusters
    origin = clusters.origin
    middle = 4 * (len(origin) // 8)
    width = lanes_of(clusters.local)
    zero = to_double(broadcast(0.0, forces))
    virial = (zero, zero, zero, zero, zero, zero)
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        at = 3 * width * c
        force = _gathered(pairs, forces, forces_behind, c)
        for k in range(3):
            store(forces, at + k * width, convert_to(force[k], forces))
        if tallies is not None:
            local = clusters.local
            x = to_double(load(local, at)) + (origin[4 * c] - origin[middle])
            y = to_double(load(local, at + width)) + (origin[4 * c + 1] - origin[middle + 1])
            z = to_double(load(local, at + 2 * width)) + (origin[4 * c + 2] - origin[middle + 2])
            fx, fy, fz = force
            virial = (
                virial[0] + fx * x,
                virial[1] + fx * y,
                virial[2] + fx * z,
                virial[3] + fy * y,
                virial[4] + fy * z,
                virial[5] + fz * z,
            )
    if tallies is not None:
        xx, xy, xz, yy, yz, zz = virial
        _add_symmetric_virial(
            tallies[block],
            (
                sum_lanes(xx),
                sum_lanes(xy),
                sum_lanes(xz),
                sum_lanes(yy),
                sum_lanes(yz),
                sum_lanes(zz),
            ),
        )


@kernel(inline=True)
def _gathered(pairs, forces, forces_behind, c):
    """The forces on the sites of a cluster, in double precision."""
    width = lanes_of(pairs.clusters.local)
    bounds = pairs.clusters.bounds
    at = 3 * width * c
    x, y, z = (
        to_double(load(forces, at)),
        to_double(load(forces, at + width)),
        to_double(load(forces, at + 2 * width)),
    )
    for b in range(len(forces_behind)):
        behind = behind_block(bounds, b, c)
        if 0 <= behind < pairs.needed[b, WINDOW]:
            there = forces_behind[b]
            at = 3 * width * behind
            x, y = x + to_double(load(there, at)), y + to_double(load(there, at + width))
            z = z + to_double(load(there, at + 2 * width))
    return x, y, z
