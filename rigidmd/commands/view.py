"""`rigidmd report` and `rigidmd view`."""

from pathlib import Path

from rigidmd.commands.arguments import Options, command, file_about_run, print_page, run_folder


@command(
    138, "write one page about a run: means with errors, plots, margins, files, how to repeat it",
    "rigidmd report runs/water",
    *run_folder("page (default: report.html in the folder of the run)"), scene="this run", writes=True,
)  # fmt: skip
def _report(options: Options) -> int:
    from rigidmd.view.run_page import REPORT, write_report

    print_page(*write_report(Path(options.folder), file_about_run(options, REPORT, (".html",))))
    return 0


@command(
    140, "write one page with the film of a run, which opens in any browser without a network",
    "rigidmd view runs/water -o water.html",
    *run_folder("page (default: view.html in the folder of the run)"), scene="this run", writes=True,
)  # fmt: skip
def _view(options: Options) -> int:
    from rigidmd.view.run_page import VIEW, write_view

    print_page(*write_view(Path(options.folder), file_about_run(options, VIEW, (".html",))))
    return 0
