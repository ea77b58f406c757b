"""The one loop of runs, for molecules and single bodies. All steps between two looks of observers are compiled."""

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
from rigidmd.core.process import ONE_AT_A_TIME
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.engines.protocol import Engine, Halted
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
from rigidmd.io.progress import Spot, announce, is_shown, progress_of
from rigidmd.run.checkpoints import PIECE, Keeper, checked_walltime
from rigidmd.run.moment import Moment
from rigidmd.run.observers import Observer
from rigidmd.run.options import AnyOptions, BodyOptions, MolecularOptions
from rigidmd.run.provenance import computed_with, input_digests, provenance
from rigidmd.run.report import write_summary
from rigidmd.run.results import Results
from rigidmd.run.resume import changed_since, fitting, read_as
from rigidmd.run.segments import Agenda, Costs, Place, Stretch
from rigidmd.run.signals import ending_signals, handled, interruptible
from rigidmd.scene import BodyScene, MolecularScene, Scene

if TYPE_CHECKING:
    from rigidmd.engines.body_system import BodySystem
    from rigidmd.engines.system import System
    from rigidmd.run.body import BodySimulation
    from rigidmd.run.molecular import MolecularSimulation

    # A type checker refuses the call of an abstract class, but `Simulation(scene)` makes one of its complete
    # subclasses.
    Base = object
else:
    Base = ABC


def _named(own: Sequence[Observer], of_user: Sequence[Observer]) -> dict[str, Observer]:
    """Observers by the names under which a checkpoint keeps what they remember: class, and number in its class."""
    found: dict[str, Observer] = {}
    for start, observers in (("", own), (USER, of_user)):
        count: Counter[str] = Counter()
        for observer in observers:
            kind = type(observer).__name__
            count[kind] += 1
            found[f"{start}{kind}{f'-{count[kind]}' if count[kind] > 1 else ''}"] = observer
    return found


