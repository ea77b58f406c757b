"""`rigidmd verify`."""

import argparse
import json

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import SCENE, Options, add_engine, command, flag, read_scene
from rigidmd.commands.streams import shown_working
from rigidmd.core.programs import runnable


def _engine(parser: argparse.ArgumentParser) -> None:
    first, *_ = runnable()
    precise = [
        f"; {name} with {key} {value}"
        for name, of in runnable().items()
        for key, value in of.precise.items()
    ]
    add_engine(parser, f"the scene's, or {first}{''.join(precise)}", itself=False)


@command(
    "Study",
    50,
    "compare energies and forces of a scene on two engines. Energies are compared by term, "
    "also the virial and a short run. Exit code 0 if they agree, else 1",
    "rigidmd verify water_pme.toml --engine lammps --ranks 2",
    *SCENE,
    _engine,
    flag("--json", help="print JSON"),
)
def _verify(options: Options) -> int:
    from rigidmd.features.external.verify import verify
    from rigidmd.scene import is_molecular

    scene = read_scene(options)
    if options.engine is None and is_molecular(scene) and not scene.engine.is_external:
        options.engine, *_ = runnable()
    if options.engine in runnable():
        for key, value in runnable()[options.engine].precise.items():
            setattr(options, key, getattr(options, key) or value)
        scene = read_scene(options)
    with shown_working("comparing with another engine"):
        comparison = verify(scene)
    print(json.dumps(comparison.to_json(), indent=2) if options.json else comparison.description())
    return 0 if comparison.agrees else FAILED
