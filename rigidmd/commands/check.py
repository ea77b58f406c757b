"""`rigidmd check`."""

import argparse

from rigidmd.commands.arguments import add_engine, add_scene, command, read_scene
from rigidmd.commands.streams import warn


def _arguments(parser: argparse.ArgumentParser) -> None:
    add_scene(parser)
    add_engine(parser)


@command(70, "describe a run without running it", "rigidmd check water_nitrogen.toml", _arguments)
def _check(options: argparse.Namespace) -> int:
    from rigidmd.assemble.describe import describe
    from rigidmd.run.pilot.stable_step import step_warnings
    from rigidmd.scene import BodyScene, MolecularScene

    scene = read_scene(options)
    print(describe(scene))
    if isinstance(scene, MolecularScene) and scene.engine.is_external:
        from rigidmd.assemble.build import build
        from rigidmd.engines.external import check_engine

        print(check_engine(build(scene)))
    for warning in [] if isinstance(scene, BodyScene) else step_warnings(scene):
        warn(warning)
    return 0
