"""The battery: all cases in their order."""

import time as clock
from collections.abc import Callable

from rigidmd.errors import SceneError
from rigidmd.scene.validation import did_you_mean
from rigidmd.studies.stability import bodies, boxes, collisions, resistance, tops, unfit, water  # noqa: F401  (cases)
from rigidmd.studies.stability.outcomes import Finding
from rigidmd.studies.stability.runs import CASES, Case


def chosen(names: list[str] | None) -> list[Case]:
    """The cases of these names, or all. Raises SceneError with a suggestion."""
    faults = [
        f"there is no case {name!r}{did_you_mean(name, CASES)} (known: {', '.join(CASES)})"
        for name in names or []
        if name not in CASES
    ]
    if faults:
        raise SceneError("--case", faults)
    found = [CASES[name] for name in names] if names else CASES.values()
    return sorted(found, key=lambda one: one.group)


def battery(names: list[str] | None = None, quick: bool = False, say: Callable[[str], None] = lambda name: None):
    """Findings of the named cases (default: all) in order; say(name) announces each."""
    for one in chosen(names):
        say(one.name)
        finding = Finding(one.name, one.group, one.sentence, *one.titles)
        began = clock.perf_counter()
        one.attempt(finding, quick)
        finding.seconds = clock.perf_counter() - began
        yield finding
