"""Sums over the molecules of a state, and its largest values: one pass over each array, for
observations of a run."""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.state import EXAMPLE, Load, State
from rigidmd.dynamics.model import Model


class StateSums(NamedTuple):
    """In u, Å, ps."""

    translation: float  # sum m V²
    rotation: float  # sum L . I^-1 L
    torque: float  # sum n . I^-1 n
    momentum: np.ndarray  # (3,) sum m V
    momentum_flux: np.ndarray  # (3, 3) sum m V (x) V
    force_squares: np.ndarray  # (3, 3) sum F (x) F/m
    orthogonality_error: float  # largest entry of |Q^T Q - 1|; NaN if one is
    #: Second derivative of the potential energy along the free motion, sum v U'' v; NaN if unknown
    curvature: float

    @property
    def force(self) -> float:
        """Sum F²/m."""
        return float(self.force_squares.trace())


#: Number of the numbers in `StateSums`.
SUM_COUNT = 19


class LargestValues(NamedTuple):
    """The largest absolute value in each array of a state and a load. NaN if one is NaN, 0 for an
    empty array."""

    position: float
    velocity: float
    rotation: float
    angular_momentum: float
    force: float
    torque: float


#: All bits of a float64 but its sign. Read as integers they are in the order of absolute values,
#: NaN after infinity.
SIZE = np.int64(2**63 - 1)


def largest_values(state: State, load: Load = EXAMPLE[1]) -> LargestValues:
    """The largest absolute values of the arrays of a state and a load."""
    values = np.empty(len(LargestValues._fields))
    arrays = (state.position, state.velocity, state.rotation, state.angular_momentum_body, *load)
    find_largest(*(array.ravel() for array in arrays), values)
    return LargestValues(*values.tolist())


@kernel(from_python=True)
def find_largest(position, velocity, rotation, angular, force, torque, found):
    """Write the numbers (6,) of `LargestValues` into `found`. The arrays are one-dimensional."""
    bits = found.view(np.int64)
    bits[0], bits[1], bits[2] = _largest(position), _largest(velocity), _largest(rotation)
    bits[3], bits[4], bits[5] = _largest(angular), _largest(force), _largest(torque)


@kernel
def _largest(values):
    """The bits of the largest absolute value. Comparisons of integers are vectorised, of floats
    with NaN not."""
    bits = values.view(np.int64)
    most = np.int64(0)
    for k in range(len(bits)):
        most = max(most, bits[k] & SIZE)
    return most


def sums_of_state(model: Model, state: State, load: Load = EXAMPLE[1]) -> StateSums:
    """Sums over a state and the load on it. Without a load those of forces and torques are 0."""
    sums = np.zeros(SUM_COUNT)
    sums[CURVATURE] = np.nan
    fill_sums(
        model.species,
        model.mass,
        model.inverse_mass,
        model.inverse_inertia,
        state.velocity,
        state.rotation,
        state.angular_momentum_body,
        load.force,
        load.torque_body,
        sums,
    )
    return unpack_sums(sums)


def unpack_sums(sums: np.ndarray) -> StateSums:
    """The sums from the numbers of `fill_sums`."""
    rotation, torque, orthogonality_error = sums[:3].tolist()
    flux, squares = sums[[FLUX, SQUARES]]
    return StateSums(
        translation=float(flux.trace()),
        rotation=rotation,
        torque=torque,
        momentum=sums[3:6].copy(),
        momentum_flux=flux,
        force_squares=squares,
        orthogonality_error=orthogonality_error,
        curvature=float(sums[CURVATURE]),
    )


#: Positions of symmetric tensors in the numbers of `fill_sums`: xx, yy, zz, xy, xz, yz.
_TENSOR = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])
FLUX, SQUARES = 6 + _TENSOR, 12 + _TENSOR
#: Position of the curvature, which `fill_sums` leaves as it is.
CURVATURE = 18


@kernel(from_python=True)
def fill_sums(
    species, mass, inverse_mass, inverse_inertia, velocity, rotation, angular, force, torque, found
):
    """Write the numbers (SUM_COUNT,) of `StateSums` but the curvature: rotation, torque,
    orthogonality, momentum, the momentum flux and the squares of forces."""
    px = py = pz = turning = twisted = worst = 0.0
    for m in range(len(velocity)):
        m_i = mass[species[m]]
        px += m_i * velocity[m, 0]
        py += m_i * velocity[m, 1]
        pz += m_i * velocity[m, 2]
    found[3], found[4], found[5] = px, py, pz
    _fill_squares(species, mass, velocity, found, 6)
    _fill_squares(species, inverse_mass, force, found, 12)
    for m in range(len(angular)):
        for k in range(3):
            turning += inverse_inertia[species[m], k] * angular[m, k] ** 2
    for m in range(len(torque)):
        for k in range(3):
            twisted += inverse_inertia[species[m], k] * torque[m, k] ** 2
    for m in range(len(rotation)):
        for j in range(3):
            for k in range(j, 3):
                entry = -1.0 if j == k else 0.0
                for i in range(3):
                    entry += rotation[m, i, j] * rotation[m, i, k]
                if not abs(entry) <= worst and worst == worst:  # NaN is kept
                    worst = abs(entry)
    found[0], found[1], found[2] = turning, twisted, worst


@kernel
def _fill_squares(species, weights, vectors, found, at):
    """Write the sum of weight v (x) v over molecules into found[at : at + 6]."""
    xx = yy = zz = xy = xz = yz = 0.0
    for m in range(len(vectors)):
        weight = weights[species[m]]
        x, y, z = vectors[m, 0], vectors[m, 1], vectors[m, 2]
        xx += weight * x * x
        yy += weight * y * y
        zz += weight * z * z
        xy += weight * x * y
        xz += weight * x * z
        yz += weight * y * z
    found[at], found[at + 1], found[at + 2] = xx, yy, zz
    found[at + 3], found[at + 4], found[at + 5] = xy, xz, yz


@kernel
def power_and_squares(model, state, load):
    """The power of a load, sum F V + sum n . I^-1 L, and sum F²/m + sum n . I^-1 n."""
    power = squares = 0.0
    for m in range(len(state.velocity)):
        weight = model.inverse_mass[model.species[m]]
        for k in range(3):
            power += load.force[m, k] * state.velocity[m, k]
            squares += weight * load.force[m, k] ** 2
    for m in range(len(load.torque_body)):
        for k in range(3):
            weighted = model.inverse_inertia[model.species[m], k] * load.torque_body[m, k]
            power += weighted * state.angular_momentum_body[m, k]
            squares += weighted * load.torque_body[m, k]
    return power, squares


@kernel
def curvature(model, state, load, before, dt):
    """Sum v U'' v in the middle of a step: the mean squares of its loads less the change of the
    power. before : power and squares at its start"""
    power, squares = power_and_squares(model, state, load)
    return 0.5 * (before[1] + squares) - (power - before[0]) / dt
