"""Outcomes of the runs of stability cases, verdicts on them, and the longest bounded step."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, nan
from typing import NamedTuple

from rigidmd.run.summary import LARGE_ENERGY_ERROR

RIGHT, REFUSED, REPORTED, UNDETECTED, CRASH = "right", "refused", "reported", "undetected", "crash"
#: Meaning of each verdict; the last two are failures.
VERDICTS = {
    RIGHT: "the answer is right within the error stated",
    REFUSED: "an error message of rigidmd describes what is wrong",
    REPORTED: "the answer is wrong, the run finished, and the diagnostics that it reports show it",
    UNDETECTED: "the answer is wrong and nothing shows it",
    CRASH: "an exception that is not an error of rigidmd",
}
#: A run is bounded while the errors of conserved quantities stay below this fraction of the kinetic energy.
BOUND = 0.1
#: Most doublings of a step that is bounded; ratio at which bisection ends.
DOUBLINGS, RATIO = 10, 1.1


class Outcome(NamedTuple):
    error: float = nan  # with respect to the known answer, in the unit of the case
    reported_error: float = nan  # largest error of conserved quantities that the run itself reports, relative
    message: str = ""  # of the rigidmd error that refused or stopped it
    crash: str = ""
    seconds: float = 0.0


@dataclass
class CaseRun:
    """One run with its expected outcome."""

    setting: str  # describes what was varied
    family: str
    x: float  # the same as a number for the figure
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
    curve: tuple[tuple[float, float], ...]  # (step, error that the run reported), by step


@dataclass
class CaseResult:
    """All runs and step limits of a case. x_title, error_title, step_unit describe its numbers."""

    name: str
    group: int
    sentence: str
    x_title: str = ""
    error_title: str = ""
    step_unit: str = ""
    runs: list[CaseRun] = field(default_factory=list)
    limits: list[StepLimit] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: float = nan

    def add(
        self, setting: str, outcome: Outcome, allowed: float = nan, family: str = "", x: float = nan, step: float = nan,
        expected: tuple[str, ...] = (RIGHT,),
    ) -> None:  # fmt: skip
        self.runs.append(CaseRun(setting, family, x, step, allowed, expected, outcome))

    @property
    def families(self) -> list[str]:
        return list(dict.fromkeys([t.family for t in self.runs] + [limit.family for limit in self.limits]))

    @property
    def failures(self) -> list[str]:
        """Undetected errors and crashes, a sentence each."""
        runs = [t for t in self.runs if t.verdict in (UNDETECTED, CRASH)]
        found = [f"{self.name}, {t.setting} {t.family}".strip() + f": {t.outcome.crash or UNDETECTED}" for t in runs]
        for limit in self.limits:
            if limit.beyond in (UNDETECTED, CRASH):
                where = f"{self.name}, {limit.setting} {limit.family}, steps beyond {limit.longest:.3g}"
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
    run: Callable[[float], Outcome], start: float, setting: str = "", family: str = "", bound: float = BOUND
) -> StepLimit:
    """The longest step that is bounded: doubled or halved from `start`, then bisected.

    Runs just beyond the limit and at two and four times it show how it fails. The worst outcome is reported, because a
    step that is far too long can seem stable again.
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
        order = (CRASH, UNDETECTED, "blow-up", "drift", "detected")
        beyond = next(way for way in order if way in ways)
        message = ways[beyond].crash or ways[beyond].message
    curve = tuple(sorted((step, outcome.reported_error) for step, outcome in seen.items()))
    seconds = sum(outcome.seconds for outcome in seen.values())
    return StepLimit(setting, family, inf if bad == inf else good, beyond, message, seconds, curve)
