"""`rigidmd sweep`."""

import os
import shlex
import sys
from collections.abc import Callable
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigidmd.commands import BY_SIGNAL, FAILED, INTERRUPTED, OUT_OF_TIME
from rigidmd.commands.arguments import (
    TRUST,
    Options,
    argument,
    command,
    number,
    output_folder,
    seconds,
)
from rigidmd.commands.streams import announce, warn
from rigidmd.errors import OutputError, visible

if TYPE_CHECKING:
    from rigidmd.io.progress import Bar
    from rigidmd.studies.sweep.folder import Manifest
    from rigidmd.studies.sweep.sweeping import OpenSweep


COUNT = number(int, 1, 4096, "a number from 1 to 4096")


@command(
    130,
    "run a scene at many points, a folder each, with a table and a figure of means and errors",
    "rigidmd sweep water.toml --set stages.equilibration.temperature_K=280,290,300 --set seed=1..8"
    " --jobs 2\n  rigidmd sweep water.toml --replicas 8\n  rigidmd sweep water.toml --set"
    " stages.2.timestep_fs=1,2,4 --extrapolate stages.2.timestep_fs --replicas 8\n  rigidmd sweep"
    " water.toml --set seed=1..64 --to slurm --walltime 4:00:00",
    argument("scene", metavar="SCENE", help="scene file (TOML)"),
    argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=A,B,...",
        dest="sets",
        help=(
            "values of a key of the scene (entries of a list are counted from 0); KEY=1..8 for"
            " whole numbers; KEY=VALUE the same for all; KEY,KEY=A,B for keys that vary together;"
            " may be repeated: all combinations run"
        ),
    ),
    argument(
        "--replicas",
        type=number(int, 2, 10000, "a number of replicas from 2 on"),
        metavar="N",
        help="run N seeds, from the scene's seed on: errors from their scatter",
    ),
    *output_folder("runs/NAME-sweep", "an earlier sweep"),
    argument(
        "--jobs",
        type=COUNT,
        metavar="N",
        help="points at a time (default: as many as fill all cores)",
    ),
    argument(
        "--threads",
        type=COUNT,
        metavar="N",
        help="threads of each point (default: cores over jobs)",
    ),
    argument(
        "--walltime",
        type=seconds,
        metavar="H:MM:SS",
        help=(
            "stop shortly before this time is up, with checkpoints and exit code 75; with --to"
            " slurm of each job"
        ),
    ),
    argument(
        "--scheduler",
        metavar="ADDRESS",
        help=(
            "run on a cluster of dask.distributed: tcp://HOST:8786, or `local` for one that is"
            " started here"
        ),
    ),
    argument(
        "--to",
        choices=["slurm"],
        help="run nothing, and write a script for an array of jobs, a point each",
    ),
    argument(
        "--collect",
        action="store_true",
        help="run nothing, and write table and figure of existing results",
    ),
    argument(
        "--extrapolate",
        metavar="KEY",
        help=(
            "extrapolate all averages to a step of 0, with their errors, over this time step of the"
            " last stage, which --set varies; `rigidmd analyse` has the same option for what it"
            " measures"
        ),
    ),
    argument(
        "--point",
        type=number(int, 0, inf, "the number of a point, from 0 on"),
        metavar="K",
        help="run point K of an existing sweep, counted from 0",
    ),
    TRUST,
    overrides=[],
    writes=True,
)
def _sweep(options: Options) -> int:
    from contextlib import ExitStack

    from rigidmd.studies.sweep.plan import parse_axes
    from rigidmd.studies.sweep.sweeping import open_existing_sweep, open_sweep, write_slurm_script

    _check(options)
    folder = Path(options.output) if options.output else None
    if options.point is not None:
        return _run_point(options)
    with ExitStack() as stack:
        if options.collect and not options.sets and options.replicas is None:
            if folder is None:
                raise OutputError(
                    "--collect needs -o, the folder of the sweep, or the --set that it was made"
                    " with"
                )
            return _collect(open_existing_sweep(folder, stack), options.extrapolate)
        scene, axes = Path(options.scene), parse_axes(options.sets)
        more = options.replicas, options.trust, options.force, options.extrapolate
        sweep = open_sweep(stack, scene, axes, folder, *more)
        if options.collect or (options.to is not None and not sweep.left):
            return _collect(sweep, options.extrapolate)
        if options.to is None:
            return _run(options, sweep)
        settings = options.walltime, options.threads or 1, options.trust, OUT_OF_TIME
        path, count = write_slurm_script(sweep.folder, sweep.manifest, *settings)
    print(f"{path}: {count} points; submit it: sbatch {shlex.quote(str(path))}")
    where = shlex.quote(str(sweep.folder))
    print(f"  when all have ended: rigidmd sweep {shlex.quote(options.scene)} -o {where} --collect")
    return 0


