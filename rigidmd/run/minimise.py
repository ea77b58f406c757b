"""Overlap removal, and minimisation of energy or enthalpy in the rigid degrees of freedom by
L-BFGS.

Both move a state to one near it: the first until molecules on a lattice are not too close, the
second to a minimum.
"""

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from math import inf, isfinite, nan
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.time_step import MARGIN, MIXED_ERROR
from rigidmd.core.state import WORK, Load, State
from rigidmd.dynamics.barostats import COMPONENTS, COUPLINGS, LONGEST_DRIFT
from rigidmd.dynamics.model import mobile
from rigidmd.engines.cpu.engine import BehindWallError, Precision
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.mechanics.rotation import from_vector
from rigidmd.run import checks
from rigidmd.run.checks import kicks
from rigidmd.run.summary import Minimum
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, COULOMB, KJ_PER_MOL

#: Rounding error of an energy relative to the sum of its parts. In mixed precision the difference
#: from double precision scatters by 2.7e-7 between near states of 216 SPC/E with PME, by 4e-9 for
#: 500 argon.
ROUNDING: dict[Precision, float] = {"double": 1e-13, "mixed": 3e-7}
MOST_STEPS = 2000
LONGEST_MOVE = 0.1  # in a step, as a fraction of `scale`


class OverlapRemoval(NamedTuple):
    """Result of a removal of overlaps."""

    steps: int
    excess: float  # largest kick of the first step over the thermal momentum; good at 1 or below


def remove_overlaps(
    system: System,
    engine: Engine,
    state: State,
    thermal: float,
    dt: float,
    stop: Callable[[], bool] = lambda: False,
) -> OverlapRemoval:
    """Steepest descent with bounded moves, in place, until the kicks of the first step are small
    enough.

    Moves are limited by the smallest diameter. Radii of molecules convert angles to moves. After a
    move that lowers the energy the next is longer by a fifth. Other moves are undone and halved.

    thermal, dt : scale of energies (u Å²/ps²) and time step (ps) of the kicks; stop : called before
    each step. The removal ends if it is true
    """
    model, scale = system.model, system.smallest_diameter
    load, tallies = engine.evaluate(state)
    excess = float(kicks(model, load, thermal, dt).max())
    if excess <= 1:
        return OverlapRemoval(0, excess)
    energy = sum(tally.energy for tally in tallies.values())
    length = LONGEST_MOVE * scale
    free, (rotates, arm) = mobile(model), _rotations(system, state)
    for step in range(1, MOST_STEPS + 1):  # noqa: B007  (the count is the answer)
        if stop():
            break
        # Each molecule moves along its own force by at most `length`, so overlaps do not slow down
        # the others.
        shift = load.force * free[:, None]
        rotation = load.torque_body * rotates / arm
        # in a uniform field there are torques alone
        largest = np.abs(shift).max() or np.abs(rotation).max()
        shift, rotation = shift / largest, rotation / largest
        reach = np.linalg.norm(shift, axis=1)
        reach[: len(rotation)] = np.maximum(
            reach[: len(rotation)], np.linalg.norm(rotation, axis=1)
        )
        scaling = length / np.sqrt(reach.max() * np.maximum(reach, 1e-3 * reach.max()))
        before = state.copy()
        state.position[:] += shift * scaling[:, None]
        if len(rotation):
            state.rotation[:] = state.rotation @ from_vector(
                rotation * scaling[: len(rotation), None] / arm
            )
        try:
            new_load, tallies = engine.evaluate(state)
            new_energy = sum(tally.energy for tally in tallies.values())
        except BehindWallError:
            new_load, new_energy = load, inf
        if new_energy < energy:
            load = new_load
            energy = new_energy
            length = min(1.2 * length, LONGEST_MOVE * scale)
            excess = float(kicks(model, load, thermal, dt).max())
            if excess <= 1:
                break
        else:
            state.position[:], state.rotation[:] = before.position, before.rotation
            length *= 0.5
            if length < 1e-6 * scale:
                break
    return OverlapRemoval(step, excess)


