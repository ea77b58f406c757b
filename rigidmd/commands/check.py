"""`rigidmd check`."""

import argparse

from rigidmd.commands.arguments import Commands, add_command, add_engine, add_scene, read_scene
from rigidmd.commands.streams import warn


def add(commands: Commands) -> None:
    example = "rigidmd check water_nitrogen.toml"
    check = add_command(commands, "check", _check, "describe a run without running it", example)
    add_scene(check)
    add_engine(check)


def _check(options: argparse.Namespace) -> int:
    from rigidmd.assemble.describe import describe
    from rigidmd.run.pilot.stable_step import step_warnings
    from rigidmd.scene import BodyScene, MolecularScene

    scene = read_scene(options)
    print(describe(scene))
    if isinstance(scene, MolecularScene) and scene.engine.is_external:
        from rigidmd.assemble.build import build
        from rigidmd.engines.external import check_supported

        check_supported(build(scene))
    for warning in [] if isinstance(scene, BodyScene) else step_warnings(scene):
        warn(warning)
    return 0
