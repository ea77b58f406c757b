"""Models with the constants of ASE's calculators."""

import numpy as np
from ase import units
from ase.calculators import tip3p, tip4p

from rigidmd.formats.through_ase import EV
from rigidmd.scene.models import load_model
from rigidmd.units import COULOMB, KJ_PER_MOL

#: Factor of charges that gives them ASE's Coulomb constant, of CODATA 2014.
SAME_COULOMB = float(np.sqrt(units.Hartree * units.Bohr * EV / COULOMB))


def ase_sites(model: str) -> dict:
    """A model with the numbers of ASE's calculator of the same name, and its Coulomb constant."""
    own, told = load_model(model).sites(), {"tip3p": tip3p, "tip4p": tip4p}[model]
    for site in own:
        site["charge_e"] *= SAME_COULOMB
        if "sigma_A" in site:
            site |= {
                "sigma_A": float(told.sigma0),
                "epsilon_kJ_mol": float(told.epsilon0 * EV / KJ_PER_MOL),
            }
    return {"name": model, "sites": own}
