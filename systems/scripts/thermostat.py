# A thermostat: translation and rotation are rescaled in the middle of a step.
from math import sqrt
from typing import NamedTuple

import rigidmd
from rigidmd.dynamics.thermostats import kinetic_energy, scale_array, translational_energy
from rigidmd.units import BOLTZMANN


class Berendsen(NamedTuple):
    """Weak coupling (Berendsen et al. 1984); it samples no ensemble, and is for equilibration
    only."""

    thermal_energy: float  # kT, u Å²/ps²
    rate: float  # 1/ps
    freedom_translation: int
    freedom_rotation: int


@rigidmd.compiled_thermostat(Berendsen)
def couple(thermostat, model, state, h, draw):
    translation = translational_energy(model, state)
    rotation = kinetic_energy(model, state) - translation
    half, weight = 0.5 * thermostat.thermal_energy, h * thermostat.rate
    scale = 1 + weight * (half * thermostat.freedom_translation / translation - 1)
    scale_rotation = 1 + weight * (half * thermostat.freedom_rotation / rotation - 1)
    scale_array(state.velocity, sqrt(scale))
    scale_array(state.angular_momentum_body, sqrt(scale_rotation))
    heat = (scale - 1) * translation + (scale_rotation - 1) * rotation
    state.energy_ledger[0] += heat  # energy less heat is conserved


# in the middle of a step
stage = {
    "ensemble": "nvt",
    "temperature_K": 330,
    "duration_ps": 2,
    "integrator": "baoab",
}
water = {
    "box": {"density_g_cm3": 0.997},
    "molecules": [{"model": "spce", "count": 216}],
    "stages": [stage],
}
scene = rigidmd.MolecularScene.from_dict(water)
freedom = rigidmd.Simulation(scene).system.freedom
thermostat = Berendsen(BOLTZMANN * 330, 10.0, freedom.translation, freedom.rotation)
results = rigidmd.Simulation(scene, thermostat=thermostat).run()
print(results["temperature_translation"][-1], results["temperature_rotation"][-1], "K of", 330)
assert abs(results["temperature"][-1] - 330) < 40
