"""`rigidmd export`: writes a scene as a folder that another engine runs by itself."""

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rigidmd.assemble.build import build
from rigidmd.core.files import writing
from rigidmd.core.state import State
from rigidmd.engines.force_field import ForceFieldView, force_field_of
from rigidmd.engines.system import System
from rigidmd.errors import OutputError, SceneError
from rigidmd.io.folder import SCENE, check_names, write_marker, written_by_runs
from rigidmd.io.scene_file import input_names, write_scene
from rigidmd.run import Simulation
from rigidmd.scene import MolecularScene, Scene
from rigidmd.scene.molecules import EngineChoice

#: File that lists what an export wrote in its folder; --force replaces the files of an export only.
MARKER = ".rigidmd-export"


class EngineWriter(NamedTuple):
    title: str  # name of the engine
    unsupported_features: Callable[[ForceFieldView], list[str]]
    write: Callable[[Path, ForceFieldView, State], list[str]]  # into a folder; returns the names of files
    command: str  # that runs the scene in the folder


class Exported(NamedTuple):
    title: str  # name of the engine
    files: list[str]
    notes: list[str]
    command: str  # that runs the scene in the folder


def export(scene: Scene, to: str, folder: Path, force: bool = False) -> Exported:
    """Write a scene for "lammps", "openmm" or "gromacs". It starts after overlap removal and the first minimisations.

    Raises SceneError with all that the engine cannot do, OutputError if the folder is in use.
    """
    if not isinstance(scene, MolecularScene):
        raise SceneError(scene.source, ["a single body stays with rigidmd: export is for molecules"])
    _check(folder, force)
    writer = writer_for(to)
    # GROMACS has the thermostats and barostats of rigidmd, so its scene has the defaults of rigidmd
    engine = EngineChoice() if to == "gromacs" else EngineChoice.model_validate({"name": to})
    system = build(scene.model_copy(update={"engine": engine}))
    view = force_field_of(system)
    unsupported = writer.unsupported_features(view) + [
        f"stages.{k}: a minimisation after other stages stays with rigidmd"
        for k, stage in enumerate(system.scene.stages)
        if stage.is_minimisation and any(not before.is_minimisation for before in system.scene.stages[:k])
    ]
    if unsupported:
        raise SceneError(scene.source, [f"{writer.title}: {feature}" for feature in unsupported])
    state = start_of(system)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".export", dir=folder) as made:
            write_scene(Path(made), system.scene)
            names = [SCENE, *input_names(system.scene).values(), *writer.write(Path(made), view, state)]
            check_names(folder, names, MARKER)
            for name in written_by_runs(folder, MARKER):
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(made) / name).replace(folder / name)
        write_marker(folder, names, MARKER)
    return Exported(writer.title, names, system.notes, writer.command)


def start_of(system: System) -> State:
    """The state after overlap removal and the first minimisations, by rigidmd itself."""
    scene = system.scene.model_copy(update={"engine": EngineChoice()})
    return Simulation(scene, warn=lambda sentence: None).settle()


def writer_for(to: str) -> EngineWriter:
    """The writer for "lammps", "openmm" or "gromacs"."""
    if to == "lammps":
        from rigidmd.engines.lammps.files import INPUT, unsupported_features, write_lammps

        return EngineWriter("LAMMPS", unsupported_features, write_lammps, f"lmp -in {INPUT}")
    if to == "gromacs":
        from rigidmd.engines.gromacs.files import unsupported_features, write_gromacs

        return EngineWriter("GROMACS", unsupported_features, write_gromacs, "sh run.sh")
    from rigidmd.engines.openmm.files import write_openmm
    from rigidmd.engines.openmm.system import unsupported_features

    return EngineWriter("OpenMM", unsupported_features, write_openmm, "python run.py")


def _check(folder: Path, force: bool) -> None:
    """Raise OutputError if an export cannot be written there; changes nothing."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name another folder with -o")
    if folder.is_dir() and any(folder.iterdir()):
        if not (folder / MARKER).is_file():
            raise OutputError(f"{folder} is not empty and holds no earlier export; name another folder with -o")
        if not force:
            raise OutputError(f"{folder} holds an earlier export; --force replaces it, -o names another folder")
    parent = folder
    while not parent.exists():
        parent = parent.parent
    if not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} cannot be written: no permission in {parent}; name another folder with -o")
