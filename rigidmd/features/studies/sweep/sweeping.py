"""`rigidmd sweep`: its folder is opened, its points run here, or commands for them are written."""

import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from rigidmd.compile.machine import MOST_THREADS
from rigidmd.core.files import write_text, writing
from rigidmd.core.plain_text import UNSAFE, as_word, in_comment
from rigidmd.core.process import OUT_OF_TIME
from rigidmd.core.toml import Json
from rigidmd.errors import OutputError, SimulationError
from rigidmd.features import provider
from rigidmd.features.studies.sweep.figure import collect
from rigidmd.features.studies.sweep.folder import FILES, SCRIPT, Manifest, is_sweep, read_manifest
from rigidmd.features.studies.sweep.limits import step_key
from rigidmd.features.studies.sweep.plan import (
    Axis,
    axes_of,
    merge_manifests,
    order_axes,
    read_points,
    with_seeds,
)
from rigidmd.features.studies.sweep.points import (
    THREADS,
    format_walltime,
    run_points,
    run_words,
    trusted_by,
)
from rigidmd.features.studies.sweep.table import Table
from rigidmd.io.folder import FolderLock, add_to_folder, elsewhere, is_empty
from rigidmd.io.progress import progress_of
from rigidmd.run.schedule import checked_count
from rigidmd.scene import Scene
from rigidmd.scene.base import default_name, read_tables

#: Time that a run leaves unused at the end of the wall time of its job: seconds, and at most this
#: fraction.
SPARE, SPARE_FRACTION = 300.0, 0.1
SLURM_SCRIPT = """#!/bin/bash
# {count} points of {name}. Submit it: sbatch {script}
# A job whose time is up submits itself again, and continues from its checkpoint. When all have
# ended,
#   {collect}
# writes table and figure. `rigidmd sweep` with --to slurm writes a script of the points that have
# not finished.
#SBATCH --job-name={job}
#SBATCH --array={array}
#SBATCH --time={time}
#SBATCH --cpus-per-task={threads}
#SBATCH --output="{folder}/slurm-%a.out"
#SBATCH --open-mode=append
cd {here} || exit 2
export {environment}
case $SLURM_ARRAY_TASK_ID in
{commands}
esac
code=$?
[ $code -eq {again} ] && exec sbatch --array="$SLURM_ARRAY_TASK_ID" {script}
exit $code
"""


@contextmanager
def open_sweep(
    scene: Path,
    axes: list[Axis],
    folder: Path | None = None,
    replicas: int | None = None,
    trust: Sequence[str] = (),
    force: bool = False,
    step: str | None = None,
    includes: Callable[[Json], bool] = lambda values: True,
) -> Iterator[Manifest]:
    """Check all points of a scene file, compare them with the folder, and write the manifest. No
    other sweep can run in the folder within the block.

    folder : default: runs/NAME-sweep
    replicas : number of seeds, from the seed of the scene on
    trust : Python files that the scene may run; force : remove the sweep in the folder
    step : a key that has to be a time step that varies; includes : see `read_points`

    Raises SceneError, OutputError.
    """
    for path in trust:
        provider("trust", "--trust").trust(path)
    data, _ = read_tables(scene)
    if replicas is not None:
        axes = with_seeds(scene, axes, replicas, data)
    if folder is None:
        names = [axis.values[0] for axis in axes if "name" in axis.keys]
        name = [*names, data.get("name") or default_name(scene)][0]
        folder = Path("runs") / f"{name}-sweep"
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; {elsewhere()}")
    if not is_empty(folder) and not is_sweep(folder):
        raise OutputError(f"{folder} is not empty and holds no sweep; {elsewhere()}")
    axes = axes if force else order_axes(folder, axes)
    manifest = read_points(scene, axes, trust, includes)
    if step is not None:
        step_key(manifest, step, Scene.read(scene, manifest.overrides(manifest.points[0].values)))
    with FolderLock(folder) as lock:
        merge_manifests(folder, manifest, force=force)
        with writing(folder, "made", f"; {elsewhere()}"):
            folder.mkdir(parents=True, exist_ok=True)
        add_to_folder(folder, FILES)
        lock.take()  # of a new folder
        manifest.write()
        yield manifest


@contextmanager
def open_existing_sweep(folder: Path) -> Iterator[Manifest]:
    """As `open_sweep`, for a sweep that is in the folder already. Raises OutputError."""
    read_manifest(folder)  # before anything is written
    with FolderLock(folder):
        manifest = read_manifest(folder)
        manifest.write()
        yield manifest


