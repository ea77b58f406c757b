# A compiled force: an umbrella that holds the centre of mass of ten molecules along z.
from typing import NamedTuple

import numpy as np

import rigidmd


class Umbrella(NamedTuple):
    """stiffness/2 (Z - height)², Z the centre of mass of the first molecules."""

    share: np.ndarray  # (members,) of the group's mass
    height: float  # Å
    stiffness: float  # u/ps²; 100 of them are 1 kJ/mol/Å²
    changes_momentum = (False, False, True)
    tied_to_places = True


@rigidmd.compiled_force(Umbrella)
def umbrella(term, state, load, tally):
    away = -term.height
    for m in range(len(term.share)):
        away += term.share[m] * state.position[m, 2]
    for m in range(len(term.share)):
        load.force[m, 2] -= term.stiffness * away * term.share[m]
    if tally is not None:
        tally[0] += 0.5 * term.stiffness * away * away


stage = {"ensemble": "nvt", "temperature_K": 94, "duration_ps": 4, "timestep_fs": 4}
argon = {"box": {"lengths_A": 25}, "molecules": [{"model": "argon", "count": 256}], "stages": [stage]}
scene = rigidmd.Scene.from_dict(argon)
results = rigidmd.Simulation(scene, forces=[Umbrella(np.full(10, 0.1), height=12.0, stiffness=500.0)]).run()
away = np.sqrt(results["umbrella"] / 2.5)  # Å, from the energy 5/2 kJ/mol/Å² times its square
print("from", away[0], "to", away[-1], "Å from its height in", results["time"][-1], "ps")
assert away[-1] < away[0]
