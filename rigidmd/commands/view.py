"""`rigidmd report` and `rigidmd view`."""

import argparse
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, add_run_folder, file_about_run, print_page


def add(commands: Commands) -> None:
    about = "write one page about a run: means with errors, plots, margins, files, how to repeat it"
    report = add_command(commands, "report", _report, about, "rigidmd report runs/water")
    add_run_folder(report, "page (default: report.html in the folder of the run)")

    about = "write one page with the film of a run, which opens in any browser without a network"
    view = add_command(commands, "view", _view, about, "rigidmd view runs/water -o water.html")
    add_run_folder(view, "page (default: view.html in the folder of the run)")


def _report(options: argparse.Namespace) -> int:
    from rigidmd.view.run_page import REPORT, write_report

    print_page(*write_report(Path(options.folder), file_about_run(options, REPORT, (".html",))))
    return 0


def _view(options: argparse.Namespace) -> int:
    from rigidmd.view.animation_page import VIEW, write_view

    print_page(*write_view(Path(options.folder), file_about_run(options, VIEW, (".html",))))
    return 0