def _rotations(system: System, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Which principal axes (n, 3) rotate. Radii (n, 1) of molecules, Å, 1 for points."""
    species = system.model.species[: len(state.rotation)]
    radius = np.array([m.radius for m in system.species])
    return (system.model.inertia > 0)[species], np.where(radius > 0, radius, 1.0)[species, None]


class EnthalpyPoint(NamedTuple):
    """A state with its energy and the gradient there."""

    state: State
    energy: float  # potential energy with constants and tail correction, u Å²/ps²
    scale: float  # sum of the absolute values of its parts, to which rounding is relative
    load: Load
    #: (6,) by `barostats.COMPONENTS`, without the kinetic part, u/(Å ps²); NaN without a box
    pressure: np.ndarray
    gradient: np.ndarray  # (k,) of the enthalpy in the coordinates of `Enthalpy.moved`, u Å/ps²

    @property
    def is_finite(self) -> bool:
        return isfinite(self.energy) and bool(np.isfinite(self.gradient).all())


class Enthalpy:
    """Enthalpy U + P V for a stage with a relaxing cell, or else the potential energy U. Frozen
    molecules do not move.

    A move from a state is a vector (k,) of lengths (Å), scaled so that all second derivatives are
    of the same order:

        shifts of centres of mass (3 n), lab frame
        rotations about principal axes, Q <- Q exp(hat(phi)), as phi times the radius of the
        molecule (3 n; 0 of points) strains of the cell, one for each coordinate of the coupling: R
        <- R T, cell <- cell T, where T is lower triangular as in `barostats`, with the exponentials
        of the first three strains on its diagonal, the rest below. A strain is multiplied by sqrt(m
        N) (V/N)^(1/3), for N molecules and m components that share the coordinate. The guide
        `ensembles` has the reason and a measurement

    Axes without inertia do not rotate. The derivative for the strain follows from the molecular
    virial W = sum F (x) R, dU/dT_ij = -W_ji.

    state : its volume scales the strain
    precision : of the forces between sites. Energies near a minimum need the digits of double
        precision
    """

    def __init__(self, system: System, stage: Stage, state: State, precision: Precision = "double"):
        self._system, self.engine = system, system.engine_of(system.terms, precision)
        self.precision, self.rounding = precision, ROUNDING[precision]
        self.free, (self.rotates, self.arm) = mobile(system.model), _rotations(system, state)
        #: Coordinate of each component of the strain; -1: none.
        self.coordinate = np.array(
            COUPLINGS[stage.pressure_coupling] if stage.changes_box else [-1] * 6
        )
        self.target = np.array(stage.pressures[0] if stage.changes_box else [0.0] * 6) * BAR
        shared = np.bincount(self.coordinate[self.coordinate >= 0])
        n = len(state.position)
        self._lengths = (
            np.sqrt(shared * n) * np.cbrt(state.volume / n) if len(shared) else np.zeros(0)
        )
        self._ends = np.cumsum([state.position.size, self.rotates.size])
        self._longest = LONGEST_MOVE * system.smallest_diameter

    def at(self, state: State) -> EnthalpyPoint:
        """Energy and gradient at a state, which is not copied. Raises SimulationError."""
        load, tallies = self.engine.evaluate(state)
        parts = [*(tally.energy for tally in tallies.values()), *self._system.constants.values()]
        volume = state.volume
        pressure = np.full(6, nan)
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
        shifts = -load.force * self.free[:, None]
        rotations = -load.torque_body * self.rotates / self.arm
        gradient = np.concatenate([shifts.ravel(), rotations.ravel(), slopes / self._lengths])
        return EnthalpyPoint(state, sum(parts), sum(map(abs, parts)), load, pressure, gradient)

    def moved(self, state: State, move: np.ndarray) -> State:
        """A copy of a state after a move (k,)."""
        shift, rotation, strain = self._parts(move)
        moved_state = state.copy()
        if strain.any():
            matrix = np.diag(np.exp(strain[:3]))
            for k in range(3, 6):
                matrix[COMPONENTS[k]] = strain[k]
            moved_state.position[:] = state.position @ matrix
            moved_state.cell[:] = state.cell @ matrix
        moved_state.position[:] += shift
        if len(rotation):
            moved_state.rotation[:] = state.rotation @ from_vector(rotation / self.arm)
        return moved_state

    def gain(self, point: EnthalpyPoint, other: EnthalpyPoint, move: np.ndarray) -> float:
        """Change of the enthalpy by a move from a point to another, u Å²/ps².

        Deviatoric pressures act as true (Cauchy) stress, as in `barostats`: their work is taken in
        the mean volume of the move. No function of the cell has these differences, so only changes
        of the enthalpy are defined.
        """
        gained = other.energy - point.energy
        if not len(self._lengths):
            return gained
        before = point.state.volume
        after = other.state.volume
        mean = self.target[:3].mean()
        deviation = self.target - np.where(np.arange(6) < 3, mean, 0.0)
        return (
            gained
            + mean * (after - before)
            + 0.5 * (before + after) * float(deviation @ self._parts(move)[2])
        )

    def bound(self, move: np.ndarray) -> float:
        """The factor that makes a move as long as allowed, in shift or rotation of a molecule and
        in strain."""
        shift, rotation, strain = self._parts(move)
        length = max(np.linalg.norm(part, axis=1).max(initial=0.0) for part in (shift, rotation))
        return float(1 / max(length / self._longest, np.abs(strain).max() / LONGEST_DRIFT))

    def largest(self, point: EnthalpyPoint) -> tuple[float, float, float]:
        """Largest force (u Å/ps²), torque about a principal axis (u Å²/ps²) and deviation of the
        pressure (u/(Å ps²)). Pressures are averaged over the components that share a coordinate, 0
        if the cell does not relax."""
        force = np.linalg.norm(point.load.force[self.free], axis=1).max(initial=0.0)
        torque = np.abs(point.load.torque_body * self.rotates).max(initial=0.0)
        off = [
            abs(np.mean((point.pressure - self.target)[self.coordinate == c]))
            for c in range(len(self._lengths))
        ]
        return float(force), float(torque), float(max(off, default=0.0))

    def _parts(self, move: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shifts (n, 3) and scaled rotations (n, 3), Å, and strains (6,) of a move."""
        shift, rotation, strain = np.split(move, self._ends)
        each = np.append(strain / self._lengths, 0.0)[self.coordinate]
        return shift.reshape(-1, 3), rotation.reshape(-1, 3), each


#: Stored pairs of moves and changes of the gradient.
MEMORY = 20
#: Length of the first move as a fraction of the longest allowed one; doubled after each move
#: without known curvature.
FIRST_MOVE = 0.1
#: Sufficient decrease: the least gain of a move as a fraction of slope times length (Nocedal &
#: Wright 2006, eq. 3.4).
DECREASE = 1e-4
#: Where rounding hides the gain, the slope at the end of a move decides: it may have at most this
#: fraction of its size at the start, with the other sign (Hager & Zhang 2005, SIAM J. Optim. 16,
#: 170, eq. 4.1 with delta = 0.1).
OPPOSITE_SLOPE = 0.8
#: Maximum number of line-search trials; each is at most half as long as the one before.
TRIALS = 30
#: If a move fails with an error even after it has been shortened by this factor, the error is
#: final.
SHORTEST = 1e-3
#: Forces above this limit, in deepest wells over the smallest diameter, come from overlaps: argon
#: at 0.77 diameters.
OVERLAPPING = 1000.0
#: Iterations between two searches for opposite charges on top of each other.
SEARCH_INTERVAL = 100


def precision_of_minimisation(system: System, stage: Stage) -> Precision:
    """The precision of the scene where the limits of a stage are far above the error of its forces,
    else double.

    The scale of forces is given by the deepest well and by the largest charges at one diameter. A
    pressure is the small difference of large parts, so that a cell relaxes in double precision.
    """
    if stage.changes_box:
        return "double"
    diameter = system.smallest_diameter
    wells = 24 * max((m.epsilon.max(initial=0.0) for m in system.species), default=0.0) / diameter
    charges = max((np.abs(m.charge).max(initial=0.0) for m in system.species), default=0.0)
    force = max(wells, COULOMB * charges**2 / diameter**2)
    limit = min(stage.force_limit_kJ_mol_A, stage.torque_limit_kJ_mol / diameter) * KJ_PER_MOL
    return system.precision if limit >= MARGIN * MIXED_ERROR * force else "double"


def _first_point(system: System, stage: Stage, state: State) -> tuple[Enthalpy, EnthalpyPoint]:
    """The enthalpy in the precision of a stage, or in double precision if the other has no numbers
    large enough."""
    if precision_of_minimisation(system, stage) == "mixed":
        with suppress(SimulationError):
            enthalpy = Enthalpy(system, stage, state, "mixed")
            point = enthalpy.at(state.copy())
            if point.is_finite:
                return enthalpy, point
    enthalpy = Enthalpy(system, stage, state)
    return enthalpy, enthalpy.at(state.copy())


def minimise(
    system: System,
    state: State,
    stage: Stage,
    stop: Callable[[], bool] = lambda: False,
    advanced: Callable[[float], object] = lambda iterations: None,
) -> Minimum:
    """Move a state, in place, to a minimum of energy or enthalpy with the limits of a stage.
    Momenta and time stay.

    The method is L-BFGS (Nocedal & Wright 2006, algorithm 7.5) with moves of bounded length.
    Forces, torques and pressure alone decide on convergence. The change of energy is added to the
    energy ledger as work.

    The optimisers of libraries are not suitable: rotations form no vector space, so each iteration
    starts from the current orientations, and an unbounded line search can put a charge without
    repulsion on an opposite charge.

    Forces have the precision of the scene if the limits are far above its error, and double
    precision from where no move lowers the energy in the other.

    stop : called before each iteration. The minimisation ends if it is true; advanced : called
        after each with 1

    Raises SimulationError if the energy has no lower bound or is not a finite number, or the box
    grows without bound.
    """
    enthalpy, point = _first_point(system, stage, state)
    start = point
    if not start.is_finite:
        raise SimulationError(
            "energy or forces are not finite numbers: sites of different molecules coincide"
        )
    overlap_steps = 0
    deepest = max((m.epsilon.max() for m in system.species), default=0.0)
    if deepest > 0 and enthalpy.free.any():
        lightest = float(system.model.mass[system.model.species][enthalpy.free].min())
        # in this step the limit of the force gives the lightest molecule a momentum of thermal size
        # at kT = one well
        dt = system.smallest_diameter * np.sqrt(lightest / deepest) / OVERLAPPING
        overlap_steps = remove_overlaps(
            system, enthalpy.engine, point.state, deepest, dt, stop
        ).steps
    if overlap_steps:
        point = enthalpy.at(point.state)
    descent = _Descent(enthalpy)
    iterations = 0
    ended_by = ""
    while True:
        force, torque, deviation = enthalpy.largest(point)
        converged = (
            force <= stage.force_limit_kJ_mol_A * KJ_PER_MOL
            and torque <= stage.torque_limit_kJ_mol * KJ_PER_MOL
            and deviation <= stage.pressure_limit_bar * BAR
        )
        if converged or ended_by:
            break
        if iterations == stage.max_iterations:
            ended_by = f"max_iterations = {stage.max_iterations}"
        elif stop():
            ended_by = "interrupted"
        elif (lower := descent.step(point)) is not None:
            point = lower
            iterations = iterations + 1
            advanced(1)
            largest = system.scene.watch.volume
            grown = point.state.volume / start.state.volume
            if point.state.volume < inf and largest and grown > largest:
                raise SimulationError(
                    f"the box has grown to {grown:.3g} volumes of the start (watch.volume ="
                    f" {largest:g}): the enthalpy has no minimum at a finite volume. Likely cause:"
                    " at this pressure nothing holds the molecules together. Try a higher"
                    " pressure_bar"
                )
            if iterations % SEARCH_INTERVAL == 0:
                _check_charges(system, point)
        elif enthalpy.precision == "mixed":
            enthalpy = Enthalpy(system, stage, state)
            start, point = enthalpy.at(start.state), enthalpy.at(point.state)
            descent = _Descent(enthalpy)
        else:
            ended_by = "no move lowers the energy any further"
    if not converged:
        _check_charges(system, point)
    for name in ("position", "rotation", "cell"):
        getattr(state, name)[:] = getattr(point.state, name)
    state.energy_ledger[WORK] += point.energy - start.energy
    pressure = tuple(point.pressure.tolist()) if np.isfinite(point.pressure).all() else None
    return Minimum(
        converged,
        ended_by,
        iterations,
        overlap_steps,
        start.energy,
        point.energy,
        force,
        torque,
        pressure,
        deviation if stage.changes_box else None,
        enthalpy.precision,
    )


class _Descent:
    """The iterations of L-BFGS and their memory.

    The components of stored vectors along rotations refer to the body axes of their own iteration.
    They are used unchanged later: the error is of the order of the rotation in between.
    """

    def __init__(self, enthalpy: Enthalpy):
        self._enthalpy = enthalpy
        self._memory: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MEMORY)
        self._fraction = FIRST_MOVE  # of the longest move, while no curvature is known

    def step(self, point: EnthalpyPoint) -> EnthalpyPoint | None:
        """The next point, lower than this one. None if there is none. Raises SimulationError."""
        move_and_point = self._along(point, self._direction(point.gradient))
        if move_and_point is None and self._memory:
            self._memory.clear()
            self._fraction = FIRST_MOVE
            return self.step(point)
        if move_and_point is None:
            return None
        move, other = move_and_point
        change = other.gradient - point.gradient
        if move @ change > 1e-8 * np.linalg.norm(move) * np.linalg.norm(change):
            self._memory.append((move, change))
        elif not self._memory:
            self._fraction = min(2 * self._fraction, 1.0)
        return other

    def _direction(self, gradient: np.ndarray) -> np.ndarray:
        """The quasi-Newton move, or one along the negative gradient. No longer than allowed."""
        if self._memory:
            direction = gradient.copy()
            weights = []
            for move, change in reversed(self._memory):
                weights.append(move @ direction / (move @ change))
                direction -= weights[-1] * change
            move, change = self._memory[-1]
            direction *= move @ change / (change @ change)
            for (move, change), weight in zip(self._memory, reversed(weights), strict=True):
                direction += (weight - change @ direction / (move @ change)) * move
            if direction @ gradient > 1e-6 * np.linalg.norm(direction) * np.linalg.norm(gradient):
                return -direction * min(1.0, self._enthalpy.bound(direction))
            self._memory.clear()
            self._fraction = FIRST_MOVE
        return -gradient * self._fraction * self._enthalpy.bound(gradient)

    def _along(
        self, point: EnthalpyPoint, direction: np.ndarray
    ) -> tuple[np.ndarray, EnthalpyPoint] | None:
        """An accepted move along a direction, and the point it leads to. None without one. Raises
        SimulationError."""
        slope = float(direction @ point.gradient)
        length = 1.0
        noise = self._enthalpy.rounding * point.scale
        for _ in range(TRIALS):
            move = length * direction
            try:
                other = self._enthalpy.at(self._enthalpy.moved(point.state, move))
            except SimulationError:  # behind a wall, or a box too small for the cutoff
                if length < SHORTEST:
                    raise
                length *= 0.1
                continue
            gain = self._enthalpy.gain(point, other, move) if other.is_finite else inf
            lower = gain <= DECREASE * length * slope
            flat = gain <= noise and other.gradient @ direction <= OPPOSITE_SLOPE * abs(slope)
            if lower or flat:
                return move, other
            length *= (
                min(0.5, max(0.1, -slope * length / (2 * (gain - slope * length))))
                if isfinite(gain)
                else 0.1
            )
        return None


def _check_charges(system: System, point: EnthalpyPoint) -> None:
    """Raise SimulationError if opposite charges are on top of each other: the energy then has no
    lower bound."""
    pair = checks.most_overlapping_pair(system, point.state, None)
    if pair is None or not pair.without_repulsion:
        return
    a, b = checks.site_labels(system, pair)
    raise SimulationError(
        f"the energy has no lower bound: {a} and {b}, of opposite charge, are at"
        f" {pair.distance:.3g} Å, and no repulsion acts between them."
        f" {checks.advice_on_repulsion(system, pair)}"
    )
