"""The runner of stability cases: verdicts on outcomes, longest bounded steps."""

import time as clock
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from math import inf
from typing import NamedTuple

from rigidmd.core.plain_text import did_you_mean
from rigidmd.errors import RigidMDError, SceneError
from rigidmd.run.summary import LARGE_ENERGY_ERROR
from rigidmd.studies.stability import bodies, molecules, water  # noqa: F401  (cases)
from rigidmd.studies.stability.cases import (
    BOUND,
    CASES,
    CRASH,
    INTEGRATORS,
    REFUSED,
    REPORTED,
    RIGHT,
    UNDETECTED,
    Case,
    Outcome,
    Trial,
)

FAILURES = (UNDETECTED, CRASH)
#: Ways in which a step that is too long fails, the worst first.
BEYOND = (CRASH, UNDETECTED, "blow-up", "drift", "detected")
#: Most doublings of a step that is bounded; ratio at which bisection ends.
DOUBLINGS, RATIO = 10, 1.1


class StepLimit(NamedTuple):
    """The longest bounded step, and how longer steps fail."""

    longest: float  # inf if no step tried was too long, 0 if none was short enough
    tried: float  # the longest step that was tried
    beyond: str = ""  # one of BEYOND, or empty if nothing fails
    message: str = ""


@dataclass
class TrialResult:
    """The outcome of a trial with one integrator, or the bisection of its longest step."""

    trial: Trial
    integrator: str
    outcome: Outcome
    limit: StepLimit | None = None

    @property
    def allowed(self) -> float:
        return self.trial.allowed + self.trial.method_errors.get(self.integrator, 0.0)

    @property
    def verdict(self) -> str:
        outcome = self.outcome
        if self.limit is not None:
            return ""
        if outcome.crash:
            return CRASH
        if outcome.message:
            return REFUSED
        # a scene that must be refused has no right answer
        if outcome.error <= self.allowed and self.trial.expected != (REFUSED,):
            return RIGHT
        return REPORTED if outcome.reported_error > LARGE_ENERGY_ERROR else UNDETECTED

    @property
    def is_expected(self) -> bool:
        return self.limit is not None or self.verdict in self.trial.expected

    @property
    def failure(self) -> str:
        """A description of an undetected error or crash; empty without one."""
        name = f"{self.trial.setting} {self.integrator}".strip()
        if self.verdict in FAILURES:
            return f"{name}: {self.outcome.crash or UNDETECTED}"
        if self.limit is not None and self.limit.beyond in FAILURES:
            reason = self.limit.message or UNDETECTED
            return f"{name}, steps beyond {self.limit.longest:.3g}: {reason}"
        return ""


@dataclass
class CaseResult:
    case: Case
    results: list[TrialResult] = field(default_factory=list)

    @property
    def runs(self) -> list[TrialResult]:
        return [result for result in self.results if result.limit is None]

    @property
    def limits(self) -> list[StepLimit]:
        return [result.limit for result in self.results if result.limit is not None]

    @property
    def failures(self) -> list[str]:
        failures = [result.failure for result in self.results]
        return [f"{self.case.name}, {failure}" for failure in failures if failure]

    @property
    def by_integrator(self) -> "dict[str, CaseResult]":
        """The results of each integrator."""
        parts: dict[str, CaseResult] = {}
        for result in self.results:
            part = parts.setdefault(result.integrator, CaseResult(self.case))
            part.results.append(result)
        return parts


def selected_cases(names: list[str] | None) -> list[Case]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    if unknown := [name for name in names or [] if name not in CASES]:
        known = f"(known: {', '.join(CASES)})"
        errors = [f"unknown case {name!r}{did_you_mean(name, CASES)} {known}" for name in unknown]
        raise SceneError("--case", errors)
    return sorted((CASES[name] for name in names or CASES), key=lambda case: case.group)


def run_cases(
    names: list[str] | None = None,
    quick: bool = False,
    progress: Callable[[float, str], object] = lambda fraction, name: None,
) -> Iterator[CaseResult]:
    """Yield the results of the named cases, or of all, in the order of their groups.

    quick : fewer settings and integrators
    progress : called before each case with the fraction done and its name
    """
    cases = selected_cases(names)
    for k, case in enumerate(cases):
        progress(k / len(cases), case.name)
        result = CaseResult(case)
        for trial in case.trials(quick):
            default = tuple(INTEGRATORS)[: 3 if quick else None]
            for integrator in trial.integrators or default:
                result.results.append(run_trial(trial, integrator))
        yield result


def run_trial(trial: Trial, integrator: str) -> TrialResult:
    began = clock.perf_counter()
    run = partial(attempt, trial, integrator)
    outcome, limit = Outcome(), None
    if trial.bound is None:
        outcome = run(trial.step)
    else:
        limit = longest_step(run, trial.step, trial.bound)
    outcome = outcome._replace(seconds=clock.perf_counter() - began)
    return TrialResult(trial, integrator, outcome, limit)


def attempt(trial: Trial, integrator: str, step: float) -> Outcome:
    """Run a trial; an error of rigidmd becomes a message, any other exception a crash."""
    try:
        return trial.run(integrator, step)
    except RigidMDError as error:
        return Outcome(message=str(error))
    except Exception as error:  # any other error is a failure of the engine
        return Outcome(crash=f"{type(error).__name__}: {error}")


def failure(outcome: Outcome) -> str:
    """How an unbounded run fails."""
    if outcome.crash:
        return CRASH
    if outcome.message:
        return "detected"
    if outcome.reported_error >= 1:
        return "blow-up"
    return "drift" if outcome.reported_error > LARGE_ENERGY_ERROR else UNDETECTED


def longest_step(run: Callable[[float], Outcome], start: float, bound: float = BOUND) -> StepLimit:
    """The longest step that is bounded: doubled or halved from `start`, then bisected.

    Runs just beyond the limit and at two and four times it show how it fails. The worst outcome is
    reported, because a step that is far too long can seem stable again.
    """
    outcomes: dict[float, Outcome] = {}
    good, bad = 0.0, inf

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
