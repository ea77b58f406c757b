"""The scene in the folder of a run, with all defaults and copies of its input files, so that it can run again."""

import shutil
from pathlib import Path

import tomli_w

from rigidmd.core.files import whole_file
from rigidmd.output.folder import SCENE
from rigidmd.scene import Scene


def input_names(scene: Scene) -> dict[str, str]:
    """Names for the copies of a scene's input files: dotted key -> unique name. A copy keeps its name."""
    starts = {key: f"input_{key.removesuffix('.file').replace('molecules.', '')}_" for key in scene.inputs}
    return {key: starts[key] + path.name.removeprefix(starts[key]) for key, path in scene.inputs.items()}


def write_scene(folder: Path, scene: Scene) -> None:
    """Write a resolved scene and copies of its input files."""
    data = scene.model_dump(exclude_none=True)
    for key, copied in input_names(scene).items():
        with whole_file(folder / copied) as temporary:
            shutil.copyfile(scene.inputs[key], temporary)
        *table, last = key.split(".")
        section = data["structure"] if table == ["structure"] else data["molecules"][int(table[1])]
        section[last] = copied
    with whole_file(folder / SCENE) as temporary:
        temporary.write_text(tomli_w.dumps(data), encoding="utf-8")
