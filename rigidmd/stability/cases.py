"""The battery: named cases in the order in which they are run."""

import time as clock
from collections.abc import Callable
from typing import NamedTuple

from rigidmd.errors import SceneError
from rigidmd.measure.stability import Finding
from rigidmd.validation import meant

#: What a case does to its finding; quick: fewer settings and integrators.
Attempt = Callable[[Finding, bool], None]


class Case(NamedTuple):
    """A named way to try to break the engine. group : its number in the list of what the battery must hold."""

    name: str
    group: int
    sentence: str
    attempt: Attempt
    titles: tuple[str, str, str]  # of x, of the error, unit of steps


CASES: dict[str, Case] = {}


def case(group: int, x: str = "", error: str = "", step: str = "s") -> Callable[[Attempt], Attempt]:
    """Put a function among the cases, under its own name and with the first line of its docstring."""

    def enter(attempt: Attempt) -> Attempt:
        sentence = attempt.__doc__.strip().splitlines()[0].rstrip(".")
        CASES[attempt.__name__] = Case(attempt.__name__, group, sentence, attempt, (x, error, step))
        return attempt

    return enter


def chosen(names: list[str] | None) -> list[Case]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    from rigidmd.stability import bodies, boxes, collisions, resistance, tops, unfit, water  # noqa: F401  (each enters its own)

    faults = [
        f"there is no case {name!r}{meant(name, CASES)} (known: {', '.join(CASES)})"
        for name in names or []
        if name not in CASES
    ]
    if faults:
        raise SceneError("--case", faults)
    found = [CASES[name] for name in names] if names else CASES.values()
    return sorted(found, key=lambda one: one.group)


def battery(names: list[str] | None = None, quick: bool = False, say: Callable[[str], None] = lambda name: None):
    """Findings of the cases of these names (all of them when not given), one after the other; say(name) before each."""
    for one in chosen(names):
        say(one.name)
        finding = Finding(one.name, one.group, one.sentence, *one.titles)
        began = clock.perf_counter()
        one.attempt(finding, quick)
        finding.seconds = clock.perf_counter() - began
        yield finding
