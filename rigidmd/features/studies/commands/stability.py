"""`rigidmd stability`."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Options, command, flag, output_folder, repeated, write_study

if TYPE_CHECKING:
    from rigidmd.features.studies.stability.runner import TrialResult


@command(
    "Study",
    70,
    "run the built-in stress tests, each compared with a known answer. Exit code 1 if an "
    "error is undetected",
    "rigidmd stability --quick --case near_linear --case water_steps",
    flag("--quick", help="use fewer settings, integrators and steps, which takes minutes"),
    repeated("--case", "NAME", help="only this case, may be repeated"),
    flag("-v", "--verbose", help="list the warnings of the runs"),
    *output_folder("runs/stability"),
    scene="stability",
    writes=True,
)
def _stability(options: Options) -> int:
    from rigidmd.features.studies.stability.report import FILES, summary, write_stability
    from rigidmd.features.studies.stability.runner import run_cases

    folder = Path(options.output) if options.output else Path("runs") / "stability"

    def measure(progress: Callable) -> list["TrialResult"]:
        results = []
        for result in run_cases(options.case, quick=options.quick, progress=progress):
            if results and results[-1].case.name != result.case.name:
                _show_case(results)
            results.append(result)
        _show_case(results)
        return results

    results = write_study(
        folder,
        force=options.force,
        files=FILES,
        begins="",
        measure=measure,
        describe=lambda results: summary(results, verbose=options.verbose),
        write=write_stability,
    )
    return FAILED if any(result.failure for result in results) else 0


def _show_case(results: list["TrialResult"]) -> None:
    """Print a line on the last case."""
    from tqdm import tqdm

    from rigidmd.features.studies.stability.report import verdict_counts

    case = [result for result in results if result.case.name == results[-1].case.name]
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in verdict_counts(case).items())
    seconds = sum(result.seconds for result in case)
    text = f"  {case[0].case.name}: {verdicts or 'longest steps'}; {seconds:.1f} s"
    tqdm.write(text, file=sys.stderr)
