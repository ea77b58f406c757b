"""Sites of one potential: their positions for a state of the bodies, and the forces and torques on
the bodies.

Each potential has a list of the sites that take part in it. Sites of one molecule are consecutive.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numba import types

from rigidmd.compile import (
    BLOCKS,
    MOST_BLOCKS,
    Pass,
    chosen_by_type,
    is_a,
    kernel,
    load_arguments,
    task,
)
from rigidmd.compile.simd import lane_count, lanes_of, load_scalar
from rigidmd.core.state import State
from rigidmd.forces.terms import TALLIED, Evaluation
from rigidmd.mechanics.vectors import body_vector, lab_vector

# Up to this number, loops over molecules run on one thread: they take a few microseconds.
SERIAL_MOLECULES = 128
MOLECULES_PER_BLOCK = 4096  # if there are more blocks than the minimum


@kernel(from_python=True)
def blocks_of(molecules):
    """Number of blocks in which molecules are moved: one, on this thread, for few molecules."""
    return (
        max(BLOCKS, min(MOST_BLOCKS, molecules // MOLECULES_PER_BLOCK))
        if molecules > SERIAL_MOLECULES
        else 1
    )


@kernel(inline=True)
def molecules_of_block(molecules, block, together):
    """First and end of the molecules of a block: whole groups of `together` molecules, except the
    last."""
    blocks = blocks_of(molecules)
    groups = (molecules + together - 1) // together
    return together * (groups * block // blocks), min(
        molecules, together * (groups * (block + 1) // blocks)
    )


class BodySites(NamedTuple):
    """Sites fixed in bodies."""

    first: np.ndarray  # (n + 1,) int32 molecule m has sites first[m] ... first[m + 1] - 1
    molecule: np.ndarray  # (s,) int32 molecule of each site
    kind: np.ndarray  # (n,) int32 index in offset_body of the first site of each molecule
    # (rows, 3) from the centre of mass, body frame, Å; stored once for each species
    offset_body: np.ndarray
    # (rows, 3) of the molecule of each row, 1/(u Å²); 0 if the moment is 0
    inverse_inertia: np.ndarray

    def offsets(self) -> np.ndarray:
        """Offsets (s, 3) of all sites, body frame, Å."""
        return self.offset_body[
            (self.kind - self.first[:-1])[self.molecule] + np.arange(len(self.molecule))
        ]


class CentralSites(NamedTuple):
    """Sites at the centres of mass of their molecules: no offsets, no torque."""

    first: np.ndarray
    molecule: np.ndarray

    def offsets(self) -> np.ndarray:
        """Offsets (s, 3) of all sites, which are 0."""
        return np.zeros((len(self.molecule), 3))


def sites_of(
    species: np.ndarray, offsets: list[np.ndarray], inverse_inertia: np.ndarray
) -> BodySites | CentralSites:
    """The sites of molecules whose species (n,) are given, with offsets[k] (sites, 3) in species k,
    body frame, Å.
    inverse_inertia : (species, 3) as in `Model`"""
    counts = np.array([len(of_species) for of_species in offsets])
    first = np.concatenate([[0], np.cumsum(counts[species])]).astype(np.int32)
    molecule = np.repeat(np.arange(len(species), dtype=np.int32), counts[species])
    if np.array_equal(molecule, first[:-1]):
        molecule = first[:-1]  # one site each: one array for both
    offset = np.concatenate(offsets)
    if not offset.any():
        return CentralSites(first, molecule)
    kind = (np.cumsum(counts) - counts)[species].astype(np.int32)
    if np.array_equal(kind, species):
        kind = species.astype(np.int32, copy=False)  # the same array for both
    return BodySites(
        first,
        molecule,
        kind,
        np.ascontiguousarray(offset),
        np.repeat(inverse_inertia, counts, axis=0),
    )


def exclusion_groups(sites: BodySites | CentralSites, frozen: np.ndarray) -> np.ndarray:
    """Exclusion group of each site (s,): the molecule, or one group for all frozen molecules. Sites
    of a group do not interact.

    frozen (n,) : whether each molecule is frozen
    """
    if not frozen.any():
        return sites.molecule
    return np.where(frozen[sites.molecule], len(frozen), sites.molecule).astype(np.int32)


class InSlots(NamedTuple):
    """Vectors (x, y, z) of sites in the order of the slots of `clusters`."""

    value: np.ndarray  # (3 slots,) x, y, z of a cluster as three consecutive vectors
    slot: np.ndarray  # (s,) slot of each site

    def of_sites(self) -> np.ndarray:
        """The vectors (s, 3) in the order of the sites, float64."""
        width = lane_count(self.value.dtype)
        at = self.slot + 2 * width * (self.slot // width)
        return np.stack([self.value[at + k * width] for k in range(3)], axis=1).astype(np.float64)


@kernel(inline=True)
def index_of_x(slot, width):
    """Index of a slot's x in an array of x, y, z in slots. `width` is a power of two."""
    return 3 * slot - 2 * (slot & (width - 1))


