"""The momenta of hybrid Monte Carlo: drawn again, in whole or in part, before each trajectory."""

from math import inf, log
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import State
from rigidmd.dynamics.model import DegreesOfFreedom, Model
from rigidmd.dynamics.noise import Key
from rigidmd.dynamics.thermostats import (
    Ramp,
    Tasks,
    apply_by_molecule,
    apply_thermostat,
    task_of_energies,
    tasks_by_molecule,
)
from rigidmd.dynamics.thermostats.langevin import apply_langevin
from rigidmd.features.monte_carlo.trajectories import Trajectories
from rigidmd.scene.stage import Stage


class HybridMonteCarlo(NamedTuple):
    """New momenta, in whole or in part, before each trajectory of `monte_carlo.trajectories`:
    the flow of Langevin's thermostat over one step, whose frictions are infinite for wholly new
    momenta."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    friction_translation: float  # 1/ps
    friction_rotation: float  # 1/ps
    key: Key

    @property
    def extension(self) -> Trajectories:
        return Trajectories(self)

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        new_momenta = tasks_by_molecule(apply_langevin, self, model, state, workspace)
        return new_momenta | task_of_energies(model, state, workspace)


def thermostat(
    stage: Stage, thermal_energy: Ramp, freedom: DegreesOfFreedom, key: Key
) -> HybridMonteCarlo:
    """The record of the refreshment of momenta in a stage."""
    kept_fraction = 1 - stage.thermostat_values["momentum_refreshment"]
    friction = -log(kept_fraction) / (2 * stage.step) if kept_fraction else inf
    return HybridMonteCarlo(thermal_energy, friction, friction, key)


implements(apply_thermostat, HybridMonteCarlo)(apply_by_molecule)
