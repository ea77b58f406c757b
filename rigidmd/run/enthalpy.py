"""The enthalpy of molecules as a function of where they are, how they are turned, and of their cell; its gradient."""

from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.momenta import mobile
from rigidmd.assemble.system import System
from rigidmd.core.state import Load, State
from rigidmd.dynamics.boxes import COMPONENTS, COUPLINGS
from rigidmd.engines.cpu import Engine
from rigidmd.mechanics.rotation import from_vector
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR


class Point(NamedTuple):
    """What a state has of energy, and how that changes with small moves from it."""

    state: State
    energy: float  # potential, with constants and what is beyond the cut-off, u Å²/ps²
    scale: float  # sum of the sizes of its parts: rounding is relative to it
    load: Load
    pressure: np.ndarray  # (6,) by `boxes.COMPONENTS`, without that of motion, u/(Å ps²); NaN without a box
    gradient: np.ndarray  # (k,) of the enthalpy in the coordinates of `Enthalpy.moved`, u Å/ps²

    @property
    def is_finite(self) -> bool:
        """Whether energy and gradient are finite numbers."""
        return isfinite(self.energy) and bool(np.isfinite(self.gradient).all())


class Enthalpy:
    """H = U + P V of the molecules of a system that are not frozen; U alone where a stage keeps the cell.

    Small moves from a state are vectors (k,) of lengths, Å, so that the second derivatives of H are of one order:

        shifts of centres of mass (3 n), lab frame
        turns about principal axes (3 n, none of points), Q <- Q exp(hat(turn)), times the radius of the molecule
        strains of the cell, one for each coordinate of its coupling: R <- R T, cell <- cell T, with T as in `boxes`,
        the exponentials of the first three strains on its diagonal and the others below it. A strain of 1 is as long as
        sqrt(m N) distances between neighbours, of N molecules and m components that share the coordinate: the root of
        the sum of squares of what neighbours go in it

    Axes without inertia do not turn. The gradient of the strain is that of the molecular virial W = sum F (x) R:
    dU/dT_ij = -W_ji. Forces between sites are in double precision: in single, energies near a minimum have too few
    digits.

    state : whose volume scales the strain
    """

    def __init__(self, system: System, stage: Stage, state: State):
        model, self._system = system.model, system
        self.engine = Engine(model, system.terms, "double", system.scene.forces.skin_A)
        self.free = mobile(model)
        turning = len(state.rotation)
        self.turns = (model.inertia > 0)[model.species][:turning]
        radius = np.array([m.radius for m in system.species])
        self._arm = np.where(radius > 0, radius, 1.0)[model.species][:turning, None]
        #: Which coordinate each component of the strain has, -1 for none.
        self.coordinate = np.array(COUPLINGS[stage.pressure_coupling] if stage.changes_box else [-1] * 6)
        self.asked = np.array(stage.pressures[0] if stage.changes_box else [0.0] * 6) * BAR
        shared = np.bincount(self.coordinate[self.coordinate >= 0])
        n = len(state.position)
        self._lengths = np.sqrt(shared * n) * np.cbrt(state.volume / n) if len(shared) else np.zeros(0)
        self._ends = np.cumsum([state.position.size, self.turns.size])

    def at(self, state: State) -> Point:
        """Energy and gradient at a state, which is kept. Raises SimulationError."""
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
        np.add.at(slopes, self.coordinate[used], volume * (self.asked - pressure)[used])
        gradient = np.concatenate(
            [
                (-load.force * self.free[:, None]).ravel(),
                (-load.torque_body * self.turns / self._arm).ravel(),
                slopes / self._lengths,
            ]
        )
        return Point(state, sum(parts), sum(map(abs, parts)), load, pressure, gradient)

    def moved(self, state: State, move: np.ndarray) -> State:
        """A copy of a state after a move (k,)."""
        shift, turn, strain = self._parts(move)
        found = state.copy()
        if strain.any():
            matrix = np.diag(np.exp(strain[:3]))
            for k in range(3, 6):
                matrix[COMPONENTS[k]] = strain[k]
            found.position[:] = state.position @ matrix
            found.cell[:] = state.cell @ matrix
        found.position[:] += shift
        if len(turn):
            found.rotation[:] = state.rotation @ from_vector(turn / self._arm)
        return found

    def gain(self, point: Point, other: Point, move: np.ndarray) -> float:
        """By how much the enthalpy of another point, which a move led to, is higher; u Å²/ps².

        As in `boxes` the work of what the pressure has besides its mean is that of a true (Cauchy) stress in the mean
        volume: no function of the cell has it, which is why enthalpies are compared across a move only.
        """
        gained = other.energy - point.energy
        if not len(self._lengths):
            return gained
        before, after, mean = point.state.volume, other.state.volume, self.asked[:3].mean()
        deviation = self.asked - np.where(np.arange(6) < 3, mean, 0.0)
        return gained + mean * (after - before) + 0.5 * (before + after) * float(deviation @ self._parts(move)[2])

    def reach(self, move: np.ndarray) -> tuple[float, float]:
        """How far the molecule goes that a move takes furthest, by its shift or turn, Å; the largest strain."""
        shift, turn, strain = self._parts(move)
        lengths = [np.linalg.norm(part, axis=1).max(initial=0.0) for part in (shift, turn)]
        return float(max(lengths)), float(np.abs(strain).max())

    def largest(self, point: Point) -> tuple[float, float, float]:
        """Largest force on a molecule (u Å/ps²), torque about a principal axis (u Å²/ps²) and deviation of the pressure
        in a coordinate of the strain (u/(Å ps²); 0 where the cell is kept)."""
        force = np.linalg.norm(point.load.force[self.free], axis=1).max(initial=0.0)
        torque = np.abs(point.load.torque_body * self.turns).max(initial=0.0)
        off = [abs(np.mean((point.pressure - self.asked)[self.coordinate == c])) for c in range(len(self._lengths))]
        return float(force), float(torque), float(max(off, default=0.0))

    def _parts(self, move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shifts (n, 3) and turns (n, 3), both Å, and strains (6,) of a move."""
        shift, turn, strain = np.split(move, self._ends)
        each = np.append(strain / self._lengths, 0.0)[self.coordinate]
        return shift.reshape(-1, 3), turn.reshape(-1, 3), each
