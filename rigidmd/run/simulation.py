"""The loop of all runs, of molecules and single bodies: steps are compiled, observers are called between them."""

import contextlib
import os
import signal
import sys
import time as clock
import warnings
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from math import inf, isclose
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack, cast, overload

import numpy as np

from rigidmd.core.display import Displayed
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.process import PROCESS_LOCK
from rigidmd.core.state import NOW, ORIGIN, STORED_NAMES, State
from rigidmd.engines.protocol import Engine, Halted, NotFiniteError
from rigidmd.errors import OutputError, RigidMDError, RigidMDWarning, SimulationError
from rigidmd.io.checkpoint import Checkpoint, latest
from rigidmd.io.folder import (
    CHECKPOINT,
    PREVIOUS,
    SUMMARY,
    FolderLock,
    check_folder,
    check_names,
    continue_folder,
    is_empty,
    make_folder,
    never_began,
)
from rigidmd.io.progress import DisplayArea, announce, is_shown, progress_of
from rigidmd.io.scene_file import write_scene
from rigidmd.run.checkpoints import SEGMENT_SECONDS, CheckpointSchedule, checked_walltime
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.options import AnyOptions, BodyOptions, MolecularOptions
from rigidmd.run.provenance import computed_with, input_digests, provenance
from rigidmd.run.report import write_summary
from rigidmd.run.results import Results
from rigidmd.run.resume import as_checkpoint_errors, describe_changes
from rigidmd.run.segments import ObservationSchedule, RunPosition, RunTimes, Segment
from rigidmd.run.signals import interruptible, signal_handler, stop_signals
from rigidmd.scene import BodyScene, MolecularScene, Scene

if TYPE_CHECKING:
    from rigidmd.engines.body_system import BodySystem
    from rigidmd.engines.system import System
    from rigidmd.run.body import BodySimulation
    from rigidmd.run.molecular import MolecularSimulation

    # Type checkers refuse the call of an abstract class, but `Simulation(scene)` makes one of its subclasses.
    Base = object
else:
    Base = ABC


def _observers_by_name(default: Sequence[Observer], user: Sequence[Observer]) -> dict[str, Observer]:
    """Observers by the names under which a checkpoint has their data: class, and number in its class."""
    found: dict[str, Observer] = {}
    for start, observers in (("", default), (USER, user)):
        count: Counter[str] = Counter()
        for observer in observers:
            kind = type(observer).__name__
            count[kind] += 1
            found[f"{start}{kind}{f'-{count[kind]}' if count[kind] > 1 else ''}"] = observer
    return found


#: Prefix of the names of user observers.
USER = "user-"


def _as_warning(sentence: str) -> None:
    """Issue a Python warning that names the calling line outside this package."""
    package, level, frame = str(Path(__file__).parent.parent), 1, sys._getframe()
    while frame is not None and frame.f_code.co_filename.startswith(package):
        level, frame = level + 1, frame.f_back
    warnings.warn(sentence, RigidMDWarning, stacklevel=level)


