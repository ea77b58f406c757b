"""What a step of liquid SPC/E costs from 216 molecules to millions, on one core and on several:
time and memory.

    python tests/benchmarks/scaling.py --copies 1,2,4,8,17 --cores 1,2 --precision mixed --to FOLDER

The liquid is W1 of peers.py: cutoff 9 Å, reaction field, steps of 2 fs at constant energy. A box
of 216 waters that has come to rest is copied along each edge, so every size is the same liquid.
Each size runs in a process of its own, so that its peak of memory is its own. The start is the time
from the state on disk to the end of the first step. Lists are built before the clock of the steps
starts, and rebuilt while it runs. No variable about threads is set: it is measured as users have
it. The rows are FOLDER/scaling.json, the figure FOLDER/scaling.png.

    python tests/benchmarks/scaling.py --draw          # only the figure, from data of the documentation
"""

import json
import resource
import subprocess
import sys
import tempfile
import time
from argparse import SUPPRESS
from pathlib import Path

import numpy as np
from command_line import SMOKE, SMOKE_OPTION, new_parser, numbers, read_options, shown
from peer_engines import environment
from peers import WORKLOADS, write_start

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.assemble.memory_check import array_bytes
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import NOW
from rigidmd.features.view.figures.style import (
    COLORS,
    COOL,
    INK,
    MARKERS,
    TEXT,
    TITLE,
    new_figure,
    open_axis,
    save_files,
)

WORK = WORKLOADS["W1"]
DATA = Path(__file__).parents[2] / "rigidmd" / "docs" / "evidence" / "data" / "scaling.json"
UNIT = 216  # molecules in the box that is copied, whose edge is little more than twice the cutoff
EDGE = WORK.edge * (UNIT / WORK.count) ** (1 / 3)  # Å
STEP = 2e-3  # ps
FEWEST_STEPS = 5 if SMOKE else 20
SECONDS = 0.0 if SMOKE else 3.0
TO_REST = 0.1 if SMOKE else 10.0  # ps


def scene(copies: int, precision: str, **changes) -> dict:
    """The scene of this many copies along each edge."""
    molecules = [{**WORK.molecules, "count": UNIT * copies**3}]
    return WORK.scene(
        box={"lengths_A": EDGE * copies}, molecules=molecules, precision=precision, **changes
    )


