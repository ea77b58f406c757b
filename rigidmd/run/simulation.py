"""The simulation of a scene. Several of them at once in one process."""

import atexit
import contextlib
import os
import signal
import time as clock
import weakref
from collections.abc import Callable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Generic,
    NamedTuple,
    TypedDict,
    TypeVar,
    Unpack,
    cast,
    overload,
)

import numpy as np

from rigidmd.compile.machine import MOST_THREADS
from rigidmd.core.display import Displayed
from rigidmd.core.state import NOW, State
from rigidmd.core.toml import Json
from rigidmd.core.user_warnings import warn_user
from rigidmd.errors import RigidMDError, SceneError
from rigidmd.io import folder as run_folder
from rigidmd.io.progress import DisplayArea, announce, is_shown
from rigidmd.io.scene_file import write_scene
from rigidmd.run.kind import kind_of
from rigidmd.run.loop import RunLoop
from rigidmd.run.observers import as_observer
from rigidmd.run.part import RunPart
from rigidmd.run.results import Results
from rigidmd.run.schedule import (
    checked_count,
    checked_walltime,
    checkpoint_signals,
    signal_handler,
    stop_signals,
)
from rigidmd.scene import Scene, is_molecular

if TYPE_CHECKING:
    import ase

    from rigidmd.engines.observables import Observation
    from rigidmd.engines.protocol import Engine
    from rigidmd.engines.sites import AnySystem
    from rigidmd.engines.system import System, TermMaker, ThermostatOfStages
    from rigidmd.run.minimise import OverlapRemoval
    from rigidmd.run.molecular import MolecularRun
    from rigidmd.scene import MolecularScene, OneScene
    from rigidmd.scene.molecules import UserForce

    AnyForce = UserForce | TermMaker | NamedTuple

    class Options(TypedDict, total=False):
        """The keyword arguments of `Simulation`, which are described there."""

        observers: object
        say: Callable[[str], object] | None
        warn: Callable[[str], object]
        resume: bool
        walltime: float | None
        forces: AnyForce | Sequence[AnyForce] | None
        thermostat: NamedTuple | ThermostatOfStages | None
        applied: Mapping[str, Callable[..., tuple]] | None


SystemT = TypeVar("SystemT")
SceneT = TypeVar("SceneT")

#: Simulations that have started and not ended, which are closed when the interpreter exits.
_BEGUN: "weakref.WeakSet[Simulation]" = weakref.WeakSet()


def _as_scene(scene: object) -> Scene:
    """A scene, or the scene in a file."""
    if isinstance(scene, str | Path):
        return Scene.read(scene)
    if isinstance(scene, Scene):
        return scene
    raise TypeError(
        f"Simulation needs a scene or the path of its file, not {scene!r:.60}: use"
        " rigidmd.Scene.from_dict for a dictionary"
    )


