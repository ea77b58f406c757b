"""What observes molecules: samples and their log, the watch, the last state, a figure."""

from typing import TYPE_CHECKING, NamedTuple

from rigidmd.core.state import Load, State
from rigidmd.core.state_file import write_state
from rigidmd.measure import watch
from rigidmd.measure.samples import Sample, Samples
from rigidmd.output.folder import ENERGY, FINAL, LAST_GOOD, LOG
from rigidmd.output.log import Log
from rigidmd.output.report import draw_energy
from rigidmd.run.moment import Moment
from rigidmd.run.observers import Observer
from rigidmd.units import FEMTOSECOND

if TYPE_CHECKING:
    from rigidmd.run.molecules import MolecularSimulation
    from rigidmd.run.results import Results


class Sampler(Observer):
    """Keeps samples in memory."""

    ends = True

    def __init__(self, interval: float):
        self.interval = interval
        self.samples = Samples()

    def see(self, moment: Moment) -> None:
        """One more."""
        self.samples.rows.append(moment.sample)


class LogFile(Observer):
    """log.csv: a line for each sample, at once on the disk."""

    ends = True

    def __init__(self, interval: float):
        self.interval = interval
        self._log: Log | None = None

    def files(self) -> list[str]:
        """One."""
        return [LOG]

    def begin(self, run: "MolecularSimulation") -> None:
        """Open it."""
        self._log = Log(run.folder / LOG)

    def see(self, moment: Moment) -> None:
        """A line."""
        self._log.write(moment.sample)

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Name it."""
        results.files.append(run.folder / LOG)

    def close(self) -> None:
        """Close it."""
        if self._log is not None:
            self._log.close()


class Good(NamedTuple):
    """A moment at which nothing was wrong."""

    step: int
    time: float
    state: State


class Watch(Observer):
    """Holds every sample against the limits of the scene, and keeps the last state that was good."""

    ends = True

    def __init__(self, run: "MolecularSimulation", interval: float):
        self.interval = interval
        self.last_good: Good | None = None
        self.thermal = 0.0  # scale of momenta, u Å²/ps²
        self._run = run
        self._rows: list[Sample] = []
        self._begins: dict[int, int] = {}  # of each stage, the row of the sample at which it began

    def files(self) -> list[str]:
        """What a run that fails leaves."""
        return [LAST_GOOD]

    def see(self, moment: Moment) -> None:
        """Raise a `Finding` if the sample, or the step ahead of it, cannot be what the scene means."""
        run, now, rows = self._run, moment.sample, self._rows
        since = self._begins.setdefault(now.stage, max(0, len(rows) - 1))
        rows.append(now)
        stage = run.scene.stages[now.stage]
        if stage.ensemble == "nvt":
            begin, since = since, len(rows) - 1
            while since > begin and rows[since].time > now.time - stage.thermostat_time_ps:
                since -= 1
        kinetic = moment._seen.kinetic
        self.thermal = self.thermal or watch.thermal_energy(run.system, kinetic)
        self.check_step(moment.stage, moment._seen.load)
        if finding := watch.sample_finding(run.system, run.scene.watch, rows[since], now):
            raise finding
        self.thermal = watch.thermal_energy(run.system, kinetic)
        self.last_good = Good(moment.step, moment.time, run.state.copy())

    def check_step(self, k: int, load: Load) -> None:
        """Raise a `Finding` if the next step of a stage would take a molecule too far."""
        run, stage = self._run, self._run.scene.stages[k]
        dt = stage.timestep_fs * FEMTOSECOND
        if finding := watch.step_finding(run.system, run.scene.watch, run.state, load, stage.scheme, dt, self.thermal):
            raise finding

    def failed(self, run: "MolecularSimulation") -> str:
        """Save the last good state."""
        if run.folder is None or self.last_good is None:
            return ""
        path = run.folder / LAST_GOOD
        write_state(path, run.system.saved(self.last_good.state))
        return f". Last good state, of step {self.last_good.step} ({self.last_good.time:g} ps): {path}"


class StepWatch(Observer):
    """Looks at the step ahead however seldom samples are taken; it costs no evaluation of forces."""

    ends = True

    def __init__(self, run: "MolecularSimulation", of: Watch):
        self.steps = watch.patience(run.system)
        self._run, self._watch = run, of

    def see(self, moment: Moment) -> None:
        """Raise a `Finding` if it would take a molecule too far."""
        self._watch.check_step(moment.stage, self._run.engine.load)


class FinalState(Observer):
    """final.npz: the state at the end, every bit of it."""

    def files(self) -> list[str]:
        """One."""
        return [FINAL]

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Write it."""
        write_state(run.folder / FINAL, run.system.saved(run.state))
        results.files.append(run.folder / FINAL)


class EnergyFigure(Observer):
    """energy.png: drift, energies and temperatures."""

    def __init__(self, sampler: Sampler):
        self._sampler = sampler

    def files(self) -> list[str]:
        """One."""
        return [ENERGY]

    def end(self, run: "MolecularSimulation", results: "Results") -> None:
        """Draw it, if there is anything to see."""
        if len(self._sampler.samples.rows) > 1:
            draw_energy(run.folder / ENERGY, run.system, self._sampler.samples, results.summary)
            results.files.append(run.folder / ENERGY)
