"""`rigidmd compare`."""

import argparse
import json
from pathlib import Path

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Commands, add_command


def add(commands: Commands) -> None:
    about = "report where two runs diverge and how their inputs and versions differ; exit code 0 if they are the same "
    about += "to the last bit, else 1"
    compare = add_command(commands, "compare", _compare, about, "rigidmd compare runs/water runs/water2")
    compare.add_argument("first", metavar="RUN", help="folder of a run")
    compare.add_argument("second", metavar="RUN", help="folder of another run")
    compare.add_argument("--json", action="store_true", help="print JSON")


def _compare(options: argparse.Namespace) -> int:
    from rigidmd.studies.compare import compare, describe_run_comparison

    found = compare(Path(options.first), Path(options.second))
    print(json.dumps(found.to_json(), indent=2) if options.json else describe_run_comparison(found))
    return 0 if found.same else FAILED
