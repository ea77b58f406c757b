"""Observers of molecules: samples with their checks and log, the final state, a figure."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.state import NOW, State
from rigidmd.core.state_file import write_state
from rigidmd.engines.cpu import Engine
from rigidmd.measure import watch
from rigidmd.measure.samples import Samples
from rigidmd.output.checkpoint import Checkpoint
from rigidmd.output.folder import ENERGY, FINAL, LAST_GOOD, LOG
from rigidmd.output.log import Log
from rigidmd.output.pressure import TENSOR_FILE, TensorFile, tensor_row
from rigidmd.output.report import draw_energy, drawn
from rigidmd.run.moment import Moment
from rigidmd.run.observers import Observer
from rigidmd.scene.stage import Stage

if TYPE_CHECKING:
    from rigidmd.run.molecules import MolecularSimulation
    from rigidmd.run.results import Results


class LogFile(Observer):
    """log.csv: a line for each sample."""

    ends = reads_energies = True

    def __init__(self, interval: float, tensor: bool):
        self.interval, self._tensor = interval, tensor
        self._log: Log | None = None

    def files(self) -> list[str]:
        """One."""
        return [LOG]

    def begin(self, run: "MolecularSimulation") -> None:
        """Open it."""
        self._log = Log(run.path(LOG), self._tensor, own=tuple(run.system.own))

    def memory(self) -> Checkpoint:
        """Its size."""
        return Checkpoint({"kept": None if self._log is None else self._log.kept}, {})

    def resume(self, run: "MolecularSimulation", kept: Checkpoint) -> None:
        """Open it where the checkpoint left it."""
        self._log = Log(run.path(LOG), self._tensor, kept.told["kept"], tuple(run.system.own))

    def see(self, moment: Moment) -> None:
        """A line."""
        if self._log is not None:
            self._log.write(moment.sample)

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Complete and name it."""
        if self._log is not None:
            self._log.flush()
        results.files.append(run.path(LOG))

    def close(self) -> None:
        """Close it."""
        if self._log is not None:
            self._log.close()


