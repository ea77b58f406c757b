"""Stretches of a run: equal steps, where in them a run is, and what they cost."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from rigidmd.core.schemes import Scheme, Solver


class Stretch(NamedTuple):
    """A stretch of equal steps, or an action that takes no time."""

    row: Scheme | Solver
    dt: float  # ps, or s for a single body
    steps: int
    counted: int = 0  # steps before it from which observers count their intervals
    act: Callable[[bool | None], None] | None = None  # called before the steps, with whether to show progress


class Place(NamedTuple):
    """Where in its stretches a run is."""

    stretch: int = 0
    first: int = 0  # steps before the stretch
    time: float = 0.0  # of the stretches before, ps or s
    computing: Sequence[float] = ()  # seconds of the stretches before
    seconds: float = 0.0  # of computing in this one


class Costs(NamedTuple):
    """Times of a run, in seconds."""

    preparing: float  # compiling, relief of overlaps
    wall: float  # stretches with observers and output
    computing: Sequence[float]  # the steps of each stretch
