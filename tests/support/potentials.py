"""Scenes with pair potentials of users."""

from typing import NamedTuple

import numba
import numpy as np

import rigidmd
from rigidmd.features.potentials.sites.custom import energy_and_force
from support.common import ROOT, site

SCRIPTS = sorted((ROOT / "systems" / "scripts").glob("*.py"))
LJ = "4*eps*((sig/r)**12 - (sig/r)**6)"
POINTS = {
    "box": {"lengths_A": 24},
    "molecules": [
        {
            "name": "dot",
            "count": 100,
            "sites": [site("D", 40, element="Ar")],
        }
    ],
    "start": {"temperature_K": 94},
    "stages": [{"duration_ps": 0.04, "timestep_fs": 4}],
    "output": {"log_interval_ps": 0.02},
}


def points(**sections) -> rigidmd.MolecularScene:
    return rigidmd.Scene.from_dict(POINTS | sections)


@numba.njit(error_model="numpy")
def at_distance(potential, formula, end, r2):
    return energy_and_force(potential, formula, end, r2)


class Pair(NamedTuple):
    eps: float
    sig: float


ARGON = {
    "sigma": 3.405,
    "epsilon": 119.8 * 8.31446261815324e-3,
}  # of the shipped model, Å and kJ/mol


def argon_energy(r):
    """Energy (kJ/mol) and force (kJ/mol/Å) of two argon atoms."""
    six = (ARGON["sigma"] / r) ** 6
    return 4 * ARGON["epsilon"] * (six**2 - six), 24 * ARGON["epsilon"] * (2 * six**2 - six) / r


ROWS = "\n".join(f"{r:.3f} {argon_energy(r)[0]:.6g}" for r in np.arange(3.0, 9.3, 0.05))


class Spring(rigidmd.Force):
    """A spring to the origin."""

    name = "spring"

    def on_molecules(self, state):
        return 0.5 * (state.position**2).sum(), -state.position
