"""Segments of a run, when observers are called in them, when checkpoints are written, and when a
run has to end.

Wall time and signals decide on checkpoints and the end, and change no bit of the results. Python
handles signals in its main thread only. In other threads the functions for signals have no effect.
"""

import _thread
import contextlib
import signal
import sys
import threading
import time as clock
from collections.abc import Callable, Collection, Iterator
from math import inf
from operator import index
from pathlib import Path
from typing import NamedTuple, SupportsIndex

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.signals import STOP_SIGNAL, has_handler
from rigidmd.io.checkpoint import Checkpoint, write_checkpoint
from rigidmd.run.observers import Observer, above_zero
from rigidmd.scene.validation import number_of_steps


class Segment(NamedTuple):
    """Equal steps (a stage, or the time between two breaks of a body), or an action in which no
    time passes."""

    method: Scheme | Solver
    dt: float  # ps, or s for a single body
    steps: int
    steps_before: int = 0  # in the same count of the intervals of observers
    together: int = 1  # steps between which nothing is observed
    action: Callable[[bool | None], None] | None = (
        None  # called before the steps, with whether to show progress
    )


class ObservationSchedule:
    """When observers are called in a segment, in which steps are counted."""

    def __init__(self, observers: Collection[Observer], segment: Segment):
        self._observers, self._last, together = observers, segment.steps, segment.together
        # steps between two calls of each, or 0; steps before the segment
        self._regular: list[tuple[int, int]] = []
        for observer in observers:
            if observer.interval is None:
                self._regular.append((-(-(observer.steps or 0) // together) * together, 0))
            else:  # may continue from the segment before
                interval = above_zero(
                    observer.interval, f"the interval of {type(observer).__name__}"
                )
                every = number_of_steps(interval, segment.dt, together)
                self._regular.append((every, segment.steps_before))

    def next_observation(self, done: int) -> int:
        """Number of steps at which the next observer is called, after `done` steps."""
        return min(
            [
                self._last,
                *(
                    done + every - (before + done) % every
                    for every, before in self._regular
                    if every
                ),
            ]
        )

    def due(self, done: int) -> list[bool]:
        """Which observers are called after `done` steps."""
        is_last = done == self._last
        is_due = []
        for observer, (every, before) in zip(self._observers, self._regular, strict=True):
            is_regular = every > 0 and (before + done) % every == 0
            is_due.append((observer.ends and is_last) or is_regular)
        return is_due


#: Seconds of computing after which the clock and signals are checked.
SEGMENT_SECONDS = 1.0
#: Time reserved for the last checkpoint and the final files: durations of the longest checkpoint,
#: and seconds.
RESERVED_CHECKPOINTS, RESERVED_SECONDS = 3.0, 2.0


def checked_walltime(seconds: float) -> float:
    """Seconds until a run has to end. ValueError unless they are finite and not negative."""
    if not 0 <= seconds < inf:
        raise ValueError(
            f"walltime is {seconds!r}, must be a finite number of seconds, not negative"
        )
    return seconds


def checked_count(value: object, name: str) -> int:
    """A number of steps, runs or threads from Python. TypeError unless it is whole, ValueError
    below 1."""
    if isinstance(value, bool) or not isinstance(value, SupportsIndex):
        raise TypeError(f"{name} is {value!r:.40}, must be an integer")
    if (count := index(value)) < 1:
        raise ValueError(f"{name} is {count}: at least 1")
    return count


class CheckpointSchedule:
    """Writes the checkpoints of a run.

    folder : of the run; None: no checkpoints
    minutes : wall time between checkpoints; False: no checkpoints
    deadline : `time.monotonic()` before which the run has to end, or None
    """

    def __init__(self, folder: Path | None, minutes: float | bool, deadline: float | None):
        self._folder = folder if minutes is not False else None
        self._seconds, self._deadline = 60.0 * minutes, deadline
        self._last, self._longest_write = clock.monotonic(), 0.0
        self._written: tuple[int, int, bool] | None = None
        self.requested, self.writes = False, self._folder is not None

    @property
    def is_due(self) -> bool:
        return self.requested or clock.monotonic() - self._last >= self._seconds

    @property
    def time_is_up(self) -> bool:
        """Whether the run has to end now to be ready at the deadline."""
        needed = SEGMENT_SECONDS + RESERVED_CHECKPOINTS * self._longest_write + RESERVED_SECONDS
        return self._deadline is not None and clock.monotonic() + needed > self._deadline

    def write_once(self, checkpoint: Checkpoint, position: tuple[int, int, bool]) -> None:
        """Write a checkpoint, unless the last one has the same position: segment, step, whether
        steps were computed. Raises OutputError."""
        self.requested = False
        if self._folder is None or position == self._written:
            return
        began = clock.monotonic()
        write_checkpoint(self._folder, checkpoint)
        self._last, self._written = clock.monotonic(), position
        self._longest_write = max(self._longest_write, self._last - began)


@contextlib.contextmanager
def signal_handler(handler: Callable[[int], None], *numbers: int) -> Iterator[None]:
    """Context in which these signals call a function with their number."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {
        number: signal.signal(number, lambda number, frame: handler(number)) for number in numbers
    }
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def stop_signals() -> list[int]:
    """The signals that end runs: Ctrl-C, and SIGTERM unless the program handles it."""
    return [signal.SIGINT, *([] if has_handler(STOP_SIGNAL) else [STOP_SIGNAL])]


def checkpoint_signals() -> list[int]:
    """The signals that request a checkpoint, unless the program handles them."""
    return [] if has_handler(signal.SIGUSR1) else [signal.SIGUSR1]


#: Seconds until a Ctrl-C is repeated that came where Python ignores exceptions.
RETRY_DELAY = 0.05


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Context in which Ctrl-C is not lost in a compiler, which ignores it while LLVM calls Python,
    or raises another error. Raises KeyboardInterrupt, at the latest at its end."""
    has_handler = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    if has_handler or threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed = False
    again = []
    ignored = sys.unraisablehook

    def interrupt(number: int) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def try_again(unraisable: "sys.UnraisableHookArgs") -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            ignored(unraisable)
            return
        again.append(threading.Timer(RETRY_DELAY, _thread.interrupt_main))
        again[-1].start()

    sys.unraisablehook = try_again
    try:
        with signal_handler(interrupt, signal.SIGINT):
            try:
                yield
            finally:
                for timer in again:
                    timer.cancel()
    except Exception:  # a compiler that was interrupted ends in errors of many types
        if pressed:
            raise KeyboardInterrupt from None
        raise
    finally:
        sys.unraisablehook = ignored
    if pressed:
        raise KeyboardInterrupt
