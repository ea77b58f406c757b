"""Charged systems and settings that several tests of Ewald sums have in common."""

from rigidmd.assemble.build import build
from support.common import shaken, small_scene

TIGHT = {"cutoff_A": 6.4, "ewald_alpha_per_A": 0.9}  # erfc is 3e-16 at the cutoff


TIGHT_EWALD = TIGHT | {"electrostatics": "ewald", "ewald_k_max": 20}


TIGHT_PME = TIGHT | {"electrostatics": "pme", "pme_grid": [32, 36, 40], "pme_order": 8}


SALT = [
    {
        "name": "Na",
        "count": 6,
        "sites": [
            {
                "name": "NA",
                "element": "Na",
                "mass_u": 22.99,
                "charge_e": 1.0,
                "sigma_A": 2.2,
                "epsilon_K": 60.0,
                "position_A": [0.0, 0.0, 0.0],
            }
        ],
    },
    {"model": "tip4p2005", "count": 9},
]


def coulomb(components):
    """Coulomb energy of components of the potential energy."""
    return sum(energy for name, energy in components.items() if name.startswith("coulomb"))


def charged_sites(system, state):
    """Positions, charges (e) and molecules of the charged sites."""
    charge = system.of_sites(lambda m: m.charges)
    on = charge != 0
    return system.site_positions(state)[on], charge[on], system.sites.molecule[on]


def salty(edges, method, **more):
    """Ions and water with a net charge, shaken."""
    scene = small_scene({}, None, molecules=SALT, box={"lengths_A": edges}, forces=method | more)
    return shaken(build(scene), 8)
