"""The loop of a run: it starts or resumes, jumps from one observation to the next, and ends with
all files."""

import contextlib
import os
import signal
import time as clock
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.compile.cache import compiling_announced, describe_cache
from rigidmd.core.files import LostFileError, writing
from rigidmd.core.process import PROCESS_LOCK
from rigidmd.core.state import NOW, ORIGIN, State
from rigidmd.engines.protocol import Halted, NotFiniteError
from rigidmd.errors import (
    OutputError,
    RigidMDError,
    SimulationError,
    StoppedError,
    resume_command,
)
from rigidmd.io import folder as run_folder
from rigidmd.io.checkpoint import Checkpoint, latest
from rigidmd.io.folder import CHECKPOINT, PREVIOUS, SUMMARY, FolderLock
from rigidmd.io.progress import progress_of
from rigidmd.io.write import write_json
from rigidmd.run import resume
from rigidmd.run.kind import kind_of
from rigidmd.run.observers import GrowingFile, Moment, Observer
from rigidmd.run.results import Results
from rigidmd.run.schedule import (
    SEGMENT_SECONDS,
    CheckpointSchedule,
    ObservationSchedule,
    checkpoint_signals,
    interruptible,
    signal_handler,
    stop_signals,
)
from rigidmd.scene import is_molecular

if TYPE_CHECKING:
    from rigidmd.run.simulation import Simulation

#: Prefix of the names of user observers in a checkpoint, and the owner of the record of the run.
USER, RECORD = "user-", "run"


def _observers_by_name(
    default: Sequence[Observer], user: Sequence[Observer]
) -> dict[str, Observer]:
    """Observers by the names under which a checkpoint has their data: class, and number in its
    class."""
    observer_of: dict[str, Observer] = {}
    for start, observers in (("", default), (USER, user)):
        count: Counter[str] = Counter()
        for observer in observers:
            kind = type(observer).__name__
            count[kind] += 1
            observer_of[f"{start}{kind}{f'-{count[kind]}' if count[kind] > 1 else ''}"] = observer
    return observer_of


