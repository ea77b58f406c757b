"""`rigidmd models`."""

import shlex
from pathlib import Path

from rigidmd.commands.arguments import Options, argument, command, flag
from rigidmd.commands.streams import warn
from rigidmd.errors import MoleculeError


@command(
    "Start",
    30,
    "list, show or draw molecular models, or write a custom one",
    "rigidmd models tip4p2005 --draw -o water.svg\n  rigidmd models --from dye.xyz --parameters"
    " table.toml -o dye.toml",
    argument(
        "model",
        nargs="?",
        metavar="NAME",
        help="model to show, or the .toml file of a custom model",
    ),
    flag("--draw", help="draw it to NAME.png"),
    argument(
        "--from",
        dest="geometry",
        metavar="FILE",
        help=(
            "write a custom model: a structure file with one molecule, of any format that a scene"
            " reads"
        ),
    ),
    argument(
        "--parameters",
        metavar="TABLE",
        help=(
            "with --from: a .toml file with charges and Lennard-Jones parameters by atom name or"
            " element"
        ),
    ),
    argument("--name", metavar="NAME", dest="custom_name", help="with --from: name of the model"),
    argument(
        "-o",
        "--output",
        metavar="FILE",
        help=(
            "picture file: .png, .svg or .pdf. With --from: the model file (default: the name of"
            " the structure file, with .toml)"
        ),
    ),
    flag("--force", help="replace that file"),
)
def _models(options: Options) -> int:
    from rigidmd.assemble.model_text import models_table, molecule_text
    from rigidmd.assemble.plausibility import molecule_warnings
    from rigidmd.features import provider
    from rigidmd.scene.models import available_models, load_model, read_molecule

    if options.geometry is not None:
        return _write_model(options)
    if options.parameters is not None or options.custom_name is not None:
        option = "--parameters" if options.parameters is not None else "--name"
        raise MoleculeError(
            "models", [f"{option} belongs to --from FILE, which writes a custom model"]
        )
    draws = options.draw or options.output is not None
    if options.model is None:
        if draws:
            raise MoleculeError("models", ["--draw and -o need the NAME of a model"])
        print(models_table([load_model(name) for name in available_models()]))
        print("\n`rigidmd models NAME` shows one in full. --draw draws it")
        return 0
    molecule = (
        read_molecule(Path(options.model))
        if options.model.endswith(".toml")
        else load_model(options.model)
    )
    for warning in molecule_warnings(molecule) if options.model.endswith(".toml") else ():
        warn(warning)
    if not draws:
        print(molecule_text(molecule))
        return 0
    path = Path(options.output or f"{Path(options.model).stem}.png")
    provider("draw_model", "--draw").draw_model(path, molecule, force=options.force)
    print(f"{molecule.name} is drawn in {path}")
    return 0


def _write_model(options: Options) -> int:
    """`models --from`."""
    from rigidmd.assemble.plausibility import molecule_warnings
    from rigidmd.assemble.species import model_from_geometry
    from rigidmd.io.scene_file import write_model
    from rigidmd.io.write import check_target

    if options.model is not None:
        problem = (
            f"--from writes a custom model: leave out {options.model}, or name the model by --name"
        )
        raise MoleculeError("models", [problem])
    geometry = Path(options.geometry)
    parameters = Path(options.parameters) if options.parameters else None
    path = Path(options.output or f"{geometry.stem}.toml")
    if options.draw:
        raise MoleculeError(
            "models", [f"--from writes a model. Draw it afterwards: rigidmd models {path} --draw"]
        )
    file, molecule, notes = model_from_geometry(geometry, parameters, options.custom_name)
    check_target(
        path,
        (".toml",),
        force=options.force,
        what="model",
        inputs=[geometry, *([parameters] if parameters else [])],
    )
    write_model(path, file)
    print(f"{path}: {molecule.name}, {molecule.description}; {file.source}")
    for note in [*notes, *molecule_warnings(molecule)]:
        warn(note)
    print("next:")
    print(f"  rigidmd models {shlex.quote(str(path))}    shows it. --draw draws it")
    print(f'a scene uses it by a line of its [[molecules]]: file = "{path.name}"')
    return 0
