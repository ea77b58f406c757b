"""`rigidmd stability`."""

from pathlib import Path

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Options, command, flag, output_folder, repeated, write_study


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
    results = write_study(
        folder,
        force=options.force,
        files=FILES,
        begins="",
        measure=lambda progress: list(
            run_cases(options.case, quick=options.quick, progress=progress)
        ),
        describe=lambda results: summary(results, verbose=options.verbose),
        write=write_stability,
    )
    return FAILED if any(result.failure for result in results) else 0