#: Begins the names of the user's observers.
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
    observers : your own, called between steps: `Every`, `LivePlot`, any `Observer`
    say : called with a sentence before something that takes a moment (compiling, relieving). Default: it is shown where
        progress is
    warn : called with each warning; the summary repeats them. Default: a `RigidMDWarning` of Python's `warnings`
    resume : go on from the last checkpoint in the folder, to the same bits; begin if the folder is empty or absent
    walltime : seconds from now after which the run has to have ended; it stops shortly before, with a checkpoint
    forces : for molecules, forces of your own: see `MolecularSimulation`
    thermostat : for molecules, a thermostat of your own
    applied : for a single body, forces from Python functions: see `BodySimulation`
    """

    state: State

    @overload
    def __new__(
        cls,
        scene: MolecularScene,
        folder: str | Path | None = None,
        force: bool = False,
        **options: Unpack[MolecularOptions],
    ) -> "MolecularSimulation": ...
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
        self,
        scene: Scene,
        folder: str | Path | None = None,
        force: bool = False,
        *,
        observers: Observer | Sequence[Observer] = (),
        say: Callable[[str], object] | None = None,
        warn: Callable[[str], object] = _as_warning,
        resume: bool = False,
        walltime: float | None = None,
    ):
        self.scene = scene
        self.folder = None if folder is None else Path(folder).absolute()  # a callback may change the directory
        self._force = force
        self._observers = [observers] if isinstance(observers, Observer) else list(observers)
        if strange := [one for one in self._observers if not isinstance(one, Observer)]:
            raise TypeError(
                f"{strange[0]!r:.60} is no observer; of a function make one: rigidmd.Every(interval, function)"
            )
        self._own_say = say
        self._progress: bool | None = None
        self._spot = Spot()
        self._warn = warn
        self._warnings: list[str] = []
        self._issued: list[str] = []  # those of this process
        self._interrupted = False
        self._failed_before: list[Observer] = []
        self._error: Exception | None = None  # of an observer
        self._signal: int | None = None
        self._resume = resume
        self._deadline = None if walltime is None else clock.monotonic() + checked_walltime(walltime)
        self._keeper = Keeper(None, False, None)  # before a run
        self._process: int | None = None  # that runs it
        if resume and folder is None:
            raise ValueError("a run without a folder has no checkpoint to resume from")

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._told}>"

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
        """Run all stretches. Raises OutputError before anything is computed, SimulationError if a run has to stop,
        CheckpointError if it cannot be resumed.

        progress : show progress: a bar on a terminal or in a notebook, elsewhere a line every 30 s on standard error;
            default: only in notebooks
        """
        scene_file = Path(self.scene.source)
        inputs = [*self.scene.inputs.values(), *([scene_file] if scene_file.is_file() else [])]
        if self._process is not None:
            raise RuntimeError("this simulation is running already; its own observers cannot run it again")
        with contextlib.ExitStack() as stack:
            kept, stays = None, False
            self._progress, self._spot, self._process = progress, Spot(), os.getpid()
            stack.callback(setattr, self, "_process", None)
            if self.folder is not None:
                stack.callback(self._if_not_forked, (lock := FolderLock(self.folder)).release)
                lock.take()
                if self._resume:
                    kept, stays = self._kept()
                if not stays:
                    check_folder(self.folder, self._force, inputs)
            self._interrupted, self._signal, self._out_of_time = False, None, False
            self._failed_before, self._error = [], None
            scene = cast(MolecularScene | BodyScene, self.scene)
            self._keeper = Keeper(self.folder, scene.output.checkpoint_minutes, self._deadline)
            if hasattr(signal, "SIGUSR1"):
                stack.enter_context(handled(self.ask_for_checkpoint, signal.SIGUSR1))
            self._warnings.clear()
            self._issued.clear()
            self._inputs = input_digests(self.scene)
            self._reset()
            began = clock.perf_counter()
            place, changed = None, None
            if kept is not None:
                with fitting(self.folder):
                    self._recall(kept)
                    place = self._place_of(kept)
                    changed = changed_since(kept.told["with"])
            named = _named(self._own_observers(), self._observers)
            observers = list(named.values())
            names = [name for observer in observers for name in observer.files()]
            names += [SUMMARY, *([CHECKPOINT, PREVIOUS] if self._keeper.keeps else [])]
            if self.folder is not None:
                if stays:
                    check_names(self.folder, names)
                else:
                    check_folder(self.folder, self._force, inputs, names)
            if kept is None:
                with interruptible(), ONE_AT_A_TIME:  # of several runs one compiles, and the others read what it made
                    self._prepare()
            prepared = clock.perf_counter() - began
            for observer in observers:
                stack.push(partial(self._close, observer))
            if kept is not None:  # first all that may refuse it, then the first change of a file
                with fitting(self.folder):
                    for name, observer in named.items():
                        if name.startswith(USER) and name not in kept.told["of"]:
                            observer.begin(self)
                        else:
                            observer.resume(self, kept.of(name))
                if changed is not None:
                    self.note(changed)
                self._say(f"continuing from step {self.state.step[NOW]}")
            if self.folder is not None:
                if stays:
                    continue_folder(self.folder, names)
                else:
                    make_folder(self.folder, self._force, names, inputs, lock)
            stack.enter_context(handled(self._stop_at_next_look, *ending_signals()))
            for observer in observers:
                if kept is None:
                    observer.begin(self)
                else:
                    observer.cut()
            try:
                began = clock.perf_counter()
                computing = self._run_stretches(named, progress, place)
                return self._finished(observers, Costs(prepared, clock.perf_counter() - began, computing))
            except (SimulationError, OutputError) as error:
                self._check_process()
                raise self._failed(error, observers) from None
            except Exception as error:  # of a force, or of an observer, after which all files are complete
                if error is not self._error and os.getpid() == self._process:
                    for observer in observers:
                        with contextlib.suppress(Exception):  # the first error is the one to report
                            observer.failed(self)
                raise

    def _if_not_forked(self, function: Callable[[], object]) -> None:
        """Call a function unless this is a forked process: files, their buffers and locks are those of the first."""
        if os.getpid() == self._process:
            function()

    def _close(self, observer: Observer, kind: Any, error: BaseException | None, trace: Any) -> None:
        """Close the files of an observer; an error before is the one to report."""
        with contextlib.suppress(*([] if error is None else [OutputError])):
            self._if_not_forked(observer.close)

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise OutputError(
                "a forked process cannot continue the run: its files are those of the process that began it"
            )

    def _finished(self, observers: list[Observer], costs: Costs) -> Results:
        """The results, with all files written. Raises OutputError."""
        results = Results(self.system, self.state, self._samples())
        results.interrupted, results.signal = self._interrupted, self._signal
        results.out_of_time = self._out_of_time
        results.summary = provenance(self.scene, self.threads, self._inputs, self.made_by) | self._summary(
            results.samples, costs
        )
        noted = len(self._warnings)
        for draws in (False, True):  # results first, pictures after
            for observer in observers:
                if observer.draws == draws:
                    self._let(observer, observer.end, self, results)
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

    # Implemented for molecules and for bodies.

    system: "System | BodySystem"
    engine: Engine
    threads: int
    stretch: Stretch  # the present one
    time_unit = ""
    made_by = "rigidmd"  # what moves the bodies

    @abstractmethod
    def introduction(self) -> str:
        """A few lines for the start of a run."""

    @abstractmethod
    def conclusion(self, results: Results) -> str:
        """The summary as text, without the notes that the run has printed."""

    @abstractmethod
    def _reset(self) -> None:
        """Return to the start, so that repeated runs are identical: sets `engine` and `state`."""

    @abstractmethod
    def _prepare(self) -> None:
        """Do everything before the first step, including compilation."""

    @abstractmethod
    def _durations(self) -> list[float]:
        """Durations of the stretches, ps or s; 0 of those without steps."""

    @abstractmethod
    def _enter(self, k: int) -> Stretch:
        """Prepare stretch k and return it."""

    @abstractmethod
    def _reenter(self, k: int) -> Stretch:
        """Return stretch k again, in which the run goes on."""

    @abstractmethod
    def _memory(self) -> dict[str, Any]:
        """What `_recall` needs besides the state and the engine's memory, as JSON has it."""

    @abstractmethod
    def _recall(self, kept: Checkpoint) -> None:
        """Return to a checkpoint, in place of `_prepare`. Raises CheckpointError if it is of another scene, and
        ValueError if it is none that a run writes."""

    def _place_of(self, kept: Checkpoint) -> Place:
        """The place of a checkpoint. What follows from the scene and the state must be so. Raises ValueError."""
        place, state = read_as(Place, kept.told["place"]), self.state
        if place.stretch >= len(self._durations()) or len(place.computing) != place.stretch:
            raise ValueError(f"it is of stage {place.stretch} of {len(self._durations())}")
        first, time = 0, 0.0
        for k in range(place.stretch):
            before = self._reenter(k)
            first, time = first + before.steps, time + before.steps * before.dt
        stretch = self._reenter(place.stretch)
        step, done = state.step.tolist(), int(state.step[NOW]) - first
        if place.first != first or step[ORIGIN] != first or not 0 <= done <= stretch.steps:
            raise ValueError(f"step {step[NOW]} is not in a stage of {stretch.steps} steps after {place.first}")
        now, origin = state.time.tolist()
        if not (isclose(origin, time, abs_tol=1e-6 * stretch.dt) and place.time == time):
            raise ValueError(f"its stage began at {origin:g} {self.time_unit}, not at {time:g} {self.time_unit}")
        if now != origin + done * stretch.dt:
            raise ValueError(f"step {step[NOW]} is not at {now:g} {self.time_unit}")
        return place

    def _is_replaced(self, moment: Moment) -> bool:
        """Whether the present moment is followed by another one of the same time."""
        return False

    def _is_finite(self) -> bool:
        """Whether all variables of the state are finite."""
        return self.state.is_finite

    @abstractmethod
    def _look(self, moment: Moment) -> Any:
        """The observation at a moment, in internal units; observers see its `reading` if it has one."""

    @abstractmethod
    def _own_observers(self) -> list[Observer]:
        """The observers that sample, check and write."""

    @abstractmethod
    def _samples(self) -> Any:
        """The samples of the run."""

    @abstractmethod
    def _summary(self, samples: Any, costs: Costs) -> dict[str, Any]:
        """The summary."""

    @abstractmethod
    def _explain(self, error: SimulationError) -> str:
        """An error in full: what was seen, the likely cause, what to try."""

    @abstractmethod
    def write_scene(self, folder: Path) -> None:
        """Write the scene as it runs, with copies of the files that it reads."""

    def _say(self, sentence: str) -> None:
        """Announce something that takes a moment."""
        if self._own_say is not None:
            self._own_say(sentence)
        elif is_shown(self._progress):
            announce(sentence, self._spot)

    def note(self, warning: str) -> None:
        """Issue a warning; the summary repeats it."""
        self._warnings.append(warning)
        self._issued.append(warning)
        self._warn(warning)

    @property
    def notes(self) -> list[str]:
        """The warnings so far."""
        return list(self._warnings)

    @np.errstate(over="ignore", invalid="ignore")
    def _failed(self, error: SimulationError | OutputError, observers: list[Observer]) -> RigidMDError:
        """The error with its step, time and explanation."""
        time, origin = self.state.time
        step = int(self.state.step[ORIGIN]) + round((time - origin) / self.stretch.dt)
        where = f"stopped at step {step} ({time:g} {self.time_unit}): "
        if isinstance(error, OutputError):
            return OutputError(f"{where}{error}{self._last_chance()}")
        saved = "".join(observer.failed(self) for observer in observers)
        return SimulationError(f"{where}{self._explain(error)}{saved}")

    def _last_chance(self) -> str:
        """What a run that could not write can be resumed from."""
        kept = [name for name in (CHECKPOINT, PREVIOUS) if self.folder is not None and self.path(name).is_file()]
        return f". Make room and go on from the last checkpoint: rigidmd resume {self.folder}" if kept else ""

    def _kept(self) -> tuple[Checkpoint | None, bool]:
        """The checkpoint to go on from, None if the run has to begin, and whether the files of the folder stay."""
        folder = cast(Path, self.folder)
        if is_empty(folder) or never_began(folder):
            self._say(f"{folder} holds no run yet: beginning it")
            return None, not is_empty(folder)
        kept, faults = latest(folder)
        for fault in faults:
            self._warn(f"{fault}. The checkpoint before it is used")
        return kept, True

    def _checkpoint(self, observers: Mapping[str, Observer], place: Place) -> None:
        """Write a checkpoint of a place, if the run keeps any and arrays can hold all that there is."""
        if not self._keeper.keeps or self._error is not None or (memory := self.engine.memory()) is None:
            return  # a run that resumes after an error calls the observer again
        of, arrays = {}, {}
        for owner, observer in observers.items():
            of[owner], own = observer.memory()
            arrays |= {f"{owner}/{name}": array for name, array in own.items()}
        arrays |= {f"state/{name}": array for name, array in self.state._asdict().items()}
        arrays |= {f"engine/{name}": array for name, array in memory.items()}
        told = {"with": computed_with(), "place": place._asdict(), "run": self._memory(), "of": of}
        self._keeper.keep(Checkpoint(told, arrays), (place.stretch, int(self.state.step[NOW]), place.seconds > 0))

    def _run_stretches(
        self, named: Mapping[str, Observer], progress: bool | None, begun: Place | None = None
    ) -> Sequence[float]:
        """Advance through all stretches, from the place of a checkpoint on; seconds of computing in each."""
        place, observers = begun or Place(), list(named.values())
        durations = self._durations()
        self.stretch = Stretch(SCHEMES["velocity_verlet"], 1.0, 0)  # before the first stretch
        whole = sum(durations)
        with progress_of(whole, self.time_unit, progress if whole > 0 else False, self._spot) as bar:
            for k in range(place.stretch, len(durations)):
                if resumed := begun is not None and k == begun.stretch:
                    self.stretch = stretch = self._reenter(k)
                    done = int(self.state.step[NOW]) - place.first
                    bar.skip(place.time + done * stretch.dt)
                else:
                    self.stretch = stretch = self._enter(k)
                    place = place._replace(stretch=k, first=int(self.state.step[NOW]), seconds=0.0)
                    done = 0
                if k == 0 and not resumed:
                    self._show(observers, Moment(self, 0, 0.0, 0), [o.interval is not None for o in observers])
                    self._checkpoint(named, place)
                agenda = Agenda(observers, stretch)
                if stretch.act is not None:
                    began = clock.perf_counter()
                    stretch.act(progress)
                    place = place._replace(seconds=clock.perf_counter() - began)
                    due = [observer.interval is not None or observer.ends for observer in observers]
                    self._show(observers, Moment(self, place.first, place.time, k), due)
                shown, pace = None, inf
                bar.unpause()
                while done < stretch.steps and not self._interrupted:
                    to = agenda.next_look(done)
                    if pace > 0:
                        to = min(to, done + max(1, int(PIECE / pace)))  # the first step alone: it may take long
                    before, shown = shown, agenda.due(to)
                    looked = agenda.reads_energies(shown)
                    began = clock.perf_counter()
                    try:
                        self.engine.advance(self.state, stretch.row, stretch.dt, place.first + to, looked)
                    except Halted:
                        shown = before
                        break
                    seconds = clock.perf_counter() - began
                    pace = seconds / (to - done)
                    place = place._replace(seconds=place.seconds + seconds)
                    if not self._is_finite():
                        raise NotFiniteError(self.state)
                    advance, done = stretch.dt * (to - done), to
                    self._show(observers, self._moment(place, done), shown)
                    bar.update(advance)
                    if not self._must_end() and done < stretch.steps and self._keeper.is_due:
                        self._checkpoint(named, place)
                if not (stretch.act is not None and self._interrupted):
                    self._checkpoint(named, place)
                if done < stretch.steps and shown is not None:  # looks that a run without a stop does not have
                    due = [observer.ends and not seen for observer, seen in zip(observers, shown, strict=True)]
                    self._show(observers, self._moment(place, done), due)
                place = place._replace(time=place.time + done * stretch.dt, computing=(*place.computing, place.seconds))
                if self._interrupted:
                    break
        return place.computing

    def _moment(self, place: Place, done: int) -> Moment:
        """The moment after so many steps of the present stretch."""
        return Moment(self, place.first + done, place.time + done * self.stretch.dt, place.stretch)

    def _show(self, observers: list[Observer], moment: Moment, due: list[bool]) -> None:
        for observer, now in zip(observers, due, strict=True):
            if now and not (observer.once and self._is_replaced(moment)):
                self._let(observer, observer.see, moment)
        self._check_process()

    def _let(self, observer: Observer, act: Callable[..., None], *given: Any) -> None:
        """Let an observer act, unless it has failed before. Its error ends the run, which raises it when all files are
        complete; an error of a picture is noted and ends nothing. Raises errors of this package but at the end."""
        if observer in self._failed_before:
            return
        try:
            act(*given)
        except Exception as error:  # a user's observer may raise anything
            if isinstance(error, RigidMDError) and act == observer.see:
                raise
            self._failed_before.append(observer)
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            if observer.draws:
                self.note(f"{', '.join(observer.files()) or type(observer).__name__} cannot be drawn: {reason}")
                return
            self.note(f"{type(observer).__name__} failed at {self.state.time[NOW]:g} {self.time_unit}: {reason}")
            self._interrupted, self._error = True, self._error or error

    def _must_end(self) -> bool:
        """Whether the run has been asked to end, or its time is up."""
        if not self._interrupted and self._keeper.time_is_up:
            self._interrupted = self._out_of_time = True
        return self._interrupted

    def ask_for_checkpoint(self, number: int | None = None) -> None:
        """Write a checkpoint at the next look. number : of the signal that asks for it"""
        self._keeper.asked = True

    def _stop_at_next_look(self, number: int) -> None:
        """End the run at the next look with everything saved; a second Ctrl-C ends it at once."""
        if self._interrupted and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.stop(number)

    def stop(self, number: int | None = None) -> None:
        """End the run at its next look, with everything saved. number : of the signal that asks for it

        An observer may call it, and any thread.
        """
        self._signal = self._signal or number
        self._interrupted = True

    def take_threads(self, count: int) -> None:
        """Let runs compute with so many threads. Results do not depend on it; a single body always takes one."""
