"""`rigidmd view`."""

import argparse
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, add_run_folder, file_about_run, print_page


def add(commands: Commands) -> None:
    about = "write one page with the film of a run, which opens in any browser without a network"
    view = add_command(commands, "view", _view, about, "rigidmd view runs/water -o water.html")
    add_run_folder(view, "page (default: view.html in the folder of the run)")


def _view(options: argparse.Namespace) -> int:
    from rigidmd.view.film_page import VIEW, write_view

    print_page(*write_view(Path(options.folder), file_about_run(options, VIEW, (".html",))))
    return 0
