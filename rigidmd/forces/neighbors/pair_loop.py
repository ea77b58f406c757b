"""Forces between pairs of sites: the one loop for every such law.

A law gives only the energy and force between one site and a vector of others at given distances, by an
`@implements(pair)` for its NamedTuple, and puts its numbers for each site into the order of the slots (`arrange`). This
loop finds the pairs and their images, sums energies, virial and forces, and adds the forces to the bodies.
"""

from math import inf
from typing import NamedTuple

import numpy as np
from numba import types

from rigidmd.compile import Code, call, call_blocks, implements, kernel, opened, packed, task
from rigidmd.compile.simd import (  # fmt: skip
    add_totals,
    align_stack,
    double,
    fill,
    item,
    lane,
    lane_count,
    load,
    load_four,
    mask_of,
    narrowed,
    select,
    spread,
    store,
    total,
    width_of,
    zeros,
)
from rigidmd.core.state import EXAMPLE, LIST_FULL, OK, TALLY_SIZE
from rigidmd.forces import terms
from rigidmd.forces.neighbors import lists as neighbors
from rigidmd.forces.neighbors.lists import (  # fmt: skip
    BUILDS,
    STATUS,
    USABLE,
    WINDOW,
    PairList,
    behind_block,
    cluster_of,
    empty_list,
    end_of_row,
    farthest,
    lanes_of_first,
    lanes_of_second,
    most_needed,
    number_of,
)
from rigidmd.forces.neighbors.sites import (  # fmt: skip
    BodySites,
    CentralSites,
    InSlots,
    blocks_of,
    count_some,
    load_some,
    room_for_virial,
    virial_of_molecules,
)
from rigidmd.forces.neighbors.update import list_code, refill, update_list
from rigidmd.forces.terms import Setup


class Sums(NamedTuple):
    """Sums of forces and energies."""

    own: np.ndarray  # (3 slots,) force on each site from the rows of its block, then from all; as Clusters.local
    others: np.ndarray  # (blocks, room) forces of a block's rows on the clusters behind the block
    before: np.ndarray  # (blocks, 3 lanes) force on a row when the image of its entries changed last, see `_cross`
    tallies: np.ndarray  # (blocks, 10)
    virial: np.ndarray  # see `room_for_virial`


class PairForces(NamedTuple):
    """A pair law and the sites that take part in it."""

    law: NamedTuple  # its arrays are in the order of the sites
    sites: BodySites | CentralSites
    group: np.ndarray  # (s,) sites of one group do not interact

    def workspace(self, setup: Setup) -> "PairWorkspace":
        """Room for a neighbour list, which is built at its first use, and for sums."""
        law, sites = self.law, self.sites
        reach = _diameter(sites) if np.array_equal(self.group, sites.molecule) else inf
        pairs = empty_list(setup.cell, self.group, reach, law.cutoff, setup.skin, setup.dtype)
        blocks, slots = len(pairs.needed), len(pairs.clusters.order)
        sums = Sums(
            own=pairs.clusters.scratch,  # no list is built while forces are summed
            others=_room_for_others(pairs, blocks, int(pairs.needed[:, WINDOW].max())),
            before=zeros((blocks, 3 * lane_count(setup.dtype)), setup.dtype),
            tallies=np.zeros((blocks, TALLY_SIZE)),
            virial=room_for_virial(),
        )
        with_energies = setup.with_energies if setup.presses else None
        return PairWorkspace(law, law.room(slots, setup.dtype), sites, pairs, sums, with_energies)


