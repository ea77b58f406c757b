"""The commands that look at a run: `report`, `view`. They print and never compute."""

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path


def add_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add them with `add(name, function, about, example)`."""
    report = add(
        "report",
        _report,
        "write one page about a run: means with errors, plots, margins, files, how to repeat it",
        "rigidmd report runs/water",
    )
    _run_arguments(report, "page (default: report.html in the folder of the run)")
    view = add(
        "view",
        _view,
        "write one page with the film of a run, which opens in any browser without a network",
        "rigidmd view runs/water -o water.html",
    )
    _run_arguments(view, "page (default: view.html in the folder of the run)")


def _run_arguments(parser: argparse.ArgumentParser, about: str) -> None:
    parser.add_argument("folder", metavar="RUN", help="folder of a run")
    parser.add_argument("-o", "--output", metavar="FILE", help=about)
    parser.add_argument("--force", action="store_true", help="replace that file")
    parser.set_defaults(scene="this run")


def _target(options: argparse.Namespace, default: str, endings: tuple[str, ...]) -> Path:
    """The file to write. In the folder of its run it may be written again, and a new run there removes it.

    Raises OutputError.
    """
    from rigidmd.output.folder import add_to_folder, check_is_run
    from rigidmd.output.target import check_target

    folder = Path(options.folder)
    check_is_run(folder)
    if options.output:
        check_target(Path(options.output), endings, options.force)
        return Path(options.output)
    add_to_folder(folder, [default])
    return folder / default


def _report(options: argparse.Namespace) -> int:
    from rigidmd.looking.report import REPORT, write_report

    path, told = write_report(Path(options.folder), _target(options, REPORT, (".html",)))
    _written(path, told)
    return 0


def _view(options: argparse.Namespace) -> int:
    from rigidmd.looking.view import VIEW, write_view

    path, told = write_view(Path(options.folder), _target(options, VIEW, (".html",)))
    _written(path, told)
    return 0


def _written(path: Path, told: list[str]) -> None:
    for sentence in told:
        print(sentence)
    print(f"{path}: {path.stat().st_size / 1e6:.2g} MB; open it in a browser: {shlex.quote(str(path.resolve()))}")
