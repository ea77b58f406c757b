"""Checkpoints: all that a run needs to go on to the same bits, in one file without pickle."""

import contextlib
import json
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.files import file_fault, sync_file, whole_file
from rigidmd.errors import CheckpointError
from rigidmd.io.folder import CHECKPOINT, PREVIOUS

#: Of the files. Version 1 (rigidmd 0.1) named observers by their number.
SCHEMA = 2
#: Members that are no arrays of the run: the rest as JSON, and the names, lengths and CRC-32 of all other members.
TOLD, CONTENTS = "told", "contents"


class Checkpoint(NamedTuple):
    """What is kept."""

    told: dict[str, Any]  # numbers, strings, lists and dictionaries of them
    arrays: dict[str, np.ndarray]

    def of(self, owner: str) -> "Checkpoint":
        """The part of one owner, whose arrays are called owner/name."""
        start = f"{owner}/"
        found = {name.removeprefix(start): array for name, array in self.arrays.items() if name.startswith(start)}
        return Checkpoint(dict(self.told["of"].get(owner, {})), found)


def count_list(values: Any) -> list[int]:
    """A list of counts from a checkpoint. Raises ValueError if they are none."""
    if not isinstance(values, list) or not all(type(value) is int and value >= 0 for value in values):
        raise ValueError(f"{values!r:.60} are no sizes and checksums of a file")
    return values


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, on the disk before it takes the place of the last one, which is kept. Raises OutputError."""
    path = folder / CHECKPOINT
    with whole_file(path) as temporary:
        told = json.dumps(checkpoint.told | {"schema": SCHEMA}).encode()
        with temporary.open("wb") as file:
            arrays: dict[str, Any] = {TOLD: np.frombuffer(told, np.uint8), **checkpoint.arrays}
            np.savez(file, **arrays)
        with zipfile.ZipFile(temporary, "a") as archive:
            archive.writestr(CONTENTS, _contents(archive))
        sync_file(temporary)
        if path.exists():
            path.replace(folder / PREVIOUS)
    with contextlib.suppress(OSError):  # a folder cannot be synchronised everywhere
        sync_file(folder)


def _contents(archive: zipfile.ZipFile) -> str:
    """Names, lengths and checksums of the members of an archive but for the list of them."""
    return "\n".join(f"{m.filename} {m.file_size} {m.CRC:08x}" for m in archive.infolist() if m.filename != CONTENTS)


def read_checkpoint(path: Path) -> Checkpoint:
    """Read one back. Raises CheckpointError if a bit of it is not as it was written."""
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.read(CONTENTS).decode() != _contents(archive):
                raise ValueError("its contents are not those that were written")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files if name != CONTENTS}
        told = json.loads(arrays.pop(TOLD).tobytes())
        schema = int(told.pop("schema"))
    except FileNotFoundError:
        raise CheckpointError(f"{path}: there is no such file") from None
    except Exception as error:  # zipfile, zlib, numpy and json refusals all mean the same to the user
        raise CheckpointError(f"{path}: is damaged, or no checkpoint: {error}") from None
    if schema != SCHEMA:
        age = "a later" if schema > SCHEMA else "an earlier"
        raise CheckpointError(
            f"{path}: was written by {age} rigidmd (version {schema} of the format; this one reads version {SCHEMA}): "
            "finish the run with that one, or begin it again with --force"
        )
    return Checkpoint(told, arrays)


def latest(folder: Path) -> tuple[Checkpoint, list[str]]:
    """The last checkpoint of a folder that can be read, and what is wrong with a later one.

    Raises CheckpointError if there is none.
    """
    faults = []
    for name in (CHECKPOINT, PREVIOUS):
        path = folder / name
        if not os.path.lexists(path):
            continue
        if fault := file_fault(path):
            faults.append(f"{path}: {fault}")
            continue
        try:
            return read_checkpoint(path), faults
        except CheckpointError as error:
            faults.append(str(error))
    there = sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    if faults:
        raise CheckpointError("; ".join(faults) + f". The run cannot go on from {folder}")
    listed = f"it holds {', '.join(there)}" if there else "it is empty"
    raise CheckpointError(f"{folder} holds no checkpoint ({listed}); --force begins the run again")
