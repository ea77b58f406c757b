"""`rigidmd resume`."""

import argparse
from pathlib import Path

from rigidmd.commands.arguments import add_trust, command
from rigidmd.commands.run import add_duration, run


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", metavar="DIR", help="folder of the run")
    add_trust(parser)
    add_duration(parser)
    parser.set_defaults(overrides=[], force=False, resume=True)


@command(40, "continue a run that was stopped", "rigidmd resume runs/water --until 200ps", _arguments)
def _resume(options: argparse.Namespace) -> int:
    from rigidmd.io.folder import SCENE, check_is_run

    folder = Path(options.folder)
    check_is_run(folder)
    options.scene, options.output = str(folder / SCENE), options.folder
    return run(options)
