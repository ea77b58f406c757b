"""`rigidmd sweep`."""

import shlex
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.commands import BY_SIGNAL, FAILED, OUT_OF_TIME
from rigidmd.commands.arguments import (
    TRUST,
    Options,
    argument,
    command,
    flag,
    number,
    output_folder,
    repeated,
    seconds,
)
from rigidmd.errors import OutputError, visible

if TYPE_CHECKING:
    from rigidmd.features.studies.sweep.folder import Manifest


COUNT = number(int, 1, 4096, "a number from 1 to 4096")


@command(
    "Run",
    40,
    "run a scene at many points, with a table and a figure of means. Each run has a folder, "
    "each mean an error",
    "rigidmd sweep water.toml --set stages.equilibration.temperature_K=280,290,300 --set seed=1..8"
    " --jobs 2\n  rigidmd sweep water.toml --replicas 8\n  rigidmd sweep water.toml --set"
    " stages.2.timestep_fs=1,2,4 --extrapolate stages.2.timestep_fs --replicas 8\n  rigidmd sweep"
    " water.toml --set seed=1..64 --to slurm --walltime 4:00:00",
    argument("scene", metavar="SCENE", help="scene file (TOML)"),
    repeated(
        "--set",
        "KEY=A,B,...",
        help=(
            "values of a scene key (entries of a list are counted from 0). KEY=1..8 sets whole"
            " numbers, KEY=VALUE one value for all runs, and KEY,KEY=A,B keys that vary together."
            " With several --set, all combinations run"
        ),
        dest="sets",
    ),
    argument(
        "--replicas",
        type=number(int, 2, 10000, "a number of replicas from 2 on"),
        metavar="N",
        help="run N seeds, from the scene's seed onwards. Errors come from their scatter",
    ),
    *output_folder("runs/NAME-sweep", "an earlier sweep"),
    argument(
        "--jobs",
        type=COUNT,
        metavar="N",
        help="runs in parallel (default: as many as fill all cores)",
    ),
    argument(
        "--threads",
        type=COUNT,
        metavar="N",
        help="threads per run (default: cores / jobs)",
    ),
    argument(
        "--walltime",
        type=seconds,
        metavar="H:MM:SS",
        help=(
            "stop shortly before this time is up, with checkpoints and exit code 75. With --to"
            " slurm it applies to each job"
        ),
    ),
    argument(
        "--scheduler",
        metavar="ADDRESS",
        help="run on a cluster of dask.distributed, such as tcp://HOST:8786",
    ),
    argument(
        "--to",
        choices=["slurm", "commands"],
        help=(
            "run nothing. slurm writes a script for an array of jobs, with one point per job."
            " commands prints one line per point with the command that runs it, for any scheduler"
        ),
    ),
    flag("--collect", help="run nothing, and write table and figure of existing results"),
    argument(
        "--extrapolate",
        metavar="KEY",
        help=(
            "extrapolate all averages, with their errors, to a time step of 0. KEY is the time"
            " step of the last stage, which --set varies. `rigidmd analyse` has the same option"
            " for its values"
        ),
    ),
    TRUST,
    overrides=[],
    writes=True,
)
def _sweep(options: Options) -> int:
    from rigidmd.features.studies.sweep.plan import parse_axes
    from rigidmd.features.studies.sweep.sweeping import open_existing_sweep, open_sweep

    _check(options)
    folder = Path(options.output) if options.output else None
    if options.collect and not options.sets and options.replicas is None:
        if folder is None:
            raise OutputError(
                "--collect needs -o, the folder of the sweep, or the --set that it was made with"
            )
        opened = open_existing_sweep(folder)
    else:
        scene, axes = Path(options.scene), parse_axes(options.sets)
        more = options.replicas, options.trust, options.force, options.extrapolate
        opened = open_sweep(scene, axes, folder, *more)
    with opened as manifest:
        if options.collect or (options.to is not None and not manifest.unfinished):
            return _collect(manifest, options.extrapolate)
        if options.to is not None:
            _write_commands(options, manifest)
            return 0
        return run(options, manifest)


def _check(options: Options) -> None:
    """Raise OutputError for options that cannot be combined."""
    if options.to == "slurm" and options.walltime is None:
        raise OutputError("--to slurm needs --walltime, the time of each job: --walltime 4:00:00")
    if options.to == "commands" and options.walltime is not None:
        raise OutputError("--to commands starts no run. Add --walltime to the commands themselves")
    alone = [name for name in ("to", "collect", "scheduler") if getattr(options, name)]
    if len(alone) > 1:
        raise OutputError(f"--{alone[0]} and --{alone[1]} cannot be combined")
    if options.extrapolate is not None and options.to is not None:
        raise OutputError(
            "--extrapolate needs results. When all points have ended, use it with --collect"
        )
    if options.collect and options.force:
        raise OutputError(
            "--collect only reads existing results. Leave out --force, which removes them"
        )


def _write_commands(options: Options, manifest: "Manifest") -> None:
    from rigidmd.features.studies.sweep.sweeping import commands, write_slurm_script

    if options.to == "commands":
        print(*commands(manifest, options.trust).values(), sep="\n")
        return
    threads = options.threads or 1
    path, count = write_slurm_script(manifest, options.walltime, threads, options.trust)
    print(f"{path}: {count} points. Submit it: sbatch {shlex.quote(str(path))}")
    words = ["rigidmd", "sweep", options.scene, "-o", str(manifest.folder), "--collect"]
    print(f"  when all have ended: {shlex.join(words)}")


