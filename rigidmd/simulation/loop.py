"""The loop between observations. All steps between two looks are compiled."""

import contextlib
import signal
import threading
import time as clock
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.dynamics.engine import NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.output.folder import check_folder, make_folder
from rigidmd.scene import BodyScene, Scene


class Phase(NamedTuple):
    """A stretch of equal steps."""

    dt: float  # ps, or s for a single body
    steps: int
    counted: int = 0  # steps before it from which observers count their intervals


class Moment:
    """What an observer is given: where the run is, its state (read-only), and what can be measured there.

    step : steps since the start; time : ps, or s for a single body; stage : index of the stage that led here
    """

    def __init__(self, simulation: "Simulation", step: int, time: float, stage: int):
        self._simulation = simulation
        self.step = step
        self.time = time
        self.stage = stage
        self.state = State(*(_read_only(array) for array in simulation.state))

    @cached_property
    def observation(self):
        """What can be measured, by name: energies, temperatures, pressure of molecules; `Pose` of a body.

        Evaluated at the first use and shared by all observers.
        """
        return self._simulation.observe(self)

    @property
    def site_positions(self) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å, as they travelled."""
        return self._simulation.system.site_positions(self.state)


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


@dataclass
class Every:
    """An observer: call `function(moment)` every `interval` ps (s for a single body)."""

    interval: float
    function: Callable[[Moment], None]


@dataclass
class Results:
    """What a run leaves: samples as arrays, a summary, the final state, the files."""

    system: object
    state: State
    samples: object
    summary: dict = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False
    _frames: tuple[list[float], list[np.ndarray]] = ((), ())

    def __repr__(self) -> str:
        state = "interrupted, " if self.interrupted else ""
        return (
            f"<Results of {self.system.scene.name}: {state}{len(self.files)} files; results[column], .summary, .state>"
        )

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the samples as an array, by name: results["energy"]."""
        return self.samples[column]

    def universe(self):
        """The trajectory as an MDAnalysis Universe: from the files if there are any, else from memory."""
        from rigidmd.output import trajectory

        output = self.system.scene.output
        if self.files:
            by_name = {path.name: path for path in self.files}
            if output.trajectory not in by_name:
                raise ValueError("this run wrote no trajectory (output.trajectory = false)")
            return trajectory.from_files(by_name[output.topology], by_name[output.trajectory])
        return trajectory.in_memory(self.system, *self._frames)


