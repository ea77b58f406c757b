"""Stability: outcomes of runs that try to break the engine, verdicts on them, and the longest bounded step."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isnan, nan
from typing import NamedTuple

from rigidmd.run.body_summary import LARGE_ENERGY_ERROR

RIGHT, REFUSED, TOLD, SILENT, CRASH = "right", "refused", "told", "SILENT", "crash"
#: Meaning of each verdict; the last two fail the battery.
VERDICTS = {
    RIGHT: "the answer is right within the error stated",
    REFUSED: "one of the engine's own errors says what is wrong",
    TOLD: "the answer is wrong, the run went on, and the figures that it reports show it",
    SILENT: "the answer is wrong and nothing shows it",
    CRASH: "an error that is not one of the engine's own",
}
#: A run is bounded while the errors of conserved quantities stay below this fraction of the kinetic energy.
BOUND = 0.1
#: Most doublings of a step that is bounded; ratio at which bisection ends.
DOUBLINGS, RATIO = 10, 1.1


class Outcome(NamedTuple):
    """The outcome of one run.

    error : against the known answer, in the unit of the case; told : the largest error of a conserved quantity that the
    run itself reports, relative to kinetic energy or |L|; message : of the rigidmd error that refused or stopped it
    """

    error: float = nan
    told: float = nan
    message: str = ""
    crash: str = ""
    seconds: float = 0.0


@dataclass
class Trial:
    """One run with its expected outcome.

    setting : what was varied, in words; x : the same as a number for the figure; allowed : largest error
    """

    setting: str
    family: str
    x: float
    step: float
    allowed: float
    expected: tuple[str, ...]
    outcome: Outcome

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        seen = self.outcome
        if seen.crash:
            return CRASH
        if seen.message:
            return REFUSED
        if seen.error <= self.allowed:
            return RIGHT
        return TOLD if not seen.told <= LARGE_ENERGY_ERROR and not isnan(seen.told) else SILENT

    @property
    def as_expected(self) -> bool:
        """Whether the verdict is one of those expected."""
        return self.verdict in self.expected


class Limit(NamedTuple):
    """The longest bounded step of a family of integrators, and how longer steps fail."""

    setting: str
    family: str
    longest: float  # inf if no step tried was too long, 0 if none was short enough
    beyond: str  # drift, blow-up, detected, SILENT, crash; empty where nothing fails
    message: str
    seconds: float
    curve: tuple[tuple[float, float], ...]  # (step, error that the run reported), by step


@dataclass
class Finding:
    """All trials and limits of a case. x_title, error_title, step_unit describe its numbers."""

    name: str
    group: int
    sentence: str
    x_title: str = ""
    error_title: str = ""
    step_unit: str = ""
    trials: list[Trial] = field(default_factory=list)
    limits: list[Limit] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: float = nan

    def add(
        self,
        setting: str,
        outcome: Outcome,
        allowed: float = nan,
        family: str = "",
        x: float = nan,
        step: float = nan,
        expected: tuple[str, ...] = (RIGHT,),
    ) -> None:
        self.trials.append(Trial(setting, family, x, step, allowed, expected, outcome))

    @property
    def families(self) -> list[str]:
        """Integrators in the order of the trials."""
        return list(dict.fromkeys([t.family for t in self.trials] + [limit.family for limit in self.limits]))

    @property
    def silent(self) -> list[str]:
        """Failures of the battery, one sentence each."""
        found = [
            f"{self.name}, {t.setting} {t.family}".strip() + f": {t.outcome.crash or SILENT}"
            for t in self.trials
            if t.verdict in (SILENT, CRASH)
        ]
        return found + [
            f"{self.name}, {limit.setting} {limit.family}, steps beyond {limit.longest:.3g}: {limit.message or SILENT}"
            for limit in self.limits
            if limit.beyond in (SILENT, CRASH)
        ]

    @property
    def unexpected(self) -> list[Trial]:
        """Trials with another outcome than expected."""
        return [trial for trial in self.trials if not trial.as_expected]


def bounded(outcome: Outcome, bound: float = BOUND) -> bool:
    """Whether a run reached its end with all errors of conserved quantities within this bound."""
    return not outcome.message and not outcome.crash and outcome.told <= bound


def failure(outcome: Outcome) -> str:
    """How an unbounded run fails; SILENT if nothing reveals the error."""
    if outcome.crash:
        return CRASH
    if outcome.message:
        return "detected"
    if outcome.told >= 1:
        return "blow-up"
    return "drift" if outcome.told > LARGE_ENERGY_ERROR else SILENT


def longest_step(
    run: Callable[[float], Outcome], start: float, setting: str = "", family: str = "", bound: float = BOUND
) -> Limit:
    """The longest step that is bounded: doubled or halved from `start`, then bisected.

    Runs just beyond the limit and at two and four times it show how it fails. The worst outcome is reported, because a
    step that is far too long can look stable again.
    """
    seen: dict[float, Outcome] = {}

    def look(step: float) -> bool:
        seen[step] = run(step)
        return bounded(seen[step], bound)

    good, bad = (start, inf) if look(start) else (0.0, start)
    for _ in range(DOUBLINGS):
        if good > 0 and bad < inf:
            break
        step = 2 * good if good > 0 else bad / 2
        good, bad = (step, bad) if look(step) else (good, step)
    while good > 0 and bad < inf and bad > RATIO * good:
        middle = (good * bad) ** 0.5
        good, bad = (middle, bad) if look(middle) else (good, middle)
    beyond = message = ""
    if good > 0 and bad < inf:
        look(2 * bad)
        look(4 * bad)
        ways = {failure(outcome): outcome for step, outcome in seen.items() if step >= bad}
        order = (CRASH, SILENT, "blow-up", "drift", "detected")
        beyond = next(way for way in order if way in ways)
        message = ways[beyond].crash or ways[beyond].message
    curve = tuple(sorted((step, outcome.told) for step, outcome in seen.items()))
    return Limit(
        setting, family, inf if bad == inf else good, beyond, message, sum(o.seconds for o in seen.values()), curve
    )
