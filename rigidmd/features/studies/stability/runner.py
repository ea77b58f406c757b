"""The runner of stability cases: runs, verdicts on their outcomes, longest bounded steps."""

import tempfile
import time as clock
from collections.abc import Callable, Iterator
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.plain_text import did_you_mean
from rigidmd.core.state_file import write_state
from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDError, SceneError
from rigidmd.features.studies.kind_study import studies
from rigidmd.features.studies.stability.cases import (
    BOUND,
    CASES,
    CRASH,
    REFUSED,
    REPORTED,
    RIGHT,
    TABLES,
    UNDETECTED,
    Case,
    Outcome,
    Trial,
)
from rigidmd.run import Simulation
from rigidmd.run.failed_check import LARGE_ENERGY_ERROR
from rigidmd.run.results import Results
from rigidmd.scene import MolecularScene, Scene

FAILURES = (UNDETECTED, CRASH)
#: Ways in which a step that is too long fails, the worst first.
BEYOND = (CRASH, UNDETECTED, "blow-up", "drift", "detected")
#: Maximum number of doublings of a step that is bounded; ratio at which bisection ends.
DOUBLINGS, RATIO = 10, 1.1
Warn = Callable[[str], object]


class StepLimit(NamedTuple):
    """The longest bounded step, and how longer steps fail."""

    longest: float  # inf if no step tried was too long, 0 if none was short enough
    tried: float  # the longest step that was tried
    beyond: str = ""  # one of BEYOND, or empty if nothing fails
    message: str = ""


class TrialResult(NamedTuple):
    """The outcome of a trial with one integrator, or its longest bounded step."""

    case: Case
    trial: Trial
    integrator: str
    outcome: Outcome
    limit: StepLimit | None = None
    seconds: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return f"{self.case.name}, {self.trial.setting} {self.integrator}".strip()

    @property
    def allowed(self) -> float:
        trial = self.trial
        return trial.allowed_of.get(self.integrator, trial.allowed) + trial.rounding

    @property
    def verdict(self) -> str:
        """Empty for a longest step."""
        outcome = self.outcome
        has_answer = RIGHT in self.trial.expected
        if self.limit is not None:
            return ""
        if outcome.crash or outcome.message:
            return CRASH if outcome.crash else REFUSED
        if has_answer and outcome.error <= self.allowed:
            return RIGHT
        return REPORTED if outcome.reported_error > LARGE_ENERGY_ERROR else UNDETECTED

    @property
    def failure(self) -> str:
        """A description of an undetected error or crash. Empty without one."""
        if self.verdict in FAILURES:
            return f"{self.name}: {self.outcome.crash or UNDETECTED}"
        if self.limit is not None and self.limit.beyond in FAILURES:
            reason = self.limit.message or UNDETECTED
            return f"{self.name}, steps beyond {self.limit.longest:.3g}: {reason}"
        return ""

    @property
    def is_unexpected(self) -> bool:
        return self.limit is None and self.verdict not in self.trial.expected


def selected_cases(names: list[str] | None) -> list[Case]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    if unknown := [name for name in names or [] if name not in CASES]:
        known = f"(known: {', '.join(CASES)})"
        errors = [f"unknown case {name!r}{did_you_mean(name, CASES)} {known}" for name in unknown]
        raise SceneError("--case", errors)
    return [case for case in CASES.values() if case.name in (names or CASES)]


def run_cases(
    names: list[str] | None = None,
    *,
    quick: bool = False,
    progress: Callable[[float, str], object] = lambda fraction, name: None,
) -> Iterator[TrialResult]:
    """Yield the results of the named cases, or of all.

    quick : fewer settings and integrators
    progress : called before each case with the fraction done and its name
    """
    cases = selected_cases(names)
    for k, case in enumerate(cases):
        progress(k / len(cases), case.name)
        for trial in case.trials(quick):
            for integrator in trial.integrators:
                yield run_trial(case, trial, integrator)


def run_trial(case: Case, trial: Trial, integrator: str) -> TrialResult:
    began = clock.perf_counter()
    warnings = []
    run = partial(attempt, trial, integrator, warnings.append)
    outcome = Outcome()
    limit = None
    if trial.is_bisected:
        limit = longest_step(run, trial.step, trial.bound)
    else:
        outcome = run(trial.step)
    seconds = clock.perf_counter() - began
    return TrialResult(case, trial, integrator, outcome, limit, seconds, tuple(warnings))


