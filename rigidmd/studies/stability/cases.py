"""Stability cases: their registry, the scenes that they make in code and run, the outcomes and the
verdicts on them."""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.errors import RigidMDError
from rigidmd.run import Simulation
from rigidmd.run.results import Results
from rigidmd.run.summary import LARGE_ENERGY_ERROR
from rigidmd.scene import MolecularScene, Scene

RIGHT, REFUSED, REPORTED, UNDETECTED, CRASH = "right", "refused", "reported", "undetected", "crash"
#: Meaning of each verdict; the last two are failures.
VERDICTS = {
    RIGHT: "the answer is right within the error stated",
    REFUSED: "an error message of rigidmd describes what is wrong",
    REPORTED: "the answer is wrong, the run finished, and the diagnostics that it reports show it",
    UNDETECTED: "the answer is wrong and nothing shows it",
    CRASH: "an exception that is not an error of rigidmd",
}
#: A run is bounded while the errors of conserved quantities stay below this fraction of the kinetic
#: energy.
BOUND = 0.1
#: Most doublings of a step that is bounded; ratio at which bisection ends.
DOUBLINGS, RATIO = 10, 1.1


class Outcome(NamedTuple):
    error: float = nan  # with respect to the known answer, in the unit of the case
    reported_error: float = (
        nan  # largest error of conserved quantities that the run itself reports, relative
    )
    message: str = ""  # of the rigidmd error that refused or stopped it
    crash: str = ""
    seconds: float = 0.0


@dataclass
class CaseRun:
    """One run with its expected outcome."""

    setting: str  # describes what was varied
    family: str
    step: float
    allowed: float  # largest error
    expected: tuple[str, ...]
    outcome: Outcome

    @property
    def verdict(self) -> str:
        seen = self.outcome
        if seen.crash:
            return CRASH
        if seen.message:
            return REFUSED
        if seen.error <= self.allowed:
            return RIGHT
        return REPORTED if seen.reported_error > LARGE_ENERGY_ERROR else UNDETECTED


class StepLimit(NamedTuple):
    """The longest bounded step of a family of integrators, and how longer steps fail."""

    setting: str
    family: str
    longest: float  # inf if no step tried was too long, 0 if none was short enough
    beyond: str  # drift, blow-up, detected, undetected, crash; empty where nothing fails
    message: str
    seconds: float
    tried: float  # the longest step that was tried


#: run(result, quick) adds runs and step limits to the result; quick : fewer settings and
#: integrators.
CaseFunction = Callable[["CaseResult", bool], None]


@dataclass
class CaseResult:
    """A named way to try to break the engine, with all its runs and step limits."""

    name: str
    group: int  # number of its kind of difficulty, from 1 to 14
    sentence: str
    error_title: str = ""  # what its error is
    step_unit: str = ""
    run: CaseFunction = lambda result, quick: None
    runs: list[CaseRun] = field(default_factory=list)
    limits: list[StepLimit] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(
        self,
        setting: str,
        outcome: Outcome,
        allowed: float = nan,
        family: str = "",
        step: float = nan,
        expected: tuple[str, ...] = (RIGHT,),
    ) -> None:
        self.runs.append(CaseRun(setting, family, step, allowed, expected, outcome))

    @property
    def families(self) -> list[str]:
        return list(
            dict.fromkeys([t.family for t in self.runs] + [limit.family for limit in self.limits])
        )

    @property
    def failures(self) -> list[str]:
        """Undetected errors and crashes, a sentence each."""
        runs = [t for t in self.runs if t.verdict in (UNDETECTED, CRASH)]
        found = [
            f"{self.name}, {t.setting} {t.family}".strip() + f": {t.outcome.crash or UNDETECTED}"
            for t in runs
        ]
        for limit in self.limits:
            if limit.beyond in (UNDETECTED, CRASH):
                where = (
                    f"{self.name}, {limit.setting} {limit.family}, steps beyond {limit.longest:.3g}"
                )
                found.append(f"{where}: {limit.message or UNDETECTED}")
        return found

    @property
    def unexpected(self) -> list[CaseRun]:
        """Runs with a verdict that was not expected."""
        return [run for run in self.runs if run.verdict not in run.expected]


def failure(outcome: Outcome) -> str:
    """How an unbounded run fails."""
    if outcome.crash:
        return CRASH
    if outcome.message:
        return "detected"
    if outcome.reported_error >= 1:
        return "blow-up"
    return "drift" if outcome.reported_error > LARGE_ENERGY_ERROR else UNDETECTED


