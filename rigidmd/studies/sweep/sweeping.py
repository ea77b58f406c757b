"""A sweep from what is wanted to its table: points checked, folder opened, points run, table and figure written."""

import os
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from rigidmd.core.toml import shorten_repr
from rigidmd.errors import OutputError, SceneError, SimulationError
from rigidmd.io.folder import FolderLock
from rigidmd.scene import MolecularScene
from rigidmd.scene.base import default_name, read_tables
from rigidmd.studies.sweep.axes import Axis, axes_of, checked
from rigidmd.studies.sweep.cluster import Cluster
from rigidmd.studies.sweep.figure import draw_sweep
from rigidmd.studies.sweep.folder import (
    FINISHED,
    SEED,
    Manifest,
    check_sweep_folder,
    is_sweep,
    make_sweep_folder,
    read_manifest,
    write_manifest,
)
from rigidmd.studies.sweep.plan import known_axes, planned, settle
from rigidmd.studies.sweep.points import points_of
from rigidmd.studies.sweep.processes import Pool
from rigidmd.studies.sweep.running import Runner, run_points, task_of
from rigidmd.studies.sweep.table import Table, table_of, write_table
from rigidmd.studies.sweep.worker import Ended, Tell, run_task


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Wanted(NamedTuple):
    """A sweep that is wanted.

    path : the scene file
    axes : what is set, see `parse_axis`
    folder : default: runs/NAME-sweep
    replicas : so many seeds, from that of the scene on
    trust : Python files that the scene may run
    force : remove what is in the folder
    """

    path: Path
    axes: list[Axis]
    folder: Path | None = None
    replicas: int | None = None
    trust: Sequence[str] = ()
    force: bool = False


class Opened(NamedTuple):
    """A sweep with its folder, in which no other sweep runs."""

    folder: Path
    manifest: Manifest
    is_body: bool

    @property
    def left(self) -> int:
        """Points that have not finished."""
        return sum(point.state != FINISHED for point in self.manifest.points)


def opened(wanted: Wanted, stack: ExitStack) -> Opened:
    """Check all points, hold them against the folder, and write the manifest. No other sweep runs there until the
    stack ends.

    Raises SceneError, OutputError.
    """
    from rigidmd.assemble.user_code.trust import trust

    for path in wanted.trust:
        trust(path)
    data, _ = read_tables(wanted.path)
    axes = wanted.axes if wanted.replicas is None else _with_seeds(wanted, data)
    keys = [key for axis in axes for key in axis.keys]
    if wanted.trust and not any("module" in str(told) for told in (data.get("forces"), keys)):
        raise SceneError("--trust", [f"{wanted.path} names no Python file by module in [[forces.custom]]"])
    named = next((axis.values[0] for axis in axes if "name" in axis.keys), None) or data.get("name")
    folder = wanted.folder or Path("runs") / f"{named or default_name(wanted.path)}-sweep"
    check_sweep_folder(folder)
    axes = checked(axes if wanted.force else known_axes(folder, axes))
    asked, is_body = points_of(wanted.path, axes)
    lock = FolderLock(folder)
    stack.callback(lock.release)
    lock.take()
    manifest = planned(folder, asked, wanted.force)
    make_sweep_folder(folder)
    lock.take()
    write_manifest(folder, manifest)
    return Opened(folder, manifest, is_body)


def opened_again(folder: Path, stack: ExitStack) -> Opened:
    """A sweep that is there, its points in the states that their folders tell. Raises OutputError."""
    if not is_sweep(folder):
        raise OutputError(f"{folder} holds no sweep; `rigidmd sweep SCENE --set ...` makes one")
    lock = FolderLock(folder)
    stack.callback(lock.release)
    lock.take()
    manifest = read_manifest(folder)
    for point in manifest.points:
        settle(folder, point)
    write_manifest(folder, manifest)
    return Opened(folder, manifest, False)


