"""Every command on every shipped scene and model: the command lines, what they end with, and the
reasons for which they may refuse.

A short form of a scene has 100 steps for each stage and a frame every second step. Its figures are
off. `reason_against` names what is wrong with the end of a command; `REFUSALS` lists true reasons.
"""

import io
import re
import shutil
import tomllib
import traceback
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import NamedTuple

import tomli_w

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.features.analysis.registry import known
from rigidmd.scene import Scene
from rigidmd.scene.base import override
from rigidmd.scene.models import available_models, load_model
from support.common import BODIES, MOLECULES, ROOT

STEPS = 100
#: Analyses that read a sweep.
OF_SWEEPS = ("pmf", "free_energy")
#: Next to a model in the liquid: an ion needs an opposite one and a solvent.
OPPOSITE = {1: "cl", -1: "na"}


class Refusal(NamedTuple):
    """A true reason for which a command refuses: a part of its message, and the cells in which it
    may occur (patterns of the names of the command and of the scene or model)."""

    reason: str
    cell: str
    subject: str = ".*"


BODY = "|".join(path.stem for path in BODIES)
REFUSALS = (
    # a single body
    Refusal("is for molecules", r"check --.*|accuracy --averages", BODY),
    Refusal("--accuracy needs molecules", "energy --accuracy", BODY),
    Refusal("analyses are for molecules", "analyse.*", BODY),
    Refusal("needs a sweep over", "analyse a sweep.*"),
    Refusal("export supports molecules only", "export .*", BODY),
    Refusal("normal modes need a molecular scene", "modes", BODY),
    Refusal("only a scene of molecules has it", "verify .*", BODY),
    # no charges, or no box
    Refusal("measures errors of Ewald sums: forces.electrostatics is", "energy --accuracy"),
    Refusal(r"needs a box, and the run has none", "analyse --only .*", "water_dimer|alone"),
    # analyses of what a liquid, an atom or a short run does not have
    Refusal("no slab between two vapours", "analyse --only (interfaces|surface_tension)"),
    Refusal("no molecule has a dipole", "analyse --only dielectric"),
    Refusal("no profile of a slab", "analyse --only (interfaces|surface_tension)"),
    Refusal("no molecule of this run is linear", "analyse --only nematic"),
    Refusal("no molecule of this run rotates", "analyse --only orientation"),
    Refusal("needs at least 20 ps of the pressure tensor", "analyse --only viscosity"),
    Refusal("needs velocities in the frames", "analyse --only spectrum"),
    Refusal("it is for nvt and npt, and the stage is n", "analyse --only zero_step"),
    Refusal("fewer than 20 independent samples", "analyse --only zero_step"),
    Refusal("are no samples|no forces act|too strong", "analyse --only zero_step"),
    Refusal("no molecule has a hydrogen bonded", "analyse --only hydrogen_bonds"),
    Refusal("needs molecules with charges", "analyse --only dielectric"),
    Refusal("'none' has no known boundary", "analyse --only dielectric", "lta"),
    Refusal("no force holds these molecules", "modes", "alone"),
    Refusal("need a thermostat without a box", "analyse --only response", "water_dimer|alone"),
    Refusal("nve has no thermostat", "accuracy --averages"),
    Refusal("forces are not smooth at the minimum", "modes", "water_slab"),
    # what other engines do not have
    Refusal("GROMACS computes pairs within a cutoff", "export gromacs", "water_dimer|alone"),
    Refusal("has no translation for", "(export|verify) .*", "gay_berne|janus|water_slab"),
    Refusal("LAMMPS' gayberne has plain", "(export|verify) lammps", "gay_berne"),
    Refusal("frozen molecules: GROMACS would compute", "export gromacs", "lta"),
)

#: What no output has: an exception, a warning of Python, a number that is none.
WRONG = re.compile(
    r"Traceback|[\w/]+\.py:\d+|\b\w*(?<!RigidMD)Warning: |\bnan\b|(?<![\w.])-?inf(?!\w)"
)


