"""Minimisation of energy or enthalpy in the rigid degrees of freedom, from a state to a minimum near it, by L-BFGS."""

from collections import deque
from collections.abc import Callable
from math import inf, isfinite

import numpy as np

from rigidmd.core.state import WORK, State
from rigidmd.dynamics.barostats import LONGEST_DRIFT
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.run import checks
from rigidmd.run.enthalpy import Enthalpy, EnthalpyPoint
from rigidmd.run.overlap_removal import LONGEST_MOVE, remove_overlaps
from rigidmd.run.summary import Minimum
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, KJ_PER_MOL

#: Stored pairs of moves and changes of the gradient.
MEMORY = 20
#: Length of the first move as a fraction of the longest allowed one; doubled after each move without known curvature.
FIRST_MOVE = 0.1
#: Sufficient decrease: the least gain of a move as a fraction of slope times length (Nocedal & Wright 2006, eq. 3.4).
DECREASE = 1e-4
#: Where rounding hides the gain, the slope at the end of a move decides: it may have at most this fraction of its size
#: at the start, with the other sign (Hager & Zhang 2005, SIAM J. Optim. 16, 170, eq. 4.1 with delta = 0.1).
OPPOSITE_SLOPE = 0.8
#: Rounding error of an energy relative to the sum of its parts.
ROUNDING = 1e-13
#: Most trial moves along a direction; each is at most half as long as the one before.
TRIALS = 30
#: If a move fails with an error even after it has been shortened by this factor, the error is final.
SHORTEST = 1e-3
#: Forces above this limit, in deepest wells over the smallest diameter, come from overlaps: argon at 0.77 diameters.
OVERLAPPING = 1000.0
#: Iterations between two searches for opposite charges on top of each other.
SEARCH_INTERVAL = 100


def minimise(
    system: System, state: State, stage: Stage, stop: Callable[[], bool] = lambda: False,
    advanced: Callable[[float], object] = lambda iterations: None,
) -> Minimum:  # fmt: skip
    """Move a state, in place, to a minimum of energy or enthalpy with the limits of a stage; momenta and time stay.

    The method is L-BFGS (Nocedal & Wright 2006, algorithm 7.5) with moves of bounded length. Forces, torques and
    pressure alone decide on convergence. The change of energy is added to the energy ledger as work.

    The optimisers of libraries are not suitable: rotations form no vector space, so each iteration starts from the
    present orientations, and an unbounded line search can put a charge without repulsion on an opposite charge.

    stop : called before each iteration; the minimisation ends if it is true; advanced : called after each with 1

    Raises SimulationError if the energy has no lower bound or is not a finite number.
    """
    enthalpy = Enthalpy(system, stage, state)
    point = start = enthalpy.at(state.copy())
    if not start.is_finite:
        raise SimulationError("energy or forces are not finite numbers: sites of different molecules coincide")
    overlap_steps = _remove_overlaps(system, enthalpy, point.state, stop)
    if overlap_steps:
        point = enthalpy.at(point.state)
    descent = _Descent(enthalpy, system.smallest_diameter)
    iterations, ended_by = 0, ""
    while not (converged := _is_within(enthalpy, point, stage)):
        if iterations == stage.most_iterations:
            ended_by = f"most_iterations = {stage.most_iterations}"
            break
        if stop():
            ended_by = "interrupted"
            break
        found = descent.step(point)
        if found is None:
            ended_by = "no move lowers the energy any further"
            break
        point = found
        iterations += 1
        advanced(1)
        _check_volume(system, start, point)
        if iterations % SEARCH_INTERVAL == 0:
            _check_charges(system, point)
    if not converged:
        _check_charges(system, point)
    for name in ("position", "rotation", "cell"):
        getattr(state, name)[:] = getattr(point.state, name)
    state.energy_ledger[WORK] += point.energy - start.energy
    force, torque, deviation = enthalpy.largest(point)
    pressure = tuple(point.pressure.tolist()) if np.isfinite(point.pressure).all() else None
    return Minimum(
        converged, ended_by, iterations, overlap_steps, start.energy, point.energy, force, torque, pressure,
        deviation if stage.changes_box else None,
    )  # fmt: skip


def _is_within(enthalpy: Enthalpy, point: EnthalpyPoint, stage: Stage) -> bool:
    force, torque, deviation = enthalpy.largest(point)
    return (
        force <= stage.force_limit_kJ_mol_A * KJ_PER_MOL
        and torque <= stage.torque_limit_kJ_mol * KJ_PER_MOL
        and deviation <= stage.pressure_limit_bar * BAR
    )