def _with_seeds(wanted: Wanted, data: Mapping[str, Any]) -> list[Axis]:
    """The axes with the seeds of replicas, from that of the scene on."""
    if "body" in data:
        raise SceneError("--replicas", [f"{wanted.path} is a single body, whose motion has no seed"])
    own = [axis for axis in wanted.axes if SEED in axis.keys]
    if any(axis.swept or len(axis.keys) > 1 for axis in own):
        raise SceneError("--replicas", ["are seeds, and --set gives them too; leave out one of them"])
    seed = own[0].values[0] if own else data.get(SEED, MolecularScene.model_fields[SEED].default)
    if not isinstance(seed, int):
        raise SceneError(str(wanted.path), [f"seed is {shorten_repr(seed)}, must be a whole number"])
    return [
        *(axis for axis in wanted.axes if axis not in own),
        Axis((SEED,), tuple(range(seed, seed + (wanted.replicas or 1)))),
    ]


def shares(count: int, jobs: int | None, threads: int | None, is_body: bool) -> tuple[int, int]:
    """Points at a time, and threads of each, so that all cores have work; what is given stays."""
    most = cores()
    if threads is None and jobs is None:
        jobs = max(1, min(most, count))
    if jobs is None:
        jobs = max(1, min(most // (threads or 1), count))
    return jobs, threads or (1 if is_body else max(1, most // jobs))


def sweep(
    scene: str | Path,
    sets: Mapping[str, Any],
    folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    threads: int | None = None,
    force: bool = False,
    trust: Sequence[str] = (),
) -> Table:
    """Run a scene file at many points in parallel, and return the table of means and errors, as `rigidmd sweep` does.

    table = rigidmd.sweep("water.toml", {"stages.0.temperature_K": [280, 290], "seed": range(1, 9)}, jobs=2)
    print(table["Temperature (K)"], table.error("Temperature (K)"))

    sets : dotted key -> list, tuple or range of values, or one value for all points; all combinations run
    folder : default: runs/NAME-sweep. Points that have finished there are not run again
    jobs, threads : points at a time, threads of each; default: so that all cores have work

    Raises SceneError and OutputError before anything runs, SimulationError if points failed (`sweep.json` tells why),
    KeyboardInterrupt after Ctrl-C; the same call goes on.
    """
    wanted = Wanted(Path(scene), axes_of(sets), None if folder is None else Path(folder), trust=trust, force=force)
    with ExitStack() as stack:
        there = opened(wanted, stack)
        manifest = there.manifest
        outcome = run_points(
            there.folder, manifest, Pool(*shares(there.left, jobs, threads, there.is_body)), trust=trust
        )
        if outcome.signal is not None:
            raise KeyboardInterrupt
        table, _ = collected(there.folder, manifest)
    for point in manifest.points:
        if point.state != FINISHED:
            count = len(outcome.failed) + len(outcome.left)
            why = point.message or "it was stopped"
            raise SimulationError(f"{count} of {len(manifest.points)} points failed; {point.folder}: {why}")
    return table


def collected(folder: Path, manifest: Manifest) -> tuple[Table, list[Path]]:
    """The table of what has finished, and the files with table and figure. Raises OutputError."""
    table = table_of(folder, manifest)
    if not any(row.runs for row in table.rows):
        return table, []
    files = [write_table(table), draw_sweep(table, manifest.name)]
    return table, [path for path in files if path is not None and path.is_file()]


def run_point(
    folder: Path, k: int, scene: Path, walltime: float | None, trust: Sequence[str], tell: Tell
) -> tuple[str, Ended]:
    """Run one point of a sweep that is there, in this process: its name, and how it ended. Raises OutputError.

    scene : its file; that of the manifest is not believed
    """
    if not is_sweep(folder):
        raise OutputError(f"{folder} holds no sweep; `rigidmd sweep SCENE --set ...` makes one")
    manifest = read_manifest(folder)
    if k >= len(manifest.points):
        raise OutputError(f"{folder} has points 0 to {len(manifest.points) - 1}, not {k}")
    point, manifest.scene = manifest.points[k], str(scene.absolute())
    ends_at = None if walltime is None else time.time() + walltime
    return point.folder, run_task(task_of(folder, manifest, point, ends_at, trust), tell, progress=True)


def runner_of(folder: Path, scheduler: str | None, jobs: int, threads: int) -> Runner:
    """Processes here, or a cluster of dask with `threads` for each point. Raises SettingError."""
    if scheduler is None:
        return Pool(jobs, threads)
    return Cluster(scheduler, jobs, threads, folder, Path.cwd())
