"""`rigidmd view`."""

from pathlib import Path

from rigidmd.commands.arguments import Options, command, file_about_run, print_page, run_folder


@command(
    "Look",
    10,
    "write a page with the animation of a run. It opens in any browser without a network",
    "rigidmd view runs/water -o water.html",
    *run_folder("page (default: view.html in the folder of the run)"),
    scene="this run",
    writes=True,
)
def _view(options: Options) -> int:
    from rigidmd.features.view.run_page import VIEW, write_view

    print_page(*write_view(Path(options.folder), file_about_run(options, VIEW, (".html",))))
    return 0
