"""`rigidmd schema`."""

import argparse
import json

from rigidmd.commands.arguments import Commands, add_command


def add(commands: Commands) -> None:
    about = "print the JSON schema of scenes, for editors"
    add_command(commands, "schema", _schema, about, "rigidmd schema > scene.schema.json")


def _schema(options: argparse.Namespace) -> int:
    from rigidmd.scene import schema

    print(json.dumps(schema(), indent=2, allow_nan=False))
    return 0