def run(options: Options, manifest: "Manifest") -> int:
    """The command `rigidmd sweep`."""
    from concurrent.futures import ThreadPoolExecutor

    from rigidmd.features.studies.sweep.points import cluster, run_points
    from rigidmd.features.studies.sweep.sweeping import jobs_and_threads
    from rigidmd.io.progress import progress_of

    began = time.monotonic()
    count = len(manifest.points)
    before = len(manifest.points_in("finished"))
    print(
        f"{manifest.name}: {count} points in {manifest.folder}, {before} of them finished before",
        flush=True,
    )
    stopped = None
    if left := count - before:
        jobs, threads = jobs_and_threads(left, options.jobs, options.threads)
        if options.scheduler is None:
            executor = ThreadPoolExecutor(jobs)
            where = f"{jobs if jobs > 1 else 'one'} at a time"
        else:
            executor = cluster(options.scheduler)
            threads = options.threads or 1  # a thread of a worker of dask for each point
            where = f"on the cluster {options.scheduler}"
        with progress_of(left, "points", shown=True) as bar, executor as pool:
            print(f"  {where}, {threads} thread{'s' if threads > 1 else ''} each", flush=True)
            settings = options.walltime, options.trust, _message_printer()
            stopped = run_points(manifest, pool, bar, threads, *settings)
    _print_results(manifest, options.extrapolate)
    finished, failed = manifest.points_in("finished"), manifest.points_in("failed")
    unfinished = manifest.points_in("waiting", "interrupted")
    print(
        f"  {len(finished) - before} finished, {len(failed)} failed, {before} skipped,"
        f" {len(unfinished)} left; {time.monotonic() - began:.3g} s"
    )
    for point in failed:
        print(f"  failed: {point.folder}: {visible(point.message or '')}")
    if manifest.unfinished:
        again = shlex.join(["rigidmd", *sys.argv[1:]]).replace(" --force", "")
        print(f"  the same command continues with what is left, and repeats what failed: {again}")
    if stopped is not None:
        return BY_SIGNAL + stopped
    if unfinished and options.walltime is not None:
        return OUT_OF_TIME
    return FAILED if manifest.unfinished else 0


def _message_printer() -> Callable[[str, str], None]:
    """A function that shows messages of points: warnings and compilations once each, errors
    at once."""
    from tqdm import tqdm

    shown: set[str] = set()

    def receive(name: str, line: str) -> None:
        problem = line.removeprefix("rigidmd: ")
        warning = problem.removeprefix("warning: ")
        if line in shown or not line.startswith(("rigidmd: ", "  compiling")):
            return
        if warning != problem:
            shown.add(line)
            text = f"rigidmd: warning: {name}: {warning}"
        elif problem != line:
            text = f"  {name}: {problem}"
        else:
            shown.add(line)
            text = f"  {name}: {line.strip()}"
        tqdm.write(visible(text), file=sys.stderr)

    return receive


def _print_results(manifest: "Manifest", step: str | None) -> None:
    """Write and print the table of what has finished. step : the key of --extrapolate"""
    from rigidmd.features.studies.sweep.figure import collect
    from rigidmd.features.studies.sweep.folder import MOST_NAMED

    folder = manifest.folder
    table, files = collect(manifest)
    if files:
        print(table.brief().text(left=()))
        if any(row.count == 2 for row in table.rows):
            print("\n  Two runs give no usable error: use more replicas")
    for name, reason in table.failed.items():
        print(f"  {name} is not in the table: {reason}")
    for point in manifest.points_in("waiting", "interrupted")[:MOST_NAMED]:
        print(f"  not in the table: {point.folder}, which is {point.state}")
    names = ["sweep.json", *(path.name for path in files)]
    names += [] if step is None else print_limits(manifest, step)
    count = len(manifest.points)
    print(f"\n  files in {folder}: {', '.join(names)}, and a folder for each of {count} points")
    if table.runs:
        print(f"  `rigidmd analyse {shlex.quote(str(folder))}` measures all of them")


def print_limits(manifest: "Manifest", step: str) -> list[str]:
    """Write and print what the averages of a sweep are at a step of 0. The names of the files."""
    from rigidmd.features.studies.sweep.limits import extrapolate_sweep, write_limits

    limits = extrapolate_sweep(manifest, step)
    if limits.limits:
        print(f"\n{limits.title}\n{limits.as_text().text(range(len(limits.keys) + 1))}")
    for line in limits.missing:
        print(f"  no limit: {line}")
    for line in limits.not_joint:
        print(f"  no joint fit: {line}")
    return write_limits(manifest.folder, limits, shlex.join(["rigidmd", *sys.argv[1:]]))


def _collect(manifest: "Manifest", step: str | None) -> int:
    count = len(manifest.points)
    finished = len(manifest.points_in("finished"))
    print(f"{manifest.name}: {count} points in {manifest.folder}, {finished} of them finished")
    _print_results(manifest, step)
    return FAILED if finished < count else 0
