"""Ewald sums: charges in a periodic box with all their images, and the direct sum over k-vectors.

See the theory chapter `interactions` for the six terms of the energy. They are, in its order: the
pairs inside the cutoff, `screened_coulomb.ScreenedCoulomb`. The sum over k-vectors, `EwaldSum` or
`pme.Pme`, and of `corrections`: `self_energy`, `intramolecular_energy`, `Background`,
`SurfaceDipole`. Charges are in units where q²/r is an energy. The cell may have any shape.
"""

from math import pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import BLOCKS, Pass, kernel, load_arguments, task
from rigidmd.compile.simd import broadcast, lane_count, lanes_of, load, store, sum_lanes
from rigidmd.core.state import TALLY_SIZE
from rigidmd.forces.ewald.smooth import InverseR, Smooth, slope, strength_times_square
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    load_pass,
    position_pass,
    sum_passes,
    virial_buffer,
)
from rigidmd.forces.neighbors.space import follow_cell
from rigidmd.forces.terms import Evaluation, Setup, TermPasses

SAME_BASIS = np.eye(3, dtype=int)  #: of a cell whose edges are those of its description


class KVectors(NamedTuple):
    """Half of the vectors n = (n_x, n_y, n_z) of a sum, in columns along n_z. The other half are
    minus these."""

    column: np.ndarray  # (columns, 4) n_x, n_y, first n_z, index of that vector in the sum
    count: np.ndarray  # (columns,) number of n_z
    most: np.ndarray  # (3,) largest |n| along each axis
    bounds: np.ndarray  # (blocks + 1,) block b has columns bounds[b] ... bounds[b + 1] - 1

    @property
    def total(self) -> int:
        """Number of vectors, with their negatives."""
        return 2 * int(self.count.sum())

    def contains(self, n_x: int, n_y: np.ndarray, n_z: np.ndarray) -> np.ndarray:
        """Whether each n of a plane is in the sum, (len(n_y), len(n_z))."""
        x, y, first = self.column[:, :3].T
        last = first + self.count - 1
        is_inside = np.zeros((len(n_y), len(n_z)), bool)
        for sign in (1, -1):
            row = {int(sign * y[c]): c for c in np.flatnonzero(sign * x == n_x)}
            for k, c in ((k, row[n]) for k, n in enumerate(n_y.tolist()) if n in row):
                is_inside[k] |= (sign * n_z >= first[c]) & (sign * n_z <= last[c])
        return is_inside


def k_vectors_up_to(
    largest: tuple[int, int, int], largest_square: int | None = None, basis: np.ndarray = SAME_BASIS
) -> KVectors:
    """All n != 0 with |n_x|, |n_y|, |n_z| up to `most`, and with |n|² up to `largest_square` if
    given.

    basis (3, 3) : integers. The edges of this cell are `basis` times those of another cell of the
        same lattice, and the bounds apply to n in that cell
    """
    square = np.inf if largest_square is None else largest_square

    def inside(n: np.ndarray) -> np.ndarray:
        other = _in_other(n, basis)
        return (np.abs(other) <= largest).all(axis=-1) & ((other**2).sum(axis=-1) <= square)

    return _in_columns(np.abs(basis) @ largest, inside)


def k_vectors_within(
    reciprocal: np.ndarray,
    radius: float,
    limit: tuple[int, int, int] | None = None,
    basis: np.ndarray = SAME_BASIS,
) -> KVectors:
    """All n != 0 with |k| up to `radius` (1/Å), and with |n_x|, |n_y|, |n_z| up to `limit` if
    given.

    reciprocal (3, 3) : rows 2 pi times the reciprocal edges, 1/Å
    basis : for the limit, see `k_vectors_up_to`
    """
    cell = 2 * pi * np.linalg.inv(reciprocal).T
    largest = np.floor(radius * np.linalg.norm(cell, axis=1) / (2 * pi)).astype(int)

    def inside(n: np.ndarray) -> np.ndarray:
        short = ((n @ reciprocal) ** 2).sum(axis=-1) <= radius**2
        return (
            short if limit is None else short & (np.abs(_in_other(n, basis)) <= limit).all(axis=-1)
        )

    if limit is not None:
        largest = np.minimum(largest, np.abs(basis) @ limit)
    return _in_columns(largest, inside)