def longest_step(
    run: Callable[[float], Outcome],
    start: float,
    setting: str = "",
    family: str = "",
    bound: float = BOUND,
) -> StepLimit:
    """The longest step that is bounded: doubled or halved from `start`, then bisected.

    Runs just beyond the limit and at two and four times it show how it fails. The worst outcome is
    reported, because a step that is far too long can seem stable again.
    """
    seen: dict[float, Outcome] = {}

    def is_bounded(step: float) -> bool:
        seen[step] = outcome = run(step)
        return not outcome.message and not outcome.crash and outcome.reported_error <= bound

    good, bad = (start, inf) if is_bounded(start) else (0.0, start)
    for _ in range(DOUBLINGS):
        if good > 0 and bad < inf:
            break
        step = 2 * good if good > 0 else bad / 2
        good, bad = (step, bad) if is_bounded(step) else (good, step)
    while good > 0 and bad < inf and bad > RATIO * good:
        middle = (good * bad) ** 0.5
        good, bad = (middle, bad) if is_bounded(middle) else (good, middle)
    beyond = message = ""
    if good > 0 and bad < inf:
        is_bounded(2 * bad)
        is_bounded(4 * bad)
        ways = {failure(outcome): outcome for step, outcome in seen.items() if step >= bad}
        beyond = next(
            way for way in (CRASH, UNDETECTED, "blow-up", "drift", "detected") if way in ways
        )
        message = ways[beyond].crash or ways[beyond].message
    seconds = sum(outcome.seconds for outcome in seen.values())
    return StepLimit(
        setting, family, inf if bad == inf else good, beyond, message, seconds, max(seen)
    )


CASES: dict[str, CaseResult] = {}  # without results


def register(
    group: int, error: str = "", step: str = "s"
) -> Callable[[CaseFunction], CaseFunction]:
    """Register a function as a case under its own name, with the first line of its docstring."""

    def add(run: CaseFunction) -> CaseFunction:
        sentence = (run.__doc__ or "").strip().splitlines()[0].rstrip(".")
        CASES[run.__name__] = CaseResult(run.__name__, group, sentence, error, step, run)
        return run

    return add


#: Integrator families: velocity Verlet with both rotors, a symplectic Nystrom scheme, compositions
#: with split rotors.
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


def families(quick: bool) -> tuple[str, ...]:
    return QUICK if quick else tuple(FAMILIES)


def attempt(run: Callable[..., Outcome]) -> Callable[..., Outcome]:
    """A run whose errors are outcomes: one of rigidmd becomes a message, any other exception a
    crash."""

    @wraps(run)
    def attempted(*arguments: Any, **options: Any) -> Outcome:
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
    return data | {
        "run": run,
        "output": {"trajectory": False, "figures": False, "interval_s": interval},
    }


@attempt
def run_body(
    data: dict,
    step: float,
    duration: float,
    family: str,
    error: Callable[[Results], float],
    samples: int = 50,
) -> Outcome:
    """The outcome of a run of a body for a duration (s); error(results) compares with the known
    answer."""
    results = Simulation(Scene.from_dict(body_scene(data, step, duration, family, samples))).run()
    wrong = list(results.summary["largest_relative_error"].values())
    reported_error = max(
        [*wrong, results.summary["largest_orthogonality_error"] or 0.0], default=0.0
    )
    return Outcome(float(error(results)), float(reported_error))


def molecules_scene(
    molecules: list[dict],
    box: dict,
    step: float,
    steps: int,
    family: str = SPLIT,
    temperature: float | None = 298.0,
    thermostat: dict | None = None,
    forces: dict | None = None,
    samples: int = 25,
) -> dict:
    """The tables of a scene of molecules: one stage of `steps` steps (fs), sampled `samples` times,
    no files."""
    stage = {"duration_ps": step * steps / 1000, "timestep_fs": float(step)} | FAMILIES[family]
    if thermostat is not None:
        stage |= {"ensemble": "nvt"} | thermostat
    start = {} if temperature is None else {"temperature_K": float(temperature)}
    output = {
        "trajectory": False,
        "log_interval_ps": min(1e9, step * max(1, steps // samples) / 1000),
    }
    scene = {
        "box": box,
        "molecules": molecules,
        "forces": forces or {},
        "start": start,
        "stages": [stage],
    }
    return scene | {"output": output}


def simulate(data: dict, state: State | None = None, folder: str = ".") -> Results:
    simulation = Simulation(MolecularScene.from_dict(data, folder))
    if state is not None:
        simulation.start_from(state)
    return simulation.run()


def energy_error(results: Results, scale: float = 0.0) -> float:
    """Largest change of the conserved energy, relative to the initial kinetic energy (or a scale,
    kJ/mol)."""
    wrong = np.abs(results["drift"])
    size = scale or results["kinetic"][0]
    return float(wrong.max() / size) if np.isfinite(wrong).all() and size > 0 else inf


@attempt
def run_molecules(
    data: dict,
    state: State | None = None,
    error: Callable[[Results], float] | None = None,
    scale: float = 0.0,
    folder: str = ".",
) -> Outcome:
    """The outcome of a run of molecules; its error is the energy error unless error(results)
    computes another."""
    results = simulate(data, state, folder)
    reported_error = energy_error(results, scale)
    return Outcome(reported_error if error is None else float(error(results)), reported_error)


@attempt
def run_invalid(data: dict) -> Outcome:
    """The outcome of a scene that must be refused before it runs; one that runs has no right
    answer."""
    Simulation(Scene.from_dict(data)).run()
    return Outcome(nan, 0.0)