class RunLoop:
    """A run of a simulation, from its starting to its end.

    drive : advances it. The run pauses in between, and then holds its folder and its files
    advanced : steps of the last call of `drive`
    results : of the run, after its end

    What comes next is a method: _open, _begin or _reenter, then for each segment _enter, _prepare,
    _advance from one observation to the next, _leave, and at the end _finish.
    """

    _schedule: ObservationSchedule  # of the current segment

    def __init__(
        self, simulation: "Simulation", *, force: bool, resumes: bool, deadline: float | None
    ):
        self._simulation, self._folder = simulation, simulation.folder
        self._part = simulation._part
        self._force, self._resumes = force, resumes
        self.checkpoints = CheckpointSchedule(
            simulation.folder, simulation.scene.output.checkpoint_minutes, deadline
        )
        self.process = os.getpid()
        self.interrupted, self.out_of_time, self.advanced = False, False, 0
        self.signal: int | None = None
        self.results: Results | None = None
        self.has_begun = False  # whether the files of the folder are those of this run
        self._error: Exception | None = None  # of an observer
        self._failed_before: list[Observer] = []
        self._bar, self._progress = progress_of(0.0, "", shown=False), False
        self._wall = 0.0  # seconds before the time since which it runs
        self._since = clock.perf_counter()
        self._preparing = 0.0  # seconds
        self._observers: dict[str, Observer] = {}
        # The position is what comes next, here, and what checkpoints have of it: the segment in
        # `RunRecord.position`, and the step in the state.
        self._next: Callable[[], None] = self._open
        self._until = 0.0  # the step at which the run pauses
        self._shown: list[bool] | None = None  # observers called after the last steps
        self._pace = inf  # seconds per step
        # locks and files, which remain open while the run pauses
        self._opened = contextlib.ExitStack()
        self.is_running = False  # whether the run advances now: an observer may check
        self.has_ended = False

    def __del__(self) -> None:
        self._opened.close()

    @property
    def is_complete(self) -> bool:
        """Whether all segments have been run."""
        position = self._part.record.position
        steps = int(self._part.state.step[NOW])
        is_last = position.segment + 1 == len(self._part.durations())
        return is_last and steps == position.first + self._part.segment.steps

    def drive(self, steps: float, *, progress: bool | None) -> None:
        """Let the run advance by at most this number of steps, or to its end."""
        self._progress = progress
        with contextlib.ExitStack() as stack:
            stack.enter_context(
                signal_handler(self._simulation._ask_for_checkpoint, *checkpoint_signals())
            )
            if self._next == self._open:
                with self._running(), self._part.lock:
                    self._open()
            part = self._part
            total = sum(self._part.durations())
            before = int(part.state.step[NOW])
            self._until = before + steps
            stack.enter_context(signal_handler(self._stop_by_signal, *stop_signals()))
            self._bar = progress_of(
                total,
                part.scene.time_unit,
                shown=progress if total > 0 else False,
                spot=self._simulation._spot,
            )
            stack.enter_context(self._bar).skip(float(part.state.time[NOW]))
            self._since = clock.perf_counter()
            with self._running():
                self._continue()
            self._wall += clock.perf_counter() - self._since
        if steps < inf and self.signal is not None:
            signal.raise_signal(self.signal)
        self.advanced = int(part.state.step[NOW]) - before

    @contextlib.contextmanager
    def _running(self) -> Iterator[None]:
        """Context in which the run advances. It ends by an error or `_finish`, and then closes its
        files."""
        self.is_running = True
        try:
            with self._opened as opened:
                yield
                if not self.has_ended:
                    self._opened = opened.pop_all()
        except BaseException:
            self.has_ended = True
            raise
        finally:
            self.is_running = False

    def _open(self) -> None:
        """Do everything before the first step: the folder, the checkpoint, compilation. All checks
        come before the first change of a file."""
        simulation, part = self._simulation, self._part
        checkpoint = None
        stays = False
        changed = None
        if self._folder is not None:
            lock = FolderLock(self._folder)
            self._opened.callback(self._if_not_forked, lock.release)
            lock.take()
            if self._resumes:
                checkpoint, stays = self._read_checkpoint(self._folder)
        part.reset()
        began = clock.perf_counter()
        input_sha256 = resume.input_digests(simulation.scene)
        scene = resume.plain(simulation.scene)
        if checkpoint is not None:
            with resume.as_checkpoint_errors(self._folder):
                part.restore_record(checkpoint.of(RECORD))
                part.restore(checkpoint)
                changed = resume.describe_changes(checkpoint.values["with"])
        part.record.scene, part.record.inputs = scene, input_sha256
        self._observers = _observers_by_name(part.default_observers(), simulation._observers)
        names = [name for observer in self._observers.values() for name in observer.files()]
        names += [SUMMARY, *([CHECKPOINT, PREVIOUS] if self.checkpoints.writes else [])]
        if self._folder is not None and stays:
            run_folder.check_names(self._folder, names)
        elif self._folder is not None:
            source = simulation.scene.path(Path(simulation.scene.source).name)
            inputs = [*simulation.scene.inputs.values(), *([source] if source.is_file() else [])]
            run_folder.check_folder(self._folder, force=self._force, inputs=inputs, names=names)
        if checkpoint is None:
            for warning in part.system.warnings:
                simulation._note(warning)
            # of several runs one compiles, and the others read its cache
            with interruptible(), PROCESS_LOCK, compiling_announced(self._announce_compiling):
                part.prepare()
        self._preparing = clock.perf_counter() - began
        for observer in self._observers.values():
            self._opened.push(partial(self._close, observer))
        if checkpoint is not None:
            self._resume_observers(checkpoint)
            if changed is not None:
                simulation._note(changed)
        if self._folder is not None and stays:
            run_folder.add_to_folder(self._folder, names)
            with writing(self._folder):
                (self._folder / SUMMARY).unlink(missing_ok=True)
        elif self._folder is not None:
            run_folder.make_folder(self._folder, names, lock)
        self.has_begun = True
        self._next = self._begin if checkpoint is None else self._reenter

    def _resume_observers(self, checkpoint: Checkpoint) -> None:
        with resume.as_checkpoint_errors(self._folder):
            for name, observer in self._observers.items():
                if name.startswith(USER) and name not in checkpoint.values["of"]:
                    observer.begin(self._simulation)
                else:
                    observer.resume(self._simulation, checkpoint.of(name))

    @property
    def _pauses(self) -> bool:
        """Whether the run waits for the next call of `drive`, by `Simulation.step`, `run` or
        `close`."""
        if self._next == self._advance:
            return int(self._part.state.step[NOW]) >= self._until and not self.interrupted
        waits = self._until < inf and self.signal is None and self._error is None
        return self._next == self._finish and waits

    def _continue(self) -> None:
        """Do what comes next until the run pauses or ends."""
        if self._next in (self._begin, self._reenter):
            self._next()
        try:
            while not (self.has_ended or self._pauses):
                self._next()
        except (SimulationError, OutputError) as error:
            self._check_process()
            raise self._failed(error) from None
        # of a user force, or of an observer, after which all files are complete
        except Exception as error:
            if error is not self._error and os.getpid() == self.process:
                for observer in self._observers.values():
                    with contextlib.suppress(Exception):  # the first error is the one to report
                        observer.failed(self._simulation)
            raise

    def _announce_compiling(self) -> None:
        self._simulation._announce(f"compiling ({describe_cache()})")

    def _if_not_forked(self, function: Callable[[], object]) -> None:
        """Call a function unless this is a forked process: files and locks belong to the process
        that was forked."""
        if os.getpid() == self.process:
            function()

    def _close(
        self, observer: Observer, kind: object, error: BaseException | None, trace: object
    ) -> None:
        """Close the files of an observer; of two errors the earlier one is reported."""
        with contextlib.suppress(*([] if error is None else [OutputError])):
            self._if_not_forked(observer.close)

    def _check_process(self) -> None:
        if os.getpid() != self.process:
            raise OutputError(
                "a forked process cannot continue the run: the files belong to the process that"
                " began it"
            )

    def _finish(self) -> None:
        """Make the results, with all files written. Raises OutputError."""
        simulation = self._simulation
        part = self._part
        notes = self._part.record.notes
        self._note_lost_files()
        results = Results(part.system, part.state, part.samples())
        results.interrupted = self.interrupted
        results.signal = self.signal
        results.out_of_time = self.out_of_time
        wall = self._wall + clock.perf_counter() - self._since
        made_by = resume.provenance(
            simulation.scene, part.threads, part.record.inputs, part.engine_version
        )
        results.summary = made_by | part.summary(results.samples, self._preparing, wall)
        for draws in (False, True):  # results first, pictures after
            noted = len(notes)
            for observer in self._observers.values():
                if observer.draws == draws:
                    self._call_observer(observer, observer.end, simulation, results)
            results.files[:] = [path for path in results.files if path.is_file()]
            files = [*results.files, *([] if self._folder is None else [self._folder / SUMMARY])]
            results.summary["notes"] += notes[noted:]
            if self._folder is not None:
                results.summary["files"] = [str(path) for path in files]
                write_json(
                    files[-1], results.summary, indent=2, ensure_ascii=False, allow_nan=False
                )
        results.files, self.results = files, results
        self.has_ended = True
        if self._error is not None:
            raise self._error

    def _note_lost_files(self) -> None:
        """Note which files another program removed, replaced or changed. The run has no more to
        write to them."""
        for observer in self._observers.values():
            if isinstance(observer, GrowingFile):
                try:
                    observer.check_file()
                except LostFileError as error:
                    self._simulation._note(str(error))

    @np.errstate(over="ignore", invalid="ignore")
    def _failed(self, error: SimulationError | OutputError) -> RigidMDError:
        """The error with its step, time and explanation, and how to resume a run that could not
        write."""
        part = self._part
        time, origin = part.state.time
        step = int(part.state.step[ORIGIN]) + round((time - origin) / part.segment.dt)
        where = f"stopped at step {step} ({time:g} {part.scene.time_unit}): "
        if isinstance(error, OutputError):
            if isinstance(error, LostFileError):
                with contextlib.suppress(OutputError):
                    return StoppedError(
                        f"{where}{error}. The run cannot continue it{self._last_words()}"
                    )
            advice = ""
            if self._folder is not None and any(
                (self._folder / name).is_file() for name in (CHECKPOINT, PREVIOUS)
            ):
                resume = resume_command(self._folder)
                advice = f". Free disk space, then {resume} continues from the last checkpoint"
            return StoppedError(f"{where}{error}{advice}")
        return SimulationError(f"{where}{part.explain(error)}{self._last_words()}")

    def _last_words(self) -> str:
        """What observers save of a run that fails, as the end of a message."""
        return "".join(observer.failed(self._simulation) for observer in self._observers.values())

    def _read_checkpoint(self, folder: Path) -> tuple[Checkpoint | None, bool]:
        """The checkpoint to resume from, None if the run has to start, and whether the files of the
        folder stay."""
        samples_file = kind_of(self._simulation.scene).samples_file
        if run_folder.is_empty(folder) or run_folder.never_began(folder, samples_file):
            self._simulation._announce(f"{folder} holds no run yet: beginning it")
            return None, not run_folder.is_empty(folder)
        for path in folder.iterdir():
            run_folder.check_inside(path)
        checkpoint, problems = latest(folder)
        for problem in problems:
            self._simulation._warn(f"{problem}. The checkpoint before it is used")
        return checkpoint, True

    def _checkpoint(self) -> None:
        """Write a checkpoint, if the run has checkpoints and its engine can give its memory as
        arrays."""
        part = self._part
        record = self._part.record
        if (
            not self.checkpoints.writes
            or self._error is not None
            or (memory := part.engine.memory()) is None
        ):
            return  # after an error a run that resumes calls the observer again
        try:
            parts = {name: observer.memory() for name, observer in self._observers.items()}
        except LostFileError:
            if self.is_complete or self.interrupted:
                return  # the run ends with its other files, and notes this
            raise
        parts |= {
            RECORD: resume.stored(record, record.types()),
            "engine": Checkpoint({}, memory),
            "state": Checkpoint({}, dict(zip(State._fields, part.state, strict=True))),
        }
        arrays = {
            f"{owner}/{name}": array
            for owner, part_of_owner in parts.items()
            for name, array in part_of_owner.arrays.items()
        }
        data = {
            "with": resume.computed_with(),
            "of": {owner: part_of_owner.values for owner, part_of_owner in parts.items()},
        }
        position = record.position.segment, int(part.state.step[NOW]), record.position.seconds > 0
        self.checkpoints.write_once(Checkpoint(data, arrays), position)

    def _begin(self) -> None:
        """Begin the first files."""
        for observer in self._observers.values():
            observer.begin(self._simulation)
        self._next = self._enter

    def _reenter(self) -> None:
        """Resume in the segment of a checkpoint."""
        for observer in self._observers.values():
            observer.cut()
        self._next = self._prepare
        part = self._part
        part.segment = part.reenter_segment(part.record.position.segment)
        step = int(part.state.step[NOW])
        longer = " (--until lengthens it)" if is_molecular(self._simulation.scene) else ""
        self._simulation._announce(
            f"the run had ended at step {step}{longer}: writing its results again"
            if self.is_complete
            else f"continuing from step {step}, the last checkpoint"
        )

    def _enter(self) -> None:
        """Enter the first segment, or the next one."""
        part = self._part
        position = self._part.record.position
        k = len(position.computing)
        with part.lock:
            part.segment = part.enter_segment(k)
        position.segment = k
        position.first = int(part.state.step[NOW])
        position.seconds = 0.0
        if k == 0:
            self._notify(0, [each.interval is not None for each in self._observers.values()])
            self._checkpoint()
        self._next = self._prepare

    def _prepare(self) -> None:
        """Take the action of a segment, if it has one, before its steps."""
        segment = self._part.segment
        observers = self._observers.values()
        self._schedule = ObservationSchedule(observers, segment)
        if segment.action is not None:
            began = clock.perf_counter()
            with self._part.lock:
                segment.action(self._progress)
            self._part.record.position.seconds = clock.perf_counter() - began
            self._notify(0, [each.interval is not None or each.ends for each in observers])
        self._shown, self._pace = None, inf
        self._bar.unpause()
        self._next = self._advance

    def _advance(self) -> None:
        """Advance to the next observation, or for about `SEGMENT_SECONDS`."""
        part = self._part
        segment = self._part.segment
        position = self._part.record.position
        done = self._done
        if done >= segment.steps or self.interrupted:
            self._next = self._leave
            return
        to = min(self._schedule.next_observation(done), self._until - position.first)
        if self._pace > 0:  # the first step alone, as it may be slow
            to = min(to, done + max(1, int(SEGMENT_SECONDS / self._pace)))
        to = done + -int((done - to) // segment.together) * segment.together
        shown = self._schedule.due(to)
        with_energies = any(
            each.reads_energies
            for each, now in zip(self._observers.values(), shown, strict=True)
            if now
        )
        began = clock.perf_counter()
        try:
            with part.lock:
                part.engine.advance(
                    part.state, segment.method, segment.dt, position.first + to, with_energies
                )
        except Halted:
            self._next = self._leave
            return
        seconds = clock.perf_counter() - began
        self._shown, self._pace = shown, seconds / (to - done)
        position.seconds += seconds
        if not part.is_finite():
            raise NotFiniteError(part.state)
        self._notify(to, shown)
        self._bar.update(segment.dt * (to - done))
        if not self.must_end() and to < segment.steps and self.checkpoints.is_due:
            self._checkpoint()

    def _leave(self) -> None:
        """Leave a segment, with a checkpoint."""
        segment = self._part.segment
        position = self._part.record.position
        done, shown = self._done, self._shown
        if not (segment.action is not None and self.interrupted):
            self._checkpoint()
        # only a run that stops here calls these observers
        if done < segment.steps and shown is not None:
            due = [
                observer.ends and not is_shown
                for observer, is_shown in zip(self._observers.values(), shown, strict=True)
            ]
            self._notify(done, due)
        position.time += done * segment.dt
        position.computing.append(position.seconds)
        is_last = len(position.computing) == len(self._part.durations())
        self._next = self._finish if is_last or self.interrupted else self._enter

    @property
    def _done(self) -> int:
        """Steps since the start of the current segment."""
        return int(self._part.state.step[NOW]) - self._part.record.position.first

    def _notify(self, done: int, due: Sequence[bool]) -> None:
        """Call the observers that are due after `done` steps of the current segment."""
        position = self._part.record.position
        time = position.time + done * self._part.segment.dt
        moment = Moment(self._simulation, position.first + done, time, position.segment)
        for observer, now in zip(self._observers.values(), due, strict=True):
            if now and not (observer.once and self._part.is_replaced(moment)):
                self._call_observer(observer, observer.observe, moment)
        self._check_process()

    def _call_observer(
        self, observer: Observer, method: Callable[..., None], *arguments: object
    ) -> None:
        """Call a method of an observer, unless the observer has failed before. Its error ends the
        run, which raises it when all files are complete. An error of a figure becomes a note.
        `observe` may raise the errors of this package."""
        if observer in self._failed_before:
            return
        try:
            method(*arguments)
        except Exception as error:  # a user's observer may raise anything
            if isinstance(error, RigidMDError) and method == observer.observe:
                raise
            self._failed_before.append(observer)
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            name = type(observer).__name__
            if observer.draws:
                self._simulation._note(
                    f"{', '.join(observer.files()) or name} cannot be drawn: {reason}"
                )
                return
            part = self._part
            self._simulation._note(
                f"{name} failed at {part.state.time[NOW]:g} {part.scene.time_unit}: {reason}"
            )
            self.interrupted, self._error = True, self._error or error

    def must_end(self) -> bool:
        """Whether the run has to end, by a signal or because its time is up."""
        if not self.interrupted and self.checkpoints.time_is_up:
            self.interrupted = self.out_of_time = True
        return self.interrupted

    def stop(self, number: int | None = None) -> None:
        """End the run at the next observation, with all files."""
        self.signal = self.signal or number
        self.interrupted = True

    def _stop_by_signal(self, number: int) -> None:
        """Stop. A second Ctrl-C ends the run at once."""
        if self.interrupted and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.stop(number)
