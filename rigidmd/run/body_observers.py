"""Observers of a single body: snapshots, checks, motion.csv, figures."""

from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rigidmd.core.state import NOW, STORED_NAMES, State
from rigidmd.engines.body_motion import Motion, Snapshot, motion
from rigidmd.figures.body import FIGURES, body_figures, write_motion_figures
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.folder import MOTION, MOTION_NPZ
from rigidmd.io.write import write_columns, write_npz
from rigidmd.run.checks import EVALUATIONS_PER_CHECK, SAMPLES_PER_CHECK, BodyCheck
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.resume import Arrays, NotNegative, state_from
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


class Sampler(Observer):
    """Keeps snapshots, of which columns are made at the end."""

    remembers: ClassVar[dict[str, Any]] = {"stacked": Arrays}
    ends = True

    def __init__(self, interval: float):
        self.interval = interval
        self.snapshots: list[Snapshot] = []

    @property
    def stacked(self) -> dict[str, np.ndarray]:
        """The arrays of all snapshots, by name."""
        found = {name: np.array([seen.state[k] for seen in self.snapshots]) for k, name in enumerate(STORED_NAMES)}
        return found | {"t": np.array([seen.time for seen in self.snapshots])}

    @stacked.setter
    def stacked(self, stacked: dict[str, np.ndarray]) -> None:
        times = stacked.pop("t")
        states = [State(*(stacked[name][k] for name in STORED_NAMES)) for k in range(len(times))]
        self.snapshots = [Snapshot(time, state) for time, state in zip(times.tolist(), states, strict=True)]

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        super().resume(run, kept)
        times = np.array([seen.time for seen in self.snapshots])
        if not ((np.diff(times) >= 0).all() and (times >= 0).all() and (times <= run.state.time[NOW]).all()):
            raise ValueError("the times of its samples cannot be of a run")
        for seen in self.snapshots:
            state_from(dict(zip(STORED_NAMES, seen.state, strict=True)), run.state, exact=False)

    def see(self, moment: Moment) -> None:
        self.snapshots.append(Snapshot(moment.time, moment.state))


class BodyWatch(Observer):
    """Checks the state against the limits of the scene, independent of the interval of samples."""

    remembers: ClassVar[dict[str, Any]] = {"exchanged": NotNegative}
    ends = True

    def __init__(self, run: "Simulation"):
        self.check = BodyCheck(run.system, run.scene.watch)
        every = max(1, round(not_none(run.scene.output.interval_s) / run.scene.run.timestep_s))
        # at most half a second of computing
        self.steps = min(
            EVALUATIONS_PER_CHECK // getattr(run.system.method, "force_evaluations", 1), SAMPLES_PER_CHECK * every
        )
        self._run = run

    @property
    def exchanged(self) -> float:
        """The largest energy exchanged so far, J."""
        return float(self.check.exchanged)

    @exchanged.setter
    def exchanged(self, exchanged: float) -> None:
        if exchanged < self.check.exchanged:
            raise ValueError(f"it has exchanged an energy of {exchanged:g} J")
        self.check.exchanged = exchanged

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        super().resume(run, kept)
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

    def end(self, run: "Simulation", results: "Results") -> None:
        if not isinstance(samples := results.samples, Motion):
            raise TypeError("these are samples of molecules")
        write_columns(run.path(MOTION), samples.written)
        results.files.append(run.path(MOTION))
        if self._npz:
            write_npz(run.path(MOTION_NPZ), samples.written)
            results.files.append(run.path(MOTION_NPZ))

    def failed(self, run: "Simulation") -> str:
        if not self._sampler.snapshots:
            return ""
        write_columns(run.path(MOTION), motion(run.system, self._sampler.snapshots).written)
        return f". The motion so far: {run.path(MOTION)}"


class Figures(Observer):
    """Figures of the axis, angles, omega and errors."""

    draws = True

    def files(self) -> list[str]:
        return [f"{figure}.{suffix}" for figure in FIGURES for suffix in ("png", "svg")]

    def end(self, run: "Simulation", results: "Results") -> None:
        if isinstance(results.samples, Motion):
            failed = None
            for stem, figure in body_figures(run.system, results.samples).items():
                try:
                    results.files += write_motion_figures(run.path(""), {stem: figure})
                except Exception as error:  # of many types; the other figures are drawn first
                    failed = failed or error
            if failed is not None:
                raise failed