def _in_other(n: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """The n (..., 3) of the same k-vectors in the other cell, see `k_vectors_up_to`."""
    return n @ np.rint(np.linalg.inv(basis)).astype(int).T


def _in_columns(largest, inside) -> KVectors:
    mx, my, mz = (int(m) for m in largest)
    z = np.arange(-mz, mz + 1)
    columns, counts = [], []
    for x in range(mx + 1):
        y = np.arange(-my if x else 0, my + 1)
        n = np.stack(np.broadcast_arrays(x, y[:, None], z), axis=-1)
        is_inside = inside(n) & ((x > 0) | (y[:, None] > 0) | (z > 0))
        has_vectors = is_inside.any(axis=1)
        y, is_inside = y[has_vectors], is_inside[has_vectors]
        columns.append(np.stack([np.full(len(y), x), y, z[is_inside.argmax(axis=1)]], axis=1))
        counts.append(np.count_nonzero(is_inside, axis=1))
    count = np.concatenate(counts).astype(np.int64)
    ends = np.cumsum(count)
    total = int(count.sum())
    blocks = max(1, min(BLOCKS, len(count)))
    block_ends = np.searchsorted(ends, np.linspace(0, total, blocks + 1)[1:-1])
    column = np.column_stack([np.concatenate(columns), ends - count]).astype(np.int64)
    return KVectors(
        column, count, np.array([mx, my, mz]), np.array([0, *block_ends, len(count)], np.int64)
    )


class KSpaceSums(NamedTuple):
    """Arrays of an Ewald sum. The sites are padded to whole vectors with charges of 0."""

    cell: np.ndarray  # (3, 3) the cell for which `strength` was computed
    reciprocal: np.ndarray  # (3, 3) rows 2 pi times the reciprocal edges, 1/Å
    position: np.ndarray  # (s, 3)
    force: np.ndarray  # (s, 3)
    charge: np.ndarray  # (slots,)
    cosine: np.ndarray  # (3, largest n + 1, slots) of 2 pi n times the fractional coordinate
    sine: np.ndarray
    strength: np.ndarray  # (k-vectors,) times |S|², the energy of n and -n together
    real: np.ndarray  # (k-vectors,) real part of S(k), then of 2 strength S(k)
    imaginary: np.ndarray
    force_by_component: np.ndarray  # (3, slots) forces on the sites, by component
    tallies: np.ndarray  # (blocks, 10)
    virial: np.ndarray  # see `virial_buffer`


class EwaldSum(NamedTuple):
    smooth: Smooth
    # (s,) in units where q²/r is an energy in u Å²/ps²; of dispersion c, where c²/r⁶ is
    charge: np.ndarray
    sites: BodySites | CentralSites
    k_vectors: KVectors

    @property
    def acts_on_charges(self) -> bool:
        return isinstance(self.smooth, InverseR)

    def workspace(self, setup: Setup) -> "EwaldWorkspace":
        s = len(self.charge)
        k_vectors = self.k_vectors
        slots = -(-s // lane_count(np.float64)) * lane_count(np.float64)
        angles = (3, int(k_vectors.most.max()) + 1, slots)
        sums = KSpaceSums(
            cell=np.zeros((3, 3)),
            reciprocal=np.zeros((3, 3)),
            position=np.zeros((s, 3)),
            force=np.zeros((s, 3)),
            charge=np.concatenate([self.charge, np.zeros(slots - s)]),
            cosine=np.zeros(angles),
            sine=np.zeros(angles),
            strength=np.zeros(k_vectors.total // 2),
            real=np.zeros(k_vectors.total // 2),
            imaginary=np.zeros(k_vectors.total // 2),
            force_by_component=np.zeros((3, slots)),
            tallies=np.zeros((len(k_vectors.bounds) - 1, TALLY_SIZE)),
            virial=virial_buffer(),
        )
        return EwaldWorkspace(self.smooth, self.sites, k_vectors, sums)


class EwaldWorkspace(NamedTuple):
    smooth: Smooth
    sites: BodySites | CentralSites
    k_vectors: KVectors
    sums: KSpaceSums

    @property
    def site_force(self) -> np.ndarray:
        """Forces (s, 3) on its sites as last evaluated, lab frame, u Å/ps²."""
        return self.sums.force

    def passes(self, into: Evaluation) -> TermPasses:
        """Positions. Strengths, if the cell has changed. Phases, structure factors, and forces."""
        sums = self.sums
        content = (self.smooth, self.k_vectors, self.sums)
        blocks = len(sums.tallies)
        strengths = "strengths of k-vectors, if the cell has changed"
        return TermPasses(
            cell=[Pass(strengths, _follow_cell, (*content, into.state))],
            positions=[
                position_pass(self.sites, into.state, sums.position),
                Pass("phases of sites", _compute_phases, content, blocks),
            ],
            forces=[
                Pass("structure factors", _sum_structure_factors, content, blocks),
                Pass("forces on sites", _compute_forces, content, blocks),
                *sum_passes(self.sites, into, sums.force, sums),
            ],
            loads=[load_pass(self.sites, into, sums.force)],
        )


@kernel
def invert_cell(cell, reciprocal):
    """Write 2 pi times the reciprocal edges of a cell (3, 3) into the rows of `reciprocal`. Returns
    the volume."""
    volume = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            reciprocal[k, c] = cell[i, a] * cell[j, b] - cell[i, b] * cell[j, a]
        volume = (
            cell[k, 0] * reciprocal[k, 0]
            + cell[k, 1] * reciprocal[k, 1]
            + cell[k, 2] * reciprocal[k, 2]
        )
    for k in range(3):
        for c in range(3):
            reciprocal[k, c] *= 2 * pi / volume
    return volume


@task()
def _follow_cell(arguments, block):
    """Set the strengths of the k-vectors, if the cell has changed."""
    smooth, k_vectors, sums, state = load_arguments(arguments)
    if follow_cell(state.cell, sums.cell):
        volume = abs(invert_cell(sums.cell, sums.reciprocal))
        _set_strengths(k_vectors, sums, smooth, volume)


@kernel
def _set_strengths(k_vectors, sums, smooth, volume):
    column, b = k_vectors.column, sums.reciprocal
    for c in range(len(column)):
        first = column[c, 3]
        for n in range(k_vectors.count[c]):
            k2 = 0.0
            for d in range(3):
                k = column[c, 0] * b[0, d] + column[c, 1] * b[1, d] + (column[c, 2] + n) * b[2, d]
                k2 += k * k
            sums.strength[first + n] = strength_times_square(smooth, k2, volume) / k2


@task(count_references=False)
def _compute_phases(arguments, block):
    """exp(2 pi i n x) of the sites of a block, by recurrence: one complex product for each multiple
    of the angle."""
    _smooth, k_vectors, sums = load_arguments(arguments)
    blocks, s = len(sums.tallies), len(sums.position)
    for i in range(s * block // blocks, s * (block + 1) // blocks):
        for d in range(3):
            turns = 0.0
            for c in range(3):
                turns += sums.position[i, c] * sums.reciprocal[d, c] / (2 * pi)
            angle = 2 * pi * (turns - np.floor(turns))
            cosine, sine = np.cos(angle), np.sin(angle)
            sums.cosine[d, 0, i] = 1.0
            sums.sine[d, 0, i] = 0.0
            for n in range(1, k_vectors.most[d] + 1):
                a, b = sums.cosine[d, n - 1, i], sums.sine[d, n - 1, i]
                sums.cosine[d, n, i] = a * cosine - b * sine
                sums.sine[d, n, i] = b * cosine + a * sine


@kernel(inline=True, count_references=False)
def _phase(sums, d, n, at):
    """exp(2 pi i n x_d) of a vector of sites, as (cosine, sine)."""
    cosine = load(sums.cosine[d, abs(n)], at)
    sine = load(sums.sine[d, abs(n)], at)
    return (cosine, sine) if n >= 0 else (cosine, -1.0 * sine)


@kernel(inline=True)
def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@task(count_references=False)
def _sum_structure_factors(arguments, block):
    """S(k) of the columns of a block, with energy and virial. Then S(k) is multiplied by 2 strength
    for the forces."""
    smooth, k_vectors, sums = load_arguments(arguments)
    column = k_vectors.column
    width = lanes_of(sums.charge)
    sums.tallies[block] = 0.0
    for c in range(k_vectors.bounds[block], k_vectors.bounds[block + 1]):
        first = column[c, 3]
        count = k_vectors.count[c]
        for n in range(count):
            sums.real[first + n] = 0.0
            sums.imaginary[first + n] = 0.0
        # batches of sites stay in the L1 cache for a whole column
        for batch in range(0, len(sums.charge), 32 * width):
            end = min(batch + 32 * width, len(sums.charge))
            for n in range(count):
                real = broadcast(0.0, sums.charge)
                imaginary = broadcast(0.0, sums.charge)
                for at in range(batch, end, width):
                    plane = _times(
                        _phase(sums, 0, column[c, 0], at), _phase(sums, 1, column[c, 1], at)
                    )
                    phase = _times(plane, _phase(sums, 2, column[c, 2] + n, at))
                    charge = load(sums.charge, at)
                    real = real + charge * phase[0]
                    imaginary = imaginary + charge * phase[1]
                sums.real[first + n] += sum_lanes(real)
                sums.imaginary[first + n] += sum_lanes(imaginary)
        for n in range(first, first + count):
            real, imaginary, strength = sums.real[n], sums.imaginary[n], sums.strength[n]
            sums.real[n], sums.imaginary[n] = 2 * strength * real, 2 * strength * imaginary
            energy = strength * (real * real + imaginary * imaginary)
            vector = (column[c, 0], column[c, 1], column[c, 2] + n - first)
            add_k_vector(sums.tallies[block], energy, vector, sums.reciprocal, smooth)


@kernel(inline=True, count_references=False)
def add_k_vector(tally, energy, n, b, smooth):
    """Add energy and virial (Nose & Klein 1983) of k = 2 pi n times the reciprocal edges, with the
    rows of b (3, 3) 2 pi times these."""
    k = (
        n[0] * b[0, 0] + n[1] * b[1, 0] + n[2] * b[2, 0],
        n[0] * b[0, 1] + n[1] * b[1, 1] + n[2] * b[2, 1],
        n[0] * b[0, 2] + n[1] * b[1, 2] + n[2] * b[2, 2],
    )
    fall = slope(smooth, k[0] * k[0] + k[1] * k[1] + k[2] * k[2])
    tally[0] += energy
    for row in range(3):
        for column in range(3):
            unit = 1.0 if row == column else 0.0
            tally[1 + 3 * row + column] += energy * (unit - fall * k[row] * k[column])


@task(count_references=False)
def _compute_forces(arguments, block):
    _smooth, k_vectors, sums = load_arguments(arguments)
    column = k_vectors.column
    width = lanes_of(sums.charge)
    blocks = len(sums.tallies)
    vectors = len(sums.charge) // width
    for at in range(
        width * (vectors * block // blocks), width * (vectors * (block + 1) // blocks), width
    ):
        zero = broadcast(0.0, sums.charge)
        fx, fy, fz = zero, zero, zero
        for c in range(len(column)):
            plane = _times(_phase(sums, 0, column[c, 0], at), _phase(sums, 1, column[c, 1], at))
            flat, high = zero, zero
            for n in range(k_vectors.count[c]):
                z, index = column[c, 2] + n, column[c, 3] + n
                phase = _times(plane, _phase(sums, 2, z, at))
                push = phase[1] * sums.real[index] - phase[0] * sums.imaginary[index]
                flat = flat + push
                high = high + push * (z + 0.0)
            x, y = column[c, 0] + 0.0, column[c, 1] + 0.0
            fx = (
                fx
                + flat * (x * sums.reciprocal[0, 0] + y * sums.reciprocal[1, 0])
                + high * sums.reciprocal[2, 0]
            )
            fy = (
                fy
                + flat * (x * sums.reciprocal[0, 1] + y * sums.reciprocal[1, 1])
                + high * sums.reciprocal[2, 1]
            )
            fz = (
                fz
                + flat * (x * sums.reciprocal[0, 2] + y * sums.reciprocal[1, 2])
                + high * sums.reciprocal[2, 2]
            )
        charge = load(sums.charge, at)
        for k, f in enumerate((charge * fx, charge * fy, charge * fz)):
            store(sums.force_by_component[k], at, f)
        for i in range(at, min(at + width, len(sums.force))):
            for k in range(3):
                sums.force[i, k] = sums.force_by_component[k, i]


def ewald_sum_in_numpy(
    charge: np.ndarray, position: np.ndarray, cell: np.ndarray, alpha: float, k_vectors: KVectors
) -> tuple[float, np.ndarray, np.ndarray]:
    """Energy, forces (s, 3) and site virial (3, 3) of charges (s,) at positions (s, 3), in
    NumPy."""
    reciprocal = 2 * pi * np.linalg.inv(cell).T
    turns = position @ reciprocal.T
    energy = 0.0
    force = np.zeros_like(position)
    virial = np.zeros((3, 3))
    for (x, y, z, _), count in zip(k_vectors.column, k_vectors.count, strict=True):
        n = np.stack([np.full(count, x), np.full(count, y), z + np.arange(count)], axis=1)
        k = n @ reciprocal
        k2 = (k**2).sum(axis=1)
        strength = 4 * pi / abs(np.linalg.det(cell)) * np.exp(-k2 / (4 * alpha**2)) / k2
        phase = charge[:, None] * np.exp(1j * (turns @ n.T))
        sum_lanes = phase.sum(axis=0)
        of = strength * np.abs(sum_lanes) ** 2
        energy += of.sum()
        force += (2 * strength * (np.conj(sum_lanes) * phase).imag) @ k
        virial += of.sum() * np.eye(3) - np.einsum(
            "k,ki,kj->ij", of * (2 / k2 + 1 / (2 * alpha**2)), k, k
        )
    return float(energy), force, virial
