"""The commands that look at runs: `report`, `view`, `film`, `gallery`. They print and never compute."""

import argparse
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from rigidmd.commands.arguments import number


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
    film = add("film", _film, "write the film of a run as a file", "rigidmd film runs/water -o water.mp4 --plots")
    _run_arguments(film, ".mp4 (needs ffmpeg) or .gif (default: film.mp4 or film.gif in the folder of the run)")
    length = number(float, 0.1, 3600, "a number of seconds from 0.1 to 3600")
    height = number(int, 100, 2160, "a number of pixels from 100 to 2160")
    film.add_argument("--seconds", type=length, default=10.0, metavar="S", help="length of the film (default: 10)")
    film.add_argument("--height", type=height, metavar="N", help="pixels (default: 640, of a .gif 448)")
    film.add_argument("--plots", action="store_true", help="put plots with a moving cursor beside it")

    gallery = add(
        "gallery",
        _gallery,
        "run shipped bodies and write a page with a picture of each, which leads to its film",
        "rigidmd gallery heavy_top_3 intermediate_axis",
    )
    gallery.add_argument("names", nargs="*", metavar="NAME", help="bodies of `rigidmd examples` (default: eleven)")
    gallery.add_argument("-o", "--output", metavar="DIR", default="gallery", help="folder (default: gallery)")
    gallery.add_argument("--force", action="store_true", help="replace an earlier gallery in that folder")
    gallery.set_defaults(scene="the gallery", writes=True)


def _run_arguments(parser: argparse.ArgumentParser, about: str) -> None:
    parser.add_argument("folder", metavar="RUN", help="folder of a run")
    parser.add_argument("-o", "--output", metavar="FILE", help=about)
    parser.add_argument("--force", action="store_true", help="replace that file")
    parser.set_defaults(scene="this run", writes=True)


def _target(options: argparse.Namespace, default: str, endings: tuple[str, ...]) -> Path:
    """The file to write. In the folder of its run it may be written again, and a new run there removes it.

    Raises OutputError.
    """
    from rigidmd.io.folder import add_to_folder, check_is_run
    from rigidmd.io.write import check_target

    folder = Path(options.folder)
    check_is_run(folder)
    if options.output:
        check_target(Path(options.output), endings, options.force)
        return Path(options.output)
    add_to_folder(folder, [default])
    return folder / default


def _report(options: argparse.Namespace) -> int:
    from rigidmd.view.run_page import REPORT, write_report

    path, told = write_report(Path(options.folder), _target(options, REPORT, (".html",)))
    _written(path, told)
    return 0


def _view(options: argparse.Namespace) -> int:
    from rigidmd.view.film_page import VIEW, write_view

    path, told = write_view(Path(options.folder), _target(options, VIEW, (".html",)))
    _written(path, told)
    return 0


def _film(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rigidmd.view.film import ENDINGS, check_writer, default_name, write_film

    path = _target(options, default_name(), ENDINGS)
    check_writer(path)
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{l_bar}{bar}| [{elapsed}<{remaining}]") as bar:
        path, told = write_film(
            Path(options.folder),
            path,
            options.seconds,
            options.plots,
            options.height,
            lambda share: bar.update(share - bar.n),
        )
    for sentence in told:
        print(sentence)
    print(f"{path}: {path.stat().st_size / 1e6:.2g} MB")
    return 0


def _gallery(options: argparse.Namespace) -> int:
    from rigidmd.io.write import check_target
    from rigidmd.view.gallery import INDEX, chosen, write_gallery

    folder = Path(options.output)
    bodies = chosen(options.names)
    if folder.is_dir():
        for name in (INDEX, *(f"{body.name}.html" for body in bodies)):
            check_target(folder / name, (".html",), options.force)
    command = shlex.join(["rigidmd", "gallery", *options.names])
    say = lambda name: print(f"  {name} ...", file=sys.stderr, flush=True)  # noqa: E731
    _written(write_gallery(folder, options.names, options.force, command, say), [])
    return 0


def _written(path: Path, told: list[str]) -> None:
    for sentence in told:
        print(sentence)
    print(f"{path}: {path.stat().st_size / 1e6:.2g} MB; open it in a browser: {shlex.quote(str(path.resolve()))}")