@chosen_by_type(inline=True)
def site_vector(vectors, i):
    """(x, y, z) of site i in an array (s, 3) or `InSlots`. The type of `vectors` chooses the
    function at compile time."""
    if isinstance(vectors, types.Array):
        return lambda vectors, i: (vectors[i, 0], vectors[i, 1], vectors[i, 2])

    def load_from_slot(vectors, i):
        value = vectors.value
        width = lanes_of(vectors.value)
        at = index_of_x(load_scalar(vectors.slot, i), width)
        return (
            load_scalar(value, at),
            load_scalar(value, at + width),
            load_scalar(value, at + 2 * width),
        )

    return load_from_slot


@chosen_by_type(inline=True)
def locate_site(sites, state, m, i):
    """Position (x, y, z) of site i of molecule m, lab frame, Å."""
    if is_a(sites, CentralSites):
        return lambda sites, state, m, i: (
            state.position[m, 0],
            state.position[m, 1],
            state.position[m, 2],
        )

    def locate_site(sites, state, m, i):
        x, y, z = site_offset_lab(sites, state, m, i)
        centre = state.position[np.uint64(m)]
        return centre[0] + x, centre[1] + y, centre[2] + z

    return locate_site


@chosen_by_type(inline=True)
def predict_site(sites, state, m, i, lead):
    """Position of site i of molecule m after a time `lead` at constant velocity and angular
    velocity, Å."""
    if is_a(sites, CentralSites):
        return lambda sites, state, m, i, lead: (
            state.position[m, 0] + lead * state.velocity[m, 0],
            state.position[m, 1] + lead * state.velocity[m, 1],
            state.position[m, 2] + lead * state.velocity[m, 2],
        )

    def predict_site(sites, state, m, i, lead):
        q = state.rotation[m]
        centre = state.position[m]
        velocity = state.velocity[m]
        momentum = state.angular_momentum_body[m]
        row = sites.kind[m] - sites.first[m] + i
        offset, inverse = sites.offset_body[row], sites.inverse_inertia[row]
        # Cayley rotation by 2 atan(|a|) about a = lead omega / 2, which keeps distances within a
        # molecule
        half = 0.5 * lead
        a, b, c = (
            half * inverse[0] * momentum[0],
            half * inverse[1] * momentum[1],
            half * inverse[2] * momentum[2],
        )
        x, y, z = offset[0], offset[1], offset[2]
        factor = 2 / (1 + a * a + b * b + c * c)
        u, v, w = factor * (b * z - c * y), factor * (c * x - a * z), factor * (a * y - b * x)
        x, y, z = x + u + (b * w - c * v), y + v + (c * u - a * w), z + w + (a * v - b * u)
        return (
            centre[0] + lead * velocity[0] + q[0, 0] * x + q[0, 1] * y + q[0, 2] * z,
            centre[1] + lead * velocity[1] + q[1, 0] * x + q[1, 1] * y + q[1, 2] * z,
            centre[2] + lead * velocity[2] + q[2, 0] * x + q[2, 1] * y + q[2, 2] * z,
        )

    return predict_site


@kernel(inline=True)
def site_offset_lab(sites, state, m, i):
    """Vector (x, y, z) from the centre of mass of molecule m to its site i, lab frame, Å."""
    m = np.uint64(m)
    offset = sites.offset_body[np.uint64(sites.kind[m] - sites.first[m] + i)]
    return lab_vector(state.rotation[m], offset[0], offset[1], offset[2])


@chosen_by_type(inline=True)
def load_molecule(sites, state, load, m, site_force):
    """Add the site forces of molecule m, and their torque about the centre of mass, to its load."""
    if is_a(sites, CentralSites):

        def load_central(sites, state, load, m, site_force):
            for i in range(sites.first[m], sites.first[m + 1]):
                fx, fy, fz = site_vector(site_force, i)
                load.force[m, 0] += fx
                load.force[m, 1] += fy
                load.force[m, 2] += fz

        return load_central

    def load_body(sites, state, load, m, site_force):
        m = np.uint64(m)  # an unsigned index is not tested for being negative
        q, force, torque = state.rotation[m], load.force[m], load.torque_body[m]
        begin = sites.kind[m] - sites.first[m]
        sum_x = sum_y = sum_z = turn_x = turn_y = turn_z = (
            0.0  # kept in registers until the last site
        )
        for i in range(sites.first[m], sites.first[np.uint64(m + 1)]):
            fx, fy, fz = site_vector(site_force, i)
            sum_x, sum_y, sum_z = sum_x + fx, sum_y + fy, sum_z + fz
            # n_body = d x (Q^T f), with the site's offset d in the body frame
            bx, by, bz = body_vector(q, (fx, fy, fz))
            offset = sites.offset_body[np.uint64(begin + i)]
            x, y, z = offset[0], offset[1], offset[2]
            turn_x += y * bz - z * by
            turn_y += z * bx - x * bz
            turn_z += x * by - y * bx
        force[0] += sum_x
        force[1] += sum_y
        force[2] += sum_z
        torque[0] += turn_x
        torque[1] += turn_y
        torque[2] += turn_z

    return load_body


