"""Observers of a single body: snapshots, checks, motion.csv, figures."""

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import NOW, STORED_NAMES
from rigidmd.engines.body_motion import Motion, Snapshot, motion
from rigidmd.figures.body import FIGURES, draw_motion
from rigidmd.figures.run import body_figures
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.folder import MOTION, MOTION_NPZ
from rigidmd.io.write import write_columns, write_npz
from rigidmd.run.checks import EVALUATIONS_PER_CHECK, SAMPLES_PER_CHECK, BodyCheck
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.resume import state_from
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.run.body import BodySimulation
    from rigidmd.run.results import Results


class Sampler(Observer):
    """Keeps snapshots, of which columns are made at the end."""

    ends = True

    def __init__(self, interval: float):
        self.interval = interval
        self.snapshots: list[Snapshot] = []

    def memory(self) -> Checkpoint:
        stacked = {
            name: np.array([snapshot.state[k] for snapshot in self.snapshots]) for k, name in enumerate(STORED_NAMES)
        }
        return Checkpoint({}, stacked | {"t": np.array([snapshot.time for snapshot in self.snapshots])})

    def resume(self, run: "BodySimulation", kept: Checkpoint) -> None:
        times = kept.arrays["t"]
        if not ((np.diff(times) >= 0).all() and (times >= 0).all() and (times <= run.state.time[NOW]).all()):
            raise ValueError("the times of its samples cannot be of a run")
        arrays = [{name: array[k] for name, array in kept.arrays.items() if name != "t"} for k in range(len(times))]
        states = [state_from(of, run.state, exact=False) for of in arrays]
        self.snapshots = [Snapshot(time, state) for time, state in zip(times.tolist(), states, strict=True)]

    def see(self, moment: Moment) -> None:
        self.snapshots.append(Snapshot(moment.time, moment.state))


class BodyWatch(Observer):
    """Checks the state against the limits of the scene, independent of the interval of samples."""

    ends = True

    def __init__(self, run: "BodySimulation"):
        self.check = BodyCheck(run.system, run.scene.watch)
        every = max(1, round(not_none(run.scene.output.interval_s) / run.scene.run.timestep_s))
        # at most half a second of computing
        self.steps = min(
            EVALUATIONS_PER_CHECK // getattr(run.system.method, "force_evaluations", 1), SAMPLES_PER_CHECK * every
        )
        self._run = run

    def memory(self) -> Checkpoint:
        return Checkpoint({"moved": self.check.exchanged}, {})

    def resume(self, run: "BodySimulation", kept: Checkpoint) -> None:
        least, self.check.exchanged = self.check.exchanged, float(kept.values["moved"])
        if not least <= self.check.exchanged < inf:
            raise ValueError(f"it has exchanged an energy of {self.check.exchanged:g} J")
        if problem := self.check.failed_check(run.state, run.scene.run.timestep_s):
            raise ValueError(f"its state cannot be of this run: {problem}")

    def see(self, moment: Moment) -> None:
        if problem := self.check.failed_check(self._run.state, self._run.segment.dt):
            raise problem


class MotionFiles(Observer):
    """motion.csv and motion.npz."""

    def __init__(self, sampler: Sampler, npz: bool):
        self._sampler, self._npz = sampler, npz

    def files(self) -> list[str]:
        return [MOTION, MOTION_NPZ]

    def end(self, run: "BodySimulation", results: "Results") -> None:
        if not isinstance(samples := results.samples, Motion):
            raise TypeError("these are samples of molecules")
        write_columns(run.path(MOTION), samples.written)
        results.files.append(run.path(MOTION))
        if self._npz:
            write_npz(run.path(MOTION_NPZ), samples.written)
            results.files.append(run.path(MOTION_NPZ))

    def failed(self, run: "BodySimulation") -> str:
        if not self._sampler.snapshots:
            return ""
        write_columns(run.path(MOTION), motion(run.system, self._sampler.snapshots).written)
        return f". The motion so far: {run.path(MOTION)}"


class Figures(Observer):
    """Figures of the axis, angles, omega and errors."""

    draws = True

    def files(self) -> list[str]:
        return [f"{figure}.{suffix}" for figure in FIGURES for suffix in ("png", "svg")]

    def end(self, run: "BodySimulation", results: "Results") -> None:
        if isinstance(results.samples, Motion):
            failed = None
            for stem, figure in body_figures(run.system, results.samples).items():
                try:
                    results.files += draw_motion(run.path(""), {stem: figure})
                except Exception as error:  # of many types; the other figures are drawn first
                    failed = failed or error
            if failed is not None:
                raise failed
