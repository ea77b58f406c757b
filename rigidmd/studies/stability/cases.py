"""The registry of stability cases, and the scenes that they make in code and run."""

import time as clock
from collections.abc import Callable
from functools import wraps
from math import inf, nan
from typing import NamedTuple, ParamSpec

import numpy as np

from rigidmd.core.state import State
from rigidmd.errors import RigidMDError
from rigidmd.run import Simulation
from rigidmd.run.results import Results
from rigidmd.scene import MolecularScene, Scene
from rigidmd.studies.stability.outcomes import CaseResult, Outcome

P = ParamSpec("P")

#: Integrator families: velocity Verlet with both rotors, a symplectic Nystrom scheme, compositions with split rotors.
FAMILIES = {
    "velocity_verlet": {"integrator": "velocity_verlet", "rotor": "split"},
    "velocity_verlet, exact rotor": {"integrator": "velocity_verlet", "rotor": "exact"},
    "srkn_4": {"integrator": "srkn_4"},
    "pefrl": {"integrator": "pefrl"},
    "kahan_li_6": {"integrator": "kahan_li_6"},
}
SPLIT, EXACT = "velocity_verlet", "velocity_verlet, exact rotor"
POINT = "velocity_verlet of a point"  # a body without rotation, which has no rotor
QUICK = (SPLIT, EXACT, "srkn_4")
TEXTBOOK = {
    f"{solver}, {form}": {"integrator": solver, "formulation": form}
    for solver in ("rk4", "dop853")
    for form in ("matrix", "quaternion", "euler_angles")
}


#: run(result, quick) adds runs and step limits to the result; quick : fewer settings and integrators.
CaseFunction = Callable[[CaseResult, bool], None]


class StabilityCase(NamedTuple):
    """A named way to try to break the engine. group : number of its kind of difficulty, from 1 to 14."""

    name: str
    group: int
    sentence: str
    run: CaseFunction
    titles: tuple[str, str, str]  # of x and of the error; unit of steps


CASES: dict[str, StabilityCase] = {}


def register(group: int, x: str = "", error: str = "", step: str = "s") -> Callable[[CaseFunction], CaseFunction]:
    """Register a function as a case under its own name, with the first line of its docstring."""

    def add(run: CaseFunction) -> CaseFunction:
        sentence = (run.__doc__ or "").strip().splitlines()[0].rstrip(".")
        CASES[run.__name__] = StabilityCase(run.__name__, group, sentence, run, (x, error, step))
        return run

    return add


def families(quick: bool) -> tuple[str, ...]:
    return QUICK if quick else tuple(FAMILIES)


def attempt(run: Callable[P, Outcome]) -> Callable[P, Outcome]:
    """A run whose errors are outcomes: one of rigidmd becomes a message, any other exception a crash."""

    @wraps(run)
    def attempted(*arguments: P.args, **options: P.kwargs) -> Outcome:
        began = clock.perf_counter()
        try:
            with np.errstate(all="ignore"):
                outcome = run(*arguments, **options)
        except RigidMDError as error:
            outcome = Outcome(message=str(error))
        except Exception as error:  # any other error is a failure of the engine
            outcome = Outcome(crash=f"{type(error).__name__}: {error}")
        return outcome._replace(seconds=clock.perf_counter() - began)

    return attempted


def body_scene(data: dict, step: float, duration: float, family: str, samples: int = 50) -> dict:
    """The tables of a body's scene with a run of this family; no files."""
    known = FAMILIES | TEXTBOOK | {POINT: {"integrator": "velocity_verlet"}}
    run = {"duration_s": float(duration), "timestep_s": float(step)} | known[family]
    interval = min(max(float(step), duration / samples), float(duration))
    return data | {"run": run, "output": {"trajectory": False, "figures": False, "interval_s": interval}}


@attempt
def run_body(
    data: dict, step: float, duration: float, family: str, error: Callable[[Results], float], samples: int = 50
) -> Outcome:
    """The outcome of a run of a body for a duration (s); error(results) compares with the known answer."""
    results = Simulation(Scene.from_dict(body_scene(data, step, duration, family, samples))).run()
    wrong = list(results.summary["largest_relative_error"].values())
    reported_error = max([*wrong, results.summary["largest_orthogonality_error"] or 0.0], default=0.0)
    return Outcome(float(error(results)), float(reported_error))


def molecules_scene(
    molecules: list[dict], box: dict, step: float, steps: int, family: str = SPLIT, temperature: float | None = 298.0,
    thermostat: dict | None = None, forces: dict | None = None, samples: int = 25,
) -> dict:  # fmt: skip
    """The tables of a scene of molecules: one stage of `steps` steps (fs), sampled `samples` times, no files."""
    stage = {"duration_ps": step * steps / 1000, "timestep_fs": float(step)} | FAMILIES[family]
    if thermostat is not None:
        stage |= {"ensemble": "nvt"} | thermostat
    start = {} if temperature is None else {"temperature_K": float(temperature)}
    output = {"trajectory": False, "log_interval_ps": min(1e9, step * max(1, steps // samples) / 1000)}
    scene = {"box": box, "molecules": molecules, "forces": forces or {}, "start": start, "stages": [stage]}
    return scene | {"output": output}


def simulate(data: dict, state: State | None = None) -> Results:
    simulation = Simulation(MolecularScene.from_dict(data))
    if state is not None:
        simulation.start_from(state)
    return simulation.run()


def energy_error(results: Results, scale: float = 0.0) -> float:
    """Largest change of the conserved energy, relative to the initial kinetic energy (or a scale, kJ/mol)."""
    wrong = np.abs(results["drift"])
    size = scale or results["kinetic"][0]
    return float(wrong.max() / size) if np.isfinite(wrong).all() and size > 0 else inf


@attempt
def run_molecules(
    data: dict, state: State | None = None, error: Callable[[Results], float] | None = None, scale: float = 0.0
) -> Outcome:
    """The outcome of a run of molecules; its error is the energy error unless error(results) computes another."""
    results = simulate(data, state)
    reported_error = energy_error(results, scale)
    return Outcome(reported_error if error is None else float(error(results)), reported_error)


@attempt
def run_invalid(data: dict) -> Outcome:
    """The outcome of a scene that must be refused before it runs; one that runs has no right answer."""
    Simulation(Scene.from_dict(data)).run()
    return Outcome(nan, 0.0)
