"""`rigidmd film`."""

from pathlib import Path

from rigidmd.commands.arguments import (
    Options,
    argument,
    command,
    file_about_run,
    flag,
    number,
    run_folder,
)
from rigidmd.commands.streams import progress_bar


@command(
    "Look",
    30,
    "write an animation of a run as a file",
    "rigidmd film runs/water -o water.mp4 --plots",
    *run_folder(
        ".mp4 (needs ffmpeg) or .gif (default: film.mp4 or film.gif in the folder of the run)"
    ),
    argument(
        "--seconds",
        type=number(float, 0.1, 3600, "a number of seconds from 0.1 to 3600"),
        metavar="S",
        default=10.0,
        help="length of the animation (default: 10)",
    ),
    argument(
        "--height",
        type=number(int, 100, 2160, "a number of pixels from 100 to 2160"),
        metavar="N",
        help="pixels (default: 640, of a .gif 300)",
    ),
    flag("--plots", help="put plots with a moving cursor next to it"),
    scene="this run",
    writes=True,
)
def _film(options: Options) -> int:
    from rigidmd.features.view.animation import EXTENSIONS, default_name, write_film

    path = file_about_run(options, default_name(), EXTENSIONS)
    with progress_bar() as progress:
        path, notes = write_film(
            Path(options.folder),
            path,
            options.seconds,
            with_plots=options.plots,
            height=options.height,
            progress=progress,
        )
    for note in notes:
        print(note)
    print(f"{path}: {path.stat().st_size / 1e6:.2g} MB")
    return 0
