"""`rigidmd stability`: named cases that try to break the engine, each compared with a known answer."""

import time as clock
from collections.abc import Callable, Iterator

from rigidmd.errors import SceneError
from rigidmd.scene.validation import did_you_mean
from rigidmd.studies.stability import bodies, molecules, water  # noqa: F401  (cases)
from rigidmd.studies.stability.cases import CASES, StabilityCase
from rigidmd.studies.stability.outcomes import CaseResult


def selected_cases(names: list[str] | None) -> list[StabilityCase]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    if unknown := [name for name in names or [] if name not in CASES]:
        known = f"(known: {', '.join(CASES)})"
        raise SceneError("--case", [f"unknown case {name!r}{did_you_mean(name, CASES)} {known}" for name in unknown])
    found = [CASES[name] for name in names] if names else CASES.values()
    return sorted(found, key=lambda case: case.group)


def run_cases(
    names: list[str] | None = None, quick: bool = False, progress: Callable[..., object] = lambda *_: None
) -> Iterator[CaseResult]:
    """Yield the results of the named cases (default: all) in order. progress(fraction done, name) : before each"""
    cases = selected_cases(names)
    for k, case in enumerate(cases):
        progress(k / len(cases), case.name)
        result = CaseResult(case.name, case.group, case.sentence, *case.titles)
        began = clock.perf_counter()
        case.run(result, quick)
        result.seconds = clock.perf_counter() - began
        yield result
