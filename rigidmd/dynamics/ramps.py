"""Numbers that change evenly over a stretch of equal steps: temperatures and pressures as told."""

from typing import NamedTuple

from rigidmd.compile import kernel
from rigidmd.core.state import NOW, ORIGIN


class Ramp(NamedTuple):
    """From one value to another, evenly over the steps of a stretch; a constant where the two are equal."""

    first: float
    last: float
    steps: float  # of the stretch


def steady(value: float) -> Ramp:
    """The ramp that stays at a value."""
    return Ramp(value, value, 1.0)


@kernel(inline=True)
def present(ramp, state):
    """The value of a ramp in the step that is being taken."""
    return ramp.first + (ramp.last - ramp.first) * ((state.step[NOW] - state.step[ORIGIN] + 1) / ramp.steps)
