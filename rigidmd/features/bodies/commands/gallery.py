"""`rigidmd gallery`."""

import shlex
from pathlib import Path

from rigidmd.commands.arguments import Options, argument, command, flag, print_page
from rigidmd.commands.streams import announce


@command(
    160,
    "run shipped bodies and write a page with a picture of each, which links to its animation",
    "rigidmd gallery heavy_top_3 intermediate_axis",
    argument(
        "names",
        nargs="*",
        metavar="NAME",
        help="bodies from `rigidmd examples` (default: eleven of them)",
    ),
    argument("-o", "--output", metavar="DIR", default="gallery", help="folder (default: gallery)"),
    flag("--force", help="replace an earlier gallery in that folder"),
    scene="the gallery",
    writes=True,
)
def _gallery(options: Options) -> int:
    from rigidmd.features.bodies.gallery import INDEX, selected_bodies, write_gallery
    from rigidmd.io.write import check_target

    folder = Path(options.output)
    bodies = selected_bodies(options.names)
    if folder.is_dir():
        for name in (INDEX, *(f"{body.name}.html" for body in bodies)):
            check_target(folder / name, (".html",), force=options.force)
    command = shlex.join(["rigidmd", "gallery", *options.names])
    print_page(
        write_gallery(
            folder, options.names, force=options.force, command=command, progress=announce
        ),
        [],
    )
    return 0
