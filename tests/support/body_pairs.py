"""Scenes of rods and discs whose bodies interact."""

import sys
from functools import partial
from itertools import product
from types import SimpleNamespace

import numpy as np

from rigidmd import Scene, Simulation
from rigidmd.features.potentials.poses.gay_berne import GayBerne
from support.common import site

ROD = {"length_A": 12.0, "width_A": 4.0, "epsilon_kJ_mol": 1.0, "side": 1.0, "end": 0.2}
DISC = {"length_A": 3.0, "width_A": 8.0, "epsilon_kJ_mol": 1.5, "side": 0.5, "end": 1.2}


SITES = {
    "rod": [[0.0, 0.0, 3.4], [0.0, 0.0, -3.4]],
    "disc": [[3.0, 0.0, 0.0], [-1.5, 2.6, 0.0], [-1.5, -2.6, 0.0]],
}


def body(name: str, count: int) -> dict:
    sites = [site(f"A{k}", 20.0, position) for k, position in enumerate(SITES[name])]
    return {"name": name, "count": count, "sites": sites}


def scene(forces: dict | None, counts=None, **tables) -> Scene:
    """Rods and discs in a triclinic box, with a potential of [[forces.bodies]]."""
    molecules = [body(name, count) for name, count in (counts or {"rod": 24, "disc": 8}).items()]
    return Scene.from_dict(
        {
            "box": {"lengths_A": [36.0, 37.0, 38.0], "angles_deg": [90.0, 84.0, 78.0]},
            "molecules": molecules,
            "start": {"temperature_K": 200.0},
            "precision": "double",
            "threads": 1,
            "forces": {"bodies": [forces] if forces else []},
            "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
        }
        | tables
    )


GAY_BERNE = {
    "potential": "gay_berne",
    "parameters": {"rod": ROD, "disc": DISC},
    "references": {"disc": [0.5, 0.2, 0.3]},
    "cutoff_A": 15.0,
}


def named(values: dict) -> SimpleNamespace:
    return SimpleNamespace(**values)


def evaluated(formula):
    """A formula as a function of a row of numbers and two poses, in plain Python."""
    function = sys.modules[formula.kind.__module__]._of_formula
    return partial(getattr(function, "py_func", function), formula.kind())


def simulation(tables: dict, counts=None, **more) -> Simulation:
    return Simulation(scene(tables, counts, **more), warn=str)


ENERGY = GayBerne()


def brute_force(system, state, forces: dict, energy=ENERGY) -> float:
    """The energy (kJ/mol) by a loop over all pairs and their nearest images."""
    cutoff, cell, axis = forces["cutoff_A"], state.cell, "xyz".index(forces.get("axis", "z"))
    shifts = np.array(list(product((-1, 0, 1), repeat=3))) @ cell
    models, names = system.species, [m.name for m in system.species]
    frames = [state.rotation[k] @ models[s].axes.T for k, s in enumerate(system.model.species)]
    points = []
    for k, s in enumerate(system.model.species):
        m = models[s]
        reference = np.array(forces.get("references", {}).get(m.name, m.centre)) - m.centre
        points.append(state.position[k] + frames[k] @ reference)
    total = 0.0
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            r = points[j] - points[i]
            r = r - np.rint(np.linalg.solve(cell.T, r)) @ cell
            r = min(r + shifts, key=np.linalg.norm)
            distance = np.linalg.norm(r)
            if distance >= cutoff:
                continue
            x = max(0.0, (distance / cutoff - 0.9) / 0.1)
            kinds = [names[system.model.species[k]] for k in (i, j)]
            of_pair = {}
            for pair in forces.get("pairs", ()):
                of_pair |= pair["parameters"] if sorted(kinds) == sorted(pair["species"]) else {}
            parameters = [named(forces["parameters"][name] | of_pair) for name in kinds]
            axes = frames[i][:, axis], frames[j][:, axis]
            total += (1 - x**3 * (10 - 15 * x + 6 * x * x)) * energy(r, *axes, *parameters)
    return total


LINES = {"along": [0.0, 0.0, 1.0], "across": [1.0, 0.0, 0.0], "oblique": [0.6, 0.0, 0.8]}


def line(name: str, count: int = 6) -> dict:
    """Two masses on a line."""
    ends = [[sign * x for x in LINES[name]] for sign in (1.0, -1.0)]
    sites = [site(f"A{k}", 20.0, x) for k, x in enumerate(ends)]
    return {"name": name, "count": count, "sites": sites}


def of_angles(r, first, second, dihedral):
    """An energy of two linear bodies that an exchange does not change."""
    c, d = np.cos(first), np.cos(second)
    e = c * d + np.sin(first) * np.sin(second) * np.cos(dihedral)
    return 40 * np.exp(-r / 2) * (1 + 0.4 * c * d + 0.3 * e**2 + 0.2 * (c - d) * (1 + 0.5 * e))


def written_table(path, points=(30, 25, 25, 25), **changes):
    ends = {
        "r_A": (4.0, 12.0),
        "theta_1_deg": (0, 180),
        "theta_2_deg": (0, 180),
        "phi_deg": (0, 180),
    }
    grid = {name: np.linspace(*ends[name], n) for name, n in zip(ends, points, strict=True)}
    r, *angles = np.meshgrid(*grid.values(), indexing="ij")
    grid["energy_kJ_mol"] = of_angles(r, *map(np.radians, angles))
    arrays = {name: array for name, array in (grid | changes).items() if array is not None}
    np.savez(path, **arrays)
    return path