class PairWorkspace(NamedTuple):
    """Workspace of a `PairForces`."""

    law: NamedTuple
    arranged: NamedTuple  # what the loop reads: the law's numbers in the order of slots, in the precision of lanes
    sites: BodySites | CentralSites
    pairs: PairList
    sums: Sums
    with_energies: np.ndarray | None  # (1,) of the loader; None where virials are never asked for without them
    list_code: Code | None = None
    code: Code | None = None

    @property
    def passing(self) -> np.ndarray:
        """The array that it needs only while its forces are computed."""
        return self.sums.others

    def with_passing(self, memory: np.ndarray) -> "PairWorkspace":
        """With that array in memory of the same type, which may be larger."""
        others = self.sums.others
        return self._replace(sums=self.sums._replace(others=memory.reshape(-1)[: others.size].reshape(others.shape)))

    @property
    def site_force(self) -> np.ndarray:
        """Forces (s, 3) on its sites as last evaluated, lab frame, u Å/ps²."""
        return self.forces_in_slots.of_sites()

    @property
    def forces_in_slots(self) -> InSlots:
        """Forces on its sites as last evaluated, in slots."""
        return InSlots(self.sums.own, self.pairs.clusters.slot)

    def with_code(self) -> "PairWorkspace":
        """With the machine code that finds pairs and computes their forces."""
        state, load = EXAMPLE
        lists = list_code(self.pairs, self.sites)
        content = (self.arranged, self.pairs, self.sums)
        pressed = {} if self.with_energies is None else {"forces_and_virial": (_forces_and_virial, content)}
        code = Code(
            find=(_find, (lists, self.law, self.arranged, self.sites, self.pairs, self.sums, state)),
            forces=(_forces, content),
            forces_and_energies=(_forces_and_energies, content),
            gather=(_gather, content),
            gather_and_count=(_gather_and_count, content),
            load=(load_some, (self.sites, state, load, self.forces_in_slots)),
            count=(count_some, (self.sites, state, self.forces_in_slots, self.sums.virial)),
            **pressed,
        )
        return self._replace(code=code, list_code=lists)

    def with_room(self, cell: np.ndarray) -> "PairWorkspace":
        """With the room that the last build of the list needed."""
        pairs = neighbors.with_room(self.pairs, cell)
        others, clusters = self.sums.others, int(pairs.needed[:, WINDOW].max())
        if 3 * lane_count(others.dtype) * clusters > others.shape[1]:
            others = _room_for_others(pairs, len(others), int(1.1 * clusters) + 1)
        return self._replace(pairs=pairs, sums=self.sums._replace(others=others))

    def memory(self) -> dict[str, np.ndarray]:
        """Its list as last built."""
        return neighbors.memory_of(self.pairs)

    def recall(self, memory: dict[str, np.ndarray], skin: float, now: float) -> "PairWorkspace":
        """With the list of a memory; has machine code. Raises ValueError if the memory is that of another term."""
        found = self._replace(pairs=neighbors.recalled(self.pairs, memory, skin, now))
        while "order" in memory and _refill(found):
            found = found.with_room(found.pairs.cell)
        return found


def _room_for_others(pairs: PairList, blocks: int, clusters: int) -> np.ndarray:
    dtype = pairs.clusters.local.dtype
    return zeros((blocks, 3 * lane_count(dtype) * clusters), dtype)


def pair_forces(law: NamedTuple, sites: BodySites | CentralSites, group: np.ndarray | None = None) -> PairForces:
    """The term of a law with a `cutoff`; without groups, sites of one molecule do not interact."""
    return PairForces(law, sites, sites.molecule if group is None else group)


def _diameter(sites: BodySites | CentralSites) -> float:
    """An upper bound on the distance between sites of a molecule, Å: the longest diagonal of boxes around them."""
    if not isinstance(sites, BodySites) or not len(sites.molecule):
        return 0.0
    starts, offsets = np.unique(sites.kind[np.diff(sites.first) > 0]), sites.offset_body
    extents = np.maximum.reduceat(offsets, starts) - np.minimum.reduceat(offsets, starts)
    return float(np.linalg.norm(extents, axis=1).max())


def pair(law, i, j, r2):
    """(energy, force/r) of the site in slot i with those in slots j, j + 1, ... at squared distances r2, as vectors.

    Valid below cutoff²; a positive force repels.
    """
    raise TypeError(f"{type(law).__name__} is not a pair law, or this was called outside compiled code")


def arrange(law, arranged, order):
    """Fill the numbers that an arranged law has for each slot with those of the site now in that slot."""
    raise TypeError("compiled code only")


@kernel
def into_slots(of_sites, in_slots, order):
    """Copy numbers of the sites (s,) into slots (slots,); `order` has the site in each slot."""
    for slot, i in enumerate(order):
        in_slots[slot] = of_sites[i]


@implements(terms.add_forces, PairWorkspace, counted=False)
def _add_pair_forces(term, state, load, tally):
    code, pairs, sums = term.code, term.pairs, term.sums
    call(code, "find", packed((term.list_code, term.law, term.arranged, term.sites, pairs, sums, state)))
    if pairs.counters[STATUS] != OK:
        return pairs.counters[STATUS]
    parcel = packed((term.arranged, pairs, sums))
    blocks = len(sums.tallies)
    if tally is None:
        call_blocks(code, "forces", parcel, blocks)
        call_blocks(code, "gather", parcel, blocks)
    else:
        _call_tallied(term.with_energies, code, parcel, blocks)
        call_blocks(code, "gather_and_count", parcel, blocks)
    force = InSlots(sums.own, pairs.clusters.slot)
    call_blocks(code, "load", packed((term.sites, state, load, force)), blocks_of(len(state.position)))
    if tally is not None:
        for block in range(blocks):
            for k in range(len(tally)):
                tally[k] += sums.tallies[block, k]
        virial_of_molecules(term.sites, code, state, force, sums.virial, tally)
    return OK


