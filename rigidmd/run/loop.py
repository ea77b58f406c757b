"""The one loop between looks, of molecules and of a single body. All steps between two looks are compiled."""

import contextlib
import signal
import sys
import threading
import time as clock
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict, Unpack, overload

import numpy as np

from rigidmd.core.schemes import SCHEMES, Scheme, Solver
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.engines import Engine
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.errors import RigidMDWarning, SimulationError
from rigidmd.output.folder import SUMMARY, check_folder, make_folder
from rigidmd.output.progress import progress_of
from rigidmd.output.report import write_summary
from rigidmd.run.moment import Moment
from rigidmd.run.observers import Every, Observer
from rigidmd.run.results import Results
from rigidmd.scene import BodyScene, MolecularScene, Scene

if TYPE_CHECKING:
    from rigidmd.assemble.body import BodySystem, Pose
    from rigidmd.assemble.system import System
    from rigidmd.run.body import BodySimulation
    from rigidmd.run.molecules import MolecularSimulation

    # a type checker lets nobody call an abstract class, but `Simulation(scene)` makes one of its complete subclasses
    Base = object
else:
    Base = ABC


def _as_warning(sentence: str) -> None:
    """A warning that names the line outside of this package from which it comes."""
    package, level, frame = str(Path(__file__).parent.parent), 1, sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(package):
        level, frame = level + 1, frame.f_back
    warnings.warn(sentence, RigidMDWarning, stacklevel=level)


class Stretch(NamedTuple):
    """A stretch of equal steps."""

    row: Scheme | Solver
    dt: float  # ps, or s for a single body
    steps: int
    counted: int = 0  # steps before it from which observers count their intervals


class Costs(NamedTuple):
    """What a run took, in seconds."""

    preparing: float  # compiling, relief of overlaps
    wall: float  # stretches with all that looks at them
    computing: list[float]  # steps of each stretch


class Options(TypedDict, total=False):
    """Keywords of a `Simulation`."""

    observers: Every | Sequence[Every]
    say: Callable[[str], object]
    warn: Callable[[str], object]


class BodyOptions(Options, total=False):
    """Keywords of a `BodySimulation`."""

    applied: "Mapping[str, Callable[[Pose], tuple]] | None"


