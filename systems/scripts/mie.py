# A pair potential from a NamedTuple and a function of the distance: a Mie 14-7 fluid.
from typing import NamedTuple

import rigidmd


class Mie(NamedTuple):
    """Parameters of a pair of sites."""

    epsilon: float  # kJ/mol
    sigma: float  # Å


def mie(p: Mie, r: float, inverse: float) -> tuple[float, float]:
    """Energy (kJ/mol) and force (kJ/mol/Å) of C eps ((sigma/r)^14 - (sigma/r)^7), C = 4 for these
    powers."""
    seven = (p.sigma * inverse) ** 7
    u = 4 * p.epsilon * seven
    return u * (seven - 1), u * (14 * seven - 7) * inverse


scene = rigidmd.Scene.from_dict(
    {
        "box": {"lengths_A": 25},
        "molecules": [{"model": "argon", "count": 128}, {"model": "krypton", "count": 64}],
        "forces": {"lennard_jones": False, "truncation": "shift"},
        "start": {"temperature_K": 120},
        "stages": [{"duration_ps": 2, "timestep_fs": 4}],
    }
)
# between Ar and Kr: mean sigma, root of eps
potential = rigidmd.pair_law(mie, {"Ar": Mie(1.0, 3.4), "Kr": Mie(1.4, 3.65)})
results = rigidmd.Simulation(scene, forces=[potential]).run()
print(results["mie"][-1], "kJ/mol; drift", results["drift"][-1])
assert abs(results["drift"][-1]) < 2e-3 * results["kinetic"][-1]
