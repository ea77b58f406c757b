"""The scene of a run, in its folder, with every default spelled out and the files it reads: enough to run it again."""

import shutil
from math import inf
from pathlib import Path

import tomli_w

from rigidmd.build.system import System
from rigidmd.output.folder import SCENE_FILE, whole_file
from rigidmd.scene import Scene


def write_scene(folder: Path, scene: Scene, system: System) -> None:
    """Write the resolved scene and copies of its input files."""
    data = scene.model_dump(exclude_none=True)
    if system.cutoff < inf:
        data["forces"]["cutoff_A"] = system.cutoff
    for section in [data.get("structure", {}), *data["molecules"]]:
        if "file" in section:
            source = scene.path(section["file"])
            section["file"] = f"input_{source.name}"
            with whole_file(folder / section["file"]) as temporary:
                shutil.copyfile(source, temporary)
    with whole_file(folder / SCENE_FILE) as temporary:
        temporary.write_text(tomli_w.dumps(data), encoding="utf-8")
