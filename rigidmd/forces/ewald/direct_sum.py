"""Ewald sums: charges in a periodic box with all their images, and the sum over wave vectors one by one.

    E = sum over pairs inside the cut-off q_i q_j erfc(alpha r)/r     screened.ScreenedCoulomb
      + 2 pi/V sum over k != 0 exp(-k²/4 alpha²)/k² |S(k)|²           EwaldSum, or mesh.Pme
      - alpha/sqrt(pi) sum q_i²                                       corrections.self_energy
      - sum over pairs inside molecules q_i q_j erf(alpha r)/r        corrections.intramolecular_energy
      - pi/(2 V alpha²) (sum q_i)²                                    corrections.Background
      + 2 pi/((2 eps + 1) V) |sum q_i r_i|²                           corrections.SurfaceDipole

(de Leeuw, Perram & Smith 1980; Allen & Tildesley 2017, 6.2), with S(k) = sum q_i exp(i k r_i), and q in units where
q²/r is an energy. The last term describes a large sphere of boxes in a medium of permittivity eps; it is 0 for a
conductor ("tin foil"), the usual choice.

The sum over k includes the pairs inside molecules. In a rigid body such a pair exerts no net force and no torque, so
only its energy, a constant, has to be subtracted. The cell may have any shape: k is 2 pi (n_x, n_y, n_z) times the
reciprocal edges.
"""

from math import pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Code, call_blocks, implements, kernel, opened, packed, task
from rigidmd.compile.simd import fill, lane_count, load, store, total, width_of
from rigidmd.core.state import OK, TALLY_SIZE
from rigidmd.forces import terms
from rigidmd.forces.ewald.k_vectors import Waves
from rigidmd.forces.neighbors.sites import (
    BodySites,
    CentralSites,
    blocks_of,
    room_for_virial,
    site_tasks,
    virial_of_molecules,
)
from rigidmd.forces.neighbors.space import follow_cell
from rigidmd.forces.terms import Setup

WIDTH = lane_count(np.float64)


class WaveSums(NamedTuple):
    """Arrays of an Ewald sum. The sites are padded to whole vectors with charges of 0."""

    cell: np.ndarray  # (3, 3) the cell of the present strengths
    reciprocal: np.ndarray  # (3, 3) rows 2 pi times the reciprocal edges, 1/Å
    position: np.ndarray  # (s, 3)
    force: np.ndarray  # (s, 3)
    charge: np.ndarray  # (slots,)
    cosine: np.ndarray  # (3, largest n + 1, slots) of 2 pi n times the fractional coordinate
    sine: np.ndarray
    strength: np.ndarray  # (waves,) 4 pi/V exp(-k²/4 alpha²)/k²: times |S|², the energy of n and -n together
    real: np.ndarray  # (waves,) real part of S(k), then of 2 strength S(k)
    imaginary: np.ndarray
    push: np.ndarray  # (3, slots) forces on the sites, by component
    tallies: np.ndarray  # (blocks, 10)
    virial: np.ndarray  # see `room_for_virial`


