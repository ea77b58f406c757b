"""`rigidmd verify`."""

import argparse
import json

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import Commands, add_command, add_engine, add_scene, read_scene


def add(commands: Commands) -> None:
    about = "compute a scene on two engines and compare energies by term, forces, virial, and a short run; exit code 0 "
    about += "if they agree, else 1"
    example = "rigidmd verify water_pme.toml --engine lammps --ranks 2"
    verify = add_command(commands, "verify", _verify, about, example)
    add_scene(verify)
    add_engine(verify, "lammps or openmm", "the scene's, or lammps; openmm on its platform Reference")
    verify.add_argument("--json", action="store_true", help="print JSON")


def _verify(options: argparse.Namespace) -> int:
    from rigidmd.scene import MolecularScene
    from rigidmd.studies.verify import verify

    if options.engine == "openmm" and options.platform is None:
        options.platform = "Reference"
    scene = read_scene(options)
    if options.engine is None and isinstance(scene, MolecularScene) and not scene.engine.is_external:
        options.engine = "lammps"
        scene = read_scene(options)
    found = verify(scene)
    print(json.dumps(found.to_json(), indent=2) if options.json else found.description())
    return 0 if found.agrees else FAILED
