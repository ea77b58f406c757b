"""The folder of a sweep: its manifest sweep.json, and a folder for each point, which is the folder
of a run."""

import contextlib
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from rigidmd.core.files import writing
from rigidmd.errors import OutputError, option
from rigidmd.io.folder import (
    LOCK,
    MARKER,
    SUMMARY,
    SWEEP,
    check_inside,
    offsets_of,
    written_by_runs,
)
from rigidmd.io.run_files import Bounded, Summary, read_json
from rigidmd.io.write import write_json
from rigidmd.scene.validation import not_none

MANIFEST, TABLE, FIGURE, SCRIPT = SWEEP, "sweep.csv", "sweep.png", "sweep.sbatch"
STOP = "stop"  # while this file exists, points on other machines stop at their next observation
FILES = (MANIFEST, TABLE, FIGURE, SCRIPT, STOP)
SCHEMA = 1  # version of the format of the manifest
State = Literal["waiting", "running", "finished", "interrupted", "failed"]
SEED = "seed"  # the key whose values make replicas
LONGEST = 120  # most letters of the name of a folder


class ManifestVersion(BaseModel):
    schema_: int = Field(alias="schema")


@dataclass
class SweepPoint:
    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    folder: str  # its name
    values: dict[str, Any]  # swept key -> value
    scene_sha256: str  # digest of its scene, as it was read, and of the files that it reads
    state: State = "waiting"
    ran_sha256: str | None = None  # scene_sha256 of the summary of its run, once it has ended
    message: str | None = None  # why it failed
    seconds: Bounded = 0.0  # run time of all attempts


@dataclass
class Manifest:
    """The scene, the keys and the points of a sweep."""

    __pydantic_config__ = ConfigDict(strict=True, extra="forbid")

    name: str
    scene: str  # its file
    keys: dict[str, list[str]]  # swept key -> the keys that are set together with it, itself first
    fixed: dict[str, Any]  # key -> value for all points
    common: dict[str, Any]  # dotted key -> value of the scene, without the swept keys
    inputs: dict[str, str]  # dotted key -> SHA-256 of the files that all points read
    points: list[SweepPoint] = field(default_factory=list)
    schema: int = SCHEMA

    def overrides(self, point: SweepPoint) -> dict[str, Any]:
        """Dotted key -> value of a point, for `Scene.read`."""
        return self.fixed | {
            key: value for first, value in point.values.items() for key in self.keys[first]
        }

    def combinations(self) -> list[tuple[dict[str, Any], list[SweepPoint]]]:
        """The values of all keys but `seed`, each with its points: its replicas, if the seed is
        swept."""
        found: dict[str, tuple[dict[str, Any], list[SweepPoint]]] = {}
        for point in self.points:
            values = {key: value for key, value in point.values.items() if key != SEED}
            found.setdefault(json.dumps(values), (values, []))[1].append(point)
        return list(found.values())


def is_sweep(folder: Path) -> bool:
    return (folder / MANIFEST).is_file()


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a sweep. Raises OutputError."""
    path, remedy = folder / MANIFEST, f"; {option('force')} begins the sweep anew"
    schema = read_json(path, ManifestVersion, remedy)
    if schema is None:
        raise OutputError(f"{folder} holds no sweep; `rigidmd sweep SCENE --set ...` makes one")
    if schema.schema_ > SCHEMA:
        versions = f"(version {schema.schema_} of the format; this one reads {SCHEMA})"
        raise OutputError(f"{path}: was written by a later rigidmd {versions}")
    found = not_none(read_json(path, Manifest, remedy))
    names = [point.folder for point in found.points]
    problem = ""
    if any(Path(name).name != name or name in ("", ".", "..") for name in names) or len(
        {*names}
    ) < len(names):
        problem = "points with invalid names of folders"
    if any(point.values.keys() != found.keys.keys() for point in found.points):
        problem = "points without values of all keys"
    if any(key not in together for key, together in found.keys.items()):
        problem = "keys that are missing in their own groups"
    if problem:
        raise OutputError(f"{path} is not a valid manifest of a sweep: {problem}{remedy}")
    for name in names:
        check_inside(folder / name)
    return found


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write sweep.json as a whole. Raises OutputError."""
    write_json(folder / MANIFEST, asdict(manifest), indent=1)


def clear_sweep(folder: Path, names: Iterable[str]) -> None:
    """Remove the files of a sweep, and the files of runs in folders of these names. Raises
    OutputError."""
    for inner in [*(folder / name for name in names if Path(name).name == name), folder]:
        if not inner.is_dir() or (inner.is_symlink() and inner != folder):
            continue
        with writing(inner, "cleared"):
            for name in written_by_runs(inner):
                for path in (inner / name, *offsets_of(inner / name)):
                    path.unlink(missing_ok=True)
            (inner / MARKER).unlink(missing_ok=True)
            if inner != folder:
                (inner / LOCK).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # it holds other files
                    inner.rmdir()


def state_on_disk(folder: Path, point: SweepPoint) -> State:
    """The state that the folder of a point shows: finished, interrupted, or waiting if nothing has
    run there."""
    inner = folder / point.folder
    with contextlib.suppress(OutputError):
        summary = read_json(inner / SUMMARY, Summary) or Summary(interrupted=True)
        if not summary.interrupted and point.ran_sha256 in (None, summary.scene_sha256):
            return "finished"
    return "interrupted" if (inner / MARKER).is_file() else "waiting"


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Key -> the shortest end that no other key has: temperature_K of stages.0.temperature_K."""
    keys = list(keys)
    found = {}
    for key in keys:
        parts = key.split(".")
        ends = (".".join(parts[-n:]) for n in range(1, len(parts) + 1))
        alone = (
            end
            for end in ends
            if not any(other != key and f".{other}".endswith(f".{end}") for other in keys)
        )
        found[key] = re.sub(r"[^\w.+\-]", "-", next(alone, key))
    return found


def value_name(value: Any) -> str:
    """A value in the name of a folder: letters, digits and . + - only; equal values have equal
    names."""
    match value:
        case bool():
            return str(value).lower()
        case float() if value.is_integer() and abs(value) < 1e15:
            return str(int(value))
        case int() | float():
            return repr(value)
        case list() | tuple() if all(isinstance(one, int | float) for one in value):
            return "x".join(map(value_name, value))
    plain = re.sub(r"[^\w.+\-]", "-", str(value)).lstrip(".")
    if plain == value and len(plain) <= LONGEST // 3:
        return plain
    return f"{plain[: LONGEST // 3]}-{hashlib.sha256(repr(value).encode()).hexdigest()[:6]}"


def point_name(values: Mapping[str, Any], short: Mapping[str, str]) -> str:
    """The name of a point's folder: temperature_K=280_seed=1."""
    name = "_".join(f"{short[key]}={value_name(value)}" for key, value in values.items())
    return (
        name
        if len(name) <= LONGEST
        else f"{name[:LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    )


def combination_folder(folder: Path, values: Mapping[str, Any], short: Mapping[str, str]) -> Path:
    """The folder of what the replicas of a combination of values have together."""
    return folder / point_name(values, short) if values else folder


def describe_values(values: Mapping[str, Any], short: Mapping[str, str]) -> str:
    """Values for messages: temperature_K = 280, seed = 1."""
    return ", ".join(f"{short[key]} = {value_name(value)}" for key, value in values.items())
