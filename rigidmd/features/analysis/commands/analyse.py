"""`rigidmd analyse`."""

import argparse
from importlib import import_module
from pathlib import Path

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Options, argument, command, flag, number, repeated, time_ps
from rigidmd.commands.streams import progress_bar
from rigidmd.features import modules


class _List(argparse.Action):
    def __call__(self, parser, *_):
        from rigidmd.features.analysis.registry import (
            analysis_order,
            known,
            selected,
            sweep_analyses,
        )

        for entry in selected(sorted(known(), key=analysis_order)):
            print(f"{entry.name:18} {entry.about}")
        for of_sweep in sweep_analyses():
            print(f"{of_sweep.name:18} {of_sweep.about}, of a sweep")
        parser.exit()


@command(
    "Look",
    40,
    "measure g(r), diffusion, viscosity and more in a run, with errors. Orientation and the "
    "dielectric constant are among them",
    "rigidmd analyse runs/water --only rdf,diffusion --from 10ps",
    argument(
        "folder",
        metavar="RUN",
        help=(
            "folder of a run, or of a sweep, whose runs are analysed together. For `insertion` also"
            " a scene, into whose frozen molecules a model is inserted without a run"
        ),
    ),
    argument(
        "requests",
        nargs="*",
        metavar="NAME",
        help=(
            "analyses to run, like --only. KEY=VALUE sets one of their options, such as"
            " `insertion model=krypton trials=5000`"
        ),
    ),
    argument(
        "--only",
        type=lambda text: [name.strip() for name in text.split(",") if name.strip()],
        default=[],
        metavar="NAMES",
        help="analyses to run, separated by commas (default: all). `--list` names them",
    ),
    argument(
        "--from",
        dest="start",
        type=time_ps,
        metavar="TIME",
        help=(
            "use frames from this time of the run onwards, such as 10ps (default: from where the"
            " run is found to be equilibrated)"
        ),
    ),
    argument(
        "--viscosity",
        type=number(float, 1e-6, 1e12, "a viscosity from 1e-6 to 1e12"),
        metavar="VALUE",
        help=(
            "viscosity in mPa s for the finite-size correction of D (default: measured in the run)"
        ),
    ),
    argument(
        "--figures",
        choices=["png", "svg", "pdf"],
        default="png",
        help="type of the figures (default: png)",
    ),
    argument(
        "--extrapolate",
        metavar="KEY",
        help=(
            "for a sweep: extrapolate all averages and values to a time step of 0. KEY is the"
            " time step that the sweep varies, such as stages.1.timestep_fs"
        ),
    ),
    repeated(
        "--trust",
        "FILE.py",
        help=(
            "run this Python file first. It may define analyses with @rigidmd.analysis.register."
            " Can be repeated"
        ),
    ),
    flag("-v", "--verbose", help="also print the notes of each analysis, and what its curves show"),
    argument("--list", action=_List, nargs=0, help="list the analyses"),
    scene="this run",
    writes=True,
)
def _analyse(options: Options) -> int:
    from rigidmd.errors import OutputError
    from rigidmd.features import provider
    from rigidmd.features.analysis.files import analyse_folder
    from rigidmd.features.analysis.registry import run_user_file, sweep_analyses
    from rigidmd.features.analysis.report import frames_text
    from rigidmd.io.folder import SWEEP, check_is_run
    from rigidmd.scene import parse_override

    for path in options.trust:
        run_user_file(Path(path))
    names = [*options.only, *(text for text in options.requests if "=" not in text)]
    more = dict(parse_override(text) for text in options.requests if "=" in text)
    if options.folder.endswith(".toml"):
        return _analyse_scene(options.folder, names, more, verbose=options.verbose)
    with progress_bar() as progress:
        folder = Path(options.folder)
        request = (names, options.start, options.viscosity)
        if (folder / SWEEP).exists():
            studies = provider("analyse_sweep", f"{folder}, a sweep,")
            return studies.analyse_sweep(folder, request, more, progress, options)
        check_is_run(folder)
        for of_sweep in sweep_analyses():
            if of_sweep.name in names:
                raise OutputError(
                    f"{of_sweep.name} needs a sweep over {of_sweep.over}, and {folder} is the"
                    " folder of a run"
                )
        if options.extrapolate is not None:
            raise OutputError(
                f"--extrapolate needs a sweep over a time step, and {folder} is the folder of a"
                f" run: `rigidmd analyse {folder} zero_step` needs one run only"
            )
        done = analyse_folder(folder, *request, progress, options.figures, more)
    used = done.frames_used
    text = frames_text(used["frames"], used["from_ps"], used["to_ps"])
    print(f"{options.folder}: {text}")
    for note in used["notes"]:
        print(f"  {note}")
    print_results(done.results, done.failed, verbose=options.verbose)
    print(
        f"\n{len(done.files)} files in {options.folder}, values in {done.files[0].name}. `rigidmd"
        " report` shows them"
    )
    return FAILED if names and done.failed else 0


def _analyse_scene(path: str, names: list[str], more: dict[str, object], *, verbose: bool) -> int:
    """Print the results of an analysis that needs no run."""
    from rigidmd.errors import OutputError

    of_scenes = dict(modules("scene_analyses"))
    if len(names) != 1 or names[0] not in of_scenes:
        known = " or ".join(of_scenes)
        raise OutputError(
            f"{path} is a scene, and only {known} needs no run: `rigidmd analyse {path} {known}"
            " model=NAME`, or `rigidmd run` first"
        )
    results, failed = import_module(of_scenes[names[0]]).results_of_scene(path, more)
    print_results(results, failed, verbose=verbose)
    return FAILED if failed else 0


def print_results(results: list, failed: dict[str, str], *, verbose: bool) -> None:
    from rigidmd.features.analysis.report import results_text

    print(*results_text(results, failed, verbose=verbose), sep="\n")
    if verbose:
        print(*("", *results), sep="\n")
