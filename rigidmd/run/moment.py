"""A moment of a run, as observers see it."""

from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidmd.core.state import State

if TYPE_CHECKING:
    from rigidmd.engines.samples import Sample
    from rigidmd.run.molecular import MolecularSimulation
    from rigidmd.run.simulation import Simulation


class Moment:
    """The argument of observers: position in the run, state and observation. What it gives may be kept: it stays as it
    is when the run continues.

    step : steps since the start; time : ps, or s for a single body; stage : index of the stage that led here
    state : for molecules in Å, Å/ps and u Å²/ps (angular momentum along principal axes), for a body in SI units
    """

    def __init__(self, run: "Simulation", step: int, time: float, stage: int):
        self._run, self._state = run, run.state
        self.step = step
        self.time = time
        self.stage = stage

    def __repr__(self) -> str:
        return f"<Moment at time {self.time:g}, step {self.step}, stage {self.stage}>"

    @cached_property
    def state(self) -> State:
        """A copy of the state of the run, read-only."""
        return State(*map(_read_only, self._state.copy()))

    @cached_property
    def _seen(self) -> Any:
        """The observation in internal units, evaluated at the first use and shared by all observers."""
        return self._run._look(self)

    @cached_property
    def sample(self) -> "Sample":
        """The line of the log; for molecules only."""
        return cast("MolecularSimulation", self._run).sample_of(self)

    @cached_property
    def observation(self) -> Any:
        """The observation: a `Reading` for molecules, in the units of the log; a `Pose` for a body, in SI units."""
        return getattr(self._seen, "reading", self._seen)

    @property
    def site_positions(self) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å, not wrapped."""
        return self._run.system.site_positions(self._state)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array
