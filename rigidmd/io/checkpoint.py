"""Checkpoints: all data that a run needs to resume to the same bits, in one file without pickle."""

import contextlib
import json
import os
import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.core.files import atomic_file, sync_file, unreadable_reason
from rigidmd.core.toml import Json
from rigidmd.errors import CheckpointError, option
from rigidmd.io.folder import CHECKPOINT, PREVIOUS

#: Version of the format. Version 1 (rigidmd 0.1) named observers by their number; 2 had no record
#: of the run; 3 had other names, 6 other columns.
SCHEMA = 7
#: Members besides the arrays of the run: all other values as JSON, and names, lengths and CRC-32 of
#: all other members.
JSON, CONTENTS = "values", "contents"
#: The name of JSON in version 3.
FORMER_JSON = "told"


class Checkpoint(NamedTuple):
    values: Json  # numbers, strings, lists and dictionaries of them
    arrays: dict[str, np.ndarray]

    def of(self, owner: str) -> "Checkpoint":
        """The part of one owner, whose arrays have names of the form owner/name."""
        start = f"{owner}/"
        arrays = {
            name.removeprefix(start): array
            for name, array in self.arrays.items()
            if name.startswith(start)
        }
        return Checkpoint(dict(self.values["of"].get(owner, {})), arrays)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint to the disk, then replace the last one, which is kept as PREVIOUS. Raises
    OutputError."""
    path = folder / CHECKPOINT
    with atomic_file(path) as temporary:
        values = json.dumps(checkpoint.values | {"schema": SCHEMA}).encode()
        with temporary.open("wb") as file:
            arrays = {JSON: np.frombuffer(values, np.uint8), **checkpoint.arrays}
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
        with zipfile.ZipFile(temporary, "a") as archive:
            archive.writestr(CONTENTS, _contents(archive))
        sync_file(temporary)
        if path.exists():
            path.replace(folder / PREVIOUS)
    with contextlib.suppress(OSError):  # a folder cannot be synchronised everywhere
        sync_file(folder)


def _contents(archive: zipfile.ZipFile) -> str:
    """Names, lengths and checksums of all archive members except this list."""
    return "\n".join(
        f"{m.filename} {m.file_size} {m.CRC:08x}"
        for m in archive.infolist()
        if m.filename != CONTENTS
    )


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint. Raises CheckpointError if any bit differs from what was written."""
    if reason := unreadable_reason(path):
        raise CheckpointError(f"{path}: {reason}")
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.read(CONTENTS).decode() != _contents(archive):
                raise ValueError("its contents differ from those that were written")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files if name != CONTENTS}
        name = JSON if JSON in arrays else FORMER_JSON
        values = json.loads(arrays.pop(name).tobytes())
        schema = int(values.pop("schema"))
    except Exception as error:  # errors from zipfile, zlib, numpy and json all mean the same
        raise CheckpointError(f"{path}: is damaged, or not a checkpoint: {error}") from None
    if schema != SCHEMA:
        age = "a later" if schema > SCHEMA else "an earlier"
        problem = (
            f"was written by {age} rigidmd (version {schema} of the format; this one reads version"
            f" {SCHEMA})"
        )
        raise CheckpointError(
            f"{path}: {problem}: finish the run with that one, or begin it again with"
            f" {option('force')}"
        )
    return Checkpoint(values, arrays)


def latest(folder: Path) -> tuple[Checkpoint, list[str]]:
    """The last readable checkpoint of a folder, and the error of a later one. Raises
    CheckpointError without one."""
    errors = []
    for name in (CHECKPOINT, PREVIOUS):
        path = folder / name
        if os.path.lexists(path):
            try:
                return read_checkpoint(path), errors
            except CheckpointError as error:
                errors.append(str(error))
    if folder.is_dir():
        file_names = sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    else:
        file_names = []
    if errors:
        raise CheckpointError("; ".join(errors) + f". The run cannot be resumed from {folder}")
    listed = f"it holds {', '.join(file_names)}" if file_names else "it is empty"
    raise CheckpointError(
        f"{folder} holds no checkpoint ({listed}); {option('force')} begins the run again"
    )