def _check(options: Options) -> None:
    """Raise OutputError for options that cannot be combined."""
    if options.to is not None and options.walltime is None:
        raise OutputError("--to slurm needs --walltime, the time of each job: --walltime 4:00:00")
    if options.point is not None and not options.output:
        raise OutputError("--point needs -o, the folder of the sweep")
    alone = [
        name
        for name in ("to", "collect", "point", "scheduler")
        if getattr(options, name) not in (None, False)
    ]
    if len(alone) > 1:
        raise OutputError(f"--{alone[0]} and --{alone[1]} cannot be combined")
    if options.point is not None and (options.sets or options.replicas or options.force):
        raise OutputError(
            "--point uses the settings in the folder; leave out --set, --replicas and --force"
        )
    if options.extrapolate is not None and (options.point is not None or options.to is not None):
        raise OutputError(
            "--extrapolate needs results; when all points have ended, use it with --collect"
        )
    if options.collect and options.force:
        raise OutputError(
            "--collect only reads existing results; leave out --force, which removes them"
        )


def _run(options: Options, sweep: "OpenSweep") -> int:
    from rigidmd.io.progress import progress_of
    from rigidmd.studies.sweep.backends import Cluster, Pool
    from rigidmd.studies.sweep.sweeping import SweepOutcome, jobs_and_threads, run_points

    folder, manifest, outcome = sweep.folder, sweep.manifest, SweepOutcome()
    jobs, threads = jobs_and_threads(sweep.left, options.jobs, options.threads, sweep.is_body)
    if options.scheduler not in (None, "local"):
        threads = options.threads or 1  # a thread of a worker of dask for each point
    count = len(manifest.points)
    before = count - sweep.left
    print(
        f"{manifest.name}: {count} points in {folder}, {before} of them finished before", flush=True
    )
    if sweep.left:
        if options.scheduler is None:
            runner, where = Pool(jobs, threads), f"{jobs if jobs > 1 else 'one'} at a time"
        else:
            runner = Cluster(options.scheduler, jobs, threads, folder, Path.cwd())
            where = f"on the cluster {options.scheduler}"
        print(f"  {where}, {threads} thread{'s' if threads > 1 else ''} each", flush=True)
        with progress_of(sweep.left, "points", True) as bar:
            outcome = run_points(
                folder, manifest, runner, options.walltime, options.trust, _shown_on(bar)
            )
    _print_results(sweep, options.extrapolate)
    ended = f"{len(outcome.finished)} finished, {len(outcome.failed)} failed, {before} skipped"
    print(f"  {ended}, {len(outcome.left)} left; {outcome.seconds:.3g} s")
    for point in manifest.points:
        if point.folder in outcome.failed:
            print(f"  failed: {point.folder}: {visible(point.message or '')}")
    if outcome.failed or outcome.left:
        again = shlex.join(["rigidmd", *sys.argv[1:]]).replace(" --force", "")
        print(f"  the same command continues with what is left, and repeats what failed: {again}")
    if outcome.signal is not None:
        return BY_SIGNAL + outcome.signal
    if outcome.out_of_time:
        return OUT_OF_TIME
    return FAILED if outcome.failed or outcome.left else 0


