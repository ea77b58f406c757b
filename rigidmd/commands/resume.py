"""`rigidmd resume`."""

import argparse
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, add_trust
from rigidmd.commands.run import add_duration, run_scene


def add(commands: Commands) -> None:
    example = "rigidmd resume runs/water --until 200ps"
    resume = add_command(commands, "resume", _resume, "continue a run that was stopped", example)
    resume.add_argument("folder", metavar="DIR", help="folder of the run")
    add_trust(resume)
    add_duration(resume)
    resume.set_defaults(overrides=[], force=False, resume=True)


def _resume(options: argparse.Namespace) -> int:
    from rigidmd.io.folder import SCENE, check_is_run

    folder = Path(options.folder)
    check_is_run(folder)
    options.scene, options.output = str(folder / SCENE), options.folder
    return run_scene(options)
