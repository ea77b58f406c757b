"""The folder of a sweep: its manifest sweep.json, and in a folder each, which are those of runs, its points."""

import contextlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from rigidmd.errors import OutputError
from rigidmd.io.folder import LOCK, MARKER, SUMMARY, SWEEP, add_to_folder, is_empty, offsets_of, written_by_runs
from rigidmd.io.run_files import Bounded, Summary, read_json
from rigidmd.io.write import write_json, writing
from rigidmd.scene.validation import not_none
from rigidmd.studies.sweep.names import point_name, short_keys

MANIFEST, TABLE, FIGURE, SCRIPT = SWEEP, "sweep.csv", "sweep.png", "sweep.sbatch"
#: While it is there, points that run elsewhere stop at their next look.
STOP = "stop"
FILES = (MANIFEST, TABLE, FIGURE, SCRIPT, STOP)
#: Of the manifest.
SCHEMA = 1
WAITING, RUNNING, FINISHED, INTERRUPTED, FAILED = "waiting", "running", "finished", "interrupted", "failed"
#: The key whose values make replicas.
SEED = "seed"


class Schema(BaseModel):
    """The version of a manifest."""

    schema_: int = Field(alias="schema")


@dataclass
class Point:
    """A point of a sweep.

    folder : name of its folder
    values : swept key -> value
    scene_sha256 : digest of its scene, as it was read, and of the files that it reads
    ran_sha256 : scene_sha256 of the summary of its run, once it has ended
    message : of a failed point, why
    seconds : that it ran, in all
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    folder: str
    values: dict[str, Any]
    scene_sha256: str
    state: Annotated[str, Field(pattern="^(waiting|running|finished|interrupted|failed)$")] = WAITING
    ran_sha256: str | None = None
    message: str | None = None
    seconds: Bounded = 0.0


@dataclass
class Manifest:
    """What a sweep is made of.

    scene : the file of the scene
    keys : swept key -> the keys that are set together with it, itself first
    fixed : key -> value for all points
    common : dotted key -> value of the scene, without the swept keys
    inputs : dotted key -> SHA-256 of the files that all points read
    """

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    name: str
    scene: str
    keys: dict[str, list[str]]
    fixed: dict[str, Any]
    common: dict[str, Any]
    inputs: dict[str, str]
    points: list[Point] = field(default_factory=list)
    schema: int = SCHEMA

    def overrides(self, point: Point) -> dict[str, Any]:
        """Dotted key -> value of a point, for `Scene.read`."""
        return self.fixed | {key: value for first, value in point.values.items() for key in self.keys[first]}

    def folder_of(self, values: dict[str, Any]) -> str:
        """The name of the folder for what is found over the replicas of a combination of values."""
        return point_name(values, short_keys(self.keys))

    def combinations(self) -> list[tuple[dict[str, Any], list[Point]]]:
        """The values of all keys but `seed`, each with its points: its replicas, if the seed is swept."""
        found: list[tuple[dict[str, Any], list[Point]]] = []
        places: dict[str, int] = {}
        for point in self.points:
            values = {key: value for key, value in point.values.items() if key != SEED}
            place = places.setdefault(json.dumps(values), len(found))
            if place == len(found):
                found.append((values, []))
            found[place][1].append(point)
        return found


def is_sweep(folder: Path) -> bool:
    """Whether a folder is that of a sweep."""
    return (folder / MANIFEST).is_file()


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a sweep. Raises OutputError if it is none."""
    path, remedy = folder / MANIFEST, "; --force begins the sweep anew"
    schema = read_json(path, Schema, remedy)
    if schema is None:
        raise OutputError(f"{path} cannot be read: there is no such file")
    if schema.schema_ > SCHEMA:
        raise OutputError(
            f"{path}: was written by a later rigidmd (version {schema.schema_} of the format; this one reads {SCHEMA})"
        )
    found = not_none(read_json(path, Manifest, remedy))
    names = [point.folder for point in found.points]
    fault = ""
    if any(Path(name).name != name or name in ("", ".", "..") for name in names) or len({*names}) < len(names):
        fault = "points with names of folders that a sweep does not give"
    if any(point.values.keys() != found.keys.keys() for point in found.points):
        fault = "points without values of all keys"
    if any(key not in together for key, together in found.keys.items()):
        fault = "keys that are not set with themselves"
    if fault:
        raise OutputError(f"{path} is no manifest of a sweep: {fault}{remedy}")
    return found


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write sweep.json as a whole. Raises OutputError."""
    write_json(folder / MANIFEST, asdict(manifest), indent=1)


def check_sweep_folder(folder: Path) -> None:
    """Raise OutputError if a folder holds what is not of a sweep; changes nothing."""
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder} is a file; name another folder with -o")
    if not is_empty(folder) and not is_sweep(folder):
        raise OutputError(f"{folder} is not empty and holds no sweep; name another folder with -o")


def make_sweep_folder(folder: Path) -> None:
    """Make it, and note the files that a sweep writes there. Raises OutputError."""
    with writing(folder, "made", "; name another folder with -o"):
        folder.mkdir(parents=True, exist_ok=True)
    add_to_folder(folder, FILES)


def clear_sweep(folder: Path, names: Iterable[str]) -> None:
    """Remove what a sweep wrote: its own files, and those of the runs in folders of these names. Raises OutputError."""
    for inner in [*(folder / name for name in names if Path(name).name == name), folder]:
        if not inner.is_dir() or (inner.is_symlink() and inner != folder):
            continue
        with writing(inner, "cleared"):
            for name in written_by_runs(inner):
                for own in (inner / name, *offsets_of(inner / name)):
                    own.unlink(missing_ok=True)
            (inner / MARKER).unlink(missing_ok=True)
            if inner != folder:
                (inner / LOCK).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # it holds files of others
                    inner.rmdir()


def state_on_disk(folder: Path, point: Point) -> str:
    """What the folder of a point says: finished, interrupted, or waiting if nothing has run there."""
    own = folder / point.folder
    try:
        summary = read_json(own / SUMMARY, Summary) or Summary(interrupted=True)
        ended = not summary.interrupted and point.ran_sha256 in (None, summary.scene_sha256)
    except OutputError:
        ended = False
    if ended:
        return FINISHED
    return INTERRUPTED if (own / MARKER).is_file() else WAITING
