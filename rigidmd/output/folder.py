"""The folder of a run: it is never overwritten without --force, and its files are complete or absent."""

import os
from collections.abc import Iterable
from pathlib import Path

from rigidmd.errors import OutputError

#: Files of a run; the scene names trajectory and topology.
SCENE, LOG, MOTION, MOTION_NPZ = "scene.toml", "log.csv", "motion.csv", "motion.npz"
FINAL, LAST_GOOD, ENERGY, SUMMARY = "final.npz", "last_good_state.npz", "energy.png", "summary.json"
#: Marks the folder of a run and lists the files that the run may write, one a line; --force may remove these.
MARKER = ".rigidmd-run"


def check_folder(folder: Path, force: bool, inputs: Iterable[Path] = ()) -> None:
    """Raise OutputError if a run could not be written there, or would remove one of its inputs; changes nothing."""
    if folder.exists():
        if not folder.is_dir():
            raise OutputError(f"{folder} is a file; name another folder with -o")
        if any(folder.iterdir()):
            if not (folder / MARKER).is_file():
                raise OutputError(f"{folder} is not empty and holds no earlier run; name another folder with -o")
            if not force:
                raise OutputError(f"{folder} holds an earlier run; --force replaces it, -o names another folder")
            doomed = {(folder / name).resolve() for name in _written(folder)}
            for path in inputs:
                if path.resolve() in doomed:
                    raise OutputError(
                        f"{path} is an input of this run and would be replaced; name another folder with -o"
                    )
    parent = folder
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} cannot be written: no permission in {parent}; name another folder with -o")


def make_folder(folder: Path, force: bool, names: Iterable[str], inputs: Iterable[Path] = ()) -> None:
    """Make the folder of a run that will write these files. Of an earlier run only the files that it wrote are removed.

    Raises OutputError.
    """
    check_folder(folder, force, inputs)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in _written(folder):
            (folder / name).unlink(missing_ok=True)
        (folder / MARKER).write_text("\n".join(names) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder} cannot be made: {error.strerror}") from None


def _written(folder: Path) -> list[str]:
    """Files that an earlier run in this folder may have written; only plain names, whatever its marker contains."""
    marker = folder / MARKER
    if not marker.is_file():
        return []
    return [name for name in marker.read_text(encoding="utf-8").split("\n") if name and Path(name).name == name]
