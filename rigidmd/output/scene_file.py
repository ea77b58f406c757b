"""The scene of a run, in its folder, with its defaults spelled out and the files it reads: enough to run it again."""

import shutil
from math import inf
from pathlib import Path

import tomli_w

from rigidmd.assemble.system import System
from rigidmd.core.files import whole_file
from rigidmd.output.folder import SCENE
from rigidmd.scene import BodyScene, MolecularScene, Scene


def input_names(scene: Scene) -> dict[str, str]:
    """What the copies of a scene's input files are called: dotted key -> name; no two alike."""
    return {
        key: f"input_{key.removesuffix('.file').replace('molecules.', '')}_{path.name}"
        for key, path in scene.inputs.items()
    }


def write_scene(folder: Path, scene: MolecularScene, system: System) -> None:
    """Write the resolved scene and copies of its input files."""
    data = scene.model_dump(exclude_none=True)
    if system.cutoff < inf:
        data["forces"]["cutoff_A"] = system.cutoff
    data["run"]["remove_momentum_interval_ps"] = scene.removes_momentum_every or False
    for key, copied in input_names(scene).items():
        with whole_file(folder / copied) as temporary:
            shutil.copyfile(scene.inputs[key], temporary)
        *table, last = key.split(".")
        section = data["structure"] if table == ["structure"] else data["molecules"][int(table[1])]
        section[last] = copied
    _write(folder, data)


def write_body_scene(folder: Path, scene: BodyScene) -> None:
    """Write the resolved scene of a body."""
    _write(folder, scene.model_dump(exclude_none=True))


def _write(folder: Path, data: dict) -> None:
    with whole_file(folder / SCENE) as temporary:
        temporary.write_text(tomli_w.dumps(data), encoding="utf-8")
