# A thermostat as a flow in a row: translation and rotation are rescaled in the middle of a step.
from math import sqrt
from typing import NamedTuple

import rigidmd
from rigidmd.dynamics.thermostats import kinetic_energy, scale_array, translational_energy
from rigidmd.units import BOLTZMANN


class Berendsen(NamedTuple):
    """Weak coupling (Berendsen et al. 1984); it samples no ensemble, and is good for the way to a temperature."""

    thermal_energy: float  # kT, u Å²/ps²
    rate: float  # 1/ps
    freedom_translation: int
    freedom_rotation: int


@rigidmd.compiled_thermostat(Berendsen)
def couple(bath, model, state, h, draw):
    moving = translational_energy(model, state)
    turning = kinetic_energy(model, state) - moving
    slower = 1 + h * bath.rate * (0.5 * bath.freedom_translation * bath.thermal_energy / moving - 1)
    calmer = 1 + h * bath.rate * (0.5 * bath.freedom_rotation * bath.thermal_energy / turning - 1)
    scale_array(state.velocity, sqrt(slower))
    scale_array(state.angular_momentum_body, sqrt(calmer))
    state.energy_ledger[0] += (slower - 1) * moving + (calmer - 1) * turning  # energy less heat is conserved


stage = {"ensemble": "nvt", "temperature_K": 330, "duration_ps": 2, "integrator": "baoab"}  # its row has a middle
water = {"box": {"density_g_cm3": 0.997}, "molecules": [{"model": "spce", "count": 216}], "stages": [stage]}
scene = rigidmd.MolecularScene.from_dict(water)
freedom = rigidmd.Simulation(scene).system.freedom
bath = Berendsen(BOLTZMANN * 330, 10.0, freedom.translation, freedom.rotation)
results = rigidmd.Simulation(scene, thermostat=bath).run()
print(results["temperature_translation"][-1], results["temperature_rotation"][-1], "K of", 330)
assert abs(results["temperature"][-1] - 330) < 40
