"""Enthalpy of rigid molecules as a function of positions, orientations and cell, and its gradient."""

from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.dynamics.barostats import COMPONENTS, COUPLINGS
from rigidmd.dynamics.momenta import mobile
from rigidmd.engines.system import System
from rigidmd.mechanics.rotation import from_vector
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR


class EnthalpyPoint(NamedTuple):
    """A state with its energy and the gradient there."""

    state: State
    energy: float  # potential energy with constants and tail correction, u Å²/ps²
    scale: float  # sum of the absolute values of its parts, to which rounding is relative
    load: Load
    pressure: np.ndarray  # (6,) by `barostats.COMPONENTS`, without the kinetic part, u/(Å ps²); NaN without a box
    gradient: np.ndarray  # (k,) of the enthalpy in the coordinates of `Enthalpy.moved`, u Å/ps²

    @property
    def is_finite(self) -> bool:
        return isfinite(self.energy) and bool(np.isfinite(self.gradient).all())


class Enthalpy:
    """Enthalpy U + P V for a stage with a relaxing cell, or else the potential energy U. Frozen molecules do not move.

    A move from a state is a vector (k,) of lengths (Å), scaled so that all second derivatives are of the same order:

        shifts of centres of mass (3 n), lab frame
        rotations about principal axes, Q <- Q exp(hat(phi)), as phi times the radius of the molecule (3 n; 0 of points)
        strains of the cell, one for each coordinate of the coupling: R <- R T, cell <- cell T, where T is lower
        triangular as in `barostats`, with the exponentials of the first three strains on its diagonal, the rest below.
        A strain is multiplied by sqrt(m N) (V/N)^(1/3), for N molecules and m components that share the coordinate:
        in a strain all N distances to neighbours, about (V/N)^(1/3), change together. A flexible cell of ice Ih (192
        TIP4P/2005) took 50 iterations; 54 and 338 with strains scaled by 0.3 and 3 times as much, 63 and 59 with
        rotations scaled by 0.5 and 2 times as much

    Axes without inertia do not rotate. The derivative for the strain follows from the molecular virial W = sum F (x) R,
    dU/dT_ij = -W_ji. Forces are in double precision, as energies need many digits near a minimum.

    state : its volume scales the strain
    """

    def __init__(self, system: System, stage: Stage, state: State):
        model, self._system = system.model, system
        self.engine = system.engine_of(system.terms, "double")
        self.free = mobile(model)
        count = len(state.rotation)
        self.rotates = (model.inertia > 0)[model.species][:count]
        radius = np.array([m.radius for m in system.species])
        self._arm = np.where(radius > 0, radius, 1.0)[model.species][:count, None]
        #: Coordinate of each component of the strain; -1: none.
        self.coordinate = np.array(COUPLINGS[stage.pressure_coupling] if stage.changes_box else [-1] * 6)
        self.target = np.array(stage.pressures[0] if stage.changes_box else [0.0] * 6) * BAR
        shared = np.bincount(self.coordinate[self.coordinate >= 0])
        n = len(state.position)
        self._lengths = np.sqrt(shared * n) * np.cbrt(state.volume / n) if len(shared) else np.zeros(0)
        self._ends = np.cumsum([state.position.size, self.rotates.size])

    def at(self, state: State) -> EnthalpyPoint:
        """Energy and gradient at a state, which is not copied. Raises SimulationError."""
        load, tallies = self.engine.evaluate(state)
        parts = [*(tally.energy for tally in tallies.values()), *self._system.constants.values()]
        volume, pressure = state.volume, np.full(6, nan)
        if volume < inf:
            virial = sum((tally.virial for tally in tallies.values()), np.zeros((3, 3)))
            pressure = np.array([virial[j, i] for i, j in COMPONENTS]) / volume
            pressure[:3] += self._system.constant_pressure
            if self._system.tail is not None:
                parts.append(self._system.tail.energy(volume))
                pressure[:3] += self._system.tail.pressure(volume)
        used = self.coordinate >= 0
        slopes = np.zeros(len(self._lengths))
        np.add.at(slopes, self.coordinate[used], volume * (self.target - pressure)[used])
        gradient = np.concatenate(
            [
                (-load.force * self.free[:, None]).ravel(),
                (-load.torque_body * self.rotates / self._arm).ravel(),
                slopes / self._lengths,
            ]
        )
        return EnthalpyPoint(state, sum(parts), sum(map(abs, parts)), load, pressure, gradient)

    def moved(self, state: State, move: np.ndarray) -> State:
        """A copy of a state after a move (k,)."""
        shift, rotation, strain = self._parts(move)
        found = state.copy()
        if strain.any():
            matrix = np.diag(np.exp(strain[:3]))
            for k in range(3, 6):
                matrix[COMPONENTS[k]] = strain[k]
            found.position[:] = state.position @ matrix
            found.cell[:] = state.cell @ matrix
        found.position[:] += shift
        if len(rotation):
            found.rotation[:] = state.rotation @ from_vector(rotation / self._arm)
        return found

    def gain(self, point: EnthalpyPoint, other: EnthalpyPoint, move: np.ndarray) -> float:
        """Change of the enthalpy by a move from a point to another, u Å²/ps².

        Deviatoric pressures act as true (Cauchy) stress, as in `barostats`: their work is taken in the mean volume of
        the move. No function of the cell has these differences, so only changes of the enthalpy are defined.
        """
        gained = other.energy - point.energy
        if not len(self._lengths):
            return gained
        before, after, mean = point.state.volume, other.state.volume, self.target[:3].mean()
        deviation = self.target - np.where(np.arange(6) < 3, mean, 0.0)
        return gained + mean * (after - before) + 0.5 * (before + after) * float(deviation @ self._parts(move)[2])

    def reach(self, move: np.ndarray) -> tuple[float, float]:
        """Largest shift or rotation (times the radius) of a molecule in a move, Å; largest strain."""
        shift, rotation, strain = self._parts(move)
        lengths = [np.linalg.norm(part, axis=1).max(initial=0.0) for part in (shift, rotation)]
        return float(max(lengths)), float(np.abs(strain).max())

    def largest(self, point: EnthalpyPoint) -> tuple[float, float, float]:
        """Largest force (u Å/ps²), torque about a principal axis (u Å²/ps²) and deviation of the pressure (u/(Å ps²)).

        Pressures are averaged over the components that share a coordinate; 0 if the cell does not relax.
        """
        force = np.linalg.norm(point.load.force[self.free], axis=1).max(initial=0.0)
        torque = np.abs(point.load.torque_body * self.rotates).max(initial=0.0)
        off = [abs(np.mean((point.pressure - self.target)[self.coordinate == c])) for c in range(len(self._lengths))]
        return float(force), float(torque), float(max(off, default=0.0))

    def _parts(self, move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shifts (n, 3) and scaled rotations (n, 3), Å, and strains (6,) of a move."""
        shift, rotation, strain = np.split(move, self._ends)
        each = np.append(strain / self._lengths, 0.0)[self.coordinate]
        return shift.reshape(-1, 3), rotation.reshape(-1, 3), each
