"""`rigidmd new`."""

import shlex
from pathlib import Path

from rigidmd.commands.arguments import Options, argument, command, flag


@command(
    "Start",
    10,
    "copy a shipped scene, notebook or script to start from",
    "rigidmd new water -o mine.toml",
    argument("name", metavar="NAME", help="which one. `rigidmd examples` lists them"),
    argument("-o", "--output", metavar="FILE", help="the copy (default: NAME.toml, .ipynb or .py)"),
    flag("--force", help="replace that file"),
)
def _new(options: Options) -> int:
    from rigidmd.core.shipped import copy_example, find_example, series_of
    from rigidmd.scene import Scene

    example = find_example(options.name)
    path = Path(options.output or f"{example.name}{example.path.suffix}")
    read = Scene.read(example.path).inputs.values() if example.kind == "scene" else ()
    written = copy_example(example, path, force=options.force, read=read)
    if example.name != options.name:
        print(
            f"{options.name} is a series of scenes ({', '.join(series_of(options.name))}). This is"
            f" {example.name}"
        )
    print(f"{path}: {example.about}")
    if inputs := [str(file) for file in written[1:]]:
        print(f"files that it reads, copied to the same folder: {', '.join(inputs)}")
    print("next:")
    quoted = shlex.quote(str(path))
    if example.kind == "script":
        print(f"  python {quoted}    runs it. `rigidmd help extending` explains it")
        return 0
    if example.kind == "notebook":
        print(
            "  open it in Jupyter, VS Code or any program for notebooks: pip install chemiscope"
            " jupyterlab pandas"
        )
        print(f"  jupyter lab {quoted}")
        return 0
    print(f"  rigidmd check {quoted}    describes the run without running it")
    print(f"  rigidmd run {quoted}      runs it. Results go to {Path('runs') / path.stem}")
    print("its comment describes what to look at. `rigidmd help scene` explains every table")
    return 0