def short_form(path: Path, folder: Path) -> Path:
    """A shipped scene, shortened, in a folder with the structure files next to it."""
    scene = Scene.read(path)
    tables = tomllib.loads(path.read_text())
    if isinstance(scene, rigidmd.BodyScene):
        step = scene.run.timestep_s
        changes = {"run.duration_s": STEPS * step, "output.interval_s": 2 * step}
    else:
        stages = rigidmd.with_defaults(scene).stages
        moving = {k: stage.step for k, stage in enumerate(stages) if not stage.is_minimisation}
        shortest = min(moving.values())
        changes = {f"stages.{k}.duration_ps": STEPS * step for k, step in moving.items()} | {
            "output.log_interval_ps": 2 * shortest,
            "output.trajectory_interval_ps": 2 * shortest,
        }
        if scene.box.periodic:
            changes["output.pressure_tensor_interval_ps"] = 2 * shortest
    for key, value in (changes | {"output.figures": False}).items():
        _, errors = override(tables, key, value)
        assert not errors, errors
    structures = folder / "structures"
    if not structures.exists():
        shutil.copytree(ROOT / "systems" / "structures", structures)
    short = folder / path.name
    short.write_bytes(tomli_w.dumps(tables).encode())
    return short


def liquid_of(model: str, folder: Path) -> Path:
    """A small liquid of a model; of an ion a solution."""
    species = load_model(model)
    charge = round(species.charge)
    counts = {model: 40}
    volume = 40 * (30.0 + 1.2 * species.mass)
    if charge:
        kind = model.rpartition("_")[2]
        counts = {model: 2, f"{OPPOSITE[charge]}_{kind}": 2, kind: 60}
        volume = 64 * 40.0
    tables = {
        "box": {"lengths_A": volume ** (1 / 3)},
        "molecules": [{"model": name, "count": count} for name, count in counts.items()],
        "forces": {"cutoff_A": 6.0},
        "stages": [
            {"ensemble": "minimise"},
            {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.1, "timestep_fs": 1.0},
        ],
        "output": {
            "log_interval_ps": 0.002,
            "trajectory_interval_ps": 0.002,
            "pressure_tensor_interval_ps": 0.002,
            "figures": False,
        },
    }
    path = folder / f"{model}.toml"
    path.write_bytes(tomli_w.dumps(tables).encode())
    return path


def alone(model: str, folder: Path) -> Path:
    """One molecule of a model without a box."""
    tables = {
        "box": {"lengths_A": 20.0, "periodic": False},
        "molecules": [{"model": model, "count": 1}],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 0.1, "timestep_fs": 1.0}],
        "output": {"trajectory_interval_ps": 0.002, "figures": False},
    }
    path = folder / f"one_{model}.toml"
    path.write_bytes(tomli_w.dumps(tables).encode())
    return path


