# A compiled force: an umbrella that holds the centre of mass of ten molecules along z.
from typing import NamedTuple

import numpy as np

import rigidmd


class Umbrella(NamedTuple):
    """stiffness/2 (Z - height)², Z the centre of mass of the first molecules."""

    fraction: np.ndarray  # (members,) of the mass of the group
    height: float  # Å
    stiffness: float  # u/ps²; 100 u/ps² are 1 kJ/mol/Å²
    changes_momentum = (False, False, True)
    absolute_positions = True


@rigidmd.compiled_force(Umbrella)
def umbrella(term, state, load, tally):
    offset = -term.height
    for m in range(len(term.fraction)):
        offset += term.fraction[m] * state.position[m, 2]
    for m in range(len(term.fraction)):
        load.force[m, 2] -= term.stiffness * offset * term.fraction[m]
    if tally is not None:
        tally[0] += 0.5 * term.stiffness * offset * offset


stage = {"ensemble": "nvt", "temperature_K": 94, "duration_ps": 4, "timestep_fs": 4}
argon = {
    "box": {"lengths_A": 25},
    "molecules": [{"model": "argon", "count": 256}],
    "stages": [stage],
}
scene = rigidmd.Scene.from_dict(argon)
results = rigidmd.Simulation(
    scene, forces=[Umbrella(np.full(10, 0.1), height=12.0, stiffness=500.0)]
).run()
offset = np.sqrt(results["umbrella"] / 2.5)  # Å, from the energy 5/2 kJ/mol/Å² times its square
print("from", offset[0], "to", offset[-1], "Å from its height in", results["time"][-1], "ps")
assert offset[-1] < offset[0]
