"""`rigidmd report`."""

import argparse
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, add_run_folder, file_about_run, print_page


def add(commands: Commands) -> None:
    about = "write one page about a run: means with errors, plots, margins, files, how to repeat it"
    report = add_command(commands, "report", _report, about, "rigidmd report runs/water")
    add_run_folder(report, "page (default: report.html in the folder of the run)")


def _report(options: argparse.Namespace) -> int:
    from rigidmd.view.run_page import REPORT, write_report

    print_page(*write_report(Path(options.folder), file_about_run(options, REPORT, (".html",))))
    return 0
