"""A single file that a command writes: checked before anything slow begins."""

from collections.abc import Iterable
from pathlib import Path

from rigidmd.errors import OutputError


def check_target(
    path: Path, endings: tuple[str, ...], force: bool, what: str = "file", inputs: Iterable[Path] = ()
) -> None:
    """Raise OutputError if a file cannot be written there or would replace one; changes nothing.

    inputs : files that it is made of, which are never replaced
    """
    if path.suffix not in endings:
        raise OutputError(f"{path}: the name of this {what} ends in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: there is no folder {path.parent}")
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise OutputError(f"{path} is what this {what} is made of; -o names another file")
    if path.exists() and not force:
        raise OutputError(f"{path} exists; --force replaces it, -o names another file")
