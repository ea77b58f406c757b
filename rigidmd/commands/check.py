"""`rigidmd check`."""

from rigidmd.commands.arguments import SCENE, Options, add_engine, command, read_scene
from rigidmd.commands.streams import warn


@command(70, "describe a run without running it", "rigidmd check water_nitrogen.toml", *SCENE, add_engine)
def _check(options: Options) -> int:
    from rigidmd.assemble.describe import describe_system
    from rigidmd.scene import BodyScene

    scene = read_scene(options)
    if isinstance(scene, BodyScene):
        from rigidmd.assemble.body import build_body
        from rigidmd.run.pilot.stable_step import body_step_warnings

        body = build_body(scene)
        print(describe_system(body))
        warnings = [*body.warnings, *body_step_warnings(body)]
    else:
        from rigidmd.assemble.build import build
        from rigidmd.assemble.time_step import step_warnings
        from rigidmd.engines.external import check_engine

        system = build(scene)
        print(describe_system(system))
        if scene.engine.is_external:
            print(check_engine(system))
        warnings = [*system.warnings, *step_warnings(scene)]
    for warning in warnings:
        warn(warning)
    return 0
