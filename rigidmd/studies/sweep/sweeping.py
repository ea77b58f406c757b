"""`rigidmd sweep`: its folder is opened, its points run here or by a script for Slurm, its results
are written."""

import contextlib
import json
import os
import re
import shlex
import signal
import time as clock
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from rigidmd.assemble.user_code.trust import trust as trust_file
from rigidmd.core.files import write_text, writing
from rigidmd.core.plain_text import UNSAFE, as_word, in_comment
from rigidmd.errors import OutputError, SceneError, SimulationError, option
from rigidmd.io.folder import FolderLock, add_to_folder, elsewhere, is_empty
from rigidmd.io.progress import Bar, progress_of
from rigidmd.run.resume import NOT_COMPARED, keys_of, plain
from rigidmd.run.schedule import checked_walltime, signal_handler
from rigidmd.scene import Scene
from rigidmd.scene.base import default_name, read_tables
from rigidmd.studies.sweep.backends import Cluster, PointResult, PointTask, Pool, Send, run_task
from rigidmd.studies.sweep.folder import (
    FILES,
    SCRIPT,
    Manifest,
    SweepPoint,
    is_sweep,
    read_manifest,
    write_manifest,
)
from rigidmd.studies.sweep.limits import step_key
from rigidmd.studies.sweep.plan import (
    Axis,
    axes_of,
    merge_manifests,
    order_axes,
    read_points,
    update_state,
    with_seeds,
)
from rigidmd.studies.sweep.table import Table, collect

#: Time that a run leaves unused at the end of the wall time of its job: seconds, and at most this
#: fraction.
SPARE, SPARE_FRACTION = 300.0, 0.1
SLURM_SCRIPT = """#!/bin/bash
# {count} points of {name}. Submit it: sbatch {script}
# A job whose time is up submits itself again, and continues from its checkpoint. When all have
# ended,
#   {collect}
# writes table and figure; `rigidmd sweep` with --to slurm writes a script of the points that have
# not finished.
#SBATCH --job-name={job}
#SBATCH --array={array}
#SBATCH --time={time}
#SBATCH --cpus-per-task={threads}
#SBATCH --output="{folder}/slurm-%a.out"
#SBATCH --open-mode=append
cd {here} || exit 2
{point} --point "$SLURM_ARRAY_TASK_ID" --threads {threads} --walltime {inner}
code=$?
[ $code -eq {again} ] && exec sbatch --array="$SLURM_ARRAY_TASK_ID" {script}
exit $code
"""


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class OpenSweep(NamedTuple):
    """A sweep with its folder, in which no other sweep runs."""

    folder: Path
    manifest: Manifest
    is_body: bool

    @property
    def left(self) -> int:
        """Points that have not finished."""
        return sum(point.state != "finished" for point in self.manifest.points)


def open_sweep(
    stack: ExitStack,
    scene: Path,
    axes: list[Axis],
    folder: Path | None = None,
    replicas: int | None = None,
    trust: Sequence[str] = (),
    force: bool = False,
    step: str | None = None,
) -> OpenSweep:
    """Check all points of a scene file, compare them with the folder, and write the manifest.

    folder : default: runs/NAME-sweep; no other sweep can run in it until the stack ends
    replicas : number of seeds, from the seed of the scene on
    trust : Python files that the scene may run; force : remove the sweep in the folder
    step : a key that has to be a time step that varies

    Raises SceneError, OutputError.
    """
    for path in trust:
        trust_file(path)
    data, _ = read_tables(scene)
    axes = axes if replicas is None else with_seeds(scene, axes, replicas, data)
    keys = [key for axis in axes for key in axis.keys]
    if trust and not any("module" in str(part) for part in (data.get("forces"), keys)):
        raise SceneError(
            option("trust"), [f"{scene} names no Python file by module in [[forces.custom]]"]
        )
    named = next((axis.values[0] for axis in axes if "name" in axis.keys), None) or data.get("name")
    folder = folder or Path("runs") / f"{named or default_name(scene)}-sweep"
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; {elsewhere()}")
    if not is_empty(folder) and not is_sweep(folder):
        raise OutputError(f"{folder} is not empty and holds no sweep; {elsewhere()}")
    fresh, is_body = read_points(scene, axes if force else order_axes(folder, axes))
    if step is not None:
        step_key(fresh, step, Scene.read(scene, fresh.overrides(fresh.points[0])))
    lock = stack.enter_context(FolderLock(folder))
    manifest = merge_manifests(folder, fresh, force)
    with writing(folder, "made", f"; {elsewhere()}"):
        folder.mkdir(parents=True, exist_ok=True)
    add_to_folder(folder, FILES)
    lock.take()  # of a new folder
    write_manifest(folder, manifest)
    return OpenSweep(folder, manifest, is_body)


