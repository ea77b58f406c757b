"""Segments of a run: runs of equal steps, when observers are called in them, computing times."""

from collections.abc import Callable, Collection, Sequence
from operator import and_
from typing import NamedTuple

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.run.observers import Observer, above_zero


class Segment(NamedTuple):
    """Equal steps (a stage, or the time between two breaks of a body), or an action in which no time passes."""

    method: Scheme | Solver
    dt: float  # ps, or s for a single body
    steps: int
    steps_before: int = 0  # in the same count of the intervals of observers
    action: Callable[[bool | None], None] | None = None  # called before the steps, with whether to show progress


class ObservationSchedule:
    """When observers are called in a segment, in which steps are counted; lists have a value for each observer."""

    def __init__(self, observers: Collection[Observer], segment: Segment):
        self._last = segment.steps
        self._ends = [observer.ends for observer in observers]
        self._reads = [observer.reads_energies for observer in observers]
        self._regular: list[tuple[int, int, int]] = []  # index of an observer, steps between two calls, steps before
        for k, observer in enumerate(observers):
            if observer.interval is not None:  # may continue from the segment before
                interval = above_zero(observer.interval, f"the interval of {type(observer).__name__}")
                self._regular.append((k, max(1, round(interval / segment.dt)), segment.steps_before))
            elif observer.steps:
                self._regular.append((k, observer.steps, 0))

    def next_observation(self, done: int) -> int:
        """Number of steps at which the next observer is called, after `done` steps."""
        return min([self._last, *(done + every - (before + done) % every for _, every, before in self._regular)])

    def due(self, done: int) -> list[bool]:
        """Which observers are called after `done` steps."""
        due = self._ends.copy() if done == self._last else [False] * len(self._ends)
        for k, every, before in self._regular:
            if (before + done) % every == 0:
                due[k] = True
        return due

    def reads_energies(self, due: list[bool]) -> bool:
        """Whether one of the observers that are due reads energies."""
        return any(map(and_, self._reads, due))


class RunTimes(NamedTuple):
    """Wall times of a run, in seconds."""

    preparing: float  # compiling, removal of overlaps
    wall: float  # segments with observers and output
    computing: Sequence[float]  # the steps of each segment
