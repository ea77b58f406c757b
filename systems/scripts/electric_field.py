# A force in plain NumPy: an electric field on rigid waters, along which their dipoles align.
import numpy as np

import rigidmd

E_PER_V_PER_NM = 9.64853321  # an elementary charge in 1 V/nm feels 9.65 kJ/mol/Å


class ElectricField(rigidmd.Force):
    """A field in V/nm, which conserves the momentum of neutral molecules."""

    changes_momentum = (False, False, False)
    absolute_positions = False  # the energy does not depend on positions: the box may change

    def __init__(self, field):
        self.field = E_PER_V_PER_NM * np.array(field, float)

    def begin(self, system):
        self.charge = system.of_sites(lambda molecule: molecule.charges)

    def on_sites(self, position, state):
        force = self.charge[:, None] * self.field
        return -(force * position).sum(), force


scene = rigidmd.Scene.from_dict(
    {
        "box": {"lengths_A": 30},
        "molecules": [{"model": "spce", "count": 64}],
        "forces": {"electrostatics": "none", "lennard_jones": False},  # free dipoles
        "start": {"temperature_K": 300},
        "stages": [{"ensemble": "nvt", "temperature_K": 300, "duration_ps": 4}],
    }
)
results = rigidmd.Simulation(scene, forces=[ElectricField([0, 0, 1.0])]).run()
half = len(results["electric_field"]) // 2
print("energy in the field:", results["electric_field"][half:].mean() / 64, "kJ/mol per molecule")
# dipoles align with the field, by Langevin's function
assert results["electric_field"][half:].mean() < 0
