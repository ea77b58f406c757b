"""`rigidmd report`."""

from pathlib import Path

from rigidmd.commands.arguments import Options, command, file_about_run, print_page, run_folder


@command(
    "Look",
    20,
    "write a page about a run: means with errors, plots, files. It also has margins and how "
    "to repeat the run",
    "rigidmd report runs/water",
    *run_folder("page (default: report.html in the folder of the run)"),
    scene="this run",
    writes=True,
)
def _report(options: Options) -> int:
    from rigidmd.features.view.run_page import REPORT, write_report

    print_page(*write_report(Path(options.folder), file_about_run(options, REPORT, (".html",))))
    return 0