class EwaldSum(NamedTuple):
    """The sum over wave vectors one by one."""

    alpha: float  # 1/Å
    charge: np.ndarray  # (s,) in units where q²/r is an energy in u Å²/ps²
    sites: BodySites | CentralSites
    waves: Waves

    def workspace(self, setup: Setup) -> "EwaldWorkspace":
        """Room for the sums, which are always in double precision."""
        s, over = len(self.charge), self.waves
        slots = -(-s // WIDTH) * WIDTH
        angles = (3, int(over.most.max()) + 1, slots)
        sums = WaveSums(
            cell=np.zeros((3, 3)),
            reciprocal=np.zeros((3, 3)),
            position=np.zeros((s, 3)),
            force=np.zeros((s, 3)),
            charge=np.concatenate([self.charge, np.zeros(slots - s)]),
            cosine=np.zeros(angles),
            sine=np.zeros(angles),
            strength=np.zeros(over.total // 2),
            real=np.zeros(over.total // 2),
            imaginary=np.zeros(over.total // 2),
            push=np.zeros((3, slots)),
            tallies=np.zeros((len(over.bounds) - 1, TALLY_SIZE)),
            virial=room_for_virial(),
        )
        return EwaldWorkspace(self.alpha, self.sites, over, sums)


class EwaldWorkspace(NamedTuple):
    """Workspace of an `EwaldSum`."""

    alpha: float
    sites: BodySites | CentralSites
    waves: Waves
    sums: WaveSums
    code: Code | None = None

    @property
    def site_force(self) -> np.ndarray:
        """Forces (s, 3) on its sites as last evaluated, lab frame, u Å/ps²."""
        return self.sums.force

    def with_code(self) -> "EwaldWorkspace":
        """With its machine code."""
        content = (self.alpha, self.waves, self.sums)
        moved = site_tasks(self.sites, self.sums.position, self.sums.force, self.sums.virial)
        return self._replace(code=Code(turn=(_turn, content), sum=(_sum, content), push=(_push, content), **moved))


@kernel
def invert_cell(cell, reciprocal):
    """Write 2 pi times the reciprocal edges of a cell (3, 3) into the rows of `reciprocal`; returns the volume."""
    volume = 0.0
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            a, b = (c + 1) % 3, (c + 2) % 3
            reciprocal[k, c] = cell[i, a] * cell[j, b] - cell[i, b] * cell[j, a]
        volume = cell[k, 0] * reciprocal[k, 0] + cell[k, 1] * reciprocal[k, 1] + cell[k, 2] * reciprocal[k, 2]
    for k in range(3):
        for c in range(3):
            reciprocal[k, c] *= 2 * pi / volume
    return volume


@implements(terms.add_forces, EwaldWorkspace, counted=False)
def _add_ewald_sum(term, state, load, tally):
    own = term.sums
    placed, molecules = packed((term.sites, state, own.position)), blocks_of(len(state.position))
    call_blocks(term.code, "place", placed, molecules)
    if follow_cell(state.cell, own.cell):
        volume = abs(invert_cell(own.cell, own.reciprocal))
        _set_strengths(term.waves, own, term.alpha, volume)
    parcel = packed((term.alpha, term.waves, own))
    blocks = len(own.tallies)
    call_blocks(term.code, "turn", parcel, blocks)
    call_blocks(term.code, "sum", parcel, blocks)
    call_blocks(term.code, "push", parcel, blocks)
    if tally is not None:
        for block in range(blocks):
            for k in range(len(tally)):
                tally[k] += own.tallies[block, k]
        virial_of_molecules(term.sites, term.code, state, own.force, own.virial, tally)
    call_blocks(term.code, "load", packed((term.sites, state, load, own.force)), molecules)
    return OK


@kernel
def _set_strengths(over, own, alpha, volume):
    for c in range(len(over.column)):
        first = over.column[c, 3]
        for n in range(over.count[c]):
            k2 = 0.0
            for d in range(3):
                k = (
                    over.column[c, 0] * own.reciprocal[0, d]
                    + over.column[c, 1] * own.reciprocal[1, d]
                    + (over.column[c, 2] + n) * own.reciprocal[2, d]
                )
                k2 += k * k
            own.strength[first + n] = 4 * pi / volume * np.exp(-k2 / (4 * alpha * alpha)) / k2


@task(counted=False)
def _turn(parcel, block):
    """Cosines and sines for a share of the sites, by recurrence: one complex product for each multiple of the angle."""
    _alpha, over, own = opened(parcel)
    blocks, s = len(own.tallies), len(own.position)
    for i in range(s * block // blocks, s * (block + 1) // blocks):
        for d in range(3):
            turns = 0.0
            for c in range(3):
                turns += own.position[i, c] * own.reciprocal[d, c] / (2 * pi)
            angle = 2 * pi * (turns - np.floor(turns))
            cosine, sine = np.cos(angle), np.sin(angle)
            own.cosine[d, 0, i] = 1.0
            own.sine[d, 0, i] = 0.0
            for n in range(1, over.most[d] + 1):
                a, b = own.cosine[d, n - 1, i], own.sine[d, n - 1, i]
                own.cosine[d, n, i] = a * cosine - b * sine
                own.sine[d, n, i] = b * cosine + a * sine


@kernel(inline=True, counted=False)
def _phase(own, d, n, at):
    """exp(2 pi i n x_d) of a vector of sites, as (cosine, sine)."""
    cosine = load(own.cosine[d, abs(n)], at)
    sine = load(own.sine[d, abs(n)], at)
    return (cosine, sine) if n >= 0 else (cosine, -1.0 * sine)


@kernel(inline=True)
def _times(a, b):
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


@task(counted=False)
def _sum(parcel, block):
    """S(k) of the columns of a block, with energy and virial; S(k) is then multiplied for the forces."""
    alpha, over, own = opened(parcel)
    width = width_of(own.charge)
    own.tallies[block] = 0.0
    for c in range(over.bounds[block], over.bounds[block + 1]):
        first, count = over.column[c, 3], over.count[c]
        for n in range(count):
            own.real[first + n] = 0.0
            own.imaginary[first + n] = 0.0
        # sites are taken in batches that stay in the L1 cache for a whole column
        for batch in range(0, len(own.charge), 32 * width):
            end = min(batch + 32 * width, len(own.charge))
            for n in range(count):
                real = fill(0.0, own.charge)
                imaginary = fill(0.0, own.charge)
                for at in range(batch, end, width):
                    plane = _times(_phase(own, 0, over.column[c, 0], at), _phase(own, 1, over.column[c, 1], at))
                    phase = _times(plane, _phase(own, 2, over.column[c, 2] + n, at))
                    charge = load(own.charge, at)
                    real = real + charge * phase[0]
                    imaginary = imaginary + charge * phase[1]
                own.real[first + n] += total(real)
                own.imaginary[first + n] += total(imaginary)
        for n in range(count):
            _count_wave(own, alpha, over.column[c, 0], over.column[c, 1], over.column[c, 2] + n, first + n, block)


@kernel(inline=True, counted=False)
def _count_wave(own, alpha, nx, ny, nz, wave, block):
    tally = own.tallies[block]
    real, imaginary, strength = own.real[wave], own.imaginary[wave], own.strength[wave]
    energy = strength * (real * real + imaginary * imaginary)
    own.real[wave] = 2 * strength * real
    own.imaginary[wave] = 2 * strength * imaginary
    k = (
        nx * own.reciprocal[0, 0] + ny * own.reciprocal[1, 0] + nz * own.reciprocal[2, 0],
        nx * own.reciprocal[0, 1] + ny * own.reciprocal[1, 1] + nz * own.reciprocal[2, 1],
        nx * own.reciprocal[0, 2] + ny * own.reciprocal[1, 2] + nz * own.reciprocal[2, 2],
    )
    k2 = k[0] * k[0] + k[1] * k[1] + k[2] * k[2]
    tally[0] += energy
    add_wave_virial(tally, energy, k, 2 / k2 + 1 / (2 * alpha * alpha))


@kernel(inline=True)
def add_wave_virial(tally, energy, k, slope):
    """Add the virial energy (1 - slope k k) of a wave with an energy proportional to |S|² exp(-k²/4 alpha²)/(k² V).

    slope = 2/k² + 1/(2 alpha²), for sites that are scaled with the cell (Nose & Klein 1983, Mol. Phys. 50, 1055)
    """
    for row in range(3):
        for column in range(3):
            unit = 1.0 if row == column else 0.0
            tally[1 + 3 * row + column] += energy * (unit - slope * k[row] * k[column])


@task(counted=False)
def _push(parcel, block):
    """Forces on a share of the sites."""
    _alpha, over, own = opened(parcel)
    width = width_of(own.charge)
    blocks, vectors = len(own.tallies), len(own.charge) // width
    for at in range(width * (vectors * block // blocks), width * (vectors * (block + 1) // blocks), width):
        zero = fill(0.0, own.charge)
        fx, fy, fz = zero, zero, zero
        for c in range(len(over.column)):
            plane = _times(_phase(own, 0, over.column[c, 0], at), _phase(own, 1, over.column[c, 1], at))
            flat, high = zero, zero
            for n in range(over.count[c]):
                z = over.column[c, 2] + n
                phase = _times(plane, _phase(own, 2, z, at))
                wave = over.column[c, 3] + n
                push = phase[1] * own.real[wave] - phase[0] * own.imaginary[wave]
                flat = flat + push
                high = high + push * (z + 0.0)
            x, y = over.column[c, 0] + 0.0, over.column[c, 1] + 0.0
            fx = fx + flat * (x * own.reciprocal[0, 0] + y * own.reciprocal[1, 0]) + high * own.reciprocal[2, 0]
            fy = fy + flat * (x * own.reciprocal[0, 1] + y * own.reciprocal[1, 1]) + high * own.reciprocal[2, 1]
            fz = fz + flat * (x * own.reciprocal[0, 2] + y * own.reciprocal[1, 2]) + high * own.reciprocal[2, 2]
        charge = load(own.charge, at)
        for k, f in enumerate((charge * fx, charge * fy, charge * fz)):
            store(own.push[k], at, f)
        for i in range(at, min(at + width, len(own.force))):
            for k in range(3):
                own.force[i, k] = own.push[k, i]


def sum_of(
    charge: np.ndarray, position: np.ndarray, cell: np.ndarray, alpha: float, over: Waves
) -> tuple[float, np.ndarray, np.ndarray]:
    """Energy, forces (s, 3) and site virial (3, 3) of charges (s,) at positions (s, 3), in NumPy: for single uses."""
    reciprocal = 2 * pi * np.linalg.inv(cell).T
    turns = position @ reciprocal.T
    energy, force, virial = 0.0, np.zeros_like(position), np.zeros((3, 3))
    for (x, y, z, _), count in zip(over.column, over.count, strict=True):
        n = np.stack([np.full(count, x), np.full(count, y), z + np.arange(count)], axis=1)
        k = n @ reciprocal
        k2 = (k**2).sum(axis=1)
        strength = 4 * pi / abs(np.linalg.det(cell)) * np.exp(-k2 / (4 * alpha**2)) / k2
        phase = charge[:, None] * np.exp(1j * (turns @ n.T))
        total = phase.sum(axis=0)
        of = strength * np.abs(total) ** 2
        energy += of.sum()
        force += (2 * strength * (np.conj(total) * phase).imag) @ k
        virial += of.sum() * np.eye(3) - np.einsum("k,ki,kj->ij", of * (2 / k2 + 1 / (2 * alpha**2)), k, k)
    return float(energy), force, virial