@kernel(from_python=True)
def compute_site_positions(sites, state, site_position):
    """Write the positions of all sites into site_position (s, 3), lab frame. Molecules are not
    wrapped."""
    for m in range(len(state.position)):
        for i in range(sites.first[m], sites.first[m + 1]):
            site_position[i, 0], site_position[i, 1], site_position[i, 2] = locate_site(
                sites, state, m, i
            )


@task()
def _compute_positions_of_block(arguments, block):
    """`compute_site_positions` for the molecules of a block, see `blocks_of`."""
    sites, state, site_position = load_arguments(arguments)
    first, end = molecules_of_block(len(state.position), block, 1)
    for m in range(first, end):
        for i in range(sites.first[m], sites.first[m + 1]):
            site_position[i, 0], site_position[i, 1], site_position[i, 2] = locate_site(
                sites, state, m, i
            )


@task()
def _load_block(arguments, block):
    """`load_molecule` for the molecules of a block, see `blocks_of`."""
    sites, state, load, site_force = load_arguments(arguments)
    first, end = molecules_of_block(len(state.position), block, 1)
    for m in range(first, end):
        load_molecule(sites, state, load, m, site_force)


@task()
def _sum_offset_virial_of_block(arguments, block):
    """Sums of f (x) (x_site - X_molecule) over the molecules of a block (`blocks_of`), into a row
    (9,) of `virial`."""
    sites, state, site_force, virial = load_arguments(arguments)
    virial[block] = 0.0
    first, end = molecules_of_block(len(state.position), block, 1)
    for m in range(first, end):
        for i in range(sites.first[m], sites.first[m + 1]):
            offset = site_offset_lab(sites, state, m, i)
            force = site_vector(site_force, i)
            for row in range(3):
                for k in range(3):
                    virial[block, 3 * row + k] += force[row] * offset[k]


def position_pass(sites: BodySites | CentralSites, state: State, position: np.ndarray) -> Pass:
    """`compute_site_positions` into an array (s, 3)."""
    return Pass(
        "positions of sites",
        _compute_positions_of_block,
        (sites, state, position),
        blocks_of(len(state.position)),
    )


class SumsOfBlocks(Protocol):
    """The sums of the blocks of a term."""

    @property
    def tallies(self) -> np.ndarray: ...  # (blocks, 10) energy and site virial
    @property
    def virial(self) -> np.ndarray: ...  # see `virial_buffer`


def load_pass(
    sites: BodySites | CentralSites, into: Evaluation, force: np.ndarray | InSlots
) -> Pass:
    """The pass that adds site forces (s, 3) to the load."""
    content = sites, into.state, into.load, force
    blocks = blocks_of(len(into.state.position))
    return Pass("forces and torques on molecules", _load_block, content, blocks)


def sum_passes(
    sites: BodySites | CentralSites,
    into: Evaluation,
    force: np.ndarray | InSlots,
    sums: SumsOfBlocks,
) -> list[Pass]:
    """The passes that add the sums of blocks to the tally, with the site forces (s, 3)."""
    state, tally = into.state, into.tally
    blocks = blocks_of(len(state.position))
    passes = [Pass("sum energies and virials", sum_tallies, (sums.tallies, tally), when=TALLIED)]
    if isinstance(sites, BodySites):
        offsets = (sites, state, force, sums.virial)
        virial = (sums.virial[:blocks], tally)
        passes += [
            Pass("virial within molecules", _sum_offset_virial_of_block, offsets, blocks, TALLIED),
            Pass("subtract it", _subtract_offset_virial, virial, when=TALLIED),
        ]
    return passes


def virial_buffer() -> np.ndarray:
    """Array for the sums of `_sum_offset_virial_of_block`: 9 for each block, which has two cache
    lines."""
    return np.zeros((MOST_BLOCKS, 16))


@task()
def sum_tallies(arguments, block):
    """Add the sums of all blocks (blocks, 10) to a tally."""
    tallies, tally = load_arguments(arguments)
    for b in range(len(tallies)):
        for k in range(len(tally)):
            tally[k] += tallies[b, k]


@task()
def _subtract_offset_virial(arguments, block):
    """Convert the site virial in a tally to the molecular virial: subtract sum f (x) (x_site -
    X_molecule)."""
    virial, tally = load_arguments(arguments)
    for b in range(len(virial)):
        for k in range(9):
            tally[1 + k] -= virial[b, k]
