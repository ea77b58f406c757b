"""Scenes that several test files use, as tables and as text. What is made of them is in `support.common`.

Kernels are compiled for the types of the force terms, which takes 95 % of the time of all tests.
What makes a type: how a potential ends (truncation), the electrostatics with the number of
coefficients that its accuracy needs, the order of splines of PME (README's water has 6), the
precision, whether the cell is slanted, open or neither, and whether all molecules are single sites.
Which models are in the scene, how many, the cutoff and the time steps make none. A test that needs nothing special takes `common.small_scene` with its
settings (truncation "switch" of all forces, reaction field), {"truncation": "smooth_switch"}, or
PME with its default accuracy, in double precision, or the defaults of a scene (PME in mixed
precision): these are compiled in any case.
"""

import numpy as np

PME = {"electrostatics": "pme", "cutoff_A": 7.0, "pme_order": 6}
WALL = [{"model": "argon", "count": 20, "frozen": True}, {"model": "spce", "count": 30}]
#: Ten systems of every kind, in a cube of 15 Å unless they state otherwise: name -> models and
#: counts, tables of the scene.
SCENES = {
    "three sites": ({"spce": 30}, {"forces": PME}),
    "four sites": ({"tip4p2005": 30}, {"forces": PME}),
    "five sites": ({"tip5p": 30}, {"forces": PME}),
    "nitrogen": ({"nitrogen": 40}, {"forces": {"cutoff_A": 7.0}}),
    "carbon dioxide": ({"co2_epm2": 20}, {"forces": PME}),
    "benzene": ({"benzene_opls": 8}, {"forces": PME}),
    "mixture": ({"spce": 20, "nitrogen": 10, "argon": 5}, {"forces": {"cutoff_A": 7.0}}),
    "ions": ({"spce": 20, "na_spce": 3, "cl_spce": 3}, {"forces": PME}),
    "frozen wall": ({}, {"molecules": WALL, "forces": PME}),
    "triclinic": (
        {"spce": 40},
        {"forces": PME, "box": {"lengths_A": [16.0, 17.0, 18.0], "angles_deg": [75.0, 80.0, 70.0]}},
    ),
}

#: Forty waters, and stages: what is stopped, continues and is read back.
FORTY_WATERS = {
    "box": {"density_g_cm3": 0.9},
    "molecules": [{"model": "spce", "count": 40}],
    "forces": {
        "cutoff_A": 5.0,
        "truncation": "smooth_switch",
        "electrostatics": "reaction_field",
        "tail_correction": False,
    },
    "precision": "double",
    "start": {"temperature_K": 298.0},
    "output": {"log_interval_ps": 0.013, "trajectory_interval_ps": 0.02, "figures": False},
}
NVT = {"ensemble": "nvt", "temperature_K": 298.0, "duration_ps": 0.1, "timestep_fs": 1.0}
NPT = NVT | {
    "ensemble": "npt",
    "pressure_bar": 1.0,
    "barostat_interval_ps": 0.007,
    "temperature_K": [298.0, 320.0],
}
NVE = {"duration_ps": 0.1, "timestep_fs": 2.0}
NPH = NVE | {"ensemble": "nph", "pressure_bar": 1.0}
MINIMISE = {"ensemble": "minimise", "max_iterations": 5}

#: The smallest scene file, to be spoilt.
GOOD = """\
[box]
lengths_A = 20.0

[[molecules]]
model = "spce"
count = 20

[[stages]]
duration_ps = 0.01
timestep_fs = 1

[start]
temperature_K = 300
"""
#: Molecules from the file FILE.
FROM_FILE = """
[[molecules]]
model = "spce"
[structure]
file = "FILE"
[box]
lengths_A = 18.0
[forces]
cutoff_A = 5.0
[start]
temperature_K = 300
[[stages]]
duration_ps = 0.01
"""
#: A body in a frame that rotates, with a wheel.
SATELLITE = """
[body]
mass_kg = 10.0
inertia_kg_m2 = [1.0, 2.0, 2.5]
[start]
quaternion_wxyz = [1.0, 0.0, 0.0, 0.1]
angular_velocity_body_rad_s = [0.1, 1.0, 0.0]
[[wheels]]
axis = [0.0, 0.0, 1.0]
motor_torque_N_m = [0.0, 0.01]
times_s = [0.0, 1.0]
[frame]
angular_velocity_rad_s = [0.0, 0.001, 0.0]
[run]
duration_s = 1.0
timestep_s = 0.01
integrator = "dop853"
relative_tolerance = 1e-9
[output]
interval_s = 0.1
"""