class _Descent:
    """The iterations of L-BFGS and their memory.

    The components of stored vectors along rotations refer to the body axes of their own iteration. They are used
    unchanged later: the error is of the order of the rotation in between.
    """

    def __init__(self, enthalpy: Enthalpy, diameter: float):
        self._enthalpy = enthalpy
        self._longest = LONGEST_MOVE * diameter
        self._memory: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=MEMORY)
        self._fraction = FIRST_MOVE  # of the longest move, while no curvature is known

    def step(self, point: EnthalpyPoint) -> EnthalpyPoint | None:
        """The next point, lower than this one; None if there is none. Raises SimulationError."""
        found = self._along(point, self._direction(point.gradient))
        if found is None and self._memory:
            self._memory.clear()
            self._fraction = FIRST_MOVE
            found = self._along(point, self._direction(point.gradient))
        if found is None:
            return None
        move, other = found
        change = other.gradient - point.gradient
        if move @ change > 1e-8 * np.linalg.norm(move) * np.linalg.norm(change):
            self._memory.append((move, change))
        elif not self._memory:
            self._fraction = min(2 * self._fraction, 1.0)
        return other

    def _direction(self, gradient: np.ndarray) -> np.ndarray:
        """The quasi-Newton move, or one along the negative gradient; no longer than allowed."""
        if self._memory:
            found = gradient.copy()
            weights = []
            for move, change in reversed(self._memory):
                weights.append(move @ found / (move @ change))
                found -= weights[-1] * change
            move, change = self._memory[-1]
            found *= move @ change / (change @ change)
            for (move, change), weight in zip(self._memory, reversed(weights), strict=True):
                found += (weight - change @ found / (move @ change)) * move
            if found @ gradient > 1e-6 * np.linalg.norm(found) * np.linalg.norm(gradient):
                return -found * min(1.0, self._bound(found))
            self._memory.clear()
            self._fraction = FIRST_MOVE
        return -gradient * self._fraction * self._bound(gradient)

    def _bound(self, move: np.ndarray) -> float:
        """The factor that makes a move as long as allowed."""
        length, strain = self._enthalpy.reach(move)
        return 1 / max(length / self._longest, strain / LONGEST_DRIFT)

    def _along(self, point: EnthalpyPoint, direction: np.ndarray) -> tuple[np.ndarray, EnthalpyPoint] | None:
        """An accepted move along a direction, and the point it leads to; None without one. Raises SimulationError."""
        slope, length, noise = float(direction @ point.gradient), 1.0, ROUNDING * point.scale
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
            length *= min(0.5, max(0.1, -slope * length / (2 * (gain - slope * length)))) if isfinite(gain) else 0.1
        return None


def _remove_overlaps(system: System, enthalpy: Enthalpy, state: State, stop: Callable[[], bool]) -> int:
    """Remove overlaps of molecules, in place; the number of steps."""
    deepest = max((m.epsilon.max() for m in system.species), default=0.0)
    if not (deepest > 0 and enthalpy.free.any()):
        return 0
    scale, radius = system.smallest_diameter, np.array([m.radius for m in system.species])
    lightest = float(system.model.mass[system.model.species][enthalpy.free].min())
    # in this time step the limit of the force gives the lightest molecule a momentum of thermal size at kT = one well
    step = scale * np.sqrt(lightest / deepest) / OVERLAPPING
    return remove_overlaps(system.model, enthalpy.engine, state, radius, scale, deepest, step, stop).steps


def _check_volume(system: System, start: EnthalpyPoint, point: EnthalpyPoint) -> None:
    """Raise SimulationError if the box grows without bound."""
    largest, grown = system.scene.watch.volume, point.state.volume / start.state.volume
    if point.state.volume < inf and largest and grown > largest:
        raise SimulationError(
            f"the box has grown to {grown:.3g} volumes of the start (watch.volume = {largest:g}): the enthalpy has no "
            "minimum at a finite volume. Likely cause: at this pressure nothing holds the molecules together. Try a "
            "higher pressure_bar"
        )


def _check_charges(system: System, point: EnthalpyPoint) -> None:
    """Raise SimulationError if opposite charges are on top of each other: the energy then has no lower bound."""
    pair = checks.most_overlapping_pair(system, point.state, None)
    if pair is None or not pair.without_repulsion:
        return
    a, b = checks.site_labels(system, pair)
    one, other = system.sites.name[[pair.first, pair.second]]
    raise SimulationError(
        f"the energy has no lower bound: {a} and {b}, of opposite charge, are at {pair.distance:.3g} Å, and no "
        "repulsion acts between them. Try giving one of these sites sigma_A and epsilon_kJ_mol, or the pair an "
        f'entry [[forces.pairs]] with sites = ["{one}", "{other}"]'
    )
