"""The commands `export` and `verify`, by which a scene goes to another engine. They print and never compute."""

import argparse
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rigidmd.commands.arguments import add_engine

#: Of `verify`, whose exit code tells whether the engines agree.
AGREES, PARTS = 0, 1


def add_commands(
    add: Callable[..., argparse.ArgumentParser],
    scene_arguments: Callable[[argparse.ArgumentParser], None],
    read_scene: Callable[..., Any],
) -> None:
    """Add them with `add(name, function, about, example)`; scenes are read by `read_scene(options, key=value)`."""
    export = add(
        "export",
        _export,
        "write a scene as a folder that runs on another engine by itself",
        "rigidmd export water_pme.toml --to lammps -o water_lammps",
    )
    scene_arguments(export)
    export.add_argument("--to", required=True, choices=["lammps", "openmm", "gromacs"], help="the engine")
    export.add_argument("-o", "--output", metavar="DIR", help="the folder (default: NAME-ENGINE)")
    export.add_argument("--force", action="store_true", help="replace an earlier export in that folder")
    export.set_defaults(writes=True, read_scene=read_scene)

    verify = add(
        "verify",
        _verify,
        "compute a scene on two engines and hold them against each other: energies by term, forces, virial, a short "
        "run; exit code 0 if they agree, else 1",
        "rigidmd verify water_pme.toml --engine lammps --ranks 2",
    )
    scene_arguments(verify)
    add_engine(verify, "lammps or openmm", "the scene's, or lammps; openmm on its platform Reference")
    verify.add_argument("--json", action="store_true", help="print JSON")
    verify.set_defaults(read_scene=read_scene)


def _export(options: argparse.Namespace) -> int:
    from rigidmd.studies.export import export

    scene = options.read_scene(options)
    folder = Path(options.output or f"{scene.name}-{options.to}")
    done = export(scene, options.to, folder, options.force)
    print(f"{scene.name} for {done.title} in {folder}: {', '.join(done.files)}")
    for note in done.notes:
        print(f"  {note}")
    print(f"next:\n  cd {shlex.quote(str(folder))} && {done.command}")
    return 0


def _verify(options: argparse.Namespace) -> int:
    import json

    from rigidmd.scene import MolecularScene
    from rigidmd.studies.verify import verify

    if options.engine == "openmm" and options.platform is None:
        options.platform = "Reference"
    scene = options.read_scene(options)
    if options.engine is None and isinstance(scene, MolecularScene) and not scene.engine.is_external:
        options.engine = "lammps"
        scene = options.read_scene(options)
    found = verify(scene)
    print(json.dumps(found.told(), indent=2) if options.json else found.in_words())
    return AGREES if found.agrees else PARTS