def _shown_on(bar: "Bar") -> Callable[[str, str, Any], None]:
    """A function that shows messages of points: fractions as progress, warnings once each, failures
    at once."""
    from tqdm import tqdm

    from rigidmd.studies.sweep.sweeping import ProgressOfPoints

    progress = ProgressOfPoints(bar)
    shown: set[str] = set()

    def receive(name: str, kind: str, value: Any) -> None:
        progress(name, kind, value)
        line = ""
        if kind in ("ended", "died"):
            why = value if kind == "died" else value["message"]
            line = f"  {name}: {visible(why)}" if why else ""
        elif value not in shown and (
            kind == "warned" or (kind == "announced" and value.startswith("compiling"))
        ):
            shown.add(value)
            line = (
                f"rigidmd: warning: {name}: {visible(value)}"
                if kind == "warned"
                else f"  {name}: {value} ..."
            )
        if line:
            tqdm.write(line, file=sys.stderr)

    return receive


def _print_results(sweep: "OpenSweep", step: str | None) -> None:
    """Write and print the table of what has finished. step : the key of --extrapolate"""
    from rigidmd.studies.sweep.table import collect, table_text

    table, files = collect(sweep.folder, sweep.manifest)
    if files:
        print(table_text(table))
    for name, why in table.failed.items():
        print(f"  {name} is not in the table: {why}")
    names = ["sweep.json", *(path.name for path in files)]
    names += [] if step is None else print_limits(sweep.folder, sweep.manifest, step)
    count = len(sweep.manifest.points)
    print(
        f"\n  files in {sweep.folder}: {', '.join(names)}, and a folder for each of {count} points"
    )
    if any(row.runs for row in table.rows):
        print(f"  `rigidmd analyse {shlex.quote(str(sweep.folder))}` measures all of them")


def print_limits(folder: Path, manifest: "Manifest", step: str) -> list[str]:
    """Write and print what the averages of a sweep are at a step of 0; the names of the files."""
    from rigidmd.studies.sweep.limits import extrapolate_sweep, write_limits

    found = extrapolate_sweep(folder, manifest, step)
    if found.limits:
        print(f"\n{found.title}\n{found.as_text().text(range(len(found.columns()) + 1))}")
    for line in found.missing:
        print(f"  no limit: {line}")
    return write_limits(folder, found, shlex.join(["rigidmd", *sys.argv[1:]]))


def _collect(sweep: "OpenSweep", step: str | None) -> int:
    count = len(sweep.manifest.points)
    print(
        f"{sweep.manifest.name}: {count} points in {sweep.folder}, {count - sweep.left} of them"
        " finished"
    )
    _print_results(sweep, step)
    return FAILED if sweep.left else 0


def _run_point(options: Options) -> int:
    """`--point`: the point that a scheduler started."""
    if options.threads is not None:
        os.environ["NUMBA_NUM_THREADS"] = str(options.threads)  # before Numba is imported
    from rigidmd.studies.sweep.sweeping import run_point

    show = {"warned": warn, "announced": announce}

    def send(kind, value):
        return show[kind](value) if kind in show else None

    folder, scene = Path(options.output), Path(options.scene)
    name, ended = run_point(folder, options.point, scene, options.walltime, options.trust, send)
    print(f"{name}: {ended['state']}, {ended['seconds']:.3g} s")
    if ended["message"]:
        print(f"rigidmd: {name}: {visible(ended['message'])}", file=sys.stderr)
    codes = {"finished": 0, "failed": FAILED, "interrupted": INTERRUPTED}
    return OUT_OF_TIME if ended["out_of_time"] else codes[ended["state"]]
