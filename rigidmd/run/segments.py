"""Stretches of a run: equal steps, where in them a run is, and what they cost."""

from collections.abc import Callable, Sequence
from operator import and_
from typing import Annotated, NamedTuple

from pydantic import Field, NonNegativeInt

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.run.observers import Observer, above_zero

Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Stretch(NamedTuple):
    """A stretch of equal steps, or an action that takes no time."""

    row: Scheme | Solver
    dt: float  # ps, or s for a single body
    steps: int
    counted: int = 0  # steps before it from which observers count their intervals
    act: Callable[[bool | None], None] | None = None  # called before the steps, with whether to show progress


class Agenda:
    """When observers look at the steps of a stretch. Steps are counted in it; a list has a value for each observer."""

    def __init__(self, observers: Sequence[Observer], stretch: Stretch):
        self._last = stretch.steps
        self._ends = [observer.ends for observer in observers]
        self._reads = [observer.reads_energies for observer in observers]
        self._regular: list[tuple[int, int, int]] = []  # number of an observer, steps between two looks, steps before
        for k, observer in enumerate(observers):
            if observer.interval is not None:  # may continue from the stretch before
                interval = above_zero(observer.interval, f"the interval of {type(observer).__name__}")
                self._regular.append((k, max(1, round(interval / stretch.dt)), stretch.counted))
            elif observer.steps:
                self._regular.append((k, observer.steps, 0))

    def next_look(self, done: int) -> int:
        """Steps at the next look after so many."""
        return min([self._last, *(done + every - (before + done) % every for _, every, before in self._regular)])

    def due(self, done: int) -> list[bool]:
        """Who looks after so many steps."""
        due = self._ends.copy() if done == self._last else [False] * len(self._ends)
        for k, every, before in self._regular:
            if (before + done) % every == 0:
                due[k] = True
        return due

    def reads_energies(self, due: list[bool]) -> bool:
        """Whether one of those who look reads energies."""
        return any(map(and_, self._reads, due))


class Place(NamedTuple):
    """Where in its stretches a run is."""

    stretch: NonNegativeInt = 0
    first: NonNegativeInt = 0  # steps before the stretch
    time: Seconds = 0.0  # of the stretches before, ps or s
    computing: tuple[Seconds, ...] = ()  # seconds of the stretches before
    seconds: Seconds = 0.0  # of computing in this one


class Costs(NamedTuple):
    """Times of a run, in seconds."""

    preparing: float  # compiling, relief of overlaps
    wall: float  # stretches with observers and output
    computing: Sequence[float]  # the steps of each stretch
