"""`rigidmd compile`."""

import time

from rigidmd.commands.arguments import SCENE, Options, argument, command, read_scene
from rigidmd.commands.streams import shown_working

#: What is compiled without a scene: a liquid with PME, as a first run needs it.
FIRST_SCENE = "water"


@command(
    "Run",
    50,
    "compile what a scene needs without running it. Use it before a course or on the login "
    "node of a cluster",
    "rigidmd compile water.toml",
    argument(
        "scene",
        metavar="SCENE",
        nargs="?",
        help=f"scene file (default: the shipped {FIRST_SCENE}.toml)",
    ),
    *SCENE[1:],
)
def _compile(options: Options) -> int:
    from rigidmd.compile.cache import cache_folder, compiling_announced, describe_cache
    from rigidmd.core.shipped import find_example
    from rigidmd.run import Simulation

    if options.scene is None:
        options.scene = str(find_example(FIRST_SCENE).path)
    scene = read_scene(options)
    announced: list[bool] = []
    began = time.perf_counter()
    with compiling_announced(lambda: announced.append(True)), shown_working("compiling"):
        Simulation(scene).compile()
    if announced:
        print(f"{scene.name}: compiled in {time.perf_counter() - began:.0f} s; {describe_cache()}")
    else:
        print(f"{scene.name}: all code is there already")
    if folder := cache_folder():
        print(f"  {folder}")
    return 0
