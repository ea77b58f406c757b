"""Gay-Berne rods at constant energy: steps/s next to LAMMPS from the same state, in turns, and what
derived forces cost compared with forces by hand.

    python tests/benchmarks/body_pairs.py --rounds 7 --steps 200 --threads 2

LAMMPS (`lmp` on the path) has an ellipsoid with mass for each rod, `fix nve/asphere` and the same
cutoff, with a process for each thread. Its own time of the loop counts. Medians of the ratios.
"""

import os
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from statistics import median

import numpy as np
from command_line import SMOKE, new_parser, read_options
from liquid_crystal import DENSITY, DEPTH, REPEAT, ROD, SITES, WIDTH, crystal
from scipy.spatial.transform import Rotation

import rigidmd
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.assemble.build import integrator_of_stage as row
from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.features.potentials.poses.gay_berne import PARAMETERS, GayBerne

STEP, MELTING = 5.0, 10 if SMOKE else 1000  # fs, steps before the measurement
TWICE = REPEAT if SMOKE else [2 * count for count in REPEAT]
KCAL = 4.184  # kJ/mol


def dipoles(r, u, v):
    """Point dipoles, kJ/mol."""
    s = np.sqrt(r @ r)
    return 30.0 * (u @ v / s**3 - 3 * (u @ r) * (v @ r) / s**5)


def dipoles_by_hand(r, u, v):
    """The same with force and torques."""
    s2 = r @ r
    s3, s5 = s2**1.5, s2**2.5
    a, b, c = u @ r, v @ r, u @ v
    force = 90.0 * ((c * r + b * u + a * v) / s5 - 5 * a * b * r / (s5 * s2))
    first, second = 30.0 * (v / s3 - 3 * b * r / s5), 30.0 * (u / s3 - 3 * a * r / s5)
    energy = 30.0 * (c / s3 - 3 * a * b / s5)
    return energy, force, np.cross(first, u), np.cross(second, v)


def gay_berne_by_hand(r, u, v, p, q):
    """Gay-Berne of equal ellipsoids by its original formula, with force and torques."""
    chi = (p.length_A**2 - p.width_A**2) / (p.length_A**2 + p.width_A**2)
    root = np.sqrt(p.side), np.sqrt(p.end)
    other = (root[0] - root[1]) / (root[0] + root[1])
    s = np.sqrt(r @ r)
    n = r / s
    a, b, c = u @ n, v @ n, u @ v

    def bracket(x):
        """1 - x (..)/2 and its slopes by a, b, c."""
        plus, minus = (a + b) / (1 + x * c), (a - b) / (1 - x * c)
        value = 1 - x / 2 * ((a + b) * plus + (a - b) * minus)
        return value, -x * (plus + minus), -x * (plus - minus), x * x / 2 * (plus**2 - minus**2)

    shape, well = bracket(chi), bracket(other)
    contact = p.width_A / np.sqrt(shape[0])
    first = 1 / np.sqrt(1 - (chi * c) ** 2)
    ratio = p.width_A / (s - contact + p.width_A)
    six = ratio**6
    strength = 4 * p.epsilon_kJ_mol * p.side * first * well[0] ** 2
    energy = strength * (six * six - six)
    by_distance = -strength * (12 * six * six - 6 * six) * ratio / p.width_A
    of_contact = by_distance * contact / (2 * shape[0])
    of_well = 2 * energy / well[0]
    by_a, by_b, by_c = (of_contact * shape[k] + of_well * well[k] for k in (1, 2, 3))
    by_c = by_c + energy * chi * chi * c * first * first
    across = (by_a * (u - a * n) + by_b * (v - b * n)) / s
    force = -(by_distance * n + across)
    to_first, to_second = by_a * n + by_c * v, by_b * n + by_c * u
    return energy, force, -np.cross(u, to_first), -np.cross(v, to_second)


def scene(folder: Path, threads: int) -> Scene:
    (folder / "crystal.gro").write_text(crystal(DENSITY))
    return Scene.from_dict(
        {
            "structure": {"file": "crystal.gro", "repeat": TWICE},
            "molecules": [{"name": "rod", "sites": SITES}],
            "start": {"temperature_K": 400.0},
            "precision": "double",
            "threads": threads,
            "stages": [{"duration_ps": 1, "timestep_fs": STEP}],
        },
        folder,
    )


def with_potential(base: Scene, function) -> System:
    """The system with a potential of two rods."""
    has_parameters = function not in (dipoles, dipoles_by_hand)
    potential = rigidmd.body_pair_potential(
        function,
        {"rod": ROD} if has_parameters else None,
        axis="z",
        truncation="plain",
        cutoff_A=4 * WIDTH,
    )
    return build(base.with_user_code([potential]))


class Running:
    """A system that takes steps; its state is a copy of a start."""

    def __init__(self, system: System, start: State):
        self.engine, self.scheme, self.end = system.engine(), row(system, 0), int(start.step[0])
        self.state = self.engine.begin(start.copy(), self.scheme)
        self.advance(20)

    def advance(self, steps: int) -> float:
        """Seconds that steps took."""
        self.end += steps
        began = time.perf_counter()
        self.engine.advance(self.state, self.scheme, STEP / 1000, self.end)
        return time.perf_counter() - began