def forty_waters(*stages: dict, **changes) -> dict:
    """The scene of forty waters with these stages; changes replace its tables."""
    return FORTY_WATERS | {"stages": list(stages)} | changes


def structures() -> dict[str, str]:
    """Two waters in each format that is read."""
    names, one = (
        ("O", "H", "H"),
        np.array([[0, 0, 0], [0.8164904, 0.577359, 0], [-0.8164904, 0.577359, 0]]),
    )
    atoms = [
        (m, name, *(at + 2 + 6 * m)) for m in range(2) for name, at in zip(names, one, strict=True)
    ]
    rows = list(enumerate(atoms, 1))
    gro = "".join(
        f"{m + 1:5}SOL  {n:>5}{k:5}{x / 10:8.3f}{y / 10:8.3f}{z / 10:8.3f}\n"
        for k, (m, n, x, y, z) in rows
    )
    xyz = "".join(f"{n} {x} {y} {z}\n" for _, (_, n, x, y, z) in rows)
    lattice = 'Lattice="18.0 0.0 0.0 0.0 18.0 0.0 0.0 0.0 18.0" Properties=species:S:1:pos:R:3'
    pdb = "".join(
        f"ATOM  {k:5} {n:4} SOL A{m + 1:4}    {x:8.3f}{y:8.3f}{z:8.3f}  1.00  0.00           {n}\n"
        for k, (m, n, x, y, z) in rows
    )
    cif = "".join(f"{n}{k} {n} {x / 18} {y / 18} {z / 18} 1.0\n" for k, (_, n, x, y, z) in rows)
    data = "".join(
        f"{k} {m + 1} {1 if n == 'O' else 2} 0.0 {x} {y} {z}\n" for k, (m, n, x, y, z) in rows
    )
    dump = "".join(f"{k} {n} {x} {y} {z}\n" for k, (_, n, x, y, z) in rows)
    columns = "".join(
        f"_atom_site_{key}\n"
        for key in ("label", "type_symbol", "fract_x", "fract_y", "fract_z", "occupancy")
    )
    edges = "".join(f"_cell_length_{axis} 18\n" for axis in "abc")
    angles = "".join(f"_cell_angle_{angle} 90\n" for angle in ("alpha", "beta", "gamma"))
    return {
        "x.gro": f"water\n{len(rows)}\n{gro}   1.8 1.8 1.8\n",
        "x.xyz": f"{len(rows)}\nwater\n{xyz}",
        "y.xyz": f"{len(rows)}\n{lattice}\n{xyz}",
        "x.pdb": f"CRYST1   18.000   18.000   18.000  90.00  90.00  90.00 P 1           1\n{pdb}END\n",
        "x.cif": f"data_x\n{edges}{angles}loop_\n{columns}{cif}",
        "x.dump": f"ITEM: TIMESTEP\n0\nITEM: NUMBER OF ATOMS\n{len(rows)}\nITEM: BOX BOUNDS pp pp pp\n0 18\n0 18\n0 18\nITEM: ATOMS id element x y z\n{dump}",
        "x.data": f"units = real\n\n{len(rows)} atoms\n2 atom types\n0 18 xlo xhi\n0 18 ylo yhi\n0 18 zlo zhi\n\nMasses\n\n1 15.999\n2 1.008\n\nAtoms # full\n\n{data}",
    }


STRUCTURES = structures()

#: An asymmetric top on a pivot in gravity.
PINNED = {
    "body": {
        "mass_kg": 2.0,
        "inertia_kg_m2": [0.5, 0.7, 0.9],
        "pinned": True,
        "centre_of_mass_m": [0.1, 0.2, 0.3],
    },
    "start": {
        "euler_angles_deg": [10.0, 50.0, 70.0],
        "angular_velocity_body_rad_s": [1.0, -2.0, 3.0],
    },
    "gravity": {},
    "run": {"duration_s": 1.0, "timestep_s": 0.01},
    "output": {"trajectory": False, "interval_s": 0.1},
}
