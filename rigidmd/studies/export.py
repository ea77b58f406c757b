"""`rigidmd export`: writes a scene as a folder that another engine runs by itself."""

import tempfile
from pathlib import Path
from typing import NamedTuple

from rigidmd.assemble.build import build
from rigidmd.core.files import writing
from rigidmd.core.state import State
from rigidmd.engines.external import checked_view
from rigidmd.engines.registry import programs
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.io.folder import SCENE, check_folder, check_names, write_marker, written_by_runs
from rigidmd.io.scene_file import input_names, write_scene
from rigidmd.run import Simulation
from rigidmd.scene import MolecularScene, Scene
from rigidmd.scene.engine import EngineChoice

#: File that lists what an export wrote in its folder; --force replaces the files of an export only.
MARKER = ".rigidmd-export"


class Exported(NamedTuple):
    title: str  # name of the engine
    files: list[str]
    notes: list[str]
    command: str  # that runs the scene in the folder


def export(scene: Scene, to: str, folder: Path, force: bool = False) -> Exported:
    """Write a scene for an external engine. It starts after overlap removal and the first minimisations. Raises
    SceneError with all that the engine cannot do, OutputError if the folder is in use."""
    if not isinstance(scene, MolecularScene):
        raise SceneError(scene.source, ["a single body stays with rigidmd: export is for molecules"])
    check_folder(folder, force, what="export", marker=MARKER)
    program = programs()[to]
    # a scene for an engine that scenes cannot name has the defaults of rigidmd
    engine = EngineChoice.model_validate({"name": to}) if program.engine else EngineChoice()
    system = build(scene.model_copy(update={"engine": engine}))
    later = [
        f"stages.{k}: a minimisation after other stages stays with rigidmd"
        for k, stage in enumerate(system.scene.stages)
        if stage.is_minimisation and any(not before.is_minimisation for before in system.scene.stages[:k])
    ]
    view = checked_view(system, program, program.title, later)
    state = start_of(system)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".export", dir=folder) as made:
            write_scene(Path(made), system.scene)
            names = [SCENE, *input_names(system.scene).values(), *program.load(program.writer)(Path(made), view, state)]
            check_names(folder, names, MARKER)
            for name in written_by_runs(folder, MARKER):
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(made) / name).replace(folder / name)
        write_marker(folder, names, MARKER)
    return Exported(program.title, names, system.notes, program.command)


def start_of(system: System) -> State:
    """The state after overlap removal and the first minimisations, by rigidmd itself."""
    scene = system.scene.model_copy(update={"engine": EngineChoice()})
    return Simulation(scene, warn=lambda sentence: None).part.settle()
