"""`rigidmd export`."""

import shlex
from pathlib import Path

from rigidmd.commands.arguments import SCENE, Options, command, output_folder, read_scene
from rigidmd.commands.streams import shown_working
from rigidmd.core.programs import programs


@command(
    "Study",
    60,
    "write a scene as a folder that runs on another engine by itself",
    "rigidmd export water_pme.toml --to lammps -o water_lammps",
    *SCENE,
    lambda parser: parser.add_argument(
        "--to",
        required=True,
        choices=[name for name, of in programs().items() if of.writer],
        help="the engine",
    ),
    *output_folder("NAME-ENGINE", "an earlier export"),
    writes=True,
)
def _export(options: Options) -> int:
    from rigidmd.features.external.verify import export

    scene = read_scene(options)
    folder = Path(options.output or f"{scene.name}-{options.to}")
    with shown_working(f"exporting to {options.to}"):
        done = export(scene, options.to, folder, options.force)
    print(f"{scene.name} for {done.title} in {folder}: {', '.join(done.files)}")
    for note in done.notes:
        print(f"  {note}")
    print(f"next:\n  cd {shlex.quote(str(folder))} && {done.command}")
    return 0