class Simulation(Displayed, Generic[SystemT, SceneT]):
    """A scene, ready to run: `run()` runs it to its end, `step(n)` advances it by n steps, both can
    be mixed.

    Parameters
    ----------
    scene : Scene, str or Path
        The scene, or the path of its TOML file
    folder : str or Path, optional
        Folder for the files. None writes nothing and keeps the frames in memory
    force : bool, optional
        Replace an earlier run in that folder
    observers : Observer or sequence of Observer, optional
        Called between steps: `Every`, `LivePlot`, or any object with `interval` and
        `observe(moment)`
    say : callable, optional
        Called with a sentence before something slow (compiling, pilot runs). Default: printed with
        the progress
    warn : callable, optional
        Called with each warning. The summary repeats them. Default: a `RigidMDWarning` of Python's
        `warnings`
    resume : bool, optional
        Continue from the last checkpoint in the folder, to the same bits. If the folder is empty or
        absent, a new run starts
    walltime : float, optional
        Seconds from now until the run has to have ended. It stops shortly before, with a checkpoint
    forces : object or sequence of objects, optional
        For molecules, user-defined forces, in addition to the forces of the scene: `rigidmd.Force`,
        `rigidmd.pair_potential`, terms of classes with `rigidmd.compiled_force`, or objects whose
        method term(system) makes such a term. At the start forces and torques are compared with
        differences of the energy, and the virial with the effect of a strain of the box
    thermostat : object, optional
        For molecules, a user-defined thermostat for every stage: a NamedTuple of a class with
        `rigidmd.compiled_thermostat`, or an object whose method for_stage(system, k) makes one
    applied : dict of str to callable, optional
        For a single body, name -> function of a `Pose` that gives a force (3,) in N along the lab's
        axes, at the centre of mass, and a torque (3,) in N m along the body's axes. It is called
        once for each position of the body. Forces that depend on the velocity are constant within a
        step, which reduces its order to 1

    Raises
    ------
    SceneError
        If the scene has errors, or does not take one of the arguments.
    TypeError, ValueError
        For arguments of other types or values.

    Examples
    --------
        results = rigidmd.Simulation("water.toml").run()

        with rigidmd.Simulation("water.toml", "runs/water") as simulation:
            simulation.step(100)
            print(simulation.time, simulation.energy)
    """

    _part: RunPart

    if TYPE_CHECKING:

        @overload
        def __init__(
            self: "Simulation[System, MolecularScene]",
            scene: "MolecularScene",
            folder: str | Path | None = None,
            force: bool = False,
            **options: Unpack[Options],
        ) -> None: ...

        @overload
        def __init__(
            self: "Simulation[AnySystem, OneScene]",
            scene: Scene | str | Path,
            folder: str | Path | None = None,
            force: bool = False,
            **options: Unpack[Options],
        ) -> None: ...

    def __init__(
        self,
        scene: Scene | str | Path,
        folder: str | Path | None = None,
        force: bool = False,
        *,
        observers: object = (),
        say: Callable[[str], object] | None = None,
        warn: Callable[[str], object] = warn_user,
        resume: bool = False,
        walltime: float | None = None,
        forces: "AnyForce | Sequence[AnyForce] | None" = None,
        thermostat: "NamedTuple | ThermostatOfStages | None" = None,
        applied: "Mapping[str, Callable[..., tuple]] | None" = None,
    ):
        scene = _as_scene(scene)
        # a callback may change the directory
        self.folder = None if folder is None else Path(folder).absolute()
        if resume and folder is None:
            raise ValueError("a run without a folder has no checkpoint to resume from")
        self._force, self._resume, self._user_say, self._warn = force, resume, say, warn
        self._deadline = (
            None if walltime is None else clock.monotonic() + checked_walltime(walltime)
        )
        self._observers = [
            as_observer(each)
            for each in (observers if isinstance(observers, Sequence) else [observers])
        ]
        self._spot = DisplayArea()
        self._progress: bool | None = None
        self._issued: list[str] = []  # warnings by this process
        self._loop: RunLoop | None = None  # the run, after it has started and before it has ended
        self._earlier: run_folder.RunMark | None = (
            None  # of the last run by this object in the folder
        )
        given = {"forces": forces, "thermostat": thermostat, "applied": applied}
        user_code = {key: value for key, value in given.items() if value is not None}
        kind = kind_of(scene)
        if refused := [key for key in user_code if key not in kind.takes]:
            raise SceneError(scene.source, [f"{' and '.join(refused)}: {kind.takes_instead}"])
        self._part = kind.run_part(self, scene, user_code)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._summary_line}>"

    def __reduce__(self) -> object:
        what = (
            "a Simulation has compiled code and open files, and can be neither copied nor pickled"
        )
        raise TypeError(
            f"{what}: use simulation.scene and simulation.state.copy(), from which start_from"
            " begins"
        )

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @property
    def scene(self) -> SceneT:
        """The scene as it runs, with defaults and choices."""
        return cast(SceneT, self._part.scene)

    @property
    def system(self) -> SystemT:
        """The system that the scene describes."""
        return cast(SystemT, self._part.system)

    @property
    def engine(self) -> "Engine":
        """The current engine."""
        return self._part.engine

    @property
    def threads(self) -> int:
        """Number of threads."""
        return self._part.threads

    @property
    def state(self) -> State:
        """The current state, read-only: the next step changes it, a copy stays as it is.

        For molecules in Å, Å/ps and u Å²/ps (angular momentum along principal axes), for a body in
        SI units. Runs start from another state by `start_from`.
        """
        return self._part.state.read_only

    @property
    def time(self) -> float:
        """Time since the start of the run, ps, for a body s."""
        return float(self._part.state.time[NOW])

    @property
    def steps_done(self) -> int:
        """Number of steps since the start of the run."""
        return int(self._part.state.step[NOW])

    @property
    def observation(self) -> "Observation | NamedTuple":
        """Observables of the current state, before, within and after a run. Each use evaluates the
        forces. Another thread waits for the steps that are being computed.

        An `Observation` of molecules, in kJ/mol, Å, K and bar, as in the log. The `Pose` of a body,
        in SI units.

        Raises
        ------
        SimulationError
            If the forces cannot be evaluated.
        """
        with self._part.lock:
            return self._part.observe_now()

    @property
    def energy(self) -> float:
        """Potential plus kinetic energy of the current state, kJ/mol, for a body J. `observation`
        has both."""
        with self._part.lock:
            return self._part.energy_now()

    @property
    def forces(self) -> np.ndarray:
        """Forces (n, 3) on the centres of mass at the current state, lab frame, kJ/mol/Å. On a body
        (1, 3) in N, empty if it is pinned."""
        with self._part.lock:
            return self._part.forces_now()

    @property
    def notes(self) -> list[str]:
        """The warnings of the run."""
        return list(self._part.record.notes)

    def path(self, file: str) -> Path:
        """Path of a file in the folder of the run.

        Parameters
        ----------
        file : str
            Name of the file, such as "log.csv"

        Returns
        -------
        Path
            Its absolute path

        Raises
        ------
        ValueError
            Without a folder.
        """
        if self.folder is None:
            raise ValueError(f"this run has no folder for {file}")
        return self.folder / file

    @property
    def _summary_line(self) -> str:
        where = "results stay in memory" if self.folder is None else f"writes to {self.folder}"
        return f"{self._part.headline}; {where}"

    def _introduction(self) -> str:
        """A few lines for the start of a run."""
        return "\n".join([self._part.headline, *(f"  {note}" for note in self._part.system.notes)])

    def _conclusion(self, results: Results, *, verbose: bool = False) -> str:
        """The summary as text, without the notes of the introduction and the warnings that were
        issued."""
        known = [*self._part.system.notes, *self._issued]
        return self._part.summary_text(results.summary, known, is_short=not verbose)

    def _write_scene(self, folder: Path) -> None:
        """Write the scene as it runs, with copies of the files that it reads."""
        write_scene(folder, self._part.scene)

    # Before a run.

    def _before_run(self) -> RunPart:
        """The part, which is changed before a run. Raises RuntimeError within a run."""
        if self._loop is not None:
            raise RuntimeError("the run has begun. close() ends it")
        return self._part

    def _molecules(self, *, begun: bool = False) -> "MolecularRun":
        """The part of molecules. Raises TypeError for other scenes, RuntimeError within a run
        unless it may have `begun`."""
        part = self._part if begun else self._before_run()
        if not is_molecular(part.scene):
            raise TypeError(
                f"{part.scene.name} is {part.scene.subject}. This method is for molecules"
            )
        return cast("MolecularRun", part)

    def start_from(self, state: State) -> None:
        """Let runs start at the given positions, orientations and momenta, of molecules without
        removal of overlaps.

        Parameters
        ----------
        state : State
            A state of as many molecules in the same order, or of a body, in the units of `state`,
            such as `results.state`. Time and step start at 0

        Raises
        ------
        StructureError
            For a state that this scene cannot have.
        TypeError
            For anything else.
        """
        part = self._before_run()
        if not isinstance(state, State):
            raise TypeError(
                f"start_from needs a State, such as results.state, not {type(state).__name__}"
            )
        part.start_from(state)
        if self._earlier is not None:
            self._earlier.is_complete = True  # the next run does not continue it

    def _start(self) -> "OverlapRemoval | None":
        """Go to the state before the first step, from which `run` starts. Returns the removal of
        overlaps."""
        return self._molecules().start()

    def _settle(self) -> State:
        """Go to the state of molecules after removal of overlaps and the minimisations that come
        first."""
        return self._molecules().settle()

    def atoms(self) -> "ase.Atoms":
        """The current state of molecules as an `ase.Atoms`, exactly: see `Results.atoms`. Observers
        may call it.

        Returns
        -------
        ase.Atoms
            The sites with mass (a,), positions in Å

        Raises
        ------
        TypeError
            For a single body.
        """
        part = self._molecules(begun=True)
        with part.lock:
            return part.atoms()

    def compile(self) -> None:
        """Compile what a run needs, or read it from the cache, without running: before a course, or
        on a login node.

        A stage with integrator = "auto" compiles more when pilot runs have chosen.

        Raises
        ------
        RuntimeError
            Within a run.
        """
        self._before_run().prepare()
        self._part.reset()

    def _start_energy(
        self, size: float = 1.0, unit: str = "J", *, measure_accuracy: bool = False
    ) -> Json:
        """Energies and forces at the start. For the arguments see `MolecularRun.start_energy`."""
        return self._before_run().start_energy(size, unit, measure_accuracy=measure_accuracy)

    # The run.

    def run(self, progress: bool | None = None) -> Results:
        """Run the scene, or what remains of it after `step`, and complete all files.

        After the end of a run, a call repeats it. In a folder it replaces the files of that run. A
        run in a folder that was interrupted is continued from its last checkpoint. Without a folder
        there is none, and it starts again.

        Parameters
        ----------
        progress : bool, optional
            Whether to show progress, by a bar or, if not on a terminal, lines every 30 s. Default:
            in notebooks

        Returns
        -------
        Results
            Samples, summary, final state and files of the run

        Raises
        ------
        TypeError
            For a number of steps, which `step` takes.
        OutputError
            Before computing, if the folder cannot be used.
        CheckpointError
            If the run cannot be resumed.
        SimulationError
            If the run fails.
        """
        if not isinstance(progress, bool | None):
            raise TypeError(
                f"run() runs the whole scene: for {progress!r:.20} steps use step({progress!r:.20})"
            )
        return cast(Results, self._drive(inf, progress=progress).results)

    def step(self, count: int = 1) -> int:
        """Advance by a number of steps, as `run` does.

        The first call starts the run: it compiles and writes the first files. A minimisation is
        done with the next step after it. `run` or `close` completes the run. A signal such as
        Ctrl-C completes all files. The exception is then re-raised.

        Parameters
        ----------
        count : int, optional
            Number of steps. Default: 1

        Returns
        -------
        int
            Number of steps done: fewer at the end of the scene, then 0

        Raises
        ------
        TypeError, ValueError
            For a count that is not an integer, or below 1. Errors of `run` occur here too.
        """
        return self._drive(checked_count(count, "the number of steps"), progress=False).advanced

    def close(self) -> None:
        """End a run that `step` has started, with all files, as `stop` ends it: it can be resumed.
        The end of a `with` block does this, and so does the end of Python."""
        if (
            self._loop is not None
            and not self._loop.is_running
            and os.getpid() == self._loop.process
        ):
            if not self._loop.is_complete:
                self.stop()
            self.run(progress=False)

    def stop(self, number: int | None = None) -> None:
        """End the run at its next observation, with all files. Observers and other threads may call
        it.

        Parameters
        ----------
        number : int, optional
            Number of the signal that requests it
        """
        if self._loop is not None:
            self._loop.stop(number)

    def _ask_for_checkpoint(self, number: int | None = None) -> None:
        """Write a checkpoint at the next observation, at the request of a signal."""
        if self._loop is not None:
            self._loop.checkpoints.requested = True

    def _note(self, warning: str) -> None:
        """Issue a warning. The summary repeats it."""
        self._part.record.notes.append(warning)
        self._issued.append(warning)
        self._warn(warning)

    def _announce(self, sentence: str) -> None:
        """Print a sentence before something slow."""
        if self._user_say is not None:
            self._user_say(sentence)
        elif is_shown(shown=self._progress):
            announce(sentence, self._spot)

    def _must_end(self) -> bool:
        """Whether a run has to end, by a signal or because its time is up."""
        return self._loop is not None and self._loop.must_end()

    @property
    def _is_interrupted(self) -> bool:
        """Whether the run ends before the end of its scene."""
        return self._loop is not None and self._loop.interrupted

    def _drive(self, steps: float, *, progress: bool | None) -> RunLoop:
        """Let the run advance by at most this number of steps, or to its end. A new one starts
        after its end."""
        if self._loop is None:
            self._issued = []
            force, resume = self._force, self._resume
            if not resume and self._earlier is not None and self._earlier.is_there:
                resume = self._earlier.can_continue
                force = force or not resume
            self._loop = RunLoop(self, force=force, resumes=resume, deadline=self._deadline)
            _BEGUN.add(self)
        loop = self._loop
        if loop.is_running:
            raise RuntimeError(
                "this simulation is running already. Its observers cannot run it again"
            )
        self._progress, self._spot = progress, DisplayArea()
        try:
            loop.drive(steps, progress=progress)
        finally:
            if loop.has_ended:
                self._loop = None
                if self.folder is not None and loop.has_begun:
                    self._earlier = run_folder.RunMark(self.folder, is_complete=loop.is_complete)
                _BEGUN.discard(self)
        return loop


