"""Cases: named ways to try to break the engine."""

from collections.abc import Callable
from typing import NamedTuple

from rigidmd.measure.stability import Finding

#: A case adds trials to its finding; quick : fewer settings and integrators.
Attempt = Callable[[Finding, bool], None]


class Case(NamedTuple):
    """A named way to try to break the engine. group : its number in the list of what the battery must hold."""

    name: str
    group: int
    sentence: str
    attempt: Attempt
    titles: tuple[str, str, str]  # of x and of the error; unit of steps


CASES: dict[str, Case] = {}


def case(group: int, x: str = "", error: str = "", step: str = "s") -> Callable[[Attempt], Attempt]:
    """Register a function as a case under its own name, with the first line of its docstring."""

    def enter(attempt: Attempt) -> Attempt:
        sentence = (attempt.__doc__ or "").strip().splitlines()[0].rstrip(".")
        CASES[attempt.__name__] = Case(attempt.__name__, group, sentence, attempt, (x, error, step))
        return attempt

    return enter
