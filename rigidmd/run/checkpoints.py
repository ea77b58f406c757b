"""When a run writes a checkpoint, and when its time is up: wall time decides, and changes no bit of a run."""

import time as clock
from math import inf
from pathlib import Path

from rigidmd.io.checkpoint import Checkpoint, write_checkpoint

#: Seconds of computing between two looks at the clock and at signals.
PIECE = 1.0
#: Time left for the last checkpoint and the files of the end, in times that the longest checkpoint took; and seconds.
COSTS, SPARE = 3.0, 2.0


def checked_walltime(seconds: float) -> float:
    """Seconds until a run has to end; ValueError unless they are finite and not negative."""
    if not 0 <= seconds < inf:
        raise ValueError(f"walltime is {seconds!r}, must be a finite number of seconds, not negative")
    return seconds


class Keeper:
    """Writes the checkpoints of a run.

    Parameters
    ----------
    folder : folder of the run; None writes nothing
    minutes : wall time between checkpoints; False writes none
    deadline : `time.monotonic()` before which the run has to end; None for never
    """

    def __init__(self, folder: Path | None, minutes: float | bool, deadline: float | None):
        self._folder = folder if minutes is not False else None
        self._seconds = 60.0 * minutes
        self._deadline = deadline
        self._last = clock.monotonic()
        self._cost = 0.0
        self._written: tuple[int, int, bool] | None = None
        self.asked = False

    @property
    def keeps(self) -> bool:
        """Whether it writes any."""
        return self._folder is not None

    @property
    def is_due(self) -> bool:
        """Whether a checkpoint is due, or has been asked for."""
        return self.asked or clock.monotonic() - self._last >= self._seconds

    @property
    def time_is_up(self) -> bool:
        """Whether the run has to end now to be ready at the deadline."""
        ahead = PIECE + COSTS * self._cost + SPARE
        return self._deadline is not None and clock.monotonic() + ahead > self._deadline

    def keep(self, checkpoint: Checkpoint, place: tuple[int, int, bool]) -> None:
        """Write a checkpoint of a place (stretch, step, whether something was computed there), once. Raises
        OutputError."""
        self.asked = False
        if self._folder is None or place == self._written:
            return
        began = clock.monotonic()
        write_checkpoint(self._folder, checkpoint)
        self._last, self._written = clock.monotonic(), place
        self._cost = max(self._cost, self._last - began)