def _call_tallied(with_energies, code, parcel, blocks):
    """Call the task that also finds virials, and energies if they are wanted."""
    raise TypeError("compiled code only")


@implements(_call_tallied)
def _call_with_energies(with_energies, code, parcel, blocks):
    if with_energies is types.none:
        return lambda with_energies, code, parcel, blocks: call_blocks(code, "forces_and_energies", parcel, blocks)

    def call_tallied(with_energies, code, parcel, blocks):
        if with_energies[0] != 0:
            call_blocks(code, "forces_and_energies", parcel, blocks)
        else:
            call_blocks(code, "forces_and_virial", parcel, blocks)

    return call_tallied


@task()
def _find(parcel, block):
    """Update the list, and the law's numbers in slots, for the present state; a status code into counters[STATUS]."""
    code, law, arranged, sites, pairs, sums, state = opened(parcel)
    builds = pairs.counters[BUILDS]
    status = update_list(pairs, code, sites, state)
    if pairs.counters[BUILDS] != builds:
        status = _arranged(law, arranged, pairs, sums)
    pairs.counters[STATUS] = status


@kernel
def _arranged(law, arranged, pairs, sums):
    """Put the law's numbers into the slots of a new list; a status code."""
    arrange(law, arranged, pairs.clusters.order)
    if 3 * width_of(sums.others) * most_needed(pairs, WINDOW) > sums.others.shape[1]:
        pairs.counters[USABLE] = 0
        return LIST_FULL
    return OK


@kernel(outer=True)
def _refill(term):
    """Build a list again from its clusters; a status code, also in counters[STATUS]."""
    pairs = term.pairs
    status = refill(pairs, term.list_code)
    if status == OK:
        status = _arranged(term.law, term.arranged, pairs, term.sums)
    pairs.counters[STATUS] = status
    return status


@task(counted=False)
def _forces(parcel, block):
    law, pairs, sums = opened(parcel)
    block_forces(law, pairs, sums, None, None, block)


@task(counted=False)
def _forces_and_energies(parcel, block):
    law, pairs, sums = opened(parcel)
    block_forces(law, pairs, sums, sums.tallies, sums.tallies, block)


@task(counted=False)
def _forces_and_virial(parcel, block):
    law, pairs, sums = opened(parcel)
    block_forces(law, pairs, sums, sums.tallies, None, block)


@task(counted=False)
def _gather(parcel, block):
    _, pairs, sums = opened(parcel)
    gather_block(pairs, sums.own, sums.others, None, block)


@task(counted=False)
def _gather_and_count(parcel, block):
    _, pairs, sums = opened(parcel)
    gather_block(pairs, sums.own, sums.others, sums.tallies, block)


