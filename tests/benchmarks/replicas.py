"""Many small systems: steps of all replicas a second, one after another and at once.

    python tests/benchmarks/replicas.py --systems 216,27,6 --replicas 8 --rounds 3

Replicas differ in their seeds. They run one after another on all cores; at once in this process by
`run_together`, a thread each; and by `rigidmd sweep --replicas` in processes, a thread each. Next to
them stands what the engine alone takes on one core, times the cores. 216 and 27: liquid SPC/E in a
box; 6: a cluster in vacuum. Steps of 2 fs at constant temperature in mixed precision, a line of the
log every 0.1 ps, all files but the trajectory and figures. A time is that of all replicas from the
scene to the last file, the start of processes included; compiled code is in the cache.
"""

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import tomli_w
from command_line import SMOKE, choice, new_parser, read_options
from scaling import STEP, speed

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation, run_together
from rigidmd.assemble.build import integrator_of_stage as row

CORES = len(os.sched_getaffinity(0))
#: Molecules -> what their scene has of its own.
SYSTEMS = {
    "216": {
        "box": {"density_g_cm3": 0.997},
        "forces": {"cutoff_A": 9.0, "electrostatics": "reaction_field"},
    },
    "27": {
        "box": {"density_g_cm3": 0.997},
        "forces": {"cutoff_A": 4.6, "electrostatics": "reaction_field"},
    },
    "6": {"box": {"lengths_A": 7.0, "periodic": False}},
}
TEMPERATURES = {"216": 298.0, "27": 298.0, "6": 150.0}
TO_REST, WARM_UP = (0.05, 10) if SMOKE else (1.0, 500)  # ps, steps
SECONDS_ALONE = 0.0 if SMOKE else 1.0


def data(name: str, duration: float, seed: int = 1) -> dict:
    """A replica for this many ps."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": TEMPERATURES[name],
        "timestep_fs": 1e3 * STEP,
        "duration_ps": duration,
    }
    return SYSTEMS[name] | {
        "precision": "mixed",
        "seed": seed,
        "molecules": [{"model": "spce", "count": int(name)}],
        "stages": [stage],
        "output": {"trajectory": False, "figures": False},
    }


def bare_speed(name: str, seconds: float) -> float:
    """Steps per second of the engine alone on one core, from a state that has come to rest."""
    simulation = Simulation(Scene.from_dict(data(name, TO_REST)))
    simulation._before_run().take_threads(1)
    state = simulation.run().state.copy()
    engine, scheme = simulation.engine, row(simulation.system, 0)

    warm = speed(engine, state, scheme, WARM_UP)
    return speed(engine, state, scheme, max(WARM_UP, round(seconds * warm)))


def one_after_another(name: str, duration: float, replicas: int, folder: Path) -> None:
    """Each on all cores."""
    for k in range(replicas):
        Simulation(Scene.from_dict(data(name, duration, 1 + k)), folder / str(k)).run()


def together(name: str, duration: float, replicas: int, folder: Path) -> None:
    """At once in this process."""
    scenes = [Scene.from_dict(data(name, duration, 1 + k)) for k in range(replicas)]
    run_together([Simulation(scene, folder / str(k)) for k, scene in enumerate(scenes)])


def swept(name: str, duration: float, replicas: int, folder: Path) -> None:
    """By the command."""
    folder.mkdir()
    scene = folder / "scene.toml"
    scene.write_text(tomli_w.dumps(data(name, duration)))
    command = [
        sys.executable,
        "-m",
        "rigidmd",
        "sweep",
        scene,
        "--replicas",
        str(replicas),
        "-o",
        folder / "out",
    ]
    subprocess.run(command, check=True, capture_output=True)


WAYS = {"one after another": one_after_another, "run_together": together, "rigidmd sweep": swept}


def measure(
    name: str, replicas: int, rounds: int, seconds: float
) -> tuple[float, dict[str, float]]:
    """The engine alone on all cores, and the median of each way: steps of all replicas a second."""
    bare = [bare_speed(name, SECONDS_ALONE)]
    duration = STEP * max(WARM_UP, round(seconds * bare[0]))
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    for k in range(rounds + 1):
        for way, run in WAYS.items():
            with tempfile.TemporaryDirectory() as folder:
                began = time.perf_counter()
                run(name, duration if k else TO_REST, replicas, Path(folder) / "runs")
                spent = time.perf_counter() - began
            if k:  # the first round fills the cache
                found[way].append(replicas * round(duration / STEP) / spent)
        bare.append(bare_speed(name, SECONDS_ALONE))
    return CORES * statistics.median(bare), {
        way: statistics.median(speeds) for way, speeds in found.items()
    }


def main() -> None:
    """Measure and print."""
    parser = new_parser(__doc__)
    names = list(SYSTEMS)
    parser.add_argument(
        "--systems", type=choice(names), default=names, help=f"of {','.join(names)}; all"
    )
    parser.add_argument("--replicas", type=int, default=8, help="8")
    parser.add_argument("--rounds", type=int, default=3, help="3")
    parser.add_argument(
        "--seconds", type=float, default=4.0, help="of computing for each replica on one core; 4"
    )
    asked = read_options(parser, systems=["27"], replicas=2, rounds=1, seconds=0.0)
    print(
        f"| SPC/E | engine alone, {CORES} times one core | {' | '.join(WAYS)} |\n|---|---|{'---|' * len(WAYS)}"
    )
    for name in asked.systems:
        bare, speeds = measure(name, asked.replicas, asked.rounds, asked.seconds)
        cells = " | ".join(f"{speed:.4g}, {speed / bare:.2f}" for speed in speeds.values())
        print(f"| {name} | {bare:.4g} | {cells} |", flush=True)


if __name__ == "__main__":
    main()
