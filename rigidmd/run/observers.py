"""Observers are called between the steps of a run. They read its state and never change it.

An observer is any object with an `interval` and a method `observe`. `Observer` has all other
methods, which have no effect. `observe` is called every `interval` of time, counted in steps of
each segment, or every `steps` steps, independent of the interval of results, and with `ends` also
at the last moment of every segment. A time at which a minimisation starts has two states: with
`once` only the second is observed. No observer depends on another: data that several need belong to
the moment or run.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from math import inf
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from pydantic import Field

from rigidmd.core.state import State
from rigidmd.core.user_warnings import warn_renamed
from rigidmd.formats.atoms import Frame
from rigidmd.io.checkpoint import Checkpoint
from rigidmd.io.folder import SCENE
from rigidmd.run.resume import restored, stored
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.engines.observables import Observation
    from rigidmd.engines.samples import Sample
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


class Moment:
    """The argument of observers: position in the run, state and observation. Its values do not
    change later.

    Attributes
    ----------
    step : int
        Steps since the start
    time : float
        Time since the start, ps, or s for a single body
    stage : int
        Index of the stage
    state : State
        For molecules in Å, Å/ps and u Å²/ps (angular momentum along principal axes), for a body in
        SI units
    """

    def __init__(self, run: "Simulation", step: int, time: float, stage: int):
        self._run, self._state = run, run._part.state
        self.step, self.time, self.stage = step, time, stage

    def __repr__(self) -> str:
        return f"<Moment at time {self.time:g}, step {self.step}, stage {self.stage}>"

    @cached_property
    def state(self) -> State:
        """A copy of the state of the run, read-only."""
        return self._state.copy().read_only

    @cached_property
    def observation(self) -> "Observation | Any":
        """Evaluated at its first use, for all observers: an `Observation` of molecules, in the
        units of the log, or the `Pose` of a body, in SI units."""
        part = self._run._part
        with part.lock:
            return part.observe(self)

    @property
    def sample(self) -> "Sample":
        """The line of the log. For molecules only."""
        return self.observation.sample

    @property
    def site_positions(self) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å, not wrapped."""
        return self._run.system.site_positions(self._state)


def above_zero(interval: float, name: str) -> float:
    """An interval between observations. ValueError unless it is a finite time above 0."""
    if not 0 < interval < inf:
        raise ValueError(f"{name} is {interval!r}, must be a finite time above 0")
    return interval


class Observer:
    """Base class of observers. Its methods have no effect.

    Attributes
    ----------
    interval : float or None
        Time between observations, ps, or s for a single body
    steps : int or None
        Number of steps between observations
    remembers : dict of str to type
        Name -> type of each attribute that a checkpoint has and a resumed run gets back: an array
        (`np.ndarray`), arrays by name (`dict[str, np.ndarray]`), or what JSON can hold, which is
        checked
    """

    remembers: ClassVar[dict[str, object]] = {}
    interval: float | None = None  # ps, or s for a single body
    steps: int | None = None
    ends = False
    once = False  # whether it is called once for each time: not before a minimisation
    # True if the observer only draws: `end` runs last, and errors become warnings
    draws = False
    reads_energies = (
        False  # whether it reads forces or energies, which the last step then computes too
    )
    _names: Sequence[str] = ()

    def files(self) -> list[str]:
        """Names of all files that may be written.

        Returns
        -------
        list of str
            Names in the folder of the run
        """
        return list(self._names)

    def begin(self, run: "Simulation") -> None:
        """Called before the first step. The folder exists.

        Parameters
        ----------
        run : Simulation
            The simulation that starts
        """

    def observe(self, moment: Moment) -> None:
        """Observe a moment.

        Parameters
        ----------
        moment : Moment
            Position in the run, state and observation

        Raises
        ------
        SimulationError
            To stop the run.
        """

    def see(self, moment: Moment) -> None:
        """`observe` by its name of the version before.

        Parameters
        ----------
        moment : Moment
            See `observe`
        """
        type(self).observe(self, moment)

    def memory(self) -> Checkpoint:
        """The data that `resume` needs, for a checkpoint. Its files must be on the disk when it
        returns.

        Returns
        -------
        Checkpoint
            The attributes that `remembers` lists
        """
        return stored(self, self.remembers)

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        """Called instead of `begin` when a run is resumed: restore the data of `memory`, and check
        files unchanged.

        Parameters
        ----------
        run : Simulation
            The simulation that is resumed
        kept : Checkpoint
            What `memory` returned

        Raises
        ------
        KeyError, TypeError, ValueError, OutputError
            To reject the checkpoint.
        """
        for name, value in restored(kept, self.remembers).items():
            setattr(self, name, value)
        self.begin(run)

    def cut(self) -> None:
        """Called when all observers have resumed: cut files to their lengths at the checkpoint."""

    def end(self, run: "Simulation", results: "Results") -> None:
        """Called after the last step or an interruption: complete the files.

        Parameters
        ----------
        run : Simulation
            The simulation that ends
        results : Results
            The results, to which files may be added
        """

    def close(self) -> None:
        """Called in any case: close files."""

    def failed(self, run: "Simulation") -> str:
        """Called if the run stops with an error: save results.

        Parameters
        ----------
        run : Simulation
            The simulation that stops

        Returns
        -------
        str
            A sentence that names the file, or ""
        """
        return ""


def _is_former(value: object) -> bool:
    """Whether an observer has the method `see` of the version before, and not `observe`: as an
    attribute, or in the first class that has one of them."""
    spaces = [getattr(value, "__dict__", {}), *map(vars, type(value).__mro__)]
    nearest = next((space for space in spaces if {"observe", "see"} & space.keys()), {})
    return "observe" not in nearest and callable(nearest.get("see"))