class Simulation(ABC):
    """A scene, ready to run: a `MolecularSimulation` or a `BodySimulation`, as the scene is.

    Parameters
    ----------
    scene : what to run
    folder : where to write; None writes nothing and keeps the frames in memory
    force : replace an earlier run in that folder
    observers : `Every` objects of your own, called between steps
    say : called with a sentence when something begins that takes a moment (compiling, relieving)
    warn : called with a sentence that whoever runs this should know before it is done; the summary has it too
    applied : of a single body, forces by Python functions: see `BodySimulation`
    """

    time_unit = ""

    def __new__(cls, scene: Scene, *arguments, **options):
        if cls is Simulation:
            from rigidmd.simulation import BodySimulation, MolecularSimulation

            cls = BodySimulation if isinstance(scene, BodyScene) else MolecularSimulation
        return super().__new__(cls)

    def __init__(
        self,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: Every | tuple[Every, ...] | list[Every] = (),
        say: Callable[[str], None] = lambda sentence: None,
        warn: Callable[[str], None] = lambda sentence: None,
    ):
        self.scene = scene
        self.folder = None if folder is None else Path(folder)
        self._force = force
        self._observers = [observers] if isinstance(observers, Every) else list(observers)
        self._say = say
        self._warn = warn
        self._warnings: list[str] = []
        self._interrupted = False

    def run(self, progress: bool = False) -> Results:
        """Run all phases. Raises OutputError before anything is computed, SimulationError when numbers go bad."""
        scene_file = Path(self.scene.source)
        inputs = [*self.scene.inputs.values(), *([scene_file] if scene_file.is_file() else [])]
        if self.folder is not None:
            check_folder(self.folder, self._force, inputs)
        self._interrupted = False
        self._warnings.clear()
        self._reset()
        began = clock.perf_counter()
        self._prepare()
        prepared = clock.perf_counter() - began
        results = Results(self.system, self.state, None)
        if self.folder is not None:
            make_folder(self.folder, self._force, self._file_names(), inputs)
        with contextlib.ExitStack() as stack:
            observers = [*self._own_observers(stack, results), *self._observers]
            stack.enter_context(self._stops_at_ctrl_c())
            began = clock.perf_counter()
            try:
                computing = self._run_phases(observers, progress)
            except SimulationError as error:
                raise self._failed(error) from None
            wall = clock.perf_counter() - began
        results.interrupted = self._interrupted
        self._conclude(results, prepared, wall, computing)
        return results

    # What molecules and bodies do in their own ways.

    @abstractmethod
    def observe(self, moment: Moment):
        """What `Moment.observation` gives."""

    @abstractmethod
    def introduction(self) -> str:
        """What is about to run, in a line or a few."""

    @abstractmethod
    def conclusion(self, results: Results) -> str:
        """The summary as a person reads it."""

    @abstractmethod
    def _reset(self) -> None:
        """Back to the start, so that every run of a simulation is the same run: sets `engine` and `state`."""

    @abstractmethod
    def _prepare(self) -> None:
        """Everything before the first step, compiling included."""

    @abstractmethod
    def _durations(self) -> list[float]:
        """How long the stretches of the run are, ps or s."""

    @abstractmethod
    def _begin(self, k: int) -> Phase:
        """Make ready for stretch k, and say how it is walked."""

    @abstractmethod
    def _advance(self, k: int, steps: int, done: int) -> None:
        """Take `steps` steps of phase k after `done` of them."""

    @abstractmethod
    def _file_names(self) -> list[str]:
        """Every file that `run` may write."""

    @abstractmethod
    def _own_observers(self, stack: contextlib.ExitStack, results: Results) -> list[Every]:
        """What samples and what writes; the first one also sees the last moment of a phase. Sets results.samples."""

    @abstractmethod
    def _conclude(self, results: Results, prepared: float, wall: float, computing: list[float]) -> None:
        """Summary and last files; times in s."""

    @abstractmethod
    def _patience(self, k: int) -> int:
        """Steps of stretch k after which `_check` is asked though no observer looks."""

    @abstractmethod
    def _check(self, k: int, dt: float) -> None:
        """Raise a `Finding` if the state cannot be what the scene means."""

    @abstractmethod
    def _explain(self, error: SimulationError, dt: float) -> str:
        """What was seen, why, what to try."""

    @abstractmethod
    def _save(self) -> str:
        """Save what is good of a run that failed; a sentence that says where, or nothing."""

    def _note(self, warning: str) -> None:
        self._warnings.append(warning)
        self._warn(warning)

    @np.errstate(over="ignore", invalid="ignore")
    def _failed(self, error: SimulationError) -> SimulationError:
        """The error with when it happened and all that can be said about it."""
        step, time, dt = self._began
        now = float(self.state.time[0])
        step += round((now - time) / dt)
        return SimulationError(
            f"stopped at step {step} ({now:g} {self.time_unit}): {self._explain(error, dt)}{self._save()}"
        )

    def _run_phases(self, observers: list[Every], progress: bool) -> list[float]:
        """Advance through all phases; seconds of computing in each."""
        self._began = (0, float(self.state.time[0]), 1.0)
        computing = []
        step, time = 0, 0.0
        durations = self._durations()
        with _bar(sum(durations), self.time_unit, progress) as bar:
            for k in range(len(durations)):
                phase = self._begin(k)
                self._began = (step, float(self.state.time[0]), phase.dt)
                if k == 0:
                    self._show(observers, Moment(self, 0, 0.0, 0), [True] * len(observers))
                checked, patience = 0, self._patience(k)
                intervals = [max(1, round(observer.interval / phase.dt)) for observer in observers]
                seconds, done = 0.0, 0
                while done < phase.steps and not self._interrupted:
                    ahead = [interval - (phase.counted + done) % interval for interval in intervals]
                    to = min(phase.steps, done + min(ahead), checked + patience)
                    began = clock.perf_counter()
                    self._advance(k, to - done, done)
                    seconds += clock.perf_counter() - began
                    if not self.state.is_finite:
                        raise NotFiniteError(self.state)
                    bar.update(phase.dt * (to - done))
                    done = to
                    if done in (checked + patience, phase.steps):
                        self._check(k, phase.dt)
                        checked = done
                    last = done == phase.steps or self._interrupted
                    due = [(phase.counted + done) % interval == 0 for interval in intervals]
                    due[0] = due[0] or last
                    self._show(observers, Moment(self, step + done, time + done * phase.dt, k), due)
                computing.append(seconds)
                step, time = step + done, time + done * phase.dt
                if self._interrupted:
                    break
        return computing

    @staticmethod
    def _show(observers: list[Every], moment: Moment, due: list[bool]) -> None:
        for observer, now in zip(observers, due, strict=True):
            if now:
                observer.function(moment)

    @contextlib.contextmanager
    def _stops_at_ctrl_c(self) -> Iterator[None]:
        """The first Ctrl-C ends the run at the next look, the second at once."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(signum, frame):
            if self._interrupted:
                raise KeyboardInterrupt
            self._interrupted = True

        before = signal.signal(signal.SIGINT, stop)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def _bar(total: float, unit: str, progress: bool):
    """A progress bar in units of time; only where asked for, and only on a terminal."""
    from tqdm import tqdm

    form = "{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit + " [{elapsed}<{remaining}]"
    with tqdm(total=total, disable=None if progress else True, bar_format=form, leave=False, mininterval=0.2) as bar:
        yield bar
