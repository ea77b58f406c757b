"""Forces between pairs of bodies from an energy of their relative position and orientations: the
term and its loop over the pairs of a list.

A formula is a NamedTuple class with an `@implements(pair_slopes)`, which `formulas` writes.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import BLOCKS, Pass, kernel, load_arguments, task
from rigidmd.compile.simd import (
    align_stack,
    extract_lane,
    lanes_of,
    load_scalar,
    lowest_bit,
    mask_bits,
)
from rigidmd.core.state import TALLY_SIZE, State
from rigidmd.forces.neighbors.lists import MASK_BITS, end_of_row, largest_displacement
from rigidmd.forces.neighbors.pair_loop import PairForces, PairWorkspace, displacements
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    blocks_of,
    molecules_of_block,
    sum_tallies,
)
from rigidmd.forces.neighbors.update import list_passes
from rigidmd.forces.terms import FORCES_ONLY, TALLIED, Evaluation, Setup, TermPasses
from rigidmd.mechanics.vectors import body_vector, lab_vector

#: The skin is at most this fraction of the cutoff.
LONGEST_SKIN = 0.5


class BodyPairs(NamedTuple):
    """U = sum over pairs of bodies of a formula of their relative pose."""

    formula: NamedTuple  # its class chooses the code
    sites: BodySites | CentralSites  # the reference points of the bodies that take part
    kind: np.ndarray  # (n,) int64 kind of each body; -1 for one that takes no part
    group: np.ndarray  # (n,) int32 bodies of one group do not interact
    reference: np.ndarray  # (kinds, 3) reference point from the centre of mass, body frame, Å
    frame: np.ndarray  # (kinds, 3, 3) from the coordinates of the model's file to the body frame
    parameters: np.ndarray  # (kinds, kinds, parameters) of the first kind with the second
    switch_start: float  # Å, where the energy begins to be switched to 0; `cutoff` for a jump
    cutoff: float  # Å, between reference points

    changes_momentum = (False, False, False)

    def workspace(self, setup: Setup) -> "BodyPairsWorkspace":
        n = len(self.kind)
        points = PairForces(Within(self.cutoff), self.sites, self.group[self.sites.molecule])
        skin = min(setup.skin, LONGEST_SKIN * self.cutoff)
        near = points.workspace(setup._replace(skin=skin, dtype=np.float64))
        loads = np.zeros((BLOCKS, n, 6))
        sums = BodySums(
            np.zeros((n, 3)), np.zeros((n, 3, 3)), loads, np.zeros((BLOCKS, TALLY_SIZE))
        )
        return BodyPairsWorkspace(self, near, sums)


class Within(NamedTuple):
    """The distance within which points are listed."""

    cutoff: float  # Å

    def for_slots(self, slots: int, dtype: type) -> "Within":
        return self


class BodySums(NamedTuple):
    arm: np.ndarray  # (n, 3) reference points from the centres of mass, lab frame, Å
    pose: np.ndarray  # (n, 3, 3) from the coordinates of the model's file to the lab
    loads: np.ndarray  # (blocks, n, 6) forces on reference points and torques, lab frame
    tallies: np.ndarray  # (blocks, 10)


class BodyPairsWorkspace(NamedTuple):
    term: BodyPairs
    near: PairWorkspace  # its list of the reference points
    sums: BodySums

    def passes(self, into: Evaluation) -> TermPasses:
        """Poses; the list; pairs; sums on bodies."""
        term, near, sums, state = self.term, self.near, self.sums, into.state
        blocks = blocks_of(len(term.kind))
        of_list = list_passes(near.pairs, near.list_code, near.sites, into)
        poses = Pass("poses of bodies", _place_bodies, (term, sums, state), blocks)
        plain = (term, near.pairs, sums, None)
        tallied = (term, near.pairs, sums, sums.tallies)
        with_energies = "forces and energies of pairs of bodies"
        return of_list._replace(
            positions=[*of_list.positions, poses],
            forces=[
                Pass("forces of pairs of bodies", _add_pairs, plain, BLOCKS, FORCES_ONLY),
                Pass(with_energies, _add_pairs, tallied, BLOCKS, TALLIED),
                Pass("sum energies", sum_tallies, (sums.tallies, into.tally), when=TALLIED),
            ],
            loads=[
                Pass("sum forces on bodies", _sum_loads, (term, sums, state, into.load), blocks)
            ],
        )

    def with_code(self) -> "BodyPairsWorkspace":
        return self._replace(near=self.near.with_code())

    def with_capacity(self, cell: np.ndarray) -> "BodyPairsWorkspace":
        return self._replace(near=self.near.with_capacity(cell))

    def renew_list(self) -> None:
        self.near.renew_list()

    def checkpoint_arrays(self) -> dict[str, np.ndarray]:
        return self.near.checkpoint_arrays()

    def restore(self, arrays: dict[str, np.ndarray], skin: float) -> "BodyPairsWorkspace":
        return self._replace(near=self.near.restore(arrays, skin))


def reference_points(term: BodyPairs, state: State) -> tuple[np.ndarray, np.ndarray]:
    """The bodies (k,) that take part, and their reference points (k, 3) in the lab, Å."""
    bodies = np.flatnonzero(term.kind >= 0)
    arms = np.einsum("nij,nj->ni", state.rotation[bodies], term.reference[term.kind[bodies]])
    return bodies, state.position[bodies] + arms


def pair_slopes(formula, p, r, a, b):
    """Energy of a pair, its slopes (3,) by r, and the torques (3,) on both bodies; lab frame, u
    Å²/ps².

    p : (parameters,). r : vector (3,) between the reference points, Å. a, b : rotation matrices (3,
        3)
    """
    raise TypeError(f"{type(formula).__name__} is not a formula of two poses")


@task()
def _place_bodies(arguments, block):
    term, sums, state = load_arguments(arguments)
    first, end = molecules_of_block(len(term.kind), block, 1)
    for m in range(first, end):
        kind = term.kind[m]
        if kind < 0:
            continue
        offset, frame = term.reference[kind], term.frame[kind]
        arm = lab_vector(state.rotation[m], offset[0], offset[1], offset[2])
        for k in range(3):
            sums.arm[m, k] = arm[k]
            column = lab_vector(state.rotation[m], frame[0, k], frame[1, k], frame[2, k])
            for i in range(3):
                sums.pose[m, i, k] = column[i]


@kernel(inline=True)
def switch(term, r):
    """Factor of the energy at a distance, and its slope: 1 up to `switch_start`, from there a
    polynomial of degree 5 with two continuous derivatives to 0 at the cutoff."""
    if r <= term.switch_start:
        return 1.0, 0.0
    width = term.cutoff - term.switch_start
    x = (r - term.switch_start) / width
    return 1 - x**3 * (10 - 15 * x + 6 * x * x), -30 * (x * (1 - x)) ** 2 / width


@task(count_references=False)
def _add_pairs(arguments, block):
    term, pairs, sums, tallies = load_arguments(arguments)
    _pairs_of_block(term, pairs, sums, tallies, block)


@kernel(inline=True, count_references=False)
def _pairs_of_block(term, pairs, sums, tallies, block):
    """Forces and torques from the rows of a block of clusters into the loads of that block, energy
    and virial into its tally."""
    align_stack()
    clusters = pairs.clusters
    local = clusters.local
    width = lanes_of(local)
    sums.loads[block] = 0.0
    if tallies is not None:
        tallies[block] = 0.0
    moved = largest_displacement(pairs)
    count = len(clusters.origin) // 4
    of = 0  # the block of the list
    for c in range(count * block // BLOCKS, count * (block + 1) // BLOCKS):
        while clusters.bounds[of + 1] <= c:
            of += 1
        begins = c == clusters.bounds[of]
        first_neighbor = 0 if begins else pairs.neighbor_end[c - 1]
        neighbors = pairs.neighbors[of, first_neighbor:]
        origin_vector = pairs.origin_vector[of, 3 * first_neighbor :]
        for i in range(width * c, width * (c + 1), 2):
            at = 2 * width * c + i
            here = (
                (local[at], local[at + width], local[at + 2 * width]),
                (local[at + 1], local[at + width + 1], local[at + 2 * width + 1]),
            )
            row = i // 2
            begins &= i == width * c
            special = 0 if begins else pairs.masked_end[row - 1]
            start = 0 if begins else pairs.row_end[row - 1]
            for n in range(special - pairs.masked_end[row], end_of_row(pairs, row, moved) - start):
                # lanes of both sites that interact, as in `PairList.masked`
                if n < 0:
                    entry = np.int64(pairs.masked[of, pairs.masked_end[row] + n, 0])
                    lanes = np.int64(pairs.masked[of, pairs.masked_end[row] + n, 1])
                else:
                    entry, lanes = np.int64(load_scalar(pairs.entries[of], start + n)), np.int64(-1)
                other, _, (a, b) = displacements(pairs, c, here, neighbors, origin_vector, entry)
                cutoff2 = term.cutoff * term.cutoff
                lanes &= mask_bits(a[3] < cutoff2) | (mask_bits(b[3] < cutoff2) << MASK_BITS)
                while lanes != 0:
                    lane = lowest_bit(lanes)
                    lanes &= lanes - 1
                    k = lane & (MASK_BITS - 1)
                    x, y, z = extract_lane(a[0], k), extract_lane(a[1], k), extract_lane(a[2], k)
                    if lane >= MASK_BITS:
                        x, y, z = (
                            extract_lane(b[0], k),
                            extract_lane(b[1], k),
                            extract_lane(b[2], k),
                        )
                    first = clusters.order[i + lane // MASK_BITS]
                    second = clusters.order[width * other + k]
                    _add_pair(term, sums, tallies, block, first, second, (-x, -y, -z))


@kernel(inline=True)
def _add_pair(term, sums, tallies, block, i, j, r):
    """One pair of points: r is the vector (3,) from point i to point j, Å."""
    i, j = term.sites.molecule[i], term.sites.molecule[j]
    # the kind that is named first is the first body, so that a pair has one energy
    if (term.kind[i], i) > (term.kind[j], j):
        i, j, r = j, i, (-r[0], -r[1], -r[2])
    energy, slope, torque, torque_of_other = pair_slopes(
        term.formula, term.parameters[term.kind[i], term.kind[j]], r, sums.pose[i], sums.pose[j]
    )
    distance = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    factor, change = switch(term, distance)
    along = change * energy / distance
    load = sums.loads[block]
    for k in range(3):
        force = factor * slope[k] + along * r[k]
        load[i, k] += force
        load[j, k] -= force
        load[i, 3 + k] += factor * torque[k]
        load[j, 3 + k] += factor * torque_of_other[k]
        if tallies is not None:
            # between centres of mass: F on the other body (x) its position from the first
            for m in range(3):
                centre = r[m] - sums.arm[j, m] + sums.arm[i, m]
                tallies[block, 1 + 3 * k + m] -= force * centre
    if tallies is not None:
        tallies[block, 0] += factor * energy


@task()
def _sum_loads(arguments, block):
    """Forces on reference points and torques as forces on centres of mass and torques about
    them."""
    term, sums, state, load = load_arguments(arguments)
    loads = sums.loads
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