def as_observer(value: object) -> Observer:
    """An observer, or one that calls an object with `observe` and `interval` (or `steps`, `ends`),
    which may also have any of the other methods and attributes of `Observer` but `remembers`.
    Raises TypeError."""
    method = getattr(value, "observe", None)
    if _is_former(value):
        warn_renamed(f"{type(value).__name__}.see", "observe")
        method = value.see  # pyright: ignore[reportAttributeAccessIssue]
        if isinstance(value, Observer):
            object.__setattr__(value, "observe", method)
    if isinstance(value, Observer):
        return value
    is_timed = any(hasattr(value, name) for name in ("interval", "steps", "ends"))
    if not is_timed or not callable(method):
        raise TypeError(
            f"{value!r:.60} is not an observer: it needs an interval and a method observe(moment). "
            "rigidmd.Every(interval, function) makes one of a function"
        )
    # its name is in messages and checkpoints
    observer = type(type(value).__name__, (Observer,), {})()
    attributes = {
        name: getattr(value, name)
        for name in dir(Observer)
        if name[0] != "_" and hasattr(value, name)
    }
    vars(observer).update(attributes | {"observe": method})
    return observer


class Every(Observer):
    """Calls a function at an interval of time, once for each time.

    Parameters
    ----------
    interval : float
        Time between calls, ps, or s for a single body
    function : callable
        Called with each `Moment`

    Raises
    ------
    ValueError
        For an interval that is not a finite time above 0.
    """

    once = True

    def __init__(self, interval: float, function: Callable[[Moment], object]):
        self.interval = above_zero(interval, "the interval of Every")
        self.function = function

    def observe(self, moment: Moment) -> None:
        """Call the function.

        Parameters
        ----------
        moment : Moment
            Its argument
        """
        self.function(moment)


class OpenFile(Protocol):
    """A file that grows during the run."""

    @property
    def kept(self) -> Sequence[int]: ...  # sizes and checksum
    def check(self) -> None: ...
    def cut(self) -> None: ...
    def close(self) -> None: ...


FileT = TypeVar("FileT", bound=OpenFile)


class GrowingFile(Observer, Generic[FileT]):
    """An observer whose file grows during the run. None without a folder."""

    remembers: ClassVar[dict[str, object]] = {
        "kept": list[Annotated[int, Field(ge=0, strict=True)]]
    }
    kept: list[int] | None = (
        None  # sizes and checksum of the file of the run that is resumed, which `begin` opens
    )
    _file: FileT | None = None

    def memory(self) -> Checkpoint:
        self.kept = list(not_none(self._file).kept)
        return super().memory()

    def check_file(self) -> None:
        """Raise LostFileError if another program removed, replaced or changed the file."""
        if self._file is not None:
            self._file.check()

    def cut(self) -> None:
        if self._file is not None:
            self._file.cut()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class SceneFile(Observer):
    """scene.toml, with copies of the files that the scene reads."""

    def __init__(self, copies: Iterable[str] = ()):
        self._names = [SCENE, *copies]

    def begin(self, run: "Simulation") -> None:
        """Write scene.toml. It is written again after an integrator has been chosen for a stage."""
        self._run = run
        self.cut()

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        self._run = run

    def cut(self) -> None:
        if self._run.folder is not None:
            self._run._write_scene(self._run.folder)

    def end(self, run: "Simulation", results: "Results") -> None:
        results.files.append(run.path(SCENE))


class OpenTrajectory(OpenFile, Protocol):
    def write(self, state: State, time: float, step: int) -> None: ...


class Frames(GrowingFile[OpenTrajectory]):
    """Topology and trajectory. Without a folder, frames in memory."""

    remembers: ClassVar[dict[str, object]] = GrowingFile.remembers | {"times": np.ndarray}
    once = True

    def __init__(
        self,
        interval: float,
        topology: str,
        trajectory: str,
        velocities: bool = False,
        wrapped: bool = False,
    ):
        self.interval: float = interval
        self._names = [topology, trajectory]
        self._velocities, self._wrapped = velocities, wrapped
        self._frames: list[Frame] = []

    @property
    def times(self) -> np.ndarray:
        return np.array([frame.time for frame in self._frames])

    @times.setter
    def times(self, times: np.ndarray) -> None:
        self._frames = [Frame(time) for time in times.tolist()]

    def begin(self, run: "Simulation") -> None:
        self._run = run
        if run.folder is None:
            return
        from rigidmd.io.trajectory_file import open_trajectory, write_topology

        if self.kept is None:
            write_topology(
                run.path(self._names[0]), run.system, run._part.state, wrapped=self._wrapped
            )
        elif self.kept[-1:] != [len(self._frames)]:
            raise ValueError("the times of its frames are not those of a run")
        path = run.path(self._names[1])
        self._file = open_trajectory(
            path,
            run.system,
            self.interval,
            velocities=self._velocities,
            wrapped=self._wrapped,
            kept=self.kept,
        )

    def observe(self, moment: Moment) -> None:
        system = self._run.system
        state = self._run._part.state
        if self._file is not None:
            self._file.write(state, moment.time, moment.step)
            self._frames.append(Frame(moment.time))
        else:
            positions = system.site_positions(state, self._wrapped).astype(np.float32)
            velocities = system.site_velocities(state).astype(np.float32)
            self._frames.append(
                Frame(moment.time, positions, state.cell.copy(), velocities, state.rotation.copy())
            )

    def end(self, run: "Simulation", results: "Results") -> None:
        results._frames = self._frames
        if self._file is not None:
            results.files += [run.path(name) for name in self._names]
