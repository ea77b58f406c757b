"""`rigidmd run`."""

import shlex
from pathlib import Path

from rigidmd.commands import BY_SIGNAL, OUT_OF_TIME
from rigidmd.commands.arguments import (
    SCENE,
    Options,
    add_engine,
    argument,
    command,
    flag,
    read_scene,
    seconds,
    time_ps,
)
from rigidmd.commands.streams import announce, warn

#: Options of a run that starts or continues.
DURATION = (
    argument(
        "--threads", type=int, metavar="N", help="threads (default: the scene's, or all cores)"
    ),
    argument(
        "--walltime",
        type=seconds,
        metavar="H:MM:SS",
        help="stop shortly before this time is up, with a checkpoint and exit code 75",
    ),
    argument(
        "--until",
        type=time_ps,
        metavar="TIME",
        help=(
            "let the last stage end at this time of the run, such as 200ps or 1.5ns. This"
            " lengthens a finished run"
        ),
    ),
    flag(
        "-v",
        "--verbose",
        help="print all that the summary has: every stage, precision, momentum, energy noise",
    ),
)


@command(
    "Run",
    20,
    "run a scene",
    "rigidmd run water.toml -o runs/water",
    *SCENE,
    argument("-o", "--output", metavar="DIR", help="folder for the results (default: runs/NAME)"),
    flag("--force", help="replace an earlier run in that folder"),
    flag(
        "--resume",
        help=(
            "continue from the last checkpoint in that folder, with bitwise identical results."
            " Without a checkpoint, start the run"
        ),
    ),
    add_engine,
    *DURATION,
    writes=True,
)
def run(options: Options) -> int:
    """The command `rigidmd run`."""
    from rigidmd.run.kind import kind_of

    scene = read_scene(options)
    if options.threads is not None:
        kind_of(scene).check_has(scene, "--threads")
        scene = read_scene(options, threads=options.threads)
    if options.until is not None:
        scene = scene.with_end(options.until)
    folder = Path(options.output) if options.output else Path("runs") / scene.name
    from rigidmd.io.folder import check_folder

    if not options.resume:
        check_folder(folder, force=options.force)  # before anything slow is imported
    from rigidmd.run import Simulation

    simulation = Simulation(
        scene,
        folder,
        options.force,
        say=announce,
        warn=warn,
        resume=options.resume,
        walltime=options.walltime,
    )
    print(simulation._introduction(), flush=True)
    results = simulation.run(progress=True)
    print(simulation._conclusion(results, verbose=options.verbose))
    names = f": {', '.join(path.name for path in results.files)}" if options.verbose else ""
    print(f"\nresults in {folder}{names}")
    quoted = shlex.quote(str(folder))
    if results.interrupted:
        print(f"`rigidmd resume {quoted}` continues it")
    else:
        print(f"next:  rigidmd {kind_of(scene).next_command} {quoted}     rigidmd view {quoted}")
    if results.out_of_time:
        return OUT_OF_TIME
    return BY_SIGNAL + results.signal if results.signal else 0
