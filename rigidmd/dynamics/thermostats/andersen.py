"""Andersen's thermostat: random collisions that redraw the momenta of single molecules."""

from math import exp
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, load_arguments, task
from rigidmd.core.state import NOW, State
from rigidmd.dynamics.model import DegreesOfFreedom, Model
from rigidmd.dynamics.noise import Key, normals, uniforms
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
from rigidmd.mechanics.batches import LANES
from rigidmd.scene.stage import Stage


class Andersen(NamedTuple):
    """Random collisions, on average after `time_constant`, that redraw the momenta of one molecule
    (Andersen 1980)."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps
    key: Key

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        return tasks_by_molecule(_apply_andersen, self, model, state, workspace)


def thermostat(stage: Stage, thermal_energy: Ramp, freedom: DegreesOfFreedom, key: Key) -> Andersen:
    """The record of the Andersen thermostat of a stage."""
    return Andersen(thermal_energy, stage.thermostat_time, key)


implements(apply_thermostat, Andersen)(apply_by_molecule)


@task()
def _apply_andersen(arguments, block):
    """Andersen collisions with the molecules of a block. The heat is written to workspace[block,
    0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    velocity, momentum = state.velocity, state.angular_momentum_body
    first, end = molecules_of_block(len(velocity), block, LANES)
    step = state.step[NOW]
    missed = exp(-h / thermostat.time_constant)
    thermal = ramp_value(thermostat.thermal_energy, state)
    new = thermal_momenta(model, thermal, thermal)
    heat = 0.0
    for m in range(first, end):
        chance, _ = uniforms(thermostat.key, draw, m, step)
        if chance <= missed:
            continue
        kind = model.species[m]
        for k in range(3):
            of_velocity, of_momentum = normals(thermostat.key, draw + 1 + k, m, step)
            after = new[kind, 3] * of_velocity
            heat += 0.5 * model.mass[kind] * (after * after - velocity[m, k] ** 2)
            velocity[m, k] = after
            if len(momentum) > 0:
                after = new[kind, k] * of_momentum
                heat += 0.5 * model.inverse_inertia[kind, k] * (after * after - momentum[m, k] ** 2)
                momentum[m, k] = after
    workspace[block, 0] = heat
