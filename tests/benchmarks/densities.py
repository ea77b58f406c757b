"""The density of liquid water at 298.15 K and 1 bar, by rigidmd and by GROMACS side by side, with
errors.

    python tests/benchmarks/densities.py --models spce,tip4p2005 --duration 2000

512 molecules, cutoff 9 Å, PME, dispersion beyond the cutoff in the pressure, steps of 2 fs, one
thread each, both at once. rigidmd: baoab with Langevin friction, stochastic cell rescaling, mixed
precision. GROMACS: leap-frog, v-rescale, C-rescale. Both measure the kinetic energy where harmonic
motions leave no time-step error in positions. Errors are standard errors by pymbar's statistical
inefficiency. The first tenth of each run is omitted. FOLDER of --to gets densities.json.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options
from peer_engines import Absent, Gromacs, call, environment, gro, program, sites_of, top
from pymbar import timeseries

from rigidmd import Scene, Simulation

COUNT = 343 if SMOKE else 512
CUTOFF, TEMPERATURE, STEP = 9.0, 298.15, 2.0  # Å, K, fs
TO_REST = 0.1 if SMOKE else 5.0  # ps, before GROMACS
EVERY = 0.1  # ps between samples
RELAXATION = 0.4  # ps, of the barostats: shorter than the time of the volume, near 1 ps, so that it barely lengthens it


def scene(model: str, *stages: dict) -> dict:
    """A scene of the liquid; `stages` begin at a guess of the density."""
    common = {
        "temperature_K": TEMPERATURE,
        "timestep_fs": STEP,
        "integrator": "baoab",
        "thermostat": "langevin",
    }
    return {
        "box": {"density_g_cm3": 0.99},
        "molecules": [{"model": model, "count": COUNT}],
        "forces": {
            "cutoff_A": CUTOFF,
            "truncation": "shift",
            "tail_correction": True,
            "electrostatics": "pme",
        },
        "precision": "mixed",
        "threads": 1,
        "start": {"temperature_K": TEMPERATURE},
        "stages": [common | stage for stage in stages],
        "output": {"trajectory": False, "figures": False, "log_interval_ps": EVERY},
    }


def own_density(model: str, duration: float) -> np.ndarray:
    """Density over time by rigidmd, g/cm³."""
    npt = {"ensemble": "npt", "pressure_bar": 1.0, "barostat_time_ps": RELAXATION}
    results = Simulation(Scene.from_dict(scene(model, npt | {"duration_ps": duration}))).run(
        progress=not SMOKE
    )
    return results["density"][1:]


def begin_gromacs(model: str, duration: float, folder: Path) -> subprocess.Popen:
    """A run of GROMACS in the folder, begun."""
    nvt = {"ensemble": "nvt", "duration_ps": TO_REST}
    simulation = Simulation(Scene.from_dict(scene(model, nvt)))
    state = simulation.run().state
    sites = sites_of(simulation.system, state)
    every = round(EVERY / (STEP * 1e-3))
    options = {
        "integrator": "md",
        "dt": STEP * 1e-3,
        "nsteps": round(duration / (STEP * 1e-3)),
        "gen-vel": "yes",
        "gen-temp": TEMPERATURE,
        "cutoff-scheme": "verlet",
        "nstlist": 20,
        "verlet-buffer-tolerance": 1e-4,
        "rvdw": CUTOFF / 10,
        "rcoulomb": CUTOFF / 10,
        "vdw-modifier": "potential-shift",
        "DispCorr": "EnerPres",
        "coulombtype": "PME",
        "tcoupl": "v-rescale",
        "tc-grps": "system",
        "tau-t": 0.5,
        "ref-t": TEMPERATURE,
        "pcoupl": "C-rescale",
        "tau-p": RELAXATION,
        "ref-p": 1.0,
        "compressibility": 4.5e-5,
        "nstenergy": every,
        "nstlog": 0,
    }
    (folder / "run.mdp").write_text("".join(f"{key} = {value}\n" for key, value in options.items()))
    (folder / "run.gro").write_text(gro(sites, np.zeros_like(sites["position"])))
    (folder / "run.top").write_text(top(sites))
    gmx = [program("gmx"), "-quiet", "-nobackup"]
    call(
        [*gmx, "grompp", "-f", "run.mdp", "-c", "run.gro", "-p", "run.top", "-o", "run.tpr"], folder
    )
    threads = ["-ntmpi", "1", "-ntomp", "1", "-notunepme"]
    with (folder / "said.txt").open("w") as said:
        return subprocess.Popen(
            [*gmx, "mdrun", "-deffnm", "run", *threads],
            cwd=folder,
            env=environment(),
            stdout=said,
            stderr=said,
        )


def end_gromacs(run: subprocess.Popen, folder: Path) -> np.ndarray:
    """Its density over time, g/cm³."""
    if run.wait() != 0:
        raise SystemExit((folder / "said.txt").read_text()[-2000:])
    call(
        [program("gmx"), "-quiet", "energy", "-f", "run.edr", "-o", "run.xvg", "-dp"],
        folder,
        "Density\n\n",
    )
    lines = [
        line.split()
        for line in (folder / "run.xvg").read_text().splitlines()
        if line[0] not in "#@"
    ]
    return 1e-3 * np.array(lines, float)[1:, 1]


def average(values: np.ndarray) -> tuple[float, float]:
    """Mean and standard error of a series without its first tenth."""
    kept = values[len(values) // 10 :]
    return float(kept.mean()), float(
        kept.std(ddof=1) * np.sqrt(timeseries.statistical_inefficiency(kept) / len(kept))
    )


def main() -> None:
    """Run both engines for each model and print the table."""
    parser = new_parser(__doc__)
    parser.add_argument("--models", default="spce,tip4p2005")
    parser.add_argument("--duration", type=float, default=2000.0, metavar="PS")
    options = read_options(parser, Path("runs/densities"), duration=2.0)
    found = {}
    try:
        print(f"{Gromacs.version()}; {options.duration:g} ps each")
    except Absent as error:
        sys.exit(f"GROMACS is not installed: {error}")
    print("| model | rigidmd, g/cm³ | GROMACS, g/cm³ | difference, % |\n|---|---|---|---|")
    for model in options.models.split(","):
        with tempfile.TemporaryDirectory() as name:
            run = begin_gromacs(model, options.duration, Path(name))
            try:
                own = average(own_density(model, options.duration))
                other = average(end_gromacs(run, Path(name)))
            finally:
                run.kill()
        difference, error = (
            100 * (own[0] / other[0] - 1),
            100 * np.hypot(own[1], other[1]) / other[0],
        )
        told = [f"{value:.5f} ± {error:.5f}" for value, error in (own, other)] + [
            f"{difference:+.3f} ± {error:.3f}"
        ]
        print(f"| {model} | {' | '.join(told)} |", flush=True)
        found[model] = {"rigidmd": own, "gromacs": other, "duration_ps": options.duration}
    (options.to / "densities.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
