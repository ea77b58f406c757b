"""The nematic order parameter of GB(3, 5, 2, 1) along an isotherm, from crystals of parallel rods.

    python tests/benchmarks/liquid_crystal.py --to FOLDER --temperature 0.95 --densities 0.28,0.30,0.32

Density and temperature in units of the potential. A run in FOLDER that was interrupted is resumed.
"""

from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.errors import OutputError
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WIDTH, DEPTH = 4.0, 3.5  # Å, kJ/mol
#: Edges (Å) of a cell of two rods at the density 0.32, and how often it is repeated.
CELL, DENSITY, REPEAT = (5.2, 5.2, 14.793), 0.32, [7, 7, 3]
MELTING = 1 if SMOKE else 50  # ps
SITES = [
    {"name": name, "mass_u": 100, "position_A": [0, 0, z]} for name, z in (("A", 2), ("B", -2))
]
ROD = {"length_A": 3 * WIDTH, "width_A": WIDTH, "epsilon_kJ_mol": DEPTH, "side": 1, "end": 0.2}


def crystal(density: float) -> str:
    """Two parallel rods in a cell, as a .gro file."""
    edges = (DENSITY / density) ** (1 / 3) * np.array(CELL)
    rows = []
    for rod, corner in enumerate((np.zeros(3), edges / 2), 1):
        for site in SITES:
            x, y, z = (corner + site["position_A"]) / 10
            name = site["name"]
            rows.append(f"{rod:5}rod  {name:>5}{len(rows) + 1:5}{x:12.7f}{y:12.7f}{z:12.7f}")
    return "\n".join(["rods", str(len(rows)), *rows, " ".join(map(str, edges / 10)), ""])


def scene(folder: Path, density: float, temperature: float, ps: float) -> Scene:
    """Rods at a density and a temperature: melting, and a production."""
    path = folder / f"crystal_{density:g}.gro"
    path.write_text(crystal(density))
    stage = {
        "ensemble": "nvt",
        "temperature_K": temperature * DEPTH * KJ_PER_MOL / BOLTZMANN,
    }
    return Scene.from_dict(
        {
            "structure": {"file": path.name, "repeat": REPEAT},
            "molecules": [{"name": "rod", "sites": SITES}],
            "forces": {
                "bodies": [
                    {"potential": "gay_berne", "cutoff_A": 4 * WIDTH, "parameters": {"rod": ROD}}
                ]
            },
            "stages": [
                {"name": "melting", "duration_ps": MELTING, "timestep_fs": 5} | stage,
                {"name": "production", "duration_ps": ps, "timestep_fs": 8} | stage,
            ],
            "output": {"log_interval_ps": 0.5, "trajectory_interval_ps": 0.5, "figures": False},
        },
        folder,
    )


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--temperature", type=float, default=0.95)
    parser.add_argument("--densities", default="0.28,0.30,0.31,0.32,0.33")
    parser.add_argument("--ps", type=float, default=400)
    options = read_options(
        parser, Path("runs/liquid_crystal"), densities="0.28,0.32", ps=4 * MELTING
    )
    densities = [float(text) for text in options.densities.split(",")]
    runs = [
        Simulation(
            scene(options.to, density, options.temperature, options.ps),
            options.to / f"{density:g}",
        )
        for density in densities
    ]
    for density, results in zip(densities, rigidmd.run_together(runs), strict=True):
        try:
            print(f"{density:g}: {rigidmd.analysis.nematic(results)}")
        except OutputError as error:  # too few frames
            print(f"{density:g}: {error}")


if __name__ == "__main__":
    main()