class Simulation(Displayed, Base):
    """A scene, ready to run. The call returns a `MolecularSimulation` or a `BodySimulation`, according to the scene.

    Parameters
    ----------
    scene : the scene
    folder : folder for the files; None writes nothing and keeps the frames in memory
    force : replace an earlier run in that folder
    observers : user-defined, called between steps: `Every`, `LivePlot`, any `Observer`
    `say` : called with a sentence before something slow (compiling, pilot runs). Default: printed with the progress
    warn : called with each warning; the summary repeats them. Default: a `RigidMDWarning` of Python's `warnings`
    resume : continue from the last checkpoint in the folder, to the same bits; begin if the folder is empty or absent
    walltime : seconds from now until the run has to have ended; it stops shortly before, with a checkpoint
    forces : for molecules, user-defined forces: see `MolecularSimulation`
    thermostat : for molecules, a user-defined thermostat
    applied : for a single body, forces from Python functions: see `BodySimulation`
    """

    state: State

    @overload
    def __new__(
        cls, scene: MolecularScene, folder: str | Path | None = None, force: bool = False,
        **options: Unpack[MolecularOptions],
    ) -> "MolecularSimulation": ...  # fmt: skip
    @overload
    def __new__(
        cls, scene: BodyScene, folder: str | Path | None = None, force: bool = False, **options: Unpack[BodyOptions]
    ) -> "BodySimulation": ...
    @overload
    def __new__(
        cls, scene: Scene, folder: str | Path | None = None, force: bool = False, **options: Unpack[AnyOptions]
    ) -> "MolecularSimulation | BodySimulation": ...
    def __new__(cls, scene: Scene, *arguments: Any, **options: Any) -> Any:
        if cls is not Simulation:
            return super().__new__(cls)
        from rigidmd.run import BodySimulation, MolecularSimulation

        return object.__new__(BodySimulation if isinstance(scene, BodyScene) else MolecularSimulation)

    def __init__(
        self, scene: Scene, folder: str | Path | None = None, force: bool = False, *,
        observers: Observer | Sequence[Observer] = (), say: Callable[[str], object] | None = None,
        warn: Callable[[str], object] = _as_warning, resume: bool = False, walltime: float | None = None,
    ):  # fmt: skip
        self.scene = scene
        self.folder = None if folder is None else Path(folder).absolute()  # a callback may change the directory
        self._force = force
        self._observers = [observers] if isinstance(observers, Observer) else list(observers)
        if wrong := [value for value in self._observers if not isinstance(value, Observer)]:
            raise TypeError(
                f"{wrong[0]!r:.60} is not an observer; rigidmd.Every(interval, function) makes one of a function"
            )
        self._user_say = say
        self._progress: bool | None = None
        self._spot = DisplayArea()
        self._warn = warn
        self._warnings: list[str] = []
        self._issued: list[str] = []  # by this process
        self._interrupted = False
        self._failed_before: list[Observer] = []
        self._error: Exception | None = None  # of an observer
        self._signal: int | None = None
        self._resume = resume
        self._deadline = None if walltime is None else clock.monotonic() + checked_walltime(walltime)
        self._checkpoints = CheckpointSchedule(None, False, None)  # replaced at the start of a run
        self._process: int | None = None  # its number, during a run
        if resume and folder is None:
            raise ValueError("a run without a folder has no checkpoint to resume from")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._summary_line}>"

    def path(self, file: str) -> Path:
        """Path of a file in the folder of the run. Raises ValueError without a folder."""
        if self.folder is None:
            raise ValueError(f"this run has no folder for {file}")
        return self.folder / file

    @property
    def _summary_line(self) -> str:
        where = "results stay in memory" if self.folder is None else f"writes to {self.folder}"
        return f"{self._headline}; {where}"

    def run(self, progress: bool | None = None) -> Results:
        """Run all segments. Raises OutputError (before computing), SimulationError if it fails, CheckpointError.

        progress : whether to show progress, by a bar or, if not on a terminal, lines every 30 s; default: in notebooks
        """
        scene_file = Path(self.scene.source)
        inputs = [*self.scene.inputs.values(), *([scene_file] if scene_file.is_file() else [])]
        if self._process is not None:
            raise RuntimeError("this simulation is running already; its observers cannot run it again")
        with contextlib.ExitStack() as stack:
            kept, stays = None, False
            self._progress, self._spot, self._process = progress, DisplayArea(), os.getpid()
            stack.callback(setattr, self, "_process", None)
            if self.folder is not None:
                stack.callback(self._if_not_forked, (lock := FolderLock(self.folder)).release)
                lock.take()
                if self._resume:
                    kept, stays = self._read_checkpoint()
                if not stays:
                    check_folder(self.folder, self._force, inputs)
            self._interrupted, self._signal, self._out_of_time = False, None, False
            self._failed_before, self._error = [], None
            scene = cast(MolecularScene | BodyScene, self.scene)
            self._checkpoints = CheckpointSchedule(self.folder, scene.output.checkpoint_minutes, self._deadline)
            if hasattr(signal, "SIGUSR1"):
                stack.enter_context(signal_handler(self.ask_for_checkpoint, signal.SIGUSR1))
            self._warnings.clear()
            self._issued.clear()
            self._inputs = input_digests(self.scene)
            self._reset()
            began = clock.perf_counter()
            position, changed = None, None
            if kept is not None:
                with as_checkpoint_errors(self.folder):
                    self._restore(kept)
                    position = self._checked_position(kept)
                    changed = describe_changes(kept.values["with"])
            named = _observers_by_name(self._default_observers(), self._observers)
            observers = list(named.values())
            names = [name for observer in observers for name in observer.files()]
            names += [SUMMARY, *([CHECKPOINT, PREVIOUS] if self._checkpoints.writes else [])]
            if self.folder is not None:
                if stays:
                    check_names(self.folder, names)
                else:
                    check_folder(self.folder, self._force, inputs, names)
            if kept is None:
                with interruptible(), PROCESS_LOCK:  # of several runs one compiles, and the others read its cache
                    self._prepare()
            prepared = clock.perf_counter() - began
            for observer in observers:
                stack.push(partial(self._close, observer))
            if kept is not None:  # all checks come before the first change of a file
                with as_checkpoint_errors(self.folder):
                    for name, observer in named.items():
                        if name.startswith(USER) and name not in kept.values["of"]:
                            observer.begin(self)
                        else:
                            observer.resume(self, kept.of(name))
                if changed is not None:
                    self.note(changed)
                self._announce(f"continuing from step {self.state.step[NOW]}")
            if self.folder is not None:
                if stays:
                    continue_folder(self.folder, names)
                else:
                    make_folder(self.folder, self._force, names, inputs, lock)
            stack.enter_context(signal_handler(self._stop_at_next_observation, *stop_signals()))
            for observer in observers:
                if kept is None:
                    observer.begin(self)
                else:
                    observer.cut()
            try:
                began = clock.perf_counter()
                computing = self._run_segments(named, progress, position)
                return self._finish(observers, RunTimes(prepared, clock.perf_counter() - began, computing))
            except (SimulationError, OutputError) as error:
                self._check_process()
                raise self._failed(error, observers) from None
            except Exception as error:  # of a user force, or of an observer, after which all files are complete
                if error is not self._error and os.getpid() == self._process:
                    for observer in observers:
                        with contextlib.suppress(Exception):  # the first error is the one to report
                            observer.failed(self)
                raise

    def _if_not_forked(self, function: Callable[[], object]) -> None:
        """Call a function unless this is a forked process: files and locks belong to the process that was forked."""
        if os.getpid() == self._process:
            function()

    def _close(self, observer: Observer, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Close the files of an observer; of two errors the earlier one is reported."""
        with contextlib.suppress(*([] if error is None else [OutputError])):
            self._if_not_forked(observer.close)

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise OutputError("a forked process cannot continue the run: the files belong to the process that began it")

    def _finish(self, observers: list[Observer], times: RunTimes) -> Results:
        """The results, with all files written. Raises OutputError."""
        results = Results(self.system, self.state, self._samples())
        results.interrupted, results.signal = self._interrupted, self._signal
        results.out_of_time = self._out_of_time
        results.summary = provenance(self.scene, self.threads, self._inputs, self.engine_version) | self._summary(
            results.samples, times
        )
        noted = len(self._warnings)
        for draws in (False, True):  # results first, pictures after
            for observer in observers:
                if observer.draws == draws:
                    self._call_observer(observer, observer.end, self, results)
            files = [*results.files, *([self.path(SUMMARY)] if self.folder is not None else [])]
            results.summary["notes"] += self._warnings[noted:]
            noted = len(self._warnings)
            if self.folder is not None:
                results.summary["files"] = [str(path) for path in files]
                write_summary(self.path(SUMMARY), results.summary)
        results.files = files
        if self._error is not None:
            raise self._error
        return results

    def introduction(self) -> str:
        """A few lines for the start of a run."""
        return "\n".join([self._headline, *(f"  {note}" for note in self.system.notes)])

    def conclusion(self, results: Results) -> str:
        """The summary as text, without the notes of the introduction and the warnings that were issued."""
        return self._summary_text(results.summary, [*self.system.notes, *self._issued])

    def write_scene(self, folder: Path) -> None:
        """Write the scene as it runs, with copies of the files that it reads."""
        write_scene(folder, self.scene)

    # Implemented for molecules and for bodies.

    system: "System | BodySystem"
    engine: Engine
    threads: int
    segment: Segment  # the present one
    time_unit = ""
    engine_version = "rigidmd"

    _summary_text: Callable[[dict, list[str]], str]  # the summary as text, without these notes

    @property
    @abstractmethod
    def _headline(self) -> str:
        """The first line of the introduction."""

    @abstractmethod
    def _reset(self) -> None:
        """Return to the start, so that repeated runs are identical: sets `engine` and `state`."""

    @abstractmethod
    def _prepare(self) -> None:
        """Do everything before the first step, including compilation."""

    @abstractmethod
    def _durations(self) -> list[float]:
        """Durations of the segments, ps or s; 0 without steps."""

    @abstractmethod
    def _enter_segment(self, k: int) -> Segment:
        """Prepare segment k and return it."""

    @abstractmethod
    def _reenter_segment(self, k: int) -> Segment:
        """Return segment k, in which the run is resumed."""

    @abstractmethod
    def _resume_json(self) -> dict[str, Any]:
        """The data that `_restore` needs besides the state and the engine's memory, as JSON values."""

    @abstractmethod
    def _restore(self, kept: Checkpoint) -> None:
        """Return to a checkpoint. Raises CheckpointError if it is of another scene, ValueError if it is invalid."""

    def _checked_position(self, kept: Checkpoint) -> RunPosition:
        """The position of a checkpoint, compared with the scene and the state. Raises ValueError."""
        position, state = RunPosition.from_json(kept.values["place"]), self.state
        if position.segment >= len(self._durations()) or len(position.computing) != position.segment:
            raise ValueError(f"it is of stage {position.segment} of {len(self._durations())}")
        first, time = 0, 0.0
        for k in range(position.segment):
            before = self._reenter_segment(k)
            first, time = first + before.steps, time + before.steps * before.dt
        segment = self._reenter_segment(position.segment)
        step, done = state.step.tolist(), int(state.step[NOW]) - first
        if position.first != first or step[ORIGIN] != first or not 0 <= done <= segment.steps:
            raise ValueError(f"step {step[NOW]} is not in a stage of {segment.steps} steps after {position.first}")
        now, origin = state.time.tolist()
        if not (isclose(origin, time, abs_tol=1e-6 * segment.dt) and position.time == time):
            raise ValueError(f"its stage began at {origin:g} {self.time_unit}, not at {time:g} {self.time_unit}")
        if now != origin + done * segment.dt:
            raise ValueError(f"step {step[NOW]} is not at {now:g} {self.time_unit}")
        return position

    def _is_replaced(self, moment: Moment) -> bool:
        """Whether the present moment is followed by another one of the same time."""
        return False

    def _is_finite(self) -> bool:
        """Whether all variables of the state are finite."""
        return self.state.is_finite

    @abstractmethod
    def _observe(self, moment: Moment) -> Any:
        """The observation at a moment; `Moment.observation` keeps it."""

    @abstractmethod
    def _default_observers(self) -> list[Observer]:
        """The observers that sample, check and write."""

    @abstractmethod
    def _samples(self) -> Any:
        """The samples of the run."""

    @abstractmethod
    def _summary(self, samples: Any, times: RunTimes) -> dict[str, Any]:
        """The summary."""

    @abstractmethod
    def _explain(self, error: SimulationError) -> str:
        """An error in full: what was seen, the likely cause, what to try."""

    def _announce(self, sentence: str) -> None:
        """Print a sentence before something slow."""
        if self._user_say is not None:
            self._user_say(sentence)
        elif is_shown(self._progress):
            announce(sentence, self._spot)

    def note(self, warning: str) -> None:
        """Issue a warning; the summary repeats it."""
        self._warnings.append(warning)
        self._issued.append(warning)
        self._warn(warning)

    @property
    def notes(self) -> list[str]:
        return list(self._warnings)

    @np.errstate(over="ignore", invalid="ignore")
    def _failed(self, error: SimulationError | OutputError, observers: list[Observer]) -> RigidMDError:
        """The error with its step, time and explanation."""
        time, origin = self.state.time
        step = int(self.state.step[ORIGIN]) + round((time - origin) / self.segment.dt)
        where = f"stopped at step {step} ({time:g} {self.time_unit}): "
        if isinstance(error, OutputError):
            return OutputError(f"{where}{error}{self._describe_resume()}")
        saved = "".join(observer.failed(self) for observer in observers)
        return SimulationError(f"{where}{self._explain(error)}{saved}")

    def _describe_resume(self) -> str:
        """How to resume a run that could not write, if it has a checkpoint."""
        kept = [name for name in (CHECKPOINT, PREVIOUS) if self.folder is not None and self.path(name).is_file()]
        return f". Free disk space and resume from the last checkpoint: rigidmd resume {self.folder}" if kept else ""

    def _read_checkpoint(self) -> tuple[Checkpoint | None, bool]:
        """The checkpoint to resume from, None if the run has to begin, and whether the files of the folder stay."""
        folder = cast(Path, self.folder)
        if is_empty(folder) or never_began(folder):
            self._announce(f"{folder} holds no run yet: beginning it")
            return None, not is_empty(folder)
        kept, problems = latest(folder)
        for problem in problems:
            self._warn(f"{problem}. The checkpoint before it is used")
        return kept, True

    def _checkpoint(self, observers: Mapping[str, Observer], position: RunPosition) -> None:
        """Write a checkpoint of a position, if the run has checkpoints and its engine can give its memory as arrays."""
        if not self._checkpoints.writes or self._error is not None or (memory := self.engine.memory()) is None:
            return  # after an error a run that resumes calls the observer again
        of, arrays = {}, {}
        for owner, observer in observers.items():
            of[owner], kept = observer.memory()
            arrays |= {f"{owner}/{name}": array for name, array in kept.items()}
        arrays |= {f"state/{name}": array for name, array in zip(STORED_NAMES, self.state, strict=True)}
        arrays |= {f"engine/{name}": array for name, array in memory.items()}
        data = {"with": computed_with(), "place": position.to_json(), "run": self._resume_json(), "of": of}
        self._checkpoints.write_once(
            Checkpoint(data, arrays), (position.segment, int(self.state.step[NOW]), position.seconds > 0)
        )

    def _run_segments(
        self, named: Mapping[str, Observer], progress: bool | None, begun: RunPosition | None = None
    ) -> Sequence[float]:
        """Advance through all segments, or from the position of a checkpoint on; seconds of computing in each."""
        position, observers = begun or RunPosition(), list(named.values())
        durations = self._durations()
        self.segment = Segment(SCHEMES["velocity_verlet"], 1.0, 0)  # before the first segment
        whole = sum(durations)
        with progress_of(whole, self.time_unit, progress if whole > 0 else False, self._spot) as bar:
            for k in range(position.segment, len(durations)):
                if resumed := begun is not None and k == begun.segment:
                    self.segment = segment = self._reenter_segment(k)
                    done = int(self.state.step[NOW]) - position.first
                    bar.skip(position.time + done * segment.dt)
                else:
                    self.segment = segment = self._enter_segment(k)
                    position = position._replace(segment=k, first=int(self.state.step[NOW]), seconds=0.0)
                    done = 0
                if k == 0 and not resumed:
                    self._notify(observers, Moment(self, 0, 0.0, 0), [o.interval is not None for o in observers])
                    self._checkpoint(named, position)
                schedule = ObservationSchedule(observers, segment)
                if segment.action is not None:
                    began = clock.perf_counter()
                    segment.action(progress)
                    position = position._replace(seconds=clock.perf_counter() - began)
                    due = [observer.interval is not None or observer.ends for observer in observers]
                    self._notify(observers, Moment(self, position.first, position.time, k), due)
                shown, pace = None, inf
                bar.unpause()
                while done < segment.steps and not self._interrupted:
                    to = schedule.next_observation(done)
                    if pace > 0:
                        to = min(
                            to, done + max(1, int(SEGMENT_SECONDS / pace))
                        )  # the first step alone, as it may be slow
                    before, shown = shown, schedule.due(to)
                    with_energies = schedule.reads_energies(shown)
                    began = clock.perf_counter()
                    try:
                        self.engine.advance(self.state, segment.method, segment.dt, position.first + to, with_energies)
                    except Halted:
                        shown = before
                        break
                    seconds = clock.perf_counter() - began
                    pace = seconds / (to - done)
                    position = position._replace(seconds=position.seconds + seconds)
                    if not self._is_finite():
                        raise NotFiniteError(self.state)
                    advance, done = segment.dt * (to - done), to
                    self._notify(observers, self._moment(position, done), shown)
                    bar.update(advance)
                    if not self._must_end() and done < segment.steps and self._checkpoints.is_due:
                        self._checkpoint(named, position)
                if not (segment.action is not None and self._interrupted):
                    self._checkpoint(named, position)
                if done < segment.steps and shown is not None:  # only a run that stops here calls these observers
                    due = [observer.ends and not seen for observer, seen in zip(observers, shown, strict=True)]
                    self._notify(observers, self._moment(position, done), due)
                position = position._replace(
                    time=position.time + done * segment.dt, computing=(*position.computing, position.seconds)
                )
                if self._interrupted:
                    break
        return position.computing

    def _moment(self, position: RunPosition, done: int) -> Moment:
        """The moment after `done` steps of the present segment."""
        return Moment(self, position.first + done, position.time + done * self.segment.dt, position.segment)

    def _notify(self, observers: list[Observer], moment: Moment, due: list[bool]) -> None:
        for observer, now in zip(observers, due, strict=True):
            if now and not (observer.once and self._is_replaced(moment)):
                self._call_observer(observer, observer.see, moment)
        self._check_process()

    def _call_observer(self, observer: Observer, method: Callable[..., None], *arguments: Any) -> None:
        """Call a method of an observer, unless the observer has failed before. Its error ends the run, which raises it
        when all files are complete; an error of a figure becomes a note. `see` may raise the errors of this package."""
        if observer in self._failed_before:
            return
        try:
            method(*arguments)
        except Exception as error:  # a user's observer may raise anything
            if isinstance(error, RigidMDError) and method == observer.see:
                raise
            self._failed_before.append(observer)
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            if observer.draws:
                self.note(f"{', '.join(observer.files()) or type(observer).__name__} cannot be drawn: {reason}")
                return
            self.note(f"{type(observer).__name__} failed at {self.state.time[NOW]:g} {self.time_unit}: {reason}")
            self._interrupted, self._error = True, self._error or error

    def _must_end(self) -> bool:
        """Whether the run has to end, by a signal or because its time is up."""
        if not self._interrupted and self._checkpoints.time_is_up:
            self._interrupted = self._out_of_time = True
        return self._interrupted

    def ask_for_checkpoint(self, number: int | None = None) -> None:
        """Write a checkpoint at the next observation. number : of the signal that requests it"""
        self._checkpoints.requested = True

    def _stop_at_next_observation(self, number: int) -> None:
        """End the run at the next observation, with all files; a second Ctrl-C ends it at once."""
        if self._interrupted and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.stop(number)

    def stop(self, number: int | None = None) -> None:
        """End the run at its next observation, with all files. Observers and other threads may call it.

        number : of the signal that requests it
        """
        self._signal = self._signal or number
        self._interrupted = True

    def take_threads(self, count: int) -> None:
        """Set the number of threads. Results do not depend on it; a single body always has one."""
