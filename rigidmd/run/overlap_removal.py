"""Removal of overlaps before the first step: molecules on a lattice that are too close to each other are moved."""

from collections.abc import Callable
from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.momenta import mobile
from rigidmd.engines.cpu.engine import BehindWallError
from rigidmd.engines.protocol import Engine
from rigidmd.mechanics.rotation import from_vector
from rigidmd.run.checks import kicks

MOST_STEPS = 2000
LONGEST_MOVE = 0.1  # in a step, as a fraction of `scale`


class OverlapRemoval(NamedTuple):
    """Result of a removal of overlaps."""

    steps: int
    excess: float  # largest kick of the first step over the thermal momentum; good at 1 or below


def remove_overlaps(
    model: Model, engine: Engine, state: State, radius: np.ndarray, scale: float, thermal: float, dt: float,
    stop: Callable[[], bool] = lambda: False,
) -> OverlapRemoval:  # fmt: skip
    """Steepest descent with bounded moves, in place, until the kicks of the first step are small enough.

    radius (species,) : radius of each molecule (Å), which converts angles to moves; scale : the smallest Lennard-Jones
    diameter (Å). After a move that lowers the energy the next is longer by a fifth; any other move is undone and
    halved. stop : called before each step; the removal ends if it is true
    """
    load, tallies = engine.evaluate(state)
    excess = float(kicks(model, load, thermal, dt).max())
    if excess <= 1:
        return OverlapRemoval(0, excess)
    energy = sum(tally.energy for tally in tallies.values())
    length = LONGEST_MOVE * scale
    arm = np.where(radius > 0, radius, 1.0)[model.species][: len(state.rotation), None]
    free = mobile(model)
    rotates = (model.inertia > 0)[model.species][: len(state.rotation)]
    for step in range(1, MOST_STEPS + 1):  # noqa: B007  (the count is the answer)
        if stop():
            break
        # Each molecule moves along its own force by at most `length`, so overlaps do not slow down the others.
        shift = load.force * free[:, None] / np.abs(load.force[free]).max()
        rotation = load.torque_body * rotates / arm / np.abs(load.force[free]).max()
        reach = np.linalg.norm(shift, axis=1)
        reach[: len(rotation)] = np.maximum(reach[: len(rotation)], np.linalg.norm(rotation, axis=1))
        scaling = length / np.sqrt(reach.max() * np.maximum(reach, 1e-3 * reach.max()))
        before = state.copy()
        state.position[:] += shift * scaling[:, None]
        if len(rotation):
            state.rotation[:] = state.rotation @ from_vector(rotation * scaling[: len(rotation), None] / arm)
        try:
            new_load, tallies = engine.evaluate(state)
            new_energy = sum(tally.energy for tally in tallies.values())
        except BehindWallError:
            new_load, new_energy = load, inf
        if new_energy < energy:
            load, energy, length = new_load, new_energy, min(1.2 * length, LONGEST_MOVE * scale)
            excess = float(kicks(model, load, thermal, dt).max())
            if excess <= 1:
                break
        else:
            state.position[:], state.rotation[:] = before.position, before.rotation
            length *= 0.5
            if length < 1e-6 * scale:
                break
    return OverlapRemoval(step, excess)
