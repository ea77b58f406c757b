"""Observers look at a run between its steps. They read its state and never change it.

All have the same methods: `files` it may write, `begin`, `see` a moment, `end`. An observer sees every `interval` of
time, counted in steps of each stretch, or every `steps` steps, independent of the interval of results. If its `ends` is
true, it also sees the last moment of every stretch. A time at which a minimisation begins has two states; one with
`once` sees only the second. No observer depends on the order of observers: data that several of them need belong to the
moment or the run.
"""

from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.core.state import NOW
from rigidmd.io.checkpoint import Checkpoint, count_list
from rigidmd.io.folder import SCENE
from rigidmd.io.frame import Frame
from rigidmd.run.moment import Moment

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


def above_zero(interval: float, name: str) -> float:
    """An interval between observations; ValueError unless it is a finite time above 0."""
    if not 0 < interval < inf:
        raise ValueError(f"{name} is {interval!r}, must be a finite time above 0")
    return interval


class Observer:
    """Base class; its methods do nothing."""

    interval: float | None = None  # ps, or s for a single body
    steps: int | None = None
    ends = False
    once = False  # whether it sees one moment of each time: none before a minimisation
    draws = False  # whether it only draws: it ends after the others, and its errors are notes
    reads_energies = False  # whether it always reads forces or energies: the last step then computes them too

    def files(self) -> list[str]:
        """Names of all files that it may write."""
        return []

    def begin(self, run: "Simulation") -> None:
        """Called before the first step; the folder exists."""

    def see(self, moment: Moment) -> None:
        """Look. Raises SimulationError to stop the run."""

    def memory(self) -> Checkpoint:
        """What `resume` needs, for a checkpoint; its files are on the disk as far as they go."""
        return Checkpoint({}, {})

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        """Called instead of `begin` when a run is resumed: restore what `memory` gave, and check files, unchanged.

        The run is refused if it raises KeyError, TypeError, ValueError or OutputError.
        """
        self.begin(run)

    def cut(self) -> None:
        """Called when all observers have resumed: cut files off where the checkpoint left them."""

    def end(self, run: "Simulation", results: "Results") -> None:
        """Called after the last step or an interruption: complete the files."""

    def close(self) -> None:
        """Called in any case: close files."""

    def failed(self, run: "Simulation") -> str:
        """Called if the run stops with an error: save results. Returns a sentence that names the file, or nothing."""
        return ""


class Every(Observer):
    """Calls `function(moment)` every `interval` ps (s for a single body), once for each time."""

    once = True

    def __init__(self, interval: float, function: Callable[[Moment], object]):
        self.interval = above_zero(interval, "the interval of Every")
        self.function = function

    def see(self, moment: Moment) -> None:
        self.function(moment)


class Growing(Observer):
    """An observer whose file grows while the run goes; None without a folder."""

    _file: Any = None

    def memory(self) -> Checkpoint:
        """The size of the file."""
        return Checkpoint({"kept": None if self._file is None else self._file.kept}, {})

    def cut(self) -> None:
        if self._file is not None:
            self._file.cut()

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None


class SceneFile(Observer):
    """scene.toml: the scene as it runs, with copies of the files that it reads."""

    def __init__(self, names: Iterable[str] = ()):
        self._copies = list(names)

    def files(self) -> list[str]:
        return [SCENE, *self._copies]

    def begin(self, run: "Simulation") -> None:
        """Write it. A run writes it again after choosing an integrator for a stage."""
        self.resume(run, Checkpoint({}, {}))
        self.cut()

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        self._run = run

    def cut(self) -> None:
        if self._run.folder is not None:
            self._run.write_scene(self._run.folder)

    def end(self, run: "Simulation", results: "Results") -> None:
        results.files.append(run.path(SCENE))


class Frames(Growing):
    """Topology and trajectory; without a folder, frames in memory."""

    once = True

    def __init__(
        self, interval: float, topology: str, trajectory: str, velocities: bool = False, wrapped: bool = False
    ):
        self.interval: float = interval
        self._names = [topology, trajectory]
        self._velocities, self._wrapped = velocities, wrapped
        self._frames: list[Frame] = []

    def files(self) -> list[str]:
        return self._names

    def begin(self, run: "Simulation") -> None:
        """Write the topology and open the trajectory."""
        self._run, self._frames = run, []
        if run.folder is not None:
            from rigidmd.io.trajectory_writer import write_topology  # MDAnalysis is slow to import

            write_topology(run.path(self._names[0]), run.system, run.state, self._wrapped)
            self._open(None)

    def memory(self) -> Checkpoint:
        """Size of the trajectory, times of its frames."""
        return super().memory()._replace(arrays={"time": np.array([frame.time for frame in self._frames])})

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        """Open the trajectory where the checkpoint left it."""
        time, now = kept.arrays["time"], run.state.time[NOW]
        *_, frames = counts = count_list(kept.told["kept"])
        if time.shape != (frames,) or not ((time >= 0) & (time <= now)).all() or not (np.diff(time) >= 0).all():
            raise ValueError("the times of its frames are not those of a run")
        self._run, self._frames = run, [Frame(time) for time in time.tolist()]
        self._open(counts)

    def _open(self, kept: Sequence[int] | None) -> None:
        from rigidmd.io.trajectory_writer import open_trajectory

        run, path = self._run, self._run.path(self._names[1])
        self._file = open_trajectory(path, run.system, self.interval, self._velocities, self._wrapped, kept)

    def see(self, moment: Moment) -> None:
        system, state = self._run.system, self._run.state
        if self._file is not None:
            self._file.write(state, moment.time, moment.step)
            self._frames.append(Frame(moment.time))
        else:
            positions = system.site_positions(state, self._wrapped).astype(np.float32)
            velocities = system.site_velocities(state).astype(np.float32)
            self._frames.append(Frame(moment.time, positions, state.cell.copy(), velocities, state.rotation.copy()))

    def end(self, run: "Simulation", results: "Results") -> None:
        """Hand over what was seen."""
        results._frames = self._frames
        if self._file is not None:
            results.files += [run.path(name) for name in self._names]
