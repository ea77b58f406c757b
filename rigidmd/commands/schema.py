"""`rigidmd schema`."""

import json

from rigidmd.commands.arguments import Options, command


@command(
    "", 10, "print the JSON schema of scenes, for editors", "rigidmd schema > scene.schema.json"
)
def _schema(options: Options) -> int:
    from rigidmd.scene import schema

    print(json.dumps(schema(), indent=2, allow_nan=False))
    return 0
