"""Stochastic velocity rescaling: one thermostat of translation and one of rotation."""

from math import exp, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import HEAT, NOW, State
from rigidmd.dynamics.model import DegreesOfFreedom, Model
from rigidmd.dynamics.noise import Key, chi_square, normals
from rigidmd.dynamics.thermostats import (
    Ramp,
    Tasks,
    apply_thermostat,
    kinetic_energies_of,
    ramp_value,
    scale_momenta,
    tasks_of_scaling,
)
from rigidmd.scene.stage import Stage


class VelocityRescaling(NamedTuple):
    """Stochastic velocity rescaling (Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101)
    by two thermostats, one of translation and one of rotation: see the theory chapter
    `sampling`."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps; infinite: no effect
    freedom_translation: int
    freedom_rotation: int
    key: Key

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        return tasks_of_scaling(model, state, workspace)


def thermostat(
    stage: Stage, thermal_energy: Ramp, freedom: DegreesOfFreedom, key: Key
) -> VelocityRescaling:
    """The record of velocity rescaling in a stage."""
    return VelocityRescaling(
        thermal_energy, stage.thermostat_time, freedom.translation, freedom.rotation, key
    )


@implements(apply_thermostat, VelocityRescaling)
def _apply_rescaling(thermostat, model, code, state, workspace, h, draw):
    if thermostat.time_constant == inf:
        return
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    factors = np.ones(2)
    step = state.step[NOW]
    c = exp(-h / thermostat.time_constant)
    thermal = 0.5 * ramp_value(thermostat.thermal_energy, state) * (1 - c)
    energies = (moving, turning)
    freedoms = (thermostat.freedom_translation, thermostat.freedom_rotation)
    for k in range(2):
        kinetic, freedom = energies[k], freedoms[k]
        if kinetic == 0.0 or freedom == 0:
            continue
        # eq. A7: one Gaussian, and the sum of the squares of the others as one number
        noise = thermal / kinetic
        gauss, _ = normals(thermostat.key, draw, k, step)
        others = chi_square(thermostat.key, draw + 1, k, step, freedom - 1)
        square = c + noise * (gauss * gauss + others) + 2 * gauss * sqrt(c * noise)
        state.energy_ledger[HEAT] += (square - 1) * kinetic
        factors[k] = sqrt(square)
    scale_momenta(code, state, factors[0], factors[1])
