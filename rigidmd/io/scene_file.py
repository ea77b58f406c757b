"""The scene in the folder of a run, with all defaults and copies of its input files, so that it can be run again."""

import re
import shutil
from pathlib import Path
from typing import Any

import tomli_w

from rigidmd.core.files import atomic_file, write_text
from rigidmd.io.folder import SCENE
from rigidmd.io.formats import STRUCTURE
from rigidmd.scene import Scene


def input_names(scene: Scene) -> dict[str, str]:
    """Names of the copies of a scene's input files: dotted key -> unique name. Copies of copies keep their names."""
    names = {key: path.name for key, path in scene.inputs.items()} | dict.fromkeys(scene.embedded_files, STRUCTURE)
    starts = {key: f"input_{re.sub(r'[.](file|module|table)$|^molecules[.]', '', key)}_" for key in names}
    return {key: starts[key] + name.removeprefix(starts[key]) for key, name in names.items()}


def write_scene(folder: Path, scene: Scene) -> None:
    data = scene.model_dump(exclude_none=True)
    for key, copied in input_names(scene).items():
        with atomic_file(folder / copied) as temporary:
            if key in scene.embedded_files:
                temporary.write_bytes(scene.embedded_files[key])
            else:
                shutil.copyfile(scene.inputs[key], temporary)
        *tables, last = key.split(".")
        section: Any = data
        for part in tables:
            section = section[int(part) if isinstance(section, list | tuple) else part]
        section[last] = copied
    write_text(folder / SCENE, tomli_w.dumps(data))
