"""Observers look at a run between its steps. They read its state and never change it.

All have the same methods: `files` it may write, `begin`, `see` a moment, `end`. An observer sees every `interval` of
time, counted in steps of each stretch, or every `steps` steps, independent of the interval of results. If its `ends` is
true, it also sees the last moment of every stretch. A time at which a minimisation begins has two states; one with
`once` sees only the second. No observer depends on the order of observers: data that several of them need belong to the
moment or the run.
"""

from collections.abc import Callable, Iterable, Sequence
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.output.checkpoint import Checkpoint
from rigidmd.output.folder import SCENE
from rigidmd.output.frame import Frame
from rigidmd.run.moment import Moment

if TYPE_CHECKING:
    from rigidmd.output.gsd_file import GsdFile
    from rigidmd.output.traj_file import TrajFile
    from rigidmd.output.trajectory_file import TrajectoryFile
    from rigidmd.run.loop import Simulation
    from rigidmd.run.results import Results


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
        """Called instead of `begin` when a run goes on from a checkpoint: restore what `memory` gave for it."""
        self.begin(run)

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
        """Call the function."""
        self.function(moment)


class SceneFile(Observer):
    """scene.toml: the scene as it runs, with copies of the files that it reads."""

    def __init__(self, names: Iterable[str] = ()):
        self._copies = list(names)

    def files(self) -> list[str]:
        """The scene and its inputs."""
        return [SCENE, *self._copies]

    def begin(self, run: "Simulation") -> None:
        """Write it. A run writes it again after choosing an integrator for a stage."""
        if run.folder is not None:
            run.write_scene(run.folder)

    def end(self, run: "Simulation", results: "Results") -> None:
        """Name it."""
        results.files.append(run.path(SCENE))


class Frames(Observer):
    """Topology and trajectory; without a folder, frames in memory."""

    once = True

    def __init__(
        self, interval: float, topology: str, trajectory: str, velocities: bool = False, wrapped: bool = False
    ):
        self.interval: float = interval
        self._names = [topology, trajectory]
        self._velocities, self._wrapped = velocities, wrapped
        self._frames: list[Frame] = []
        self._file: TrajectoryFile | GsdFile | TrajFile | None = None

    def files(self) -> list[str]:
        """Both."""
        return self._names

    def begin(self, run: "Simulation") -> None:
        """Write the topology and open the trajectory."""
        self._run, self._frames = run, []
        if run.folder is not None:
            from rigidmd.output.trajectory_file import write_topology  # MDAnalysis is slow to import

            write_topology(run.path(self._names[0]), run.system, run.state, self._wrapped)
            self._open(None)

    def memory(self) -> Checkpoint:
        """Size of the trajectory, times of its frames."""
        kept = None if self._file is None else self._file.kept
        return Checkpoint({"kept": kept}, {"time": np.array([frame.time for frame in self._frames])})

    def resume(self, run: "Simulation", kept: Checkpoint) -> None:
        """Go on with the trajectory where the checkpoint left it."""
        self._run, self._frames = run, [Frame(time) for time in kept.arrays["time"].tolist()]
        self._open(kept.told["kept"])

    def _open(self, kept: Sequence[int] | None) -> None:
        from rigidmd.output.trajectory_file import open_trajectory

        run, path = self._run, self._run.path(self._names[1])
        self._file = open_trajectory(path, run.system, self.interval, self._velocities, self._wrapped, kept)

    def see(self, moment: Moment) -> None:
        """A frame."""
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

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