def jobs_and_threads(count: int, jobs: int | None, threads: int | None) -> tuple[int, int]:
    """Number of points that run at a time, and threads per point. By default all cores have work.
    Given numbers are kept."""
    if jobs is None:
        jobs = max(1, min(MOST_THREADS // (threads or 1), count))
    return jobs, threads or max(1, MOST_THREADS // jobs)


def sweep(
    scene: str | Path,
    sets: Mapping[str, object],
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

    The same call continues a sweep.

    Parameters
    ----------
    scene : str or Path
        Path of the scene file
    sets : dict
        Dotted key -> list, tuple or range of values, or one value for all points. All combinations
        run
    folder : str or Path, optional
        Folder of the sweep. Points that have finished there are not run again. Default:
        runs/NAME-sweep
    jobs : int, optional
        Number of points that run at a time. Default: all cores have work
    threads : int, optional
        Number of threads of each point. Default: all cores have work
    force : bool, optional
        Replace the sweep in the folder
    trust : sequence of str, optional
        Python files that the scene may run, as `trust_file`
    progress : bool, optional
        Whether to show progress, as `Simulation.run` does. Default: in notebooks

    Returns
    -------
    Table
        A row for each combination of values, columns of means and errors

    Raises
    ------
    SceneError, OutputError
        Before anything runs.
    SimulationError
        If points failed. `sweep.json` has the reasons.
    KeyboardInterrupt
        After Ctrl-C.

    Examples
    --------
        table = rigidmd.sweep(
            "water.toml",
            {"stages.equilibration.temperature_K": [280, 290], "seed": range(1, 9)},
            jobs=2,
        )
        print(table["Temperature (K)"], table.error("Temperature (K)"))
    """
    where = None if folder is None else Path(folder)
    jobs = None if jobs is None else checked_count(jobs, "jobs")
    threads = None if threads is None else checked_count(threads, "threads")
    with open_sweep(Path(scene), axes_of(sets), where, trust=trust, force=force) as manifest:
        count = len(manifest.unfinished)
        jobs, threads = jobs_and_threads(count, jobs, threads)
        bar = progress_of(count, "points", shown=progress if count else False)
        with bar, ThreadPoolExecutor(jobs) as executor:
            stopped = run_points(manifest, executor, bar, threads, trust=trust)
        if stopped is not None:
            raise KeyboardInterrupt
        table, _ = collect(manifest)
    if points := manifest.unfinished:
        reason = points[0].message or "it was stopped"
        count = f"{len(points)} of {len(manifest.points)}"
        raise SimulationError(f"{count} points failed; {points[0].folder}: {reason}")
    return table


def commands(manifest: Manifest, trust: Sequence[str]) -> dict[int, str]:
    """The commands of the points that have not finished, for a shell, by their numbers."""
    return {
        k: shlex.join(run_words(manifest, point, trusted_by(manifest, point, trust)))
        for k, point in enumerate(manifest.points)
        if point.state != "finished"
    }


def write_slurm_script(
    manifest: Manifest, walltime: float, threads: int, trust: Sequence[str]
) -> tuple[Path, int]:
    """Write sweep.sbatch for the points that have not finished. Returns its path and their number.

    walltime : wall time of a job, s. Raises OutputError.
    """
    folder = str(manifest.folder.absolute())
    here = str(Path.cwd())
    script = f"{folder}/{SCRIPT}"
    for text in (manifest.scene, script, here, *trust):
        if UNSAFE.search(text):
            raise OutputError(
                f"{text!r} has a control character, a quotation mark or a backslash in its name,"
                f" which the script of a job cannot have. Rename it, or {elsewhere()}"
            )
    lines = commands(manifest, trust)
    inner = format_walltime(walltime - min(SPARE, SPARE_FRACTION * walltime))
    text = SLURM_SCRIPT.format(
        count=len(lines),
        name=in_comment(manifest.name),
        job=f"{as_word(manifest.name)}-sweep",
        array=",".join(map(str, lines)),
        threads=threads,
        time=format_walltime(walltime),
        folder=folder.replace("%", "%%"),  # Slurm replaces %j and others
        here=shlex.quote(here),
        script=shlex.quote(script),
        environment=" ".join(f"{name}={threads}" for name in THREADS),
        commands="\n".join(f"{k}) {line} --walltime {inner} ;;" for k, line in lines.items()),
        again=OUT_OF_TIME,
        collect=shlex.join(["rigidmd", "sweep", manifest.scene, "-o", folder, "--collect"]),
    )
    write_text(Path(script), text)
    return Path(script), len(lines)