class Lammps:
    """The same rods in LAMMPS, from the same state."""

    def __init__(self, system: System, start: State, folder: Path, threads: int):
        self.folder, self.threads, self.program = folder, threads, shutil.which("lmp")
        axes = system.species[0].axes
        quaternion = Rotation.from_matrix(start.rotation @ axes.T).as_quat(scalar_first=True)
        edges = start.cell.diagonal()
        position = start.position % edges
        volume = np.pi / 6 * WIDTH**2 * ROD["length_A"]
        density = system.species[0].mass / volume
        speed = start.velocity / 1000  # Å/fs
        size = f"{WIDTH} {WIDTH} {ROD['length_A']}"
        parts = {
            "Atoms # ellipsoid": [f"1 1 {density:.17g}"] * len(position),
            "Velocities": [],
            "Ellipsoids": [],
        }
        rows = [
            f"{k + 1} 1 1 {density:.17g} " + " ".join(f"{x:.17g}" for x in at)
            for k, at in enumerate(position)
        ]
        parts["Atoms # ellipsoid"] = rows
        parts["Velocities"] = [
            f"{k + 1} " + " ".join(f"{x:.17g}" for x in v) + " 0 0 0" for k, v in enumerate(speed)
        ]
        parts["Ellipsoids"] = [
            f"{k + 1} {size} " + " ".join(f"{x:.17g}" for x in q) for k, q in enumerate(quaternion)
        ]
        count = len(position)
        head = f"rods\n\n{count} atoms\n{count} ellipsoids\n1 atom types\n\n"
        head += "".join(f"0 {edges[k]:.17g} {'xyz'[k]}lo {'xyz'[k]}hi\n" for k in range(3))
        body = "".join(f"\n{name}\n\n" + "\n".join(part) + "\n" for name, part in parts.items())
        (folder / "rods.data").write_text(head + body)

    def seconds(self, steps: int) -> tuple[float, float]:
        """Seconds that LAMMPS' loop took, and the energy at the start, kJ/mol."""
        lines = [
            "units real",
            "atom_style ellipsoid",
            "read_data rods.data",
            f"pair_style gayberne 1 1 2 {4 * WIDTH}",
            f"pair_coeff 1 1 {DEPTH / KCAL:.17g} {WIDTH} 1 1 0.2 1 1 0.2",
            "neighbor 2 bin",
            "fix 1 all nve/asphere",
            f"timestep {STEP}",
            "thermo_modify format float %.12g",
            f"run {steps}",
        ]
        (self.folder / "in.rods").write_text("\n".join(lines) + "\n")
        several = ["mpirun", "-np", str(self.threads)] if self.threads > 1 else []
        ended = subprocess.run(
            [*several, str(self.program), "-in", "in.rods", "-log", "none"],
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=True,
        )
        loop = re.search(r"Loop time of (\S+)", ended.stdout)
        first = re.search(r"\n\s+0\s+\S+\s+(\S+)", ended.stdout)
        return float(loop[1]), float(first[1]) * KCAL  # type: ignore[index]


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--threads", type=int, default=2)
    options = read_options(parser, rounds=1, steps=5, threads=min(2, len(os.sched_getaffinity(0))))
    assert set(PARAMETERS) == set(ROD)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base = scene(folder, options.threads)
        functions = {
            "gay_berne": GayBerne(),
            "gay_berne by hand": gay_berne_by_hand,
            "dipoles": dipoles,
            "dipoles by hand": dipoles_by_hand,
        }
        systems = {key: with_potential(base, function) for key, function in functions.items()}
        melted = Running(systems["gay_berne"], systems["gay_berne"].state)
        melted.advance(MELTING)
        start = melted.state
        runs = {key: Running(system, start) for key, system in systems.items()}
        lammps = Lammps(systems["gay_berne"], start, folder, options.threads)
        (tally,) = systems["gay_berne"].engine().evaluate(start.copy())[1].values()
        energy = tally.energy / 100
        found = lammps.seconds(0)[1] if lammps.program else float("nan")
        if not lammps.program:
            print("LAMMPS is skipped: there is no lmp on PATH")
        count = len(start.position)
        print(f"{count} rods, {options.threads} threads, {options.steps} steps of {STEP:g} fs")
        print(f"  energy at the start {energy:.6f}, LAMMPS {found:.6f} kJ/mol")
        seconds: dict[str, list[float]] = {key: [] for key in (*runs, "LAMMPS")}
        for _ in range(options.rounds):
            for key, run in runs.items():
                seconds[key].append(run.advance(options.steps))
            if lammps.program:
                seconds["LAMMPS"].append(lammps.seconds(options.steps)[0])
        for key, values in seconds.items():
            if values:
                print(f"  {key}: {options.steps / median(values):.1f} steps/s")
        for one, other in (
            ("LAMMPS", "gay_berne"),
            ("gay_berne", "gay_berne by hand"),
            ("dipoles", "dipoles by hand"),
        ):
            pairs = zip(seconds[one], seconds[other], strict=False)
            ratios = [first / second for first, second in pairs]
            if ratios:
                spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
                print(f"  time of {one} over {other}: {median(ratios):.2f} ({spread})")


if __name__ == "__main__":
    main()