class Simulation(Base):
    """A scene, ready to run: a `MolecularSimulation` or a `BodySimulation`, as the scene is.

    Parameters
    ----------
    scene : what to run
    folder : where to write; None writes nothing and keeps the frames in memory
    force : replace an earlier run in that folder
    observers : `Every` objects of your own, called between steps
    say : called with a sentence when something begins that takes a moment (compiling, relieving)
    warn : called with a sentence that whoever runs this should know before it is done; the summary has it too. A
        `RigidMDWarning` by Python's `warnings` when not given
    applied : of a single body, forces by Python functions: see `BodySimulation`
    """

    state: State

    @overload
    def __new__(
        cls, scene: MolecularScene, folder: str | Path | None = None, force: bool = False, **options: Unpack[Options]
    ) -> "MolecularSimulation": ...
    @overload
    def __new__(
        cls, scene: BodyScene, folder: str | Path | None = None, force: bool = False, **options: Unpack[BodyOptions]
    ) -> "BodySimulation": ...
    @overload
    def __new__(
        cls, scene: Scene, folder: str | Path | None = None, force: bool = False, **options: Unpack[BodyOptions]
    ) -> "MolecularSimulation | BodySimulation": ...
    def __new__(cls, scene: Scene, *arguments: Any, **options: Any) -> Any:
        if cls is not Simulation:
            return super().__new__(cls)
        from rigidmd.run import BodySimulation, MolecularSimulation

        return object.__new__(BodySimulation if isinstance(scene, BodyScene) else MolecularSimulation)

    def __init__(
        self,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        *,
        observers: Every | Sequence[Every] = (),
        say: Callable[[str], object] = lambda sentence: None,
        warn: Callable[[str], object] = _as_warning,
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

    def path(self, file: str) -> Path:
        """A file in the folder of the run. Raises ValueError if it has none."""
        if self.folder is None:
            raise ValueError(f"this run has no folder for {file}")
        return self.folder / file

    @property
    def _told(self) -> str:
        where = "results stay in memory" if self.folder is None else f"writes to {self.folder}"
        return f"{self.introduction().splitlines()[0]}; {where}"

    def run(self, progress: bool | None = None) -> Results:
        """Run all stretches. Raises OutputError before anything is computed, SimulationError when numbers go bad.

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
        own = self._own_observers()
        observers = [*own, *self._observers]
        if self.folder is not None:
            names = [name for observer in observers for name in observer.files()]
            make_folder(self.folder, self._force, [*names, SUMMARY], inputs)
        with self._stops_at_signals(), contextlib.ExitStack() as stack:
            for observer in observers:
                stack.callback(observer.close)
                observer.begin(self)
            began = clock.perf_counter()
            try:
                computing = self._run_stretches(observers, progress)
            except SimulationError as error:
                raise self._failed(error, observers) from None
            costs = Costs(prepared, clock.perf_counter() - began, computing)
            results = Results(self.system, self.state, self._samples())
            results.interrupted, results.signal = self._interrupted, self._signal
            results.summary = self._summary(results.samples, costs)
            for observer in observers:
                observer.end(self, results)
            if self.folder is not None:
                results.files.append(self.path(SUMMARY))
                results.summary["files"] = [str(path) for path in results.files]
                write_summary(self.path(SUMMARY), results.summary)
        return results

    # What molecules and bodies have of their own.

    system: "System | BodySystem"
    engine: Engine
    stretch: Stretch  # the present one
    time_unit = ""

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
    def _enter(self, k: int) -> Stretch:
        """Make ready for stretch k, and say how it is walked."""

    @abstractmethod
    def _look(self, moment: Moment) -> Any:
        """What there is to see at a moment, in internal units; what has a `reading` shows that to observers."""

    @abstractmethod
    def _own_observers(self) -> list[Observer]:
        """What samples, watches and writes."""

    @abstractmethod
    def _samples(self) -> Any:
        """What has been sampled."""

    @abstractmethod
    def _summary(self, samples: Any, costs: Costs) -> dict[str, Any]:
        """The figures by which the run is judged."""

    @abstractmethod
    def _explain(self, error: SimulationError) -> str:
        """What was seen, why, what to try."""

    @abstractmethod
    def write_scene(self, folder: Path) -> None:
        """Write the scene as it is run, with copies of the files that it reads."""

    def note(self, warning: str) -> None:
        """Tell a sentence that whoever runs this should know before it is done; the summary has it too."""
        self._warnings.append(warning)
        self._warn(warning)

    @property
    def notes(self) -> list[str]:
        """What was told so far."""
        return list(self._warnings)

    @np.errstate(over="ignore", invalid="ignore")
    def _failed(self, error: SimulationError, observers: list[Observer]) -> SimulationError:
        """The error with when it happened and all that can be said about it."""
        time, origin = self.state.time
        step = int(self.state.step[ORIGIN]) + round((time - origin) / self.stretch.dt)
        saved = "".join(observer.failed(self) for observer in observers)
        return SimulationError(f"stopped at step {step} ({time:g} {self.time_unit}): {self._explain(error)}{saved}")

    def _run_stretches(self, observers: list[Observer], progress: bool | None) -> list[float]:
        """Advance through all stretches; seconds of computing in each."""
        computing: list[float] = []
        durations = self._durations()
        self.stretch = Stretch(SCHEMES["velocity_verlet"], 1.0, 0)  # until there is one, nothing has moved
        time = 0.0  # in whole steps, without the rounding of their sum
        with progress_of(sum(durations), self.time_unit, progress) as advanced:
            for k in range(len(durations)):
                self.stretch = stretch = self._enter(k)
                first = int(self.state.step[NOW])
                if k == 0:
                    self._show(observers, Moment(self, 0, 0.0, 0), [o.interval is not None for o in observers])
                every = [self._every(observer, stretch.dt) for observer in observers]
                seconds, done, shown = 0.0, 0, True
                while done < stretch.steps and not self._interrupted:
                    counts = [self._counted(observer, stretch) + done for observer in observers]
                    ahead = [n - count % n for count, n in zip(counts, every, strict=True) if n]
                    to = min([stretch.steps, *(done + steps for steps in ahead)])
                    began = clock.perf_counter()
                    self.engine.advance(self.state, stretch.row, stretch.dt, first + to)
                    seconds += clock.perf_counter() - began
                    if not self.state.is_finite:
                        raise NotFiniteError(self.state)
                    advanced(stretch.dt * (to - done))
                    done = to
                    last = done == stretch.steps or self._interrupted
                    due = [
                        (n > 0 and (self._counted(observer, stretch) + done) % n == 0) or (last and observer.ends)
                        for observer, n in zip(observers, every, strict=True)
                    ]
                    self._show(observers, Moment(self, first + done, time + done * stretch.dt, k), due)
                    shown = last
                if not shown:  # a signal came while observers looked
                    due = [observer.ends for observer in observers]
                    self._show(observers, Moment(self, first + done, time + done * stretch.dt, k), due)
                computing.append(seconds)
                time += done * stretch.dt
                if self._interrupted:
                    break
        return computing

    @staticmethod
    def _every(observer: Observer, dt: float) -> int:
        """Steps between two looks of an observer; 0 for none but the last."""
        if observer.interval is not None:
            return max(1, round(observer.interval / dt))
        return observer.steps or 0

    @staticmethod
    def _counted(observer: Observer, stretch: Stretch) -> int:
        """Steps before a stretch from which an observer counts: intervals of time may go on from the one before."""
        return stretch.counted if observer.interval is not None else 0

    @staticmethod
    def _show(observers: list[Observer], moment: Moment, due: list[bool]) -> None:
        for observer, now in zip(observers, due, strict=True):
            if now:
                observer.see(moment)

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
