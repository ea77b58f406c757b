"""Whether `integrator = "auto"` keeps the error of the energy that is requested: rms error over
the target.

    python tests/benchmarks/energy_errors.py --scenes water,smooth --targets 1e-4,1e-6 --ps 10

Errors of the whole stage, and of its first 0.1 and 1 ps, relative to the target; next to them the
force evaluations of the pilot runs over all of the stage.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.core.integrators import SCHEMES
from rigidmd.errors import SimulationError
from rigidmd.run import trials

WATER = {
    "box": {"lengths_A": 12.42},
    "molecules": [{"model": "spce", "count": 64}],
    "start": {"temperature_K": 300.0},
}
CO2 = {
    "box": {"lengths_A": 17.0},
    "molecules": [{"model": "co2_trappe", "count": 50}],
    "start": {"temperature_K": 250.0},
}
ARGON = {
    "box": {"lengths_A": 17.0},
    "molecules": [{"model": "argon", "count": 100}],
    "start": {"temperature_K": 120.0},
}
SCENES = {
    "water": WATER | {"forces": {"cutoff_A": 6.0}},
    "smooth": WATER | {"forces": {"cutoff_A": 6.0, "truncation": "smooth_switch"}},
    "pme": WATER | {"forces": {"cutoff_A": 6.0, "electrostatics": "pme"}},
    "co2": CO2 | {"forces": {"cutoff_A": 8.0, "electrostatics": "pme"}},
    "argon": ARGON | {"forces": {"cutoff_A": 8.0}},
}
TO_REST = 0.1 if SMOKE else 3.0  # ps
TOP = Path(__file__).parents[2] / "systems" / "heavy_top_3.toml"


def counted(made: Callable[[], Simulation]) -> tuple:
    """A simulation, its results, and the force evaluations of its pilots."""
    forces, measure_errors = [0], trials.measure_errors

    def counting(subject, trial, *more):
        forces[0] += trial.steps * subject.methods[trial.integrator].force_evaluations
        return measure_errors(subject, trial, *more)

    trials.measure_errors = counting
    try:
        simulation = made()
        return simulation, simulation.run(), forces[0]
    finally:
        trials.measure_errors = measure_errors


def of_molecules(name: str, target: float, duration: float) -> list[str]:
    """A line of the table."""
    temperature = SCENES[name]["start"]["temperature_K"]
    warm = {"ensemble": "nvt", "temperature_K": temperature, "duration_ps": TO_REST}
    stages = [warm, {"duration_ps": duration, "integrator": "auto", "energy_error_kT": target}]
    output = {"trajectory": False, "figures": False, "log_interval_ps": 0.02}
    scene = Scene.from_dict(SCENES[name] | {"stages": stages, "output": output})
    _, results, forces = counted(lambda: Simulation(scene))
    own = results["stage"] == 1
    time, error = (
        results["time"][own] - TO_REST,
        results["drift"][own] / (2 * results["kinetic"][own].mean()),
    )
    stage = results.summary["stages"][1]
    ratios = [
        float(np.sqrt(np.mean(error[time <= end + 1e-9] ** 2))) / target
        for end in (0.1, 1.0, duration)
    ]
    of_stage = stage["steps"] * SCHEMES[stage["integrator"]].force_evaluations
    return [
        f"{stage['integrator']} {stage['timestep_fs']:.3g} fs",
        *(f"{r:.2f}" for r in ratios),
        f"{forces / of_stage:.2f}",
    ]


def of_top(target: float) -> list[str]:
    """The same of a heavy top, over its run of 1.7 s."""
    changes = {
        "run.integrator": "auto",
        "run.energy_error": target,
        "run.timestep_s": 0.05,
        "output.interval_s": 0.1,
    }
    simulation, results, forces = counted(lambda: Simulation(Scene.read(TOP, changes)))
    run = simulation.scene.run
    error = float(np.sqrt(np.mean(results["energy_error"] ** 2))) / target
    of_run = run.duration_s / run.timestep_s * SCHEMES[run.integrator].force_evaluations
    return [
        f"{run.integrator} {run.timestep_s:.3g} s",
        "",
        "",
        f"{error:.2f}",
        f"{forces / of_run:.2f}",
    ]


def main() -> None:
    """Measure and print."""
    parser = new_parser(__doc__)
    parser.add_argument(
        "--scenes", default=",".join([*SCENES, "top"]), help=f"of {','.join(SCENES)},top; all"
    )
    parser.add_argument(
        "--targets", default="1e-3,1e-4,1e-5,1e-6,1e-7", help="1e-3,1e-4,1e-5,1e-6,1e-7"
    )
    parser.add_argument("--ps", type=float, default=10.0, help="length of the stage; 10")
    asked = read_options(parser, scenes="argon,top", targets="1e-3,1e-5", ps=1.0)
    print(
        "| scene | target | chosen | 0.1 ps | 1 ps | whole stage | pilots |\n|---|---|---|---|---|---|---|"
    )
    for name in asked.scenes.split(","):
        for target in map(float, asked.targets.split(",")):
            try:
                cells = of_top(target) if name == "top" else of_molecules(name, target, asked.ps)
            except SimulationError as error:
                cells = [str(error)]
            print("|", " | ".join([name, f"{target:.0e}", *cells]), "|", flush=True)


if __name__ == "__main__":
    main()
