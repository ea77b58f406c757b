"""Langevin's thermostat: friction and noise on every momentum."""

from math import exp, expm1
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, load_arguments, task
from rigidmd.compile.simd import align_stack
from rigidmd.core.state import NOW, State
from rigidmd.dynamics.model import DegreesOfFreedom, Model
from rigidmd.dynamics.noise import BATCH, Key, fill_normals
from rigidmd.dynamics.thermostats import (
    Ramp,
    Tasks,
    apply_by_molecule,
    apply_thermostat,
    ramp_value,
    tasks_by_molecule,
    thermal_momenta,
)
from rigidmd.forces.neighbors.sites import molecules_of_block
from rigidmd.mechanics.batches import LANES, apply_langevin_group
from rigidmd.scene.stage import Stage


class Langevin(NamedTuple):
    """Friction and noise on every momentum, along axes that have inertia: the Ornstein-Uhlenbeck
    process, solved exactly (Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114).
    See the theory chapter `sampling`."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    friction_translation: float  # 1/ps
    friction_rotation: float  # 1/ps
    key: Key

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        return tasks_by_molecule(apply_langevin, self, model, state, workspace)


def thermostat(stage: Stage, thermal_energy: Ramp, freedom: DegreesOfFreedom, key: Key) -> Langevin:
    """The record of the Langevin thermostat of a stage."""
    return Langevin(thermal_energy, *stage.thermostat_values.values(), key)


implements(apply_thermostat, Langevin)(apply_by_molecule)


@task()
def apply_langevin(arguments, block):
    """Langevin friction and noise for the molecules of a block. The heat is written to
    workspace[block, 0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    align_stack()
    first, end = molecules_of_block(len(state.velocity), block, LANES)
    thermal = ramp_value(thermostat.thermal_energy, state)
    passed, turned = thermostat.friction_translation * h, thermostat.friction_rotation * h
    keep, keep_turning = exp(-passed), exp(-turned)
    new = thermal_momenta(model, -thermal * expm1(-2 * passed), -thermal * expm1(-2 * turned))
    words = np.empty((2, 4, BATCH), np.uint64)
    numbers = np.empty(6 * BATCH)
    heat = 0.0
    for start in range(first, end, BATCH):
        fill_normals(numbers, words, thermostat.key, draw, start, state.step[NOW])
        heat += apply_langevin_group(
            model, state, keep, keep_turning, new, numbers, start, min(end, start + BATCH)
        )
    workspace[block, 0] = heat
