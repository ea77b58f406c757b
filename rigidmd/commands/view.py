"""Pages and pictures of runs: `rigidmd report`, `view`, `film` and `gallery`."""

import shlex
from pathlib import Path

from rigidmd.commands.arguments import Options, argument, command, file_about_run, number, print_page, run_folder
from rigidmd.commands.streams import announce, progress_bar


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


@command(
    150, "write the film of a run as a file", "rigidmd film runs/water -o water.mp4 --plots",
    *run_folder(".mp4 (needs ffmpeg) or .gif (default: film.mp4 or film.gif in the folder of the run)"),
    argument("--seconds", type=number(float, 0.1, 3600, "a number of seconds from 0.1 to 3600"), metavar="S",
        default=10.0, help="length of the film (default: 10)"),
    argument("--height", type=number(int, 100, 2160, "a number of pixels from 100 to 2160"), metavar="N",
        help="pixels (default: 640, of a .gif 448)"),
    argument("--plots", action="store_true", help="put plots with a moving cursor next to it"),
    scene="this run", writes=True,
)  # fmt: skip
def _film(options: Options) -> int:
    from rigidmd.view.animation import EXTENSIONS, default_name, write_film

    path = file_about_run(options, default_name(), EXTENSIONS)
    with progress_bar() as progress:
        path, notes = write_film(Path(options.folder), path, options.seconds, options.plots, options.height, progress)
    for note in notes:
        print(note)
    print(f"{path}: {path.stat().st_size / 1e6:.2g} MB")
    return 0


@command(
    160, "run shipped bodies and write a page with a picture of each, which leads to its film",
    "rigidmd gallery heavy_top_3 intermediate_axis",
    argument("names", nargs="*", metavar="NAME", help="bodies of `rigidmd examples` (default: eleven)"),
    argument("-o", "--output", metavar="DIR", default="gallery", help="folder (default: gallery)"),
    argument("--force", action="store_true", help="replace an earlier gallery in that folder"),
    scene="the gallery", writes=True,
)  # fmt: skip
def _gallery(options: Options) -> int:
    from rigidmd.io.write import check_target
    from rigidmd.view.run_page import INDEX, selected_bodies, write_gallery

    folder = Path(options.output)
    bodies = selected_bodies(options.names)
    if folder.is_dir():
        for name in (INDEX, *(f"{body.name}.html" for body in bodies)):
            check_target(folder / name, (".html",), options.force)
    command = shlex.join(["rigidmd", "gallery", *options.names])
    print_page(write_gallery(folder, options.names, options.force, command, announce), [])
    return 0
