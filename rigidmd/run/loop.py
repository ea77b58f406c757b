"""The loop between observations. All steps between two looks are compiled."""

import contextlib
import signal
import threading
import time as clock
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np

from rigidmd.core.state import State
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.output.folder import check_folder, make_folder
from rigidmd.output.progress import progress_of
from rigidmd.scene import BodyScene, MolecularScene, Scene

if TYPE_CHECKING:
    import MDAnalysis
    import pandas

    from rigidmd.assemble.body import BodySystem, Pose
    from rigidmd.assemble.system import System
    from rigidmd.measure.motion import Motion
    from rigidmd.measure.samples import Samples
    from rigidmd.run.body import BodySimulation
    from rigidmd.run.molecules import MolecularSimulation


class Phase(NamedTuple):
    """A stretch of equal steps."""

    dt: float  # ps, or s for a single body
    steps: int
    counted: int = 0  # steps before it from which observers count their intervals


class Moment:
    """What an observer is given: where the run is, its state (read-only), and what can be measured there.

    step : steps since the start; time : ps, or s for a single body; stage : index of the stage that led here
    state : of molecules in Å, Å/ps and u Å²/ps (angular momentum along principal axes), of a body in SI units
    """

    def __init__(self, simulation: "Simulation", step: int, time: float, stage: int):
        self._simulation = simulation
        self.step = step
        self.time = time
        self.stage = stage
        self.state = State(*(_read_only(array) for array in simulation.state))

    @cached_property
    def _seen(self) -> Any:
        return self._simulation._look(self)

    @cached_property
    def observation(self) -> Any:
        """What can be measured: a `Reading` of molecules, in the units of the log; a `Pose` of a body, in SI units.

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


@dataclass(repr=False)
class Results:
    """What a run leaves: samples as arrays, a summary, the final state, the files.

    results["energy"] is a column of the samples as an array, in the unit that log.csv has (kJ/mol of the whole system,
    K, bar, Å, ps), of a body in SI units; `units` names all columns with their units.

    summary : figures with units in their keys, as in summary.json
    state : the last one, of molecules in Å, Å/ps and u Å²/ps, of a body in SI units
    files : what was written
    interrupted : whether a signal ended the run before its time; signal : which one, 2 of Ctrl-C, 15 of SIGTERM
    """

    system: "System | BodySystem"
    state: State
    samples: "Samples | Motion"
    summary: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    interrupted: bool = False
    signal: int | None = None
    _times: list[float] = field(default_factory=list)
    _frames: list[np.ndarray] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"<Results of {self.system.scene.name}: {self._told}; results[column], .units, .summary, .universe()>"

    def _repr_html_(self) -> str:
        families: dict[tuple[str, str], list[str]] = {}
        for name, column in self.samples.described.items():
            families.setdefault((column.unit, column.about), []).append(name)
        rows = "".join(
            f"<tr><td>{' '.join(f'<code>{name}</code>' for name in names)}</td><td>{unit}</td>"
            f'<td>{self._range(names)}</td><td style="text-align: left">{escape(about)}</td></tr>'
            for (unit, about), names in families.items()
        )
        return (
            f"<b>{escape(self.system.scene.name)}</b>: {escape(self._told)}<table><tr><th>column</th><th>unit</th>"
            f"<th>first ... last</th><th></th></tr>{rows}</table>"
        )

    @property
    def _told(self) -> str:
        files = f"{len(self.files)} files in {self.files[0].parent}" if self.files else "no files"
        return f"{'interrupted, ' if self.interrupted else ''}{len(self.samples)} samples, {files}"

    def _range(self, columns: list[str]) -> str:
        """First and last value of a column that stands alone."""
        values = self[columns[0]]
        if len(columns) > 1 or values.ndim > 1 or len(values) == 0:
            return ""
        return " ... ".join(escape(x) if isinstance(x, str) else f"{x:.6g}" for x in values[[0, -1]])

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the samples as an array (n,), in the unit that `units` says: results["energy"].

        Of a body that turns results["Q"] are its rotation matrices (n, 3, 3). Raises KeyError with all names.
        """
        return self.samples[column]

    @property
    def units(self) -> dict[str, str]:
        """The unit of every column, by its name; "1" of plain numbers, empty of words."""
        return {name: column.unit for name, column in self.samples.described.items()}

    def to_dataframe(self) -> "pandas.DataFrame":
        """The samples under the headers of log.csv (motion.csv of a body). Raises ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe() needs pandas: pip install pandas") from None
        written = {name: column.header for name, column in self.samples.described.items() if column.header}
        return pandas.DataFrame({header: self[name] for name, header in written.items()})

    def universe(self) -> "MDAnalysis.Universe":
        """The trajectory as an MDAnalysis Universe: from the files if there are any, else from memory.

        Lengths in Å, times in ps: every frame has the time of the run, whatever the file can hold. Of a body a second
        is shown as a picosecond. Warns where frames are not evenly spaced. Raises ValueError where there is none.
        """
        from rigidmd.output import trajectory

        output = self.system.scene.output
        if not output.trajectory:
            raise ValueError("this run wrote no trajectory (output.trajectory = false)")
        if self.files:
            by_name = {path.name: path for path in self.files}
            return trajectory.from_files(by_name[output.topology], by_name[output.trajectory], self._times)
        return trajectory.in_memory(self.system, self._times, self._frames)


# To a type checker it is not abstract: Simulation(scene) is never one itself.
class Simulation(object if TYPE_CHECKING else ABC):
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
    system: "System | BodySystem"
    state: State

    @overload
    def __new__(
        cls,
        scene: MolecularScene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: Every | Sequence[Every] = (),
        say: Callable[[str], object] = ...,
        warn: Callable[[str], object] = ...,
    ) -> "MolecularSimulation": ...
    @overload
    def __new__(
        cls,
        scene: BodyScene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: Every | Sequence[Every] = (),
        say: Callable[[str], object] = ...,
        warn: Callable[[str], object] = ...,
        *,
        applied: "Mapping[str, Callable[[Pose], tuple]] | None" = None,
    ) -> "BodySimulation": ...
    @overload
    def __new__(
        cls,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: Every | Sequence[Every] = (),
        say: Callable[[str], object] = ...,
        warn: Callable[[str], object] = ...,
        *,
        applied: "Mapping[str, Callable[[Pose], tuple]] | None" = None,
    ) -> "MolecularSimulation | BodySimulation": ...
    def __new__(cls, scene: Scene, *arguments: Any, **options: Any) -> Any:
        if cls is Simulation:
            from rigidmd.run import BodySimulation, MolecularSimulation

            cls = BodySimulation if isinstance(scene, BodyScene) else MolecularSimulation
        return super().__new__(cls)

    def __init__(
        self,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        observers: Every | Sequence[Every] = (),
        say: Callable[[str], object] = lambda sentence: None,
        warn: Callable[[str], object] = lambda sentence: None,
    ):
        self.scene = scene
        self.folder = None if folder is None else Path(folder)
        self._force = force
        self._observers = [observers] if isinstance(observers, Every) else list(observers)
        self._say = say
        self._warn = warn
        self._warnings: list[str] = []
        self._interrupted = False
        self._signal: int | None = None

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._told}>"

    def _repr_html_(self) -> str:
        return escape(self._told)

    @property
    def _told(self) -> str:
        where = "results stay in memory" if self.folder is None else f"writes to {self.folder}"
        return f"{self.introduction().splitlines()[0]}; {where}"

    def run(self, progress: bool | None = None) -> Results:
        """Run all phases. Raises OutputError before anything is computed, SimulationError when numbers go bad.

        progress : show how far it is: a bar on a terminal or in a notebook, elsewhere a line every 30 s on standard
            error; in notebooks only when not given
        """
        scene_file = Path(self.scene.source)
        inputs = [*self.scene.inputs.values(), *([scene_file] if scene_file.is_file() else [])]
        if self.folder is not None:
            check_folder(self.folder, self._force, inputs)
        self._interrupted, self._signal = False, None
        self._warnings.clear()
        self._reset()
        began = clock.perf_counter()
        self._prepare()
        prepared = clock.perf_counter() - began
        results = Results(self.system, self.state, self._no_samples())
        if self.folder is not None:
            make_folder(self.folder, self._force, self._file_names(), inputs)
        with self._stops_at_signals():
            with contextlib.ExitStack() as stack:
                observers = [*self._own_observers(stack, results), *self._observers]
                began = clock.perf_counter()
                try:
                    computing = self._run_phases(observers, progress)
                except SimulationError as error:
                    raise self._failed(error) from None
                wall = clock.perf_counter() - began
            results.interrupted, results.signal = self._interrupted, self._signal
            self._conclude(results, prepared, wall, computing)
        return results

    # What molecules and bodies do in their own ways.

    @abstractmethod
    def observe(self, moment: Moment) -> Any:
        """What `Moment.observation` gives, in the units of the log."""

    @abstractmethod
    def _look(self, moment: Moment) -> Any:
        """What there is to see at this moment, in internal units."""

    @abstractmethod
    def _no_samples(self) -> "Samples | Motion":
        """What samples are kept in, before there are any."""

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
        """What samples and what writes; the first one also sees the last moment of a phase."""

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

    def _run_phases(self, observers: list[Every], progress: bool | None) -> list[float]:
        """Advance through all phases; seconds of computing in each."""
        self._began = (0, float(self.state.time[0]), 1.0)
        computing = []
        step, time = 0, 0.0
        durations = self._durations()
        with progress_of(sum(durations), self.time_unit, progress) as advanced:
            for k in range(len(durations)):
                phase = self._begin(k)
                self._began = (step, float(self.state.time[0]), phase.dt)
                if k == 0:
                    self._show(observers, Moment(self, 0, 0.0, 0), [True] * len(observers))
                checked, patience = 0, self._patience(k)
                intervals = [max(1, round(observer.interval / phase.dt)) for observer in observers]
                seconds, done, sampled = 0.0, 0, True
                while done < phase.steps and not self._interrupted:
                    ahead = [interval - (phase.counted + done) % interval for interval in intervals]
                    to = min(phase.steps, done + min(ahead), checked + patience)
                    began = clock.perf_counter()
                    self._advance(k, to - done, done)
                    seconds += clock.perf_counter() - began
                    if not self.state.is_finite:
                        raise NotFiniteError(self.state)
                    advanced(phase.dt * (to - done))
                    done = to
                    if done in (checked + patience, phase.steps):
                        self._check(k, phase.dt)
                        checked = done
                    last = done == phase.steps or self._interrupted
                    due = [(phase.counted + done) % interval == 0 for interval in intervals]
                    due[0] = sampled = due[0] or last
                    self._show(observers, Moment(self, step + done, time + done * phase.dt, k), due)
                if not sampled:  # the signal came while observers looked
                    self._show(observers[:1], Moment(self, step + done, time + done * phase.dt, k), [True])
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
    def _stops_at_signals(self) -> Iterator[None]:
        """Ctrl-C or SIGTERM ends the run at the next look, and everything is saved; a second Ctrl-C ends it at once.

        A SIGTERM for which the program has a handler of its own is left to that.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def stop(signum, frame):
            if self._interrupted and signum == signal.SIGINT:
                raise KeyboardInterrupt
            self._signal = self._signal or int(signum)
            self._interrupted = True

        before = {signal.SIGINT: signal.getsignal(signal.SIGINT)}
        if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL:
            before[signal.SIGTERM] = signal.SIG_DFL
        for number in before:
            signal.signal(number, stop)
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