def relax(folder: Path) -> None:
    """A box of liquid, folder/start.npz."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": WORK.temperature,
        "timestep_fs": 2.0,
        "duration_ps": TO_REST,
        "thermostat_time_ps": 0.1,
    }
    state = (
        Simulation(Scene.from_dict(scene(1, "mixed", structure=None, stages=[stage]))).run().state
    )
    keep(folder, 1, state)


def speed(engine, state, row, steps: int) -> float:
    """Steps per second of an engine that moves a state, in one piece."""
    began = time.perf_counter()
    engine.advance(state, row, STEP, int(state.step[NOW]) + steps)
    return steps / (time.perf_counter() - began)


def keep(folder: Path, copies: int, state) -> None:
    """Copies of a state of one box as folder/start.npz."""
    shifts = EDGE * np.array(list(np.ndindex((copies,) * 3)))
    position = (shifts[:, None] + state.position).reshape(-1, 3)
    rest = (state.velocity, state.rotation, state.angular_momentum_body)
    rest = (np.tile(a, (len(shifts), *(1,) * (a.ndim - 1))) for a in rest)
    write_start(folder, WORK, position, *rest, EDGE * copies)


def measure(job: dict) -> dict:
    """Seconds to start, seconds a step for each number of cores, and the peak of memory, of one
    size; in a process of its own."""
    one = Simulation(Scene.from_dict(scene(1, job["precision"]), Path(job["folder"])))
    with tempfile.TemporaryDirectory() as folder:
        keep(Path(folder), job["copies"], one.state)
        began = time.perf_counter()
        simulation = Simulation(
            Scene.from_dict(scene(job["copies"], job["precision"]), Path(folder))
        )
        start = time.perf_counter() - began
    engine, state = simulation.engine, simulation.state.copy()
    scheme, done = SCHEMES["velocity_verlet"], 1
    began = time.perf_counter()
    engine.advance(state, scheme, STEP, done)
    start += time.perf_counter() - began
    seconds = {}
    for cores in job["cores"]:
        engine.threads = cores
        done += 3
        engine.advance(state, scheme, STEP, done)
        steps, spent = 0, 0.0
        while steps < FEWEST_STEPS or spent < SECONDS:
            began = time.perf_counter()
            done += FEWEST_STEPS
            engine.advance(state, scheme, STEP, done)
            spent += time.perf_counter() - began
            steps += FEWEST_STEPS
        seconds[cores] = spent / steps
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    arrays = array_bytes((state, engine.load, engine.model, tuple(engine.workspaces.values())))
    molecules = UNIT * job["copies"] ** 3
    return {
        "molecules": molecules,
        "start": start,
        "seconds": seconds,
        "peak": peak,
        "arrays": arrays,
    }


def draw(rows: list[dict], cores: list[int], images: Path) -> None:
    """Time and memory per molecule against their number."""
    figure = new_figure(7.2, 2.9)
    time_axis, memory_axis = figure.subplots(1, 2)
    count = [row["molecules"] for row in rows]
    for k, (number, color) in enumerate(zip(cores, COLORS, strict=False)):
        cost = [1e6 * row["seconds"][str(number)] / row["molecules"] for row in rows]
        label = f"{number} core{'s' * (number > 1)}"
        time_axis.plot(count, cost, marker=MARKERS[k], ms=4, lw=1.2, color=color, label=label)
    time_axis.set_ylabel("µs per molecule and step")
    time_axis.legend(frameon=False, fontsize=TEXT, labelcolor=INK)
    memory = [row["arrays"] / row["molecules"] / 1e3 for row in rows]
    memory_axis.plot(count, memory, "o-", ms=4, lw=1.2, color=COOL)
    memory_axis.set_ylabel("kB of arrays per molecule")
    for axis in (time_axis, memory_axis):
        axis.set_xscale("log")
        axis.set_ylim(0, 1.1 * axis.dataLim.ymax)
        axis.set_xlabel("SPC/E molecules, cutoff 9 Å")
        open_axis(axis, labelsize=TEXT)
        for label in (axis.xaxis.label, axis.yaxis.label):
            label.set(fontsize=TITLE, color=INK)
    save_files(figure, images / "scaling", ["png"])


def main() -> None:
    """Measure every size and print the table."""
    parser = new_parser(__doc__)
    parser.add_argument(
        "--copies", type=numbers(int), default=[1, 2, 4, 8, 17], help="along each edge; 1,2,4,8,17"
    )
    parser.add_argument("--cores", type=numbers(int), default=[1, 2], help="1,2")
    parser.add_argument("--precision", choices=("double", "mixed"), default="mixed")
    parser.add_argument("--draw", action="store_true", help=f"only draw {shown(DATA)}")
    parser.add_argument("--job", help=SUPPRESS)
    asked = read_options(parser, Path("runs/scaling"), copies=[1, 2], cores=[1])
    if asked.job:
        print(json.dumps(measure(json.loads(asked.job))))
        return
    if asked.draw:
        rows = json.loads(DATA.read_text(encoding="utf-8"))
        draw(rows, list(map(int, rows[0]["seconds"])), asked.to)
        return
    with tempfile.TemporaryDirectory() as folder:
        relax(Path(folder))
        per_step = "".join(
            f" µs per molecule and step, {k} core{'s' * (k > 1)} |" for k in asked.cores
        )
        print(
            f"| molecules | start, s |{per_step} steps/s | arrays, kB per molecule | peak of the process, GB |"
        )
        print("|---" * (5 + len(asked.cores)) + "|", flush=True)
        rows = []
        for copies in asked.copies:
            job = {
                "copies": copies,
                "cores": asked.cores,
                "precision": asked.precision,
                "folder": folder,
            }
            command = [sys.executable, __file__, "--job", json.dumps(job), *SMOKE_OPTION]
            done = subprocess.run(command, env=environment(), capture_output=True, text=True)
            if done.returncode:
                sys.exit(done.stderr)
            found = json.loads(done.stdout)
            rows.append(found)
            n = found["molecules"]
            costs = "".join(f" {1e6 * found['seconds'][str(k)] / n:.3f} |" for k in asked.cores)
            rate = 1 / found["seconds"][str(asked.cores[-1])]
            print(
                f"| {n:,} | {found['start']:.1f} |{costs} {rate:.3g} | {found['arrays'] / n / 1e3:.2f} | {found['peak'] / 1e9:.2f} |",
                flush=True,
            )
    (asked.to / DATA.name).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    draw(rows, asked.cores, asked.to)


if __name__ == "__main__":
    main()
