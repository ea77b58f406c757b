"""`rigidmd schema`."""

import argparse
import json

from rigidmd.commands.arguments import command


@command(180, "print the JSON schema of scenes, for editors", "rigidmd schema > scene.schema.json")
def _schema(options: argparse.Namespace) -> int:
    from rigidmd.scene import schema

    print(json.dumps(schema(), indent=2, allow_nan=False))
    return 0
