"""What is measured of liquid water at 298.15 K, with errors: g(r), D, orientation, viscosity,
dielectric constant.

    python tests/benchmarks/measured.py --model spce --count 512 --duration 500 --to runs/measured
    python tests/benchmarks/measured.py --model spce --count 216 --duration 3000 --interval 0.2
    --only dielectric

PME, 10 Å (9 Å of 216), steps of 2 fs, mixed precision, the density given. The folder of the run
keeps all figures.
"""

import sys
from pathlib import Path

from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.features.analysis.files import analyse_folder

TEMPERATURE = 298.15


def scene(
    model: str, count: int, density: float, duration: float, interval: float, only: list[str]
) -> Scene:
    """The liquid in a cube, under velocity rescaling."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": TEMPERATURE,
        "duration_ps": duration,
        "timestep_fs": 2.0,
        "integrator": "baoab",
        "thermostat": "velocity_rescaling",
    }
    output = {"trajectory_interval_ps": interval, "figures": False}
    if not only or "viscosity" in only:
        output["pressure_tensor_interval_ps"] = 0.01
    return Scene.from_dict(
        {
            "box": {"density_g_cm3": density},
            "molecules": [{"model": model, "count": count}],
            "forces": {
                "cutoff_A": 10.0 if count >= 512 else 9.0,
                "electrostatics": "pme",
                "tail_correction": True,
            },
            "precision": "mixed",
            "start": {"temperature_K": TEMPERATURE},
            "stages": [stage],
            "output": output,
        }
    )


def main() -> None:
    """Run the liquid, analyse it, and print the results."""
    parser = new_parser(__doc__)
    parser.add_argument("--model", default="spce")
    parser.add_argument("--count", type=int, default=512)
    parser.add_argument("--density", type=float, default=0.997, metavar="G_CM3")
    parser.add_argument("--duration", type=float, default=500.0, metavar="PS")
    parser.add_argument("--interval", type=float, default=0.1, metavar="PS")
    parser.add_argument("--only", type=lambda text: text.split(","), default=[], metavar="NAMES")
    options = read_options(parser, Path("runs/measured"), count=256, duration=2.0, interval=0.01)
    only = options.only
    water = scene(
        options.model, options.count, options.density, options.duration, options.interval, only
    )
    Simulation(water, options.to).run(progress=not SMOKE)
    done = analyse_folder(options.to, only)
    for line in [*done.frames_used["notes"], *done.results]:
        print(line)


if __name__ == "__main__":
    main()