def attempt(trial: Trial, integrator: str, warn: Warn, step: float) -> Outcome:
    """Run a trial. An error of rigidmd becomes a message, any other exception a crash."""
    try:
        return (trial.run or run_scene)(trial, integrator, warn, step)
    except RigidMDError as error:
        return Outcome(message=str(error))
    except Exception as error:  # any other error is a failure of the engine
        return Outcome(crash=f"{type(error).__name__}: {error}")


def run_scene(trial: Trial, integrator: str, warn: Warn, step: float) -> Outcome:
    """The outcome of the scene of a trial."""
    results = finish(trial, integrator, warn, step)
    reported = conserved_error(trial, results)
    error = reported if trial.error is None else float(trial.error(results))
    return Outcome(error, reported, remark=trial.remark(results) if trial.remark else "")


def finish(trial: Trial, integrator: str, warn: Warn, step: float) -> Results:
    """The results of the scene of a trial, from its state if it has one."""
    scene = complete_scene(trial, integrator, step)
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        if trial.state is not None and "structure" in scene:
            write_state(Path(folder) / "start.npz", system_of(trial).saved(trial.state))
        simulation = Simulation(Scene.from_dict(scene, folder), warn=warn)
        if trial.state is not None and "structure" not in scene:
            simulation.start_from(trial.state)
        return simulation.run()


def complete_scene(trial: Trial, integrator: str, step: float) -> Json:
    """The tables of a scene with those of a run that writes no files, unless it has its own."""
    method = TABLES["methods"][integrator]
    trial = trial._replace(step=step)
    for table, study in studies():
        if table in trial.scene:
            return study.complete_trial(trial, method, step)
    steps = max(trial.steps, round(trial.duration / step))
    interval = min(1e9, step * max(1, steps // trial.samples) / 1000)
    output = {"trajectory": False, "log_interval_ps": interval}
    stage = method | {"duration_ps": step * steps / 1000, "timestep_fs": step} | trial.stage
    return {"stages": [stage], "output": output, **trial.scene}


def system_of(trial: Trial) -> System:
    """The molecules of a trial at rest, without the structure that they are to be read from."""
    scene = complete_scene(trial, trial.integrators[0] or "velocity_verlet", trial.step)
    scene.pop("structure", None)
    return build(MolecularScene.from_dict(scene | {"start": {"temperature_K": 0.0}}))


def conserved_error(trial: Trial, results: Results) -> float:
    """Largest error of conserved quantities, relative. For molecules the error of the energy,
    relative to the scale of the trial."""
    if "largest_relative_error" in results.summary:
        orthogonality = results.summary["largest_orthogonality_error"] or 0.0
        return max([*results.summary["largest_relative_error"].values(), orthogonality])
    largest = np.abs(results["drift"]).max()
    scale = trial.scale or results[trial.scale_column][0]
    return float(largest / scale) if isfinite(largest) and scale > 0 else inf


def failure(outcome: Outcome) -> str:
    """How an unbounded run fails."""
    if outcome.crash or outcome.message:
        return CRASH if outcome.crash else "detected"
    if outcome.reported_error >= 1:
        return "blow-up"
    return "drift" if outcome.reported_error > LARGE_ENERGY_ERROR else UNDETECTED


def longest_step(run: Callable[[float], Outcome], start: float, bound: float = BOUND) -> StepLimit:
    """The longest step that is bounded: doubled or halved from `start`, then bisected.

    Runs just beyond the limit and at two and four times it show how it fails. The worst outcome is
    reported, because a step that is far too long can seem stable again.
    """
    outcomes: dict[float, Outcome] = {}
    good = 0.0
    bad = inf

    def is_limited() -> bool:
        return good > 0 and bad < inf

    def test(step: float) -> None:
        nonlocal good, bad
        outcomes[step] = outcome = run(step)
        if outcome.message or outcome.crash or not outcome.reported_error <= bound:
            bad = step
        else:
            good = step

    test(start)
    for _ in range(DOUBLINGS):
        if not is_limited():
            test(2 * good if good > 0 else bad / 2)
    while is_limited() and bad > RATIO * good:
        test((good * bad) ** 0.5)
    if not is_limited():
        return StepLimit(inf if bad == inf else good, max(outcomes))
    for factor in (2, 4):
        outcomes[factor * bad] = run(factor * bad)
    failures = {failure(outcome): outcome for step, outcome in outcomes.items() if step >= bad}
    beyond = min(failures, key=BEYOND.index)
    message = failures[beyond].crash or failures[beyond].message
    return StepLimit(good, max(outcomes), beyond, message)
