"""`rigidmd export`."""

import argparse
import shlex
from pathlib import Path

from rigidmd.commands.arguments import Commands, add_command, add_output_folder, add_scene, read_scene


def add(commands: Commands) -> None:
    about = "write a scene as a folder that runs on another engine by itself"
    example = "rigidmd export water_pme.toml --to lammps -o water_lammps"
    export = add_command(commands, "export", _export, about, example)
    add_scene(export)
    export.add_argument("--to", required=True, choices=["lammps", "openmm", "gromacs"], help="the engine")
    add_output_folder(export, "NAME-ENGINE", "an earlier export")


def _export(options: argparse.Namespace) -> int:
    from rigidmd.studies.export import export

    scene = read_scene(options)
    folder = Path(options.output or f"{scene.name}-{options.to}")
    done = export(scene, options.to, folder, options.force)
    print(f"{scene.name} for {done.title} in {folder}: {', '.join(done.files)}")
    for note in done.notes:
        print(f"  {note}")
    print(f"next:\n  cd {shlex.quote(str(folder))} && {done.command}")
    return 0
