"""Frames of several independent runs of one system, analysed together: replicas. A single run is
one of them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.engines.system import System
from rigidmd.features.analysis.rigid_frames import EVEN, RigidFrames
from rigidmd.run.rigid_fit import Kind

#: An array and its standard error.
Measured = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Runs:
    """The frames of independent runs of one system. At least one.

    Averages are over the frames of all runs, and minimum lengths apply to their total length.
    """

    members: tuple[RigidFrames, ...]

    @property
    def are_several(self) -> bool:
        return len(self.members) > 1

    @property
    def first(self) -> RigidFrames:
        return self.members[0]

    @property
    def system(self) -> System:
        return self.first.system

    @property
    def kinds(self) -> list[Kind]:
        """The molecules by species, frozen and mobile ones separately."""
        return self.first.kinds

    @property
    def moving(self) -> list[Kind]:
        """The mobile molecules by species."""
        return self.first.moving

    @property
    def has_box(self) -> bool:
        return self.first.has_box

    @property
    def has_rotations(self) -> bool:
        return bool(self.first.Q.shape[1])

    @property
    def frame_count(self) -> int:
        """Number of frames of all runs."""
        return sum(map(len, self.members))

    @property
    def shortest(self) -> int:
        """Number of frames of the shortest run."""
        return min(map(len, self.members))

    @property
    def span(self) -> float:
        """Sum of the lengths of all runs, ps."""
        return sum(run.span for run in self.members)

    @cached_property
    def interval(self) -> float | None:
        """Time between frames, ps. None if they are not evenly spaced, or differently in different
        runs."""
        intervals = [run.interval for run in self.members]
        known = [interval for interval in intervals if interval is not None]
        if len(known) < len(intervals) or np.ptp(known) > EVEN * max(known):
            return None
        return float(np.mean(known))

    @property
    def mean_cell(self) -> np.ndarray:
        """Mean cell of all frames (3, 3), Å."""
        return self.mean([run.cell.mean(axis=0) for run in self.members])

    @property
    def volume(self) -> float:
        """Mean volume of all frames, Å³."""
        return float(self.mean([run.mean_volume for run in self.members]))

    @property
    def thermal_energy(self) -> float:
        """kB T at the mean temperature, u Å²/ps²."""
        return float(self.mean([run.thermal_energy for run in self.members]))

    @property
    def weights(self) -> np.ndarray:
        """Number of frames of each run, or of its samples if there are no frames."""
        frames = np.array([len(run) for run in self.members], float)
        return frames if frames.all() else np.array([len(r.columns["time"]) for r in self.members])

    def mean(self, values: Sequence[ArrayLike]) -> np.ndarray:
        """Mean of a value (...) of each run, weighted by the number of its frames."""
        return np.average(np.asarray(values, float), axis=0, weights=self.weights)

    def estimate(
        self, values: Sequence[ArrayLike], conclude: Callable[[np.ndarray], ArrayLike]
    ) -> Measured:
        """What follows from the mean of a value of each run, and its standard error by omitting
        one run after another (jackknife). Without further conclusions this is the standard error of
        the mean over runs.

        conclude : function of the mean of `values`, which may be nonlinear
        """
        parts = np.asarray(values, float)
        weights = self.weights
        value = np.asarray(conclude(np.average(parts, axis=0, weights=weights)), float)
        others = [np.arange(len(parts)) != k for k in range(len(parts))]
        without = [
            conclude(np.average(parts[selection], axis=0, weights=weights[selection]))
            for selection in others
        ]
        count = len(parts)
        return value, sqrt(count - 1) * np.std(np.asarray(without, float), axis=0)


def as_runs(frames: "RigidFrames | Runs") -> Runs:
    return frames if isinstance(frames, Runs) else Runs((frames,))
