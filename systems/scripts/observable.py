# An observable: the dipole moment of a box of water, every 20 fs of the run.
import numpy as np

import rigidmd

E_A_IN_DEBYE = 4.80320471
scene = rigidmd.MolecularScene.from_dict(
    {
        "box": {"density_g_cm3": 0.997},
        "molecules": [{"model": "spce", "count": 216}],
        "stages": [{"ensemble": "nvt", "temperature_K": 300, "duration_ps": 0.5}],
    }
)
seen = []
simulation = rigidmd.Simulation(
    scene, observers=[rigidmd.Every(0.02, lambda moment: seen.append(dipole(moment)))]
)
charge = simulation.system.of_sites(lambda molecule: molecule.charges)


def dipole(moment: rigidmd.Moment) -> np.ndarray:
    """M (3,) in debye; molecules are neutral and whole."""
    return E_A_IN_DEBYE * charge @ moment.site_positions


simulation.run()
print("|M| =", np.linalg.norm(seen, axis=1).mean(), "D on average of", len(seen), "samples")
assert len(seen) == 26 and np.isfinite(seen).all()