def commands_of(scene: Path) -> Iterator[tuple[str, list[str]]]:
    """Name and arguments of each command on a scene, the cheap ones first. Later ones read what
    earlier ones wrote."""
    stem, text = scene.with_suffix(""), str(scene)
    run, again = f"{stem}_run", f"{stem}_again"
    is_body = "body" in tomllib.loads(scene.read_text())
    yield "check", ["check", text]
    yield "check --program", ["check", text, "--program"]
    yield "check --profile", ["check", text, "--profile"]
    yield "energy", ["energy", text]
    yield "energy --json", ["energy", text, "--json"]
    yield "energy --accuracy", ["energy", text, "--accuracy"]
    yield "run", ["run", text, "-o", run, "-v"]
    yield "analyse", ["analyse", run]
    for name in known():
        yield f"analyse --only {name}", ["analyse", run, "--only", name, "-v"]
    yield "report", ["report", run]
    yield "view", ["view", run]
    yield "film", ["film", run, "-o", f"{run}.gif", "--seconds", "0.2", "--height", "100"]
    for engine in ("lammps", "openmm", "gromacs"):
        yield f"export {engine}", ["export", text, "--to", engine, "-o", f"{stem}_{engine}"]
    yield "modes", ["modes", text, "-o", f"{stem}_modes", "--count", "3"]
    yield "run again", ["run", text, "-o", again]
    yield "compare", ["compare", run, again]
    yield "resume", ["resume", again, *([] if is_body else ["--until", "2ps"])]
    for engine in ("lammps", "openmm"):
        yield f"verify {engine}", ["verify", text, "--engine", engine]
    steps = steps_of(scene)
    step = "run.timestep_s" if is_body else f"stages.{stages_in(scene) - 1}.timestep_fs"
    extrapolate = [] if is_body else ["--extrapolate", step]
    sweep = ["sweep", text, "--set", f"{step}={steps}", "-o", f"{stem}_sweep", "--jobs", "1"]
    yield "sweep", [*sweep, *extrapolate]
    yield "analyse a sweep", ["analyse", f"{stem}_sweep", *extrapolate]
    for name in OF_SWEEPS:
        yield f"analyse a sweep {name}", ["analyse", f"{stem}_sweep", name]
    span = str(20 * float(steps.partition(",")[0])) if is_body else "0.02"
    measured = ["accuracy", text, "--repeats", "1", "--integrators"]
    trial = ["velocity_verlet", "--timesteps", steps, "--span", span]
    yield "accuracy", [*measured, *trial, "-o", f"{stem}_accuracy"]
    sample = ["baoab+langevin", "--averages", "--sample-ps", "0.05", "--timesteps", steps]
    yield "accuracy --averages", [*measured, *sample, "-o", f"{stem}_averages"]


def stages_in(scene: Path) -> int:
    return len(tomllib.loads(scene.read_text())["stages"])


def steps_of(scene: Path) -> str:
    """Two time steps for a scene: half its own, and its own."""
    resolved = Scene.read(scene)
    if isinstance(resolved, rigidmd.BodyScene):
        step = resolved.run.timestep_s
    else:
        step = 1e3 * rigidmd.with_defaults(resolved).stages[-1].step
    return f"{step / 2:.12g},{step:.12g}"


def commands_of_model(model: str, host: Path, folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Those on a model itself. `host` is a run into which it is inserted."""
    virial = ["--temperatures", "300,500,800", "--error", "20"]
    yield "models NAME", ["models", model]
    yield "models --draw", ["models", model, "--draw", "-o", str(folder / f"{model}.svg")]
    yield "virial", ["virial", model, *virial]
    yield "virial with argon", ["virial", model, "argon", *virial]
    yield "insertion", ["analyse", str(host), "insertion", f"model={model}", "trials=200", "-v"]


def end_of(arguments: list[str]) -> tuple[int, str]:
    """Exit code and output of a command in this process; -1 after an exception."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output), warnings.catch_warnings():
        warnings.simplefilter("default")
        try:
            code = main(arguments)
        except SystemExit as end:
            code = int(end.code or 0)
        except Exception:
            traceback.print_exc(file=output)
            code = -1
    return code, output.getvalue()


def reason_against(cell: str, subject: str, code: int, text: str) -> str:
    """What is wrong with the end of a command; empty if nothing is."""
    if found := WRONG.search(text):
        return f"prints {found[0]!r}: {text[-1500:]}"
    if code == 0 or refusal_of(cell, subject, text):
        return ""
    return f"ends with {code}: {text[-600:]}"


def refusal_of(cell: str, subject: str, text: str) -> Refusal | None:
    """The listed reason for which a command refused."""
    return next(
        (
            one
            for one in REFUSALS
            if re.fullmatch(one.cell, cell)
            and re.fullmatch(one.subject, subject)
            and re.search(one.reason, text)
        ),
        None,
    )


@cache
def models() -> tuple[str, ...]:
    return tuple(available_models())


SHIPPED = {path.stem: path for path in (*BODIES, *MOLECULES)}
