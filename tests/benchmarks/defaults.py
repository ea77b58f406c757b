"""`rigidmd run` and `gmx mdrun` as their users start them, alternating: all settings that the
physics leaves open are the defaults of each program.

    python tests/benchmarks/defaults.py --rounds 9 --seconds 2 --to FOLDER

The programs start from the same positions and velocities (those of peers.py), at constant energy
with a step of 2 fs, and use all cores; no variable is set. Each reports its own speed:
`steps_per_s` of summary.json, `Performance` of md.log. Speeds are medians, and the ratio is the
median of the ratios within a round, since the speed of a shared machine changes. `gmx` is the one
on PATH: put that of this processor first. All readings are in FOLDER/defaults.json.
"""

import json
import os
import re
import tempfile
from pathlib import Path
from statistics import median

import numpy as np
from command_line import SMOKE, new_parser, read_options
from peer_engines import (
    Absent,
    Gromacs,
    Rigidmd,
    call,
    environment,
    gro,
    leapfrog_velocity,
    program,
    top,
)
from peers import WORKLOADS, start_folder, write_sites

STEP = 2.0  # fs
PILOT_STEPS = 20 if SMOKE else 400


def workload(name: str, cutoff: float, charges: str) -> dict:
    return {"start": name, "cutoff": cutoff, "charges": charges}


CASES = {
    "4096 SPC/E, reaction field, 9 Å": workload("W1", 9.0, "reaction_field"),
    "4096 SPC/E, PME, 9 Å": workload("W1", 9.0, "pme"),
    "4096 SPC/E, PME, 12 Å": workload("W1", 12.0, "pme"),
    "4000 nitrogens, 10 Å": workload("W3", 10.0, "none"),
}


def toml(value) -> str:
    """A value as TOML, tables in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(entry)}" for key, entry in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value)


def run_rigidmd(case: dict, folder: Path, steps: int) -> float:
    """Steps/s of `rigidmd run`. The scene states what the molecules are, their start and the cutoff,
    and no more."""
    work = WORKLOADS[case["start"]]
    start = start_folder(case["start"]) / "start.npz"
    forces = {"cutoff_A": case["cutoff"]}
    if case["charges"] == "reaction_field":
        forces["electrostatics"] = "reaction_field"
    scene = {
        "structure": {"file": "start.npz", "velocities": True},
        "molecules": [{**work.molecules, "count": work.count}],
        "forces": forces,
        "stages": [{"duration_ps": steps * STEP / 1000}],
    }
    (folder / "start.npz").write_bytes(start.read_bytes())
    (folder / "scene.toml").write_text(
        "".join(f"{key} = {toml(value)}\n" for key, value in scene.items())
    )
    call([program("rigidmd"), "run", "scene.toml", "-o", "out", "--force"], folder)
    summary = json.loads((folder / "out/summary.json").read_text())
    case["settings"] = [*summary["notes"][:2], summary["precision_reason"]]
    return summary["stages"][0]["steps_per_s"]


def run_gromacs(case: dict, folder: Path, steps: int) -> float:
    """Steps/s of `gmx mdrun`."""
    sites = dict(np.load(case["sites"]))
    kind = {"reaction_field": "reaction-field", "pme": "PME", "none": "cut-off"}[case["charges"]]
    options = {
        "integrator": "md",
        "dt": STEP / 1000,
        "nsteps": steps,
        "continuation": "yes",
        "coulombtype": kind,
        "rvdw": case["cutoff"] / 10,
        "rcoulomb": case["cutoff"] / 10,
        "epsilon-rf": 0,
    }
    (folder / "run.mdp").write_text("".join(f"{key} = {value}\n" for key, value in options.items()))
    (folder / "run.gro").write_text(gro(sites, leapfrog_velocity({"timestep_fs": STEP}, sites)))
    (folder / "run.top").write_text(top(sites))
    gmx = [program("gmx"), "-quiet", "-nobackup"]
    call(
        [*gmx, "grompp", "-f", "run.mdp", "-c", "run.gro", "-p", "run.top", "-o", "run.tpr"], folder
    )
    call([*gmx, "mdrun", "-deffnm", "run"], folder)
    performance = re.search(r"^Performance:\s+(\S+)", (folder / "run.log").read_text(), re.M)
    return float(performance.group(1)) * 1e6 / STEP / 86400


RUNS = {"rigidmd": run_rigidmd, "gromacs": run_gromacs}


def measure(case: dict, engines: list[str], rounds: int, seconds: float) -> dict[str, list[float]]:
    """Readings of each program, steps/s."""
    readings: dict[str, list[float]] = {engine: [] for engine in engines}
    with tempfile.TemporaryDirectory() as folder:
        steps = {}
        for engine in engines:  # compiles, and shows how many steps fit into the seconds
            rate = RUNS[engine](case, Path(folder), PILOT_STEPS)
            steps[engine] = max(PILOT_STEPS, round(seconds * rate))
        for _ in range(rounds):
            for engine in engines:
                readings[engine].append(RUNS[engine](case, Path(folder), steps[engine]))
    return readings


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    parser.add_argument("--cases", default="", help="words that a case has to contain")
    options = read_options(parser, Path("runs/defaults"), rounds=1, seconds=0.0)
    for name in os.environ.keys() - environment().keys():
        del os.environ[name]
    versions = {"rigidmd": Rigidmd.version()}
    try:
        versions["gromacs"] = Gromacs.version()
    except Absent as error:
        print(f"GROMACS is skipped: {error}")
    print(*versions.values(), sep="\n")
    found = {}
    for name, case in CASES.items():
        if options.cases not in name:
            continue
        case["sites"] = write_sites(WORKLOADS[case["start"]], start_folder(case["start"]))
        readings = measure(case, list(versions), options.rounds, options.seconds)
        middle = {engine: median(values) for engine, values in readings.items()}
        found[name] = {**readings, "settings": case.get("settings")}
        told = [
            f"{engine} {middle[engine]:.0f} ({min(values):.0f} to {max(values):.0f})"
            for engine, values in readings.items()
        ]
        if "gromacs" in middle:
            pairs = zip(readings["rigidmd"], readings["gromacs"], strict=True)
            ratios = [ours / theirs for ours, theirs in pairs]
            found[name]["ratio"] = median(ratios)
            told.append(f"ratio {median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
        print(f"{name}, steps/s: {', '.join(told)}", flush=True)
    whole = {"versions": versions, "cases": found}
    (options.to / "defaults.json").write_text(json.dumps(whole, indent=1) + "\n")


if __name__ == "__main__":
    main()
