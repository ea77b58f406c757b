"""Charged systems and settings that several tests of Ewald sums have in common."""

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.forces.neighbors.space import cell_of
from support.common import shaken, site, small_scene
from support.reference import EwaldOracle

TIGHT = {"cutoff_A": 6.4, "ewald_alpha_per_A": 0.9}  # erfc is 3e-16 at the cutoff
TIGHT_EWALD = TIGHT | {"electrostatics": "ewald", "ewald_k_max": 20}
TIGHT_PME = TIGHT | {"electrostatics": "pme", "pme_grid": [32, 36, 40], "pme_order": 8}


SALT = [
    {
        "name": "Na",
        "count": 6,
        "sites": [site("NA", 22.99, charge=1.0, element="Na", sigma_A=2.2, epsilon_K=60.0)],
    },
    {"model": "tip4p2005", "count": 9},
]
#: A box for them.
EDGES = [13.0, 14.0, 15.0]


def coulomb(components):
    """Coulomb energy of components of the potential energy."""
    return sum(energy for name, energy in components.items() if name.startswith("coulomb"))


def charged_sites(system, state):
    """Positions, charges (e) and molecules of the charged sites."""
    charge = system.of_sites(lambda m: m.charges)
    on = charge != 0
    return system.site_positions(state)[on], charge[on], system.sites.molecule[on]


def salty(method, **more):
    """Ions and water with a net charge, shaken."""
    scene = small_scene({}, None, molecules=SALT, box={"lengths_A": EDGES}, forces=method | more)
    return shaken(build(scene), 8)


def everything(n):
    """All k-vectors that the oracle has."""
    return np.full(len(n), True)


def oracle_of(system, state, alpha, cutoff, inside=everything, chosen=slice(None)) -> EwaldOracle:
    """The oracle for the charged sites of a system, or for some of them."""
    sites = (values[chosen] for values in charged_sites(system, state))
    return EwaldOracle(*sites, cell_of(system.space), alpha, cutoff, inside)
