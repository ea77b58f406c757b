"""`rigidmd compare`."""

import json
from pathlib import Path

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Options, argument, command, flag
from rigidmd.commands.streams import shown_working


@command(
    "Look",
    50,
    "report where two runs diverge. It also prints how their inputs and versions differ. "
    "Exit code 0 if they are the same to the last bit, else 1",
    "rigidmd compare runs/water runs/water2",
    argument("first", metavar="RUN", help="folder of a run"),
    argument("second", metavar="RUN", help="folder of another run"),
    flag("--json", help="print JSON"),
)
def _compare(options: Options) -> int:
    from rigidmd.features.studies.compare import compare, describe_run_comparison

    with shown_working("comparing"):
        comparison = compare(Path(options.first), Path(options.second))
    print(
        json.dumps(comparison.to_json(), indent=2)
        if options.json
        else describe_run_comparison(comparison)
    )
    return 0 if comparison.same else FAILED
