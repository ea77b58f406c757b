"""The folder of a run: made once, never overwritten unasked, files in it whole or not there."""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from rigidmd.errors import OutputError

SCENE_FILE = "scene.toml"  # every run writes it first, so it marks a folder as that of a run


def check_folder(folder: Path, force: bool) -> None:
    """Raise OutputError if a run could not be written to `folder`; changes nothing."""
    if folder.exists():
        if not folder.is_dir():
            raise OutputError(f"{folder} is a file; name another folder with -o")
        if any(folder.iterdir()):
            if not (folder / SCENE_FILE).is_file():
                raise OutputError(f"{folder} is not empty and holds no earlier run; name another folder with -o")
            if not force:
                raise OutputError(f"{folder} holds an earlier run; --force replaces it, -o names another folder")
    parent = folder
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} cannot be written: no permission in {parent}; name another folder with -o")


def make_folder(folder: Path, force: bool) -> None:
    """Make an empty folder for a run; an earlier run in it is removed if `force`. Raises OutputError."""
    check_folder(folder, force)
    try:
        if folder.exists() and (folder / SCENE_FILE).is_file():
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made: {error.strerror}") from None


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` that takes its name when the block ends well, and vanishes when it does not."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}.", suffix=path.suffix)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)
