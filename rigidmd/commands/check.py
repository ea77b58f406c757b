"""`rigidmd check`."""

from rigidmd.commands.arguments import SCENE, Options, add_engine, command, read_scene
from rigidmd.commands.streams import warn


@command(70, "describe a run without running it", "rigidmd check water_nitrogen.toml", *SCENE, add_engine)
def _check(options: Options) -> int:
    from rigidmd.assemble.describe import describe
    from rigidmd.assemble.time_step import step_warnings
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
