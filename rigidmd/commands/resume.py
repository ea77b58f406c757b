"""`rigidmd resume`."""

from pathlib import Path

from rigidmd.commands.arguments import TRUST, Options, argument, command
from rigidmd.commands.run import DURATION, run


@command(
    "Run",
    30,
    "continue a run that was stopped",
    "rigidmd resume runs/water --until 200ps",
    argument("folder", metavar="DIR", help="folder of the run"),
    TRUST,
    *DURATION,
    overrides=[],
    force=False,
    resume=True,
    writes=True,
)
def _resume(options: Options) -> int:
    from rigidmd.io.folder import SCENE, check_is_run

    folder = Path(options.folder)
    check_is_run(folder)
    options.scene, options.output = str(folder / SCENE), options.folder
    return run(options)
