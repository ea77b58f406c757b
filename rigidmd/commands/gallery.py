"""`rigidmd gallery`."""

import argparse
import shlex
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, print_page
from rigidmd.commands.streams import announce


def add(commands: Commands) -> None:
    about = "run shipped bodies and write a page with a picture of each, which leads to its film"
    example = "rigidmd gallery heavy_top_3 intermediate_axis"
    gallery = add_command(commands, "gallery", _gallery, about, example)
    gallery.add_argument("names", nargs="*", metavar="NAME", help="bodies of `rigidmd examples` (default: eleven)")
    gallery.add_argument("-o", "--output", metavar="DIR", default="gallery", help="folder (default: gallery)")
    gallery.add_argument("--force", action="store_true", help="replace an earlier gallery in that folder")
    gallery.set_defaults(scene="the gallery", writes=True)


def _gallery(options: argparse.Namespace) -> int:
    from rigidmd.io.write import check_target
    from rigidmd.view.gallery import INDEX, selected_bodies, write_gallery

    folder = Path(options.output)
    bodies = selected_bodies(options.names)
    if folder.is_dir():
        for name in (INDEX, *(f"{body.name}.html" for body in bodies)):
            check_target(folder / name, (".html",), options.force)
    command = shlex.join(["rigidmd", "gallery", *options.names])
    print_page(write_gallery(folder, options.names, options.force, command, announce), [])
    return 0