class PressureTensor(Observer):
    """pressure_tensor.csv: the pressure tensor at an interval of its own; without a folder in memory."""

    reads_energies = True

    def __init__(self, interval: float):
        self.interval = interval
        self._file: TensorFile | None = None
        self._rows: list[list[float]] = []

    def files(self) -> list[str]:
        """One."""
        return [TENSOR_FILE]

    def begin(self, run: "MolecularSimulation") -> None:
        """Open it."""
        self._rows = []
        self._file = None if run.folder is None else TensorFile(run.path(TENSOR_FILE))

    def memory(self) -> Checkpoint:
        """Its size."""
        return Checkpoint({"kept": None if self._file is None else self._file.kept}, {})

    def resume(self, run: "MolecularSimulation", kept: Checkpoint) -> None:
        """Open it where the checkpoint left it."""
        self._file = TensorFile(run.path(TENSOR_FILE), kept.told["kept"])

    def see(self, moment: Moment) -> None:
        """A line."""
        row = tensor_row(moment.time, moment.observation.pressure_tensor_bar)
        if self._file is None:
            self._rows.append(row)
        else:
            self._file.write(row)

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Hand it over."""
        if self._file is None:
            results._tensor = np.array(self._rows)
        else:
            results.files.append(run.path(TENSOR_FILE))

    def close(self) -> None:
        """Close it."""
        if self._file is not None:
            self._file.close()
            self._file = None


class Good(NamedTuple):
    """A state that passed all checks."""

    step: int
    time: float
    state: State


class Sampler(Observer):
    """Keeps samples, checks each against the limits of the scene, and keeps the last state that was good."""

    ends = reads_energies = True

    def __init__(self, run: "MolecularSimulation", interval: float, check: watch.StepCheck):
        self.interval = interval
        self.samples = Samples([stage.label for stage in run.scene.stages], tuple(run.system.own))
        self.last_good: Good | None = None
        self._run, self._check = run, check
        self._begins: dict[int, int] = {}  # stage -> row of the sample at which it began

    def files(self) -> list[str]:
        """The file of a failed run."""
        return [LAST_GOOD]

    def see(self, moment: Moment) -> None:
        """Raise a `Finding` if the sample or the next step exceeds a limit."""
        run, now, samples = self._run, moment.sample, self.samples
        since = self._begins.setdefault(now.stage, max(0, len(samples) - 1))
        samples.append(now)
        stage = run.scene.stages[now.stage]
        if stage.has_thermostat:
            since = samples.latest(now.time - stage.thermostat_time, since)
        seen = moment._seen
        if not self._check.thermal:
            self._check.rescale(seen.kinetic)
        if finding := self._check.finding(run.state, seen.load, stage, run.extent):
            raise finding
        if finding := watch.sample_finding(run.system, run.scene.watch, samples.row(since), now):
            raise finding
        self._check.rescale(seen.kinetic)
        self._keep(moment.step, moment.time)

    def _keep(self, step: int, time: float) -> None:
        """Keep the present state as the last good one, in the memory of the one before."""
        now, kept = self._run.state, self.last_good and self.last_good.state
        if kept is None or any(there.shape != here.shape for there, here in zip(kept, now, strict=True)):
            kept = now.copy()
        else:
            for there, here in zip(kept, now, strict=True):
                there[:] = here
        self.last_good = Good(step, time, kept)

    def memory(self) -> Checkpoint:
        """The samples, and what the checks remember."""
        told = {"begins": list(self._begins.items()), "thermal": self._check.thermal}
        return Checkpoint(told, {"samples": self.samples.table()})

    def resume(self, run: "MolecularSimulation", kept: Checkpoint) -> None:
        """Restore them. The state of the checkpoint is the last good one."""
        self.samples = Samples(self.samples.stages, self.samples.own, kept.arrays["samples"])
        self._begins = {int(stage): range(len(self.samples))[row] for stage, row in kept.told["begins"]}
        self._check.thermal = kept.told["thermal"]
        self._keep(int(run.state.step[NOW]), float(run.state.time[NOW]))

    def failed(self, run: "MolecularSimulation") -> str:
        """Save the last good state."""
        if run.folder is None or self.last_good is None:
            return ""
        path = run.path(LAST_GOOD)
        write_state(path, run.system.saved(self.last_good.state))
        return f". Last good state, of step {self.last_good.step} ({self.last_good.time:g} ps): {path}"


class StepWatch(Observer):
    """Checks the next step between samples; this takes no force evaluation."""

    ends = True

    def __init__(self, run: "MolecularSimulation", check: watch.StepCheck):
        self.steps = watch.steps_between(run.system)
        self._run, self._check = run, check

    def see(self, moment: Moment) -> None:
        """Raise a `Finding` if the step exceeds a limit."""
        run, engine = self._run, self._run.engine
        if not isinstance(engine, Engine) or engine.load is None:
            return  # no force has been evaluated yet
        stage = run.scene.stages[moment.stage]
        if finding := self._check.finding(run.state, engine.load, stage, run.extent):
            raise finding


class FinalState(Observer):
    """final.npz: the exact state at the end."""

    def files(self) -> list[str]:
        """One."""
        return [FINAL]

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Write it."""
        write_state(run.path(FINAL), run.system.saved(run.state))
        results.files.append(run.path(FINAL))


class EnergyFigure(Observer):
    """energy.png: drift, energies and temperatures."""

    def __init__(self, stages: Sequence[Stage]):
        self._stages = stages

    def files(self) -> list[str]:
        """One."""
        return [ENERGY]

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Draw it if there are at least two samples."""
        samples = results.samples
        if isinstance(samples, Samples) and int(drawn(self._stages, samples).sum()) > 1:
            draw_energy(run.path(ENERGY), run.system, samples, results.summary)
            results.files.append(run.path(ENERGY))
