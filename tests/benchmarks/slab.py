"""Density and surface tension of a slab of water by rigidmd and by GROMACS: the same model, box,
cutoffs and sums.

    python tests/benchmarks/slab.py --engine rigidmd --temperature 300 --ps 1000 --to runs/slab
    python tests/benchmarks/slab.py --engine gromacs --temperature 300 --ps 1000 --to runs/slab

systems/water_slab.toml, for the time that is given after 60 ps of equilibration. GROMACS has the
export of that scene with the settings below, among them sums of dispersion over images (LJ-PME,
geometric, as rigidmd) and the correction of slabs (3dc). Its list has a fixed buffer: the default
of its version 2022 is none for a slab that fills a third of the box. Both are analysed by the same
functions, GROMACS after its own 60 ps.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd.core.statistics import mean_and_error
from rigidmd.features.analysis.built_in.interfaces import BIN, fitted
from rigidmd.units import GRAM_PER_CM3

SCENE = Path(__file__).parents[2] / "systems" / "water_slab.toml"
EQUILIBRATION = 0.1 if SMOKE else 60.0  # ps
BLOCKS = 2 if SMOKE else 10
TIMESTEP = 0.002  # ps
#: Steps between pressure tensors and between frames of GROMACS.
SAMPLES, FRAMES = (5, 5) if SMOKE else (25, 600)
SETTINGS = {
    "integrator": "md",
    "dt": TIMESTEP,
    "comm-mode": "Linear",
    "nstcomm": 100,
    "nstenergy": SAMPLES,
    "nstcalcenergy": SAMPLES,
    "nstxout-compressed": FRAMES,
    "vdwtype": "PME",
    "lj-pme-comb-rule": "Geometric",
    "ewald-rtol-lj": 1e-3,
    "tcoupl": "v-rescale",
    "tau-t": 1.0,
    "ewald-geometry": "3dc",
    "rlist": 1.3,
    "verlet-buffer-tolerance": -1,
    "nstlist": 20,
}


def by_rigidmd(folder: Path, temperature: float, ps: float) -> None:
    """Run the scene on one thread and print its density and surface tension."""
    changes = ["threads=1", f"stages.production.duration_ps={ps:g}"]
    changes += [f"stages.equilibration.duration_ps={EQUILIBRATION:g}"]
    changes += ["output.trajectory_interval_ps=0.03"] if SMOKE else []
    changes += [
        f"stages.{stage}.temperature_K={temperature:g}" for stage in ("equilibration", "production")
    ]
    command = [
        "rigidmd",
        "run",
        SCENE,
        *(word for change in changes for word in ("--set", change)),
        "-o",
        folder,
    ]
    subprocess.run(list(map(str, command)), check=True)
    subprocess.run(
        ["rigidmd", "analyse", str(folder), "--only", "interfaces,surface_tension"], check=True
    )


def by_gromacs(folder: Path, temperature: float, ps: float) -> None:
    """Run the export of the scene on one thread and print its density and surface tension."""
    lacking = [
        "--set",
        "forces.ewald_slab=",
        "--set",
        "forces.dispersion=",
        "--to",
        "gromacs",
        "-o",
        folder,
    ]
    subprocess.run(list(map(str, ["rigidmd", "export", SCENE, *lacking])), check=True)
    written = [line.split("=") for line in (folder / "2_production.mdp").read_text().splitlines()]
    whole = (
        {key.strip(): value.strip() for key, value in written} | SETTINGS | {"ref-t": temperature}
    )
    before = "conf.gro"
    for name, length in (("equilibration", EQUILIBRATION), ("production", ps)):
        of_stage = whole | {"nsteps": round(length / TIMESTEP)}
        if name == "equilibration":
            of_stage |= {
                "continuation": "no",
                "gen-vel": "yes",
                "gen-temp": temperature,
                "gen-seed": 5,
            }
        text = "".join(f"{key} = {value}\n" for key, value in of_stage.items())
        (folder / f"{name}.mdp").write_text(text)
        files = (
            f"-f {name}.mdp -c {before} -p topol.top -po {name}_all.mdp -o {name}.tpr -maxwarn 3"
        )
        for words in (f"grompp {files}", f"mdrun -deffnm {name} -ntmpi 1 -ntomp 1"):
            subprocess.run(["gmx", *words.split()], cwd=folder, check=True)
        before = f"{name}.gro -t {name}.cpt"
    print(*measured(folder), sep="\n")


def measured(folder: Path) -> tuple[str, str]:
    """Density and surface tension in the files of GROMACS."""
    from MDAnalysis import Universe

    command = ["gmx", "energy", "-f", "production.edr", "-o", "tension.xvg"]
    subprocess.run(
        command, cwd=folder, input="#Surf*SurfTen\n", text=True, check=True, capture_output=True
    )
    lines = [
        line.split()
        for line in (folder / "tension.xvg").read_text().splitlines()
        if line[0] not in "#@"
    ]
    tension, error = mean_and_error(np.array(lines, float)[:, 1] / 20)  # of two interfaces, bar nm
    universe = Universe(str(folder / "equilibration.gro"), str(folder / "production.xtc"))
    atoms = universe.select_atoms("not name MW")
    mass = np.where([name.startswith("O") for name in atoms.names], 15.9994, 1.008)
    height, area = float(universe.dimensions[2]), float(universe.dimensions[:2].prod())
    at = np.array([atoms.positions[:, 2] / height for _ in universe.trajectory], float)
    middle = np.angle(np.exp(2j * np.pi * at) @ mass)[:, None] / (2 * np.pi)
    distance = ((at - middle + 0.5) % 1.0 - 0.5) * height

    edges = np.linspace(0.0, height / 2, int(height / 2 / BIN) + 1)

    def density(part: np.ndarray) -> float:
        """Of the liquid, from the profile of some frames as `rigidmd analyse` has it."""
        weights = np.broadcast_to(mass, part.shape) / len(part)
        masses = np.histogram(np.abs(part), edges, weights=weights)[0]
        profile = masses / (2 * area * np.diff(edges)) / GRAM_PER_CM3
        return float(fitted(0.5 * (edges[1:] + edges[:-1]), profile, height)[0])

    blocks = [density(part) for part in np.array_split(distance, BLOCKS)]
    spread = np.std(blocks, ddof=1) / np.sqrt(BLOCKS)
    return (
        f"GROMACS: liquid: {density(distance):.4f} ± {spread:.4f} g/cm³, {len(at)} frames",
        f"GROMACS: surface tension: {tension:.1f} ± {error:.1f} mN/m",
    )


ENGINES = {"rigidmd": by_rigidmd, "gromacs": by_gromacs}


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--engine", choices=list(ENGINES), default="rigidmd", help="rigidmd")
    parser.add_argument("--temperature", type=float, default=300.0, help="K; 300")
    parser.add_argument("--ps", type=float, default=1000.0, help="1000")
    options = read_options(parser, Path("runs/slab"), ps=0.3)
    for engine in ENGINES if SMOKE else [options.engine]:
        if engine == "gromacs" and not shutil.which("gmx"):
            sys.exit("GROMACS is not installed: there is no gmx on PATH")
        run, temperature = ENGINES[engine], options.temperature
        run(options.to / f"{engine}_{temperature:g}", temperature, options.ps)


if __name__ == "__main__":
    main()