@atexit.register
def _close_all() -> None:
    for simulation in list(_BEGUN):
        with contextlib.suppress(RigidMDError):
            simulation.close()


#: Seconds between two checks for signals.
POLL_INTERVAL = 0.2


def run_together(
    simulations: Sequence[Simulation], jobs: int | None = None
) -> list[Results | None]:
    """Run simulations at once, each on one thread, to the bits of `run`.

    For many small systems this is faster than one run after another on all cores: no thread waits
    for another, and the steps of one run continue while the observers of another are called.
    Summaries and scenes of the simulations have one thread.

    Ctrl-C and SIGTERM stop all runs at their next observations. A second Ctrl-C then raises
    KeyboardInterrupt. If a run fails, the others continue, and the first error is raised at the
    end, with a note on the runs that failed.

    Parameters
    ----------
    simulations : sequence of Simulation
        The simulations, none of them twice
    jobs : int, optional
        Number of runs at a time. Default: the number of cores

    Returns
    -------
    list of Results or None
        The results in the same order. None for a run that had not started before a signal

    Raises
    ------
    TypeError, ValueError
        For anything but different simulations, or a number of jobs below 1.
    RigidMDError
        The first error of a run.
    """
    from concurrent.futures import ThreadPoolExecutor, wait

    simulations = list(simulations)
    if wrong := [value for value in simulations if not isinstance(value, Simulation)]:
        raise TypeError(f"{wrong[0]!r:.60} is not a Simulation")
    if len(set(map(id, simulations))) < len(simulations):
        raise ValueError("a simulation is given twice. Make one for each run")
    jobs = MOST_THREADS if jobs is None else checked_count(jobs, "jobs")
    for simulation in simulations:
        simulation._before_run().take_threads(1)
    begun: list[Simulation] = []
    received: list[int] = []  # the signals that end runs, so far

    def run(simulation: Simulation) -> Results | None:
        if received:
            return None
        begun.append(simulation)
        return simulation.run(progress=False)

    def stop_all() -> None:
        for simulation in begun:
            simulation.stop(received[0])

    def stop(number: int) -> None:
        again = bool(received) and number == signal.SIGINT
        received.append(number)
        stop_all()
        if again:
            raise KeyboardInterrupt

    def ask_for_checkpoints(number: int) -> None:
        for simulation in begun:
            simulation._ask_for_checkpoint(number)

    with contextlib.ExitStack() as stack:
        stack.enter_context(signal_handler(stop, *stop_signals()))
        stack.enter_context(signal_handler(ask_for_checkpoints, *checkpoint_signals()))
        pool = stack.enter_context(ThreadPoolExecutor(jobs, "run"))
        futures = [pool.submit(run, simulation) for simulation in simulations]
        running = set(futures)
        while running:
            _, running = wait(running, POLL_INTERVAL)
            if received:
                stop_all()  # repeatedly: a run that was just starting may have missed it
    failed = {
        k: error for k, future in enumerate(futures, 1) if (error := future.exception()) is not None
    }
    if failed:
        error = next(iter(failed.values()))
        which = ", ".join(map(str, failed))
        error.add_note(
            f"of {len(futures)} runs at once these failed: {which}. This is the error of the first"
        )
        raise error
    return [future.result() for future in futures]
