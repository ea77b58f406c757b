"""The scene of a run, in its folder, with its defaults spelled out and the files it reads: enough to run it again."""

import shutil
from pathlib import Path
from typing import Any

import tomli_w

from rigidmd.assemble.body import BodySystem
from rigidmd.assemble.system import System
from rigidmd.core.files import whole_file
from rigidmd.core.schemes import RK4, Solver
from rigidmd.output.folder import SCENE
from rigidmd.scene import BodyScene, MolecularScene, Scene


def input_names(scene: Scene) -> dict[str, str]:
    """What the copies of a scene's input files are called: dotted key -> name; no two alike."""
    return {
        key: f"input_{key.removesuffix('.file').replace('molecules.', '')}_{path.name}"
        for key, path in scene.inputs.items()
    }


def resolved(scene: MolecularScene, system: System) -> dict[str, Any]:
    """A scene with every number that its run uses, as tables: what it left open is as it was decided."""
    data = scene.model_dump(exclude_none=True)
    data["forces"] |= system.decided
    if scene.forces.gives_waves or {"pme_grid", "ewald_k_radius_per_A"} & set(system.decided):
        data["forces"].pop("ewald_accuracy")  # what follows from it is said
    data["run"]["remove_momentum_interval_ps"] = system.removes_momentum_every or False
    if scene.structure is None or not scene.structure.velocities:
        data["start"].setdefault("temperature_K", scene.stages[0].temperature_K)
    return data


def write_scene(folder: Path, scene: MolecularScene, system: System) -> None:
    """Write the resolved scene and copies of its input files."""
    data = resolved(scene, system)
    for key, copied in input_names(scene).items():
        with whole_file(folder / copied) as temporary:
            shutil.copyfile(scene.inputs[key], temporary)
        *table, last = key.split(".")
        section = data["structure"] if table == ["structure"] else data["molecules"][int(table[1])]
        section[last] = copied
    _write(folder, data)


def write_body_scene(folder: Path, scene: BodyScene, system: BodySystem) -> None:
    """Write the scene of a body with every number that its run uses."""
    data = scene.model_dump(exclude_none=True)
    data["output"]["interval_s"] = scene.interval
    if isinstance(method := system.method, Solver):
        data["run"]["formulation"] = method.formulation
        if method.name != RK4:
            data["run"]["relative_tolerance"] = method.relative_tolerance
            data["run"]["absolute_tolerance"] = method.absolute_tolerance
    _write(folder, data)


def _write(folder: Path, data: dict) -> None:
    with whole_file(folder / SCENE) as temporary:
        temporary.write_text(tomli_w.dumps(data), encoding="utf-8")
