"""What observations cost: steps per second of a run with its default output, relative to the engine
alone.

    python tests/benchmarks/observation_cost.py --workloads 216,W1,W2,W3 --rounds 5

Both move the same start at constant energy in steps of 2 fs, in one process: the engine takes half
of its steps before each run and half of them after it, in one piece as in peers.py. The run is that
of `rigidmd run`: a log, a trajectory, a checkpoint, the estimate of the longest stable step. Its
time is that of its stages, observations included; the figure and the summary come after it. 216: the
smallest box of scaling.py; the others are those of peers.py.
"""

import statistics
import sys
import tempfile
from pathlib import Path

from command_line import SMOKE, choice, new_parser, read_options
from peers import WORKLOADS, start_folder
from scaling import STEP, relax, speed
from scaling import scene as small

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.core.integrators import SCHEMES

SMALL = "216"
VERLET = SCHEMES["velocity_verlet"]
WARM_UP, FEWEST_STEPS = (10, 10) if SMOKE else (200, 100)


def scene(name: str, folder: Path, duration: float, **output) -> Scene:
    """The scene of a workload, for this many ps."""
    more = {
        "precision": "mixed",
        "stages": [{"duration_ps": duration, "timestep_fs": 1e3 * STEP}],
        "output": output,
    }
    if name == SMALL:
        return Scene.from_dict(small(1, **more), folder)
    return Scene.from_dict(WORKLOADS[name].scene(**more), folder)


def measure(name: str, folder: Path, rounds: int, seconds: float) -> dict:
    """Median steps per second of the engine and of the run, and the median of their ratios."""
    alone = Simulation(scene(name, folder, 1.0, trajectory=False))
    engine, state = alone.engine, alone.state.copy()

    def of_engine(steps: int) -> float:
        return speed(engine, state, VERLET, steps)

    def of_run(steps: int) -> float:
        with tempfile.TemporaryDirectory() as out:
            whole = scene(name, folder, steps * STEP)
            return (
                steps / Simulation(whole, Path(out) / "run").run(progress=False).summary["wall_s"]
            )

    of_engine(WARM_UP)
    steps = max(FEWEST_STEPS, round(seconds * of_engine(WARM_UP)))
    of_run(FEWEST_STEPS)
    found = []
    for _ in range(rounds):
        before, run, after = of_engine(steps // 2), of_run(steps), of_engine(steps // 2)
        found.append((statistics.harmonic_mean([before, after]), run))
    engine_speed, run_speed = map(statistics.median, zip(*found, strict=True))
    return {
        "engine": engine_speed,
        "run": run_speed,
        "ratio": statistics.median(run / bare for bare, run in found),
    }


def main() -> None:
    """Measure and print."""
    parser = new_parser(__doc__)
    names = [SMALL, *WORKLOADS]
    parser.add_argument(
        "--workloads", type=choice(names), default=names, help=f"of {','.join(names)}; all"
    )
    parser.add_argument("--rounds", type=int, default=5, help="5")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement; 10")
    asked = read_options(parser, workloads=[SMALL, "W1"], rounds=1, seconds=0.0)
    print("| | engine, steps/s | run, steps/s | run over engine |\n|---|---|---|---|")
    for name in asked.workloads:
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made) if name == SMALL else start_folder(name)
            if name == SMALL:
                relax(folder)
            found = measure(name, folder, asked.rounds, asked.seconds)
        print(
            f"| {name} | {found['engine']:.4g} | {found['run']:.4g} | {found['ratio']:.3f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
