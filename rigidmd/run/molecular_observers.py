"""Observers of molecules: samples and their checks, log.csv, pressure_tensor.csv, the final
state."""

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import NOW, Load, State
from rigidmd.core.state_file import write_state
from rigidmd.engines.samples import Samples
from rigidmd.features import acting_on
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.folder import FINAL, LAST_GOOD, LOG
from rigidmd.io.run_files import TENSOR, TENSOR_FILE, Log, row_of
from rigidmd.run import checks
from rigidmd.run.observers import GrowingFile, Moment, Observer
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


class LogFile(GrowingFile[Log]):
    """log.csv: a line for each sample."""

    ends = reads_energies = True
    _names = (LOG,)

    def __init__(self, interval: float, columns: dict[str, str]):
        self.interval, self._columns = interval, columns

    def begin(self, run: "Simulation") -> None:
        self._file = Log(run.path(self._names[0]), self._columns, self.kept)

    def observe(self, moment: Moment) -> None:
        not_none(self._file).write(moment.sample)

    def end(self, run: "Simulation", results: "Results") -> None:
        not_none(self._file).flush()
        results.files.append(run.path(self._names[0]))


class PressureTensor(LogFile):
    """pressure_tensor.csv: the pressure tensor at its own interval. Without a folder in memory."""

    ends, once = False, True
    _names = (TENSOR_FILE,)

    def __init__(self, interval: float):
        super().__init__(interval, TENSOR)
        self._rows: list[list[float]] = []

    def begin(self, run: "Simulation") -> None:
        if run.folder is not None:
            super().begin(run)

    def observe(self, moment: Moment) -> None:
        if self._file is None:
            self._rows.append(row_of(moment.sample, TENSOR))
        else:
            super().observe(moment)

    def end(self, run: "Simulation", results: "Results") -> None:
        if self._file is None:
            results._tensor = np.array(self._rows)
        else:
            super().end(run, results)


def _check_next_step(run: "Simulation", check: checks.StepCheck, load: Load, stage: Stage) -> None:
    """Raise the failed check of the next step of a stage, if the stage has steps."""
    if not stage.is_minimisation:
        dt = stage.step
        if problem := check.failed_check(
            run._part.state, load, stage.scheme, dt, run.engine.extent(run._part.state)
        ):
            raise problem


class Sampler(Observer):
    """Keeps samples, checks each against the limits of the scene, and keeps the last state that
    passed."""

    remembers: dict[str, object] = {"table": np.ndarray}  # noqa: RUF012
    ends = reads_energies = True
    _names = (LAST_GOOD,)

    def __init__(self, run: "Simulation", interval: float, check: checks.StepCheck):
        self.interval = interval
        self.samples = Samples([stage.label for stage in run.scene.stages], run.system.quantities)
        self.last_good: State | None = None
        self._run, self._check = run, check
        self._warns = acting_on(run.scene)  # each once
        self.trajectories = np.zeros(5)  # see `Engine.extension_sums`, at the last sample
        if any(stage.in_trajectories for stage in run.scene.stages):
            self.remembers = self.remembers | {"trajectories": np.ndarray}
        # stage -> row of the last sample before it, or of the first
        self._begins: dict[int, int] = {}

    def origin(self, stage: int) -> float | None:
        """Conserved energy (kJ/mol) at the start of a stage: of the last sample before it, or else
        of its first."""
        return (
            self.samples.row(self._begins.get(stage, -1)).conserved if len(self.samples) else None
        )

    def observe(self, moment: Moment) -> None:
        run, now, samples = self._run, moment.sample, self.samples
        since = self._begins.setdefault(now.stage, max(0, len(samples) - 1))
        samples.append(now)
        if (trajectories := run._part.engine.extension_sums) is not None:
            self.trajectories = trajectories
        stage = run.scene.stages[now.stage]
        if stage.has_thermostat:
            since = samples.latest(now.time - stage.thermostat_time, since)
        kinetic = now.kinetic * KJ_PER_MOL
        if not self._check.thermal:
            self._check.rescale(kinetic)
        _check_next_step(run, self._check, moment.observation.load, stage)
        if problem := checks.check_sample(run.system, run.scene.watch, samples.row(since), now):
            raise problem
        for feature in self._warns:
            if warning := feature.warning_at(run.system, run._part.state):
                self._warns.remove(feature)
                run._note(warning)
                break
        self._check.rescale(kinetic)
        self.last_good = None  # its memory is free for the next
        self.last_good = run._part.state.copy()

    @property
    def table(self) -> np.ndarray:
        return self.samples.table()

    @table.setter
    def table(self, table: np.ndarray) -> None:
        self.samples = Samples(self.samples.stages, self.samples.described, table)

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        """Restore the samples. The state of the checkpoint is the last good one."""
        super().resume(run, kept)
        samples = self.samples
        stages = samples["stage"]
        first = {k: int(np.argmax(stages == k)) for k in np.unique(stages).tolist()}
        self._begins = {k: max(0, row - 1) for k, row in first.items()}
        if len(samples):
            self._check.rescale(samples.row(-1).kinetic * KJ_PER_MOL)
        self.last_good = run._part.state.copy()

    def failed(self, run: "Simulation") -> str:
        if run.folder is None or self.last_good is None:
            return ""
        path = run.path(LAST_GOOD)
        write_state(path, run.system.saved(self.last_good))
        return (
            f". Last good state, of step {self.last_good.step[NOW]} ({self.last_good.time[NOW]:g}"
            f" ps): {path}"
        )


class StepWatch(Observer):
    """Checks the next step between samples, without evaluations of forces."""

    ends = True

    def __init__(self, run: "Simulation", check: checks.StepCheck):
        self._run, self._check = run, check
        interval = run.scene.output.log_interval_ps
        stages = run.scene.stages
        moving = [stage for stage in stages if not stage.is_minimisation]
        of_samples = [inf if stage.is_auto else interval / stage.step for stage in moving]
        every = checks.check_interval(run.system)
        # samples come at least as often
        self.steps = every if max(of_samples, default=0.0) > every else None

    def observe(self, moment: Moment) -> None:
        if (load := self._run.engine.load) is not None:  # forces have been evaluated
            _check_next_step(self._run, self._check, load, self._run.scene.stages[moment.stage])


class FinalState(Observer):
    """final.npz: the exact state at the end."""

    _names = (FINAL,)

    def end(self, run: "Simulation", results: "Results") -> None:
        write_state(run.path(FINAL), run.system.saved(run._part.state))
        results.files.append(run.path(FINAL))
