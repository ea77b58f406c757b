"""Stability: what came of runs that try to break the engine, the verdict on each, and the longest step that holds."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf, isnan, nan
from typing import NamedTuple

from rigidmd.measure.body_summary import LARGE_ENERGY_ERROR

RIGHT, REFUSED, TOLD, SILENT, CRASH = "right", "refused", "told", "SILENT", "crash"
#: What each verdict means; the last two fail the battery.
VERDICTS = {
    RIGHT: "the answer is right within the error stated",
    REFUSED: "one of the engine's own errors says what is wrong",
    TOLD: "the answer is wrong, the run went on, and the figures that it reports show it",
    SILENT: "the answer is wrong and nothing shows it",
    CRASH: "an error that is not one of the engine's own",
}
#: A run whose conserved quantities are off by this much of the kinetic energy is no longer bounded.
BOUND = 0.1
#: The step is doubled until it is no longer bounded, so often at most; then bisected to this ratio.
DOUBLINGS, RATIO = 10, 1.1


class Outcome(NamedTuple):
    """What came of one run.

    error : against what is known, in the unit of its case; told : the largest error of what the run itself reports as
    conserved, relative to kinetic energy or |L|; message : the error of ours that refused or stopped it
    """

    error: float = nan
    told: float = nan
    message: str = ""
    crash: str = ""
    seconds: float = 0.0


@dataclass
class Trial:
    """One run, and what was expected of it.

    setting : what was varied, in words; x : the same as a number, for the figure; allowed : the error stated
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
    """The longest step of a family that is still bounded, and how it fails beyond."""

    setting: str
    family: str
    longest: float  # inf where no step tried was too long, 0 where none was short enough
    beyond: str  # drift, blow-up, detected, SILENT, crash; empty where nothing fails
    message: str
    seconds: float
    curve: tuple[tuple[float, float], ...]  # (step, what the run told), by step


@dataclass
class Finding:
    """All trials and limits of a case. x_title, error_title, step_unit say what its numbers are."""

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
        """One more trial."""
        self.trials.append(Trial(setting, family, x, step, allowed, expected, outcome))

    @property
    def families(self) -> list[str]:
        """Integrators, in the order in which they came."""
        return list(dict.fromkeys([t.family for t in self.trials] + [limit.family for limit in self.limits]))

    @property
    def silent(self) -> list[str]:
        """What fails the battery: each a sentence."""
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
        """Trials that ended otherwise than expected."""
        return [trial for trial in self.trials if not trial.as_expected]


def bounded(outcome: Outcome, bound: float = BOUND) -> bool:
    """Whether a run came to its end and what it conserves is no further off than this."""
    return not outcome.message and not outcome.crash and outcome.told <= bound


def failure(outcome: Outcome) -> str:
    """How a run that is not bounded fails; a result that nothing tells to be wrong is SILENT."""
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

    What is just beyond, and at two and four times the limit, says how it fails; the worst of them is told, because a
    step far too long can look quiet again.
    """
    seen: dict[float, Outcome] = {}

    def look(step: float) -> bool:
        seen[step] = run(step)
        return bounded(seen[step], bound)

    good, bad = 0.0, inf
    if look(start):
        good = start
        for _ in range(DOUBLINGS):
            if not look(2 * good):
                bad = 2 * good
                break
            good *= 2
    else:
        bad = start
        for _ in range(DOUBLINGS):
            if look(bad / 2):
                good = bad / 2
                break
            bad /= 2
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
