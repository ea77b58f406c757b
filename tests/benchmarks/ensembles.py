"""What ensembles cost: steps per second with each thermostat and barostat, against constant energy.

    python tests/benchmarks/ensembles.py --workloads W1,W2 --rounds 5

All move the same start in steps of 2 fs in mixed precision, in turns in one process, without observations. The thermostats and barostats have their default strengths. The workloads are those of
peers.py.
"""

import statistics
import sys
from pathlib import Path

from command_line import SMOKE, choice, new_parser, read_options
from peers import WORKLOADS, start_folder
from scaling import STEP, speed

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import integrator_of_stage

WARM, PRESSED = {"temperature_K": 300.0}, {"pressure_bar": 1.0}
STAGES = {
    "nve": {"ensemble": "nve"},
    "nvt, langevin": {"ensemble": "nvt", "thermostat": "langevin"} | WARM,
    "nvt, velocity_rescaling": {"ensemble": "nvt", "thermostat": "velocity_rescaling"} | WARM,
    "nvt, nose_hoover": {"ensemble": "nvt", "thermostat": "nose_hoover"} | WARM,
    "npt, cell_rescaling": {"ensemble": "npt", "barostat": "cell_rescaling"} | WARM | PRESSED,
    "npt, monte_carlo": {"ensemble": "npt", "barostat": "monte_carlo"} | WARM | PRESSED,
    "nph, piston": {"ensemble": "nph"} | PRESSED,
}
WARM_UP, FEWEST_STEPS = (10, 10) if SMOKE else (200, 50)


def measure(
    workload: str, folder: Path, rounds: int, seconds: float
) -> dict[str, tuple[float, float]]:
    """Of each ensemble its median steps per second, and the median of the ratios to constant
    energy."""
    stages = [{"duration_ps": 1.0, "timestep_fs": 1e3 * STEP} | stage for stage in STAGES.values()]
    data = WORKLOADS[workload].scene(precision="mixed", stages=stages, output={"trajectory": False})
    run = Simulation(Scene.from_dict(data, folder))
    movers = []
    for k in range(len(stages)):
        row, engine = integrator_of_stage(run.system, k), run.system.engine()
        movers.append((engine, engine.begin(run.state.copy(), row), row))

    warm = [speed(*mover, WARM_UP) for mover in movers]
    steps = max(FEWEST_STEPS, round(seconds * warm[0]))
    found = [[speed(*mover, steps) for mover in movers] for _ in range(rounds)]
    return {
        name: (
            statistics.median(one[k] for one in found),
            statistics.median(one[k] / one[0] for one in found),
        )
        for k, name in enumerate(STAGES)
    }


def main() -> None:
    """Measure and print."""
    parser = new_parser(__doc__)
    names = list(WORKLOADS)
    parser.add_argument(
        "--workloads", type=choice(names), default=["W1", "W2"], help=f"of {','.join(names)}; W1,W2"
    )
    parser.add_argument("--rounds", type=int, default=5, help="5")
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement; 2")
    asked = read_options(parser, workloads=["W1"], rounds=1, seconds=0.0)
    found = {
        name: measure(name, start_folder(name), asked.rounds, asked.seconds)
        for name in asked.workloads
    }
    print(f"| steps/s, and over nve | {' | '.join(found)} |\n|---|{'---|' * len(found)}")
    for name in STAGES:
        cells = (
            f"{speed:.4g}, {ratio:.2f}" for speed, ratio in (own[name] for own in found.values())
        )
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