def open_existing_sweep(folder: Path, stack: ExitStack) -> OpenSweep:
    """An existing sweep; the states of its points are read from their folders. Raises
    OutputError."""
    read_manifest(folder)  # before anything is written
    stack.enter_context(FolderLock(folder))
    manifest = read_manifest(folder)
    for point in manifest.points:
        update_state(folder, point)
    write_manifest(folder, manifest)
    return OpenSweep(folder, manifest, False)


def jobs_and_threads(
    count: int, jobs: int | None, threads: int | None, is_body: bool
) -> tuple[int, int]:
    """Points at a time, and threads of each, so that all cores have work. Given numbers are
    kept."""
    most = cores()
    jobs = max(1, min(most // (threads or 1), count)) if jobs is None else jobs
    return jobs, threads or (1 if is_body else max(1, most // jobs))


class ProgressOfPoints:
    """Shows how much of the points is done on a bar; a `receive` of `run_points`."""

    def __init__(self, bar: Bar):
        self._bar = bar
        self._fractions: dict[str, float] = {}

    def __call__(self, name: str, kind: str, value: Any) -> None:
        if kind not in ("fraction", "ended", "died"):
            return
        before, begins = (
            self._fractions.get(name, 0.0),
            kind == "fraction" and name not in self._fractions,
        )
        finished = kind == "ended" and value["state"] == "finished"
        now = value if kind == "fraction" else 1.0 if finished else before
        if begins and not self._fractions:
            self._bar.unpause()  # this is when the first steps begin
        self._fractions[name] = max(before, now)
        advance = max(0.0, now - before)
        if begins:
            self._bar.skip(advance)  # what a resumed point had before
        else:
            self._bar.update(advance)


def sweep(
    scene: str | Path,
    sets: Mapping[str, Any],
    folder: str | Path | None = None,
    *,
    jobs: int | None = None,
    threads: int | None = None,
    force: bool = False,
    trust: Sequence[str] = (),
    progress: bool | None = None,
) -> Table:
    """Run a scene file at many points in parallel, and return the table of means and errors, as
    `rigidmd sweep` does.

    table = rigidmd.sweep("water.toml", {"stages.equilibration.temperature_K": [280, 290], "seed":
    range(1, 9)}, jobs=2) print(table["Temperature (K)"], table.error("Temperature (K)"))

    The same call continues a sweep.

    Parameters
    ----------
    sets
        Dotted key -> list, tuple or range of values, or one value for all points; all combinations
        run
    folder
        default: runs/NAME-sweep. Points that have finished there are not run again
    jobs, threads
        Points at a time, threads of each; default: so that all cores have work
    progress
        Whether to show progress, as `Simulation.run` does; default: in notebooks

    Raises
    ------
    SceneError, OutputError
        Before anything runs.
    SimulationError
        If points failed; `sweep.json` has the reasons.
    KeyboardInterrupt
        After Ctrl-C.
    """
    with ExitStack() as stack:
        where = None if folder is None else Path(folder)
        there = open_sweep(stack, Path(scene), axes_of(sets), where, trust=trust, force=force)
        manifest = there.manifest
        pool = Pool(*jobs_and_threads(there.left, jobs, threads, there.is_body))
        with progress_of(there.left, "points", progress if there.left else False) as bar:
            outcome = run_points(
                there.folder, manifest, pool, trust=trust, receive=ProgressOfPoints(bar)
            )
        if outcome.signal is not None:
            raise KeyboardInterrupt
        table, _ = collect(there.folder, manifest)
    for point in manifest.points:
        if point.state != "finished":
            count = len(outcome.failed) + len(outcome.left)
            why = point.message or "it was stopped"
            raise SimulationError(
                f"{count} of {len(manifest.points)} points failed; {point.folder}: {why}"
            )
    return table


def run_point(
    folder: Path, k: int, scene: Path, walltime: float | None, trust: Sequence[str], send: Send
) -> tuple[str, PointResult]:
    """Run point k of an existing sweep in this process: its name, and how it ended. Raises
    OutputError.

    scene : the scene file; the path in the manifest is not trusted
    """
    manifest = read_manifest(folder)
    if k >= len(manifest.points):
        raise OutputError(f"{folder} has points 0 to {len(manifest.points) - 1}, not {k}")
    point, manifest.scene = manifest.points[k], str(scene.absolute())
    ends_at = None if walltime is None else clock.time() + walltime
    return point.folder, run_task(
        task_of(folder, manifest, point, ends_at, trust), send, progress=True
    )


def write_slurm_script(
    folder: Path,
    manifest: Manifest,
    walltime: float,
    threads: int,
    trust: Sequence[str],
    again: int,
) -> tuple[Path, int]:
    """Write sweep.sbatch for the points that have not finished. Returns its path and their number.

    walltime : wall time of a job, s; again : exit code of a run whose time was up. Raises
        OutputError.
    """
    path = folder.absolute() / SCRIPT
    left = [k for k, point in enumerate(manifest.points) if point.state != "finished"]
    words = ["rigidmd", "sweep", manifest.scene, "-o", str(folder.absolute())]
    words += [word for trusted in trust for word in ("--trust", str(Path(trusted).absolute()))]
    here = str(Path.cwd())
    if unsafe := [text for text in (*words, str(path), here) if UNSAFE.search(text)]:
        raise OutputError(
            f"{unsafe[0]!r} has a control character, a quotation mark or a backslash in its name,"
            f" which the script of a job cannot have; rename it, or {elsewhere()}"
        )
    text = SLURM_SCRIPT.format(
        count=len(left),
        name=in_comment(manifest.name),
        job=f"{as_word(manifest.name)}-sweep",
        array=format_ranges(left),
        threads=threads,
        time=format_walltime(walltime),
        inner=format_walltime(walltime - min(SPARE, SPARE_FRACTION * walltime)),
        folder=str(folder.absolute()).replace("%", "%%"),  # Slurm replaces %j and others
        here=shlex.quote(here),
        script=shlex.quote(str(path)),
        again=again,
        point=shlex.join(words),
        collect=shlex.join([*words, "--collect"]),
    )
    write_text(path, text)
    return path, len(left)


def format_ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers as Slurm's --array has them: 0-3,7."""
    runs = (
        [n for _, n in run]
        for _, run in groupby(enumerate(numbers), key=lambda pair: pair[1] - pair[0])
    )
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def format_walltime(span: float) -> str:
    """Seconds as H:MM:SS."""
    whole = int(span)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


#: Seconds between two checks of the time, and between two writings of the manifest.
TICK, WRITING_INTERVAL = 0.5, 1.0
#: Seconds of a wall time for table and figure, and those that a point needs at least; at most these
#: fractions of it.
FOR_TABLE, LEAST = 10.0, 20.0
FOR_TABLE_FRACTION, LEAST_FRACTION = 0.1, 0.2


@dataclass
class SweepOutcome:
    """How a sweep ended: names of points that finished, failed, and are left."""

    finished: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    seconds: float = 0.0
    signal: int | None = None
    out_of_time: bool = False


def run_points(
    folder: Path,
    manifest: Manifest,
    runner: Pool | Cluster,
    walltime: float | None = None,
    trust: Sequence[str] = (),
    receive: Callable[[str, str, Any], object] = lambda name, kind, value: None,
) -> SweepOutcome:
    """Run what is not finished. A point waits while one that compiles the same code has not begun.

    walltime : seconds after which all has to have ended
    trust : Python files that the scene may run
    receive : called with (point, kind, value) of each message of the backend

    Raises OutputError if the manifest cannot be written.
    """
    began, found = clock.monotonic(), SweepOutcome()
    by_name = {point.folder: point for point in manifest.points}
    waiting = Waiting(manifest, [point for point in manifest.points if point.state != "finished"])
    changed, written = True, 0.0
    ends_at, least = None, 0.0
    if walltime is not None:
        ends_at = (
            clock.time()
            + checked_walltime(walltime)
            - min(FOR_TABLE, FOR_TABLE_FRACTION * walltime)
        )
        least = min(LEAST, LEAST_FRACTION * walltime)
    pressed = 0

    def stop(number: int) -> None:
        nonlocal pressed
        found.signal = found.signal or number
        pressed += number == signal.SIGINT

    with signal_handler(stop, signal.SIGINT, signal.SIGTERM), contextlib.closing(runner):
        while True:
            late = ends_at is not None and clock.time() + least > ends_at
            while found.signal is None and not late and runner.free and (point := waiting.next()):
                runner.submit(task_of(folder, manifest, point, ends_at, trust))
            if not runner.running:
                break
            if found.signal is not None:
                runner.kill() if pressed > 1 else runner.stop()
            for name, kind, value in runner.messages(TICK):
                if (
                    kind != "died" or found.signal is None
                ):  # else it was stopped before its first step
                    receive(name, kind, value)
                if kind not in ("begun", "ended", "died"):
                    continue
                changed, point = True, by_name[name]
                waiting.compiled(point)
                if kind == "begun":
                    point.state, point.message = "running", None
                    continue
                if kind == "ended":
                    point.state, point.message, point.ran_sha256 = (
                        value["state"],
                        value["message"],
                        value["sha256"],
                    )
                    point.seconds += value["seconds"]
                    found.out_of_time |= value["out_of_time"]
                elif found.signal is None:
                    point.state, point.message = "failed", value
                else:  # it was stopped before it sent its end
                    point.state = "interrupted"
                    update_state(folder, point)
                if point.state in ("finished", "failed"):
                    (found.finished if point.state == "finished" else found.failed).append(name)
            if changed and clock.monotonic() - written > WRITING_INTERVAL:
                write_manifest(folder, manifest)
                changed, written = False, clock.monotonic()
    found.out_of_time |= found.signal is None and bool(waiting)
    found.left = [
        point.folder for point in manifest.points if point.state not in ("finished", "failed")
    ]
    write_manifest(folder, manifest)
    found.seconds = clock.monotonic() - began
    return found


def task_of(
    folder: Path,
    manifest: Manifest,
    point: SweepPoint,
    ends_at: float | None = None,
    trust: Sequence[str] = (),
) -> PointTask:
    return {
        "folder": str(folder.absolute()),
        "name": point.folder,
        "scene": manifest.scene,
        "overrides": manifest.overrides(point),
        "trust": [str(Path(path).absolute()) for path in trust],
        "sha256": point.scene_sha256,
        "ran_sha256": point.ran_sha256,
        "ends_at": ends_at,
    }


class Waiting:
    """Points that have not begun. One of those that compile the same code goes first, so that it is
    compiled once."""

    def __init__(self, manifest: Manifest, points: list[SweepPoint]):
        scenes = {
            point.folder: Scene.read(manifest.scene, manifest.overrides(point)) for point in points
        }
        self._kinds = {name: code_kind(scene) for name, scene in scenes.items()}
        self._known: set[str] = set()  # kinds whose code is compiled
        self._first: str | None = None  # a point that compiles now
        self._queue = list(points)

    def __bool__(self) -> bool:
        return bool(self._queue)

    def next(self) -> SweepPoint | None:
        for point in self._queue:
            known = self._kinds[point.folder] in self._known
            if known or self._first is None:
                self._first = self._first if known else point.folder
                self._queue.remove(point)
                return point
        return None

    def compiled(self, point: SweepPoint) -> None:
        """Note that a point has compiled its code, or will not any more."""
        self._known.add(self._kinds[point.folder])
        if self._first == point.folder:
            self._first = None


def code_kind(scene: Scene) -> str:
    """A text that is equal for scenes that compile the same code: keys and strings, without numbers
    and files."""
    kept = keys_of(plain(scene), (*scene.inputs, *scene.embedded_files, *NOT_COMPARED))
    return re.sub(r"-?\b\d[\d.e+-]*", "0", json.dumps(kept, sort_keys=True))