@kernel(inline=True, counted=False)
def block_forces(law, pairs, into, tallies, energies, block):
    """Forces from the rows of one block: on the sites of the block into `own`, on those behind it into `others`.

    into : `Sums`. tallies : (blocks, 10) for a part of the virial, or None. energies : the same array, or None

    The distance of two sites is the difference of their places in the box, less the shift of an image. So the virial is
    the sum over sites of f (x) place, see `gather_block`, less that over entries of the force on the row (x) shift.
    The latter is summed here where the image changes along a row. That is seldom: in each shell the entries of one
    image follow one another, and rows far from the edges meet no other image.
    """
    align_stack()
    clusters = pairs.clusters
    width = width_of(clusters.local)
    own, others, before = into.own, into.others[block], into.before[block]
    bounds = (clusters.bounds[block], clusters.bounds[block + 1])
    own[3 * width * bounds[0] : 3 * width * bounds[1]] = 0.0
    others[: 3 * width * pairs.needed[block, WINDOW]] = 0.0
    if tallies is not None:
        tallies[block] = 0.0
    entries = pairs.entries[block]
    masked = pairs.masked[block]
    zero = fill(0.0, clusters.local)
    moved = farthest(pairs)
    first_met = first_entry = first_special = 0
    for c in range(bounds[0], bounds[1]):
        met, apart = pairs.met[block, first_met:], pairs.apart[block, 3 * first_met :]
        for i in range(width * c, width * (c + 1), 2):
            at = 2 * width * c + i
            here = (
                (clusters.local[at], clusters.local[at + width], clusters.local[at + 2 * width]),
                (clusters.local[at + 1], clusters.local[at + width + 1], clusters.local[at + 2 * width + 1]),
            )
            still = (zero, zero, zero)
            sums, number = (still, still, zero), 0
            for n in range(first_special, pairs.special[i // 2]):
                other, image, between = _displacements(pairs, c, here, met, apart, masked[n, 0])
                if tallies is not None:
                    number = _cross(pairs, number, number_of(image), sums, before, tallies[block])
                masks = (lanes_of_first(masked[n, 1]), lanes_of_second(masked[n, 1]))
                sums = _meet(law, pairs, bounds, i, other, between, masks, own, others, sums, energies)
            # Displacements are computed one entry ahead: instructions that wait for them would otherwise fill the
            # processor's queues before those of the next entry could enter.
            last = end_of_row(pairs, i // 2, moved) - 1
            other = image = np.int32(0)
            between = ((zero, zero, zero, zero), (zero, zero, zero, zero))
            if first_entry <= last:
                other, image, between = _displacements(pairs, c, here, met, apart, item(entries, first_entry))
            for n in range(first_entry, last + 1):
                ahead, its_image, after = _displacements(pairs, c, here, met, apart, item(entries, min(n + 1, last)))
                if tallies is not None:
                    number = _cross(pairs, number, number_of(image), sums, before, tallies[block])
                sums = _meet(law, pairs, bounds, i, other, between, (None, None), own, others, sums, energies)
                other, image, between = ahead, its_image, after
            if tallies is not None:
                _cross(pairs, number, 0, sums, before, tallies[block])
            first_entry, first_special = pairs.row[i // 2], pairs.special[i // 2]
            on_one, on_two, energy = sums
            add_totals(own, at, width, on_one, on_two)
            if energies is not None:
                energies[block, 0] += total(energy)
        first_met = pairs.near[c]


@kernel(inline=True)
def _cross(pairs, number, now, sums, before, tally):
    """Go from entries of one image, if it is another one, to those of the next; returns its number.

    The force on the row since the last change (x) the shift of the image is subtracted from the tally; `before` has the
    force on the row at that change.
    """
    if now != number:
        width = width_of(before)
        on_one, on_two, _ = sums
        x, y, z = on_one[0] + on_two[0], on_one[1] + on_two[1], on_one[2] + on_two[2]
        if number != 0:
            at = 4 * number
            a, b, c = pairs.shift[at], pairs.shift[at + 1], pairs.shift[at + 2]
            fx, fy = total(x - load(before, 0)), total(y - load(before, width))
            fz = total(z - load(before, 2 * width))
            _count(tally, (-fx * a, -fx * b, -fx * c, -fy * b, -fy * c, -fz * c))
        store(before, 0, x)
        store(before, width, y)
        store(before, 2 * width, z)
    return now


@kernel(inline=True)
def _count(tally, virial):
    """Add the six numbers of a symmetric virial to the nine of a tally."""
    for k, of in enumerate((0, 1, 2, 1, 3, 4, 2, 4, 5)):
        tally[1 + k] += virial[of]


@kernel(inline=True)
def _displacements(pairs, c, here, met, apart, number):
    """The cluster and the image met by an entry, and displacements from its sites, as vectors, to each of two of c.

    These are as of `_separation`.
    """
    local = pairs.clusters.local
    width = width_of(local)
    image = item(met, number)
    other = cluster_of(image)
    at = 3 * width * other
    dx, dy, dz = origins_apart(pairs, c, met, apart, number)
    x = load(local, at) - dx
    y = load(local, at + width) - dy
    z = load(local, at + 2 * width) - dz
    return other, image, (_separation(here[0], x, y, z), _separation(here[1], x, y, z))


def origins_apart(pairs, c, met, apart, number):
    """Vector from the origin of what is met to that of cluster c, Å.

    In single precision it is looked up: to compute it would take a sixth of the time of all pairs.
    """
    raise TypeError("compiled code only")


@implements(origins_apart, inline=True)
def _origins_apart(pairs, c, met, apart, number):
    if apart.dtype.bitwidth == 32:

        def looked_up(pairs, c, met, apart, number):
            return spread(apart, 3 * number), spread(apart, 3 * number + 1), spread(apart, 3 * number + 2)

        return looked_up

    def computed(pairs, c, met, apart, number):
        origin, image = pairs.clusters.origin, item(met, number)
        there = load_four(pairs.shift, 4 * number_of(image)) + load_four(origin, 4 * cluster_of(image))
        vector = load_four(origin, 4 * c) - there
        local = pairs.clusters.local
        return fill(lane(vector, 0), local), fill(lane(vector, 1), local), fill(lane(vector, 2), local)

    return computed


@kernel(inline=True)
def _separation(here, x, y, z):
    """Displacements of a site from a vector of others, and the squared distances."""
    dx, dy, dz = here[0] - x, here[1] - y, here[2] - z
    return dx, dy, dz, dx * dx + dy * dy + dz * dz


@kernel(inline=True)
def _meet(law, pairs, bounds, i, other, between, masks, own, others, sums, energies):
    """Forces between the sites in slots i, i + 1 and those of a cluster, added to `sums` and, if the cluster is of the
    block, to `own`, else to `others`; energies too.

    energies : None if they are not wanted. bounds : of the block, see `Clusters`
    """
    width = width_of(pairs.clusters.local)
    on_one, on_two, energy = sums
    ax, ay, az, _ = between[0]
    bx, by, bz, _ = between[1]
    one, of_one = _act(law, i, width * other, between[0][3], masks[0])
    two, of_two = _act(law, i + 1, width * other, between[1][3], masks[1])
    first, end = bounds
    turn = len(pairs.clusters.origin) // 4 if other < end else 0
    at, there = other - end + turn, others
    if (other >= first) & (other < end):
        at, there = other, own
    at = 3 * width * at
    # Each product is in one expression with the sum to which it is added, so that the two are one multiply-add.
    store(there, at, load(there, at) - one * ax - two * bx)
    store(there, at + width, load(there, at + width) - one * ay - two * by)
    store(there, at + 2 * width, load(there, at + 2 * width) - one * az - two * bz)
    on_one = (on_one[0] + one * ax, on_one[1] + one * ay, on_one[2] + one * az)
    on_two = (on_two[0] + two * bx, on_two[1] + two * by, on_two[2] + two * bz)
    if energies is None:
        return on_one, on_two, energy
    return on_one, on_two, energy + (of_one + of_two)


@kernel(inline=True)
def _with_product(virial, force, at):
    """A symmetric virial, six vectors, with force (x) place added."""
    x, y, z = force
    return (
        virial[0] + x * at[0],
        virial[1] + x * at[1],
        virial[2] + x * at[2],
        virial[3] + y * at[1],
        virial[4] + y * at[2],
        virial[5] + z * at[2],
    )


@kernel(inline=True)
def _act(law, i, j, r2, mask):
    """Force over distance on a site from each of a vector of others, and the energies; 0 where there is none."""
    counts = r2 < law.cutoff * law.cutoff
    if mask is not None:
        counts = counts & mask_of(mask, r2)
    u, w = pair(law, i, j, r2)
    return select(counts, w, 0.0), select(counts, u, 0.0)


@kernel(inline=True, counted=False)
def gather_block(pairs, own, others, tallies, block):
    """Forces on the sites of a block from its own rows and from those of other blocks, added in a fixed order.

    With tallies, the rest of the virial is added: the sum over sites of f (x) place. All forces add up to zero, so that
    places may be relative to a cluster of the system: where they are small, so is what rounding of forces does.
    """
    clusters = pairs.clusters
    origin = clusters.origin
    middle = 4 * (len(origin) // 8)
    width = width_of(clusters.local)
    zero = double(fill(0.0, own))
    virial = (zero, zero, zero, zero, zero, zero)
    for c in range(clusters.bounds[block], clusters.bounds[block + 1]):
        at = 3 * width * c
        force = _gathered(pairs, own, others, c)
        for k in range(3):
            store(own, at + k * width, narrowed(force[k], own))
        if tallies is not None:
            local = clusters.local
            there = (
                double(load(local, at)) + (origin[4 * c] - origin[middle]),
                double(load(local, at + width)) + (origin[4 * c + 1] - origin[middle + 1]),
                double(load(local, at + 2 * width)) + (origin[4 * c + 2] - origin[middle + 2]),
            )
            virial = _with_product(virial, force, there)
    if tallies is not None:
        xx, xy, xz, yy, yz, zz = virial
        _count(tallies[block], (total(xx), total(xy), total(xz), total(yy), total(yz), total(zz)))


@kernel(inline=True)
def _gathered(pairs, own, others, c):
    """The forces on the sites of a cluster, in double precision."""
    width, bounds = width_of(pairs.clusters.local), pairs.clusters.bounds
    at = 3 * width * c
    x, y, z = double(load(own, at)), double(load(own, at + width)), double(load(own, at + 2 * width))
    for b in range(len(others)):
        behind = behind_block(bounds, b, c)
        if 0 <= behind < pairs.needed[b, WINDOW]:
            there, at = others[b], 3 * width * behind
            x, y = x + double(load(there, at)), y + double(load(there, at + width))
            z = z + double(load(there, at + 2 * width))
    return x, y, z
