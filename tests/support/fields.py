"""Molecules, fields and systems on which fields alone act."""

from math import inf

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.mechanics.rotation import random_rotations
from support.common import site, small_scene

VERLET = SCHEMES["velocity_verlet"]


#: An asymmetric body with a net charge and a dipole, its mirror image of the opposite charge, a
#: neutral dipole, a point.
KITE = [
    site("A", 10.0, [0, 0, 0], 1.0),
    site("B", 12.0, [1.2, 0.3, 0], -0.4),
    site("C", 5.0, [0, 1, 0.8], 0.1),
]
ETIK = [entry | {"charge_e": -entry["charge_e"]} for entry in KITE]
ROD = [site("P", 8.0, [0, 0, 0.5], 0.5), site("N", 9.0, [0, 0, -0.6], -0.5)]
#: One with Lennard-Jones sites away from its centre, for walls.
DUMBBELL = [
    site("L", 14.0, [0, 0, 0.5], 0.5, sigma_A=3.0, epsilon_kJ_mol=0.5),
    site("M", 6.0, [0, 0.2, -0.9], -0.5, sigma_A=2.5, epsilon_kJ_mol=0.5),
    site("H", 1.0, [1, 0, 0], 0.0),
]


def alone(counts, fields, box=None, **sections):
    """The system, engine, and start, rotated again, of molecules of these sites that only fields act
    on."""
    kinds = {
        "kite": KITE,
        "etik": ETIK,
        "rod": ROD,
        "dumbbell": DUMBBELL,
        "bead": [site("Z", 20.0, [0, 0, 0], 1.0)],
    }
    molecules = [
        {"name": name, "count": count, "sites": kinds[name]} for name, count in counts.items()
    ]
    box = box or {"lengths_A": 20.0, "periodic": False}
    system = build(
        small_scene(
            {},
            None,
            molecules=molecules,
            fields=fields,
            box=box,
            forces={"electrostatics": "none"} | sections.pop("forces", {}),
            **sections,
        )
    )
    terms = {name: term for name, term in system.terms.items() if name in system.external}
    state = system.state.copy()
    if len(state.rotation):
        state.rotation[:] = random_rotations(np.random.default_rng(4), len(state.rotation))
    return system, Engine(system.model, terms), state


STEADY = {"electric_V_per_nm": [0.3, -0.2, 0.6]}
OSCILLATING = STEADY | {"electric_frequency_per_ps": 2.5, "electric_phase_deg": 40.0}


def walls(kind, **more):
    own = (
        {"sigma_A": 3.0, "epsilon_kJ_mol": 2.0} if kind == "lj93" else {"stiffness_kJ_mol_A2": 5.0}
    )
    return {
        "walls": [
            {"axis": "z", "kind": kind, "positions_A": [-4.0, inf], "acts_on": "centres"}
            | own
            | more
        ]
    }


def slit(fields, **sections):
    """Waters between walls in a box, with a field."""
    both = {
        "axis": "z",
        "kind": "lj93",
        "positions_A": [0.0, 16.0],
        "sigma_A": 2.5,
        "epsilon_kJ_mol": 1.5,
    }
    data = {
        "box": {"lengths_A": [14.0, 14.0, 28.0]},
        "forces": {"cutoff_A": 6.9, "truncation": "smooth_switch"},
        "fields": {"walls": [both]} | fields,
        "output": {"trajectory": False},
    }
    return small_scene({"spce": 60}, 1.0, **data | sections)


LJ = {
    "axis": "z",
    "kind": "lj93",
    "positions_A": [0.0, 20.0],
    "sigma_A": 3.0,
    "epsilon_kJ_mol": 1.0,
}


HELD = {"stiffness_kJ_mol_A2": 5.0}
NO_BOX = {"box": {"lengths_A": 30.0, "periodic": False}}
