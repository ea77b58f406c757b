"""Forces between pairs of bodies from an energy of their relative position and orientations: the
term and its loop over the pairs of a list.

A formula is a NamedTuple class with an `@implements(pair_slopes)`, which `formulas` writes.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, kernel, load_arguments, task
from rigidmd.core.state import TALLY_SIZE, State
from rigidmd.errors import SimulationError
from rigidmd.features.potentials.poses.pair_list import (
    BLOCKS,
    MUST_BUILD,
    BodyPairList,
    empty_list,
    finish_list,
    list_pairs,
    nearest_image,
    rows_of_block,
    sort_points,
)
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.forces.terms import FORCES_ONLY, TALLIED, Evaluation, Setup
from rigidmd.mechanics.vectors import body_vector, lab_vector

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
        pairs = empty_list(n, min(setup.skin, LONGEST_SKIN * self.cutoff))
        loads = np.zeros((BLOCKS, n, 6))
        return BodyPairsWorkspace(self, pairs, loads, np.zeros((BLOCKS, TALLY_SIZE)))


class BodyPairsWorkspace(NamedTuple):
    term: BodyPairs
    pairs: BodyPairList
    loads: np.ndarray  # (blocks, n, 6) forces on reference points and torques, lab frame
    tallies: np.ndarray  # (blocks, 10)

    def passes(self, into: Evaluation) -> list[Pass]:
        """Reference points; the list; pairs; sums on bodies."""
        blocks = blocks_of(len(self.term.kind))
        plain = (self, into.state, None)
        tallied = (self, into.state, self.tallies)
        return [
            Pass("reference points of bodies", _place_points, (self, into.state), blocks),
            Pass("whether the list is valid", sort_points, (self, into.state, into.status)),
            Pass("pairs of bodies, if it is not", list_pairs, (self, into.state), BLOCKS),
            Pass("whether they fit in memory", finish_list, (self, into.status)),
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
def switch(term, r):
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
    load = work.loads[block]
    entries = pairs.entries[block]
    point = pairs.point
    first, last = rows_of_block(len(term.kind), block)
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
            factor, change = switch(term, r)
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
