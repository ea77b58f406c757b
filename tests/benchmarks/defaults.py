"""`rigidmd run` and `gmx mdrun` as their users start them, alternating: all settings that the
physics leaves open are the defaults of each program.

    python tests/benchmarks/defaults.py --rounds 3 --seconds 10 --json defaults.json

The programs start from the same positions and velocities (those of peers.py), at constant energy
with a step of 2 fs, and use all cores; no variable is set. Each reports its own speed:
`steps_per_s` of summary.json, `Performance` of md.log. `gmx` is the one on PATH: put that of this
processor first.
"""

import argparse
import json
import os
import re
import tempfile
from pathlib import Path
from statistics import median

import numpy as np
from peer_engines import Gromacs, call, environment, gro, leapfrog_velocity, program, top
from peers import WORKLOADS, start_of

STEP = 2.0  # fs
PILOT_STEPS = 400


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
    work, start = (
        WORKLOADS[case["start"]],
        start_of(case["start"], "own").sites_file.parent / "start.npz",
    )
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
    sites = dict(np.load(start_of(case["start"], "own").sites_file))
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    parser.add_argument("--cases", default="", help="words that a case has to contain")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    for name in os.environ.keys() - environment().keys():
        del os.environ[name]
    print(Gromacs.version())
    found = {}
    for name, case in CASES.items():
        if options.cases not in name:
            continue
        readings = {program: [] for program in RUNS}
        with tempfile.TemporaryDirectory() as folder:
            steps = {}
            for (
                engine,
                run,
            ) in RUNS.items():  # compiles, and shows how many steps fit into the seconds
                steps[engine] = max(
                    PILOT_STEPS, round(options.seconds * run(case, Path(folder), PILOT_STEPS))
                )
            for _ in range(options.rounds):
                for engine, run in RUNS.items():
                    readings[engine].append(run(case, Path(folder), steps[engine]))
        ours, theirs = (median(readings[engine]) for engine in RUNS)
        found[name] = readings | {"ratio": ours / theirs, "settings": case.get("settings")}
        ranges = ", ".join(
            f"{engine} {min(r):.0f} to {max(r):.0f}" for engine, r in readings.items()
        )
        print(
            f"{name}: rigidmd {ours:.0f}, GROMACS {theirs:.0f} steps/s, ratio {ours / theirs:.2f} ({ranges})",
            flush=True,
        )
    if options.json:
        options.json.write_text(
            json.dumps({"gromacs": Gromacs.version(), "cases": found}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
