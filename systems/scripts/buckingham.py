# A pair potential from a formula for its energy: argon with Buckingham's exponential repulsion.
import numpy as np

import rigidmd

# exp-6 with a well of 1.0 kJ/mol at 3.8 Å: A exp(-B r) - C/r^6, B = 14/3.8 per Å
alpha, well, distance = 14.0, 1.0, 3.8
argon = {
    "A": well * 6 / (alpha - 6) * np.exp(alpha),
    "B": alpha / distance,
    "C": well * alpha / (alpha - 6) * distance**6,
}
potential = rigidmd.pair_potential(
    "A*exp(-B*r) - C/r**6", {"Ar": argon}, name="buckingham", truncation="switch"
)

scene = rigidmd.Scene.from_dict(
    {
        "box": {"lengths_A": 25},
        "molecules": [{"model": "argon", "count": 256}],
        "forces": {"lennard_jones": False},  # replaced by the potential
        "start": {"temperature_K": 94},
        "stages": [{"duration_ps": 2, "timestep_fs": 4}],
    }
)
results = rigidmd.Simulation(scene, forces=[potential]).run()

# the energy of the last frame by NumPy, without the switch between 8.1 and 9 Å
position = results.state.position
between = position[:, None] - position
between -= 25 * np.rint(between / 25)
r = np.linalg.norm(between, axis=-1)[np.triu_indices(256, 1)]
r = r[r < 9]
expected = (argon["A"] * np.exp(-argon["B"] * r) - argon["C"] / r**6).sum()
print(
    results["buckingham"][-1],
    "kJ/mol;",
    expected,
    "without the switch; drift",
    results["drift"][-1],
)
assert abs(results["buckingham"][-1] / expected - 1) < 0.02
assert abs(results["drift"][-1]) < 1e-3 * results["kinetic"][-1]
