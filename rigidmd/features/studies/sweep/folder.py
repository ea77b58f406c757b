"""The folder of a sweep: its manifest sweep.json, and a folder for each point, which is the folder
of a run."""

import contextlib
import hashlib
import json
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal

from pydantic import ConfigDict

from rigidmd.core.files import writing
from rigidmd.core.toml import Json
from rigidmd.errors import OutputError, RigidMDError, RigidMDWarning, option
from rigidmd.io.folder import (
    LOCK,
    MARKER,
    SCENE,
    SUMMARY,
    SWEEP,
    check_inside,
    offsets_of,
    written_by_runs,
)
from rigidmd.io.run_files import Bounded, Summary, read_json
from rigidmd.io.write import write_json
from rigidmd.run.resume import scene_digest
from rigidmd.scene import Scene, is_molecular

MANIFEST = SWEEP
TABLE = "sweep.csv"
FIGURE = "sweep.png"
SCRIPT = "sweep.sbatch"
FILES = (MANIFEST, TABLE, FIGURE, SCRIPT)
State = Literal["waiting", "running", "finished", "interrupted", "failed"]
SEED = "seed"  # the key whose values make replicas
LONGEST = 120  # most letters of the name of a folder
MOST_NAMED = 8  # points in a warning
STRICT = ConfigDict(strict=True, extra="forbid")


@dataclass
class SweepPoint:
    __pydantic_config__ = STRICT

    folder: str  # its name
    values: Json  # swept key -> value
    scene_sha256: str  # digest of its scene, as it was read, and of the files that it reads
    state: State = "waiting"
    ran_sha256: str | None = None  # scene_sha256 of the summary of its run, once it has ended
    message: str | None = None  # why it failed
    seconds: Bounded = 0.0  # run time of all attempts


@dataclass
class Manifest:
    """The scene, the keys and the points of a sweep."""

    __pydantic_config__ = STRICT

    schema: Literal[1] = field(default=1, kw_only=True)  # version of the format
    name: str
    scene: str  # its file
    keys: dict[str, list[str]]  # swept key -> the keys that are set together with it, itself first
    fixed: Json  # key -> value for all points
    common: Json  # dotted key -> value of the scene, without the swept keys
    inputs: dict[str, str]  # dotted key -> SHA-256 of the files that all points read
    points: list[SweepPoint] = field(default_factory=list)
    has_checkpoints: bool = True
    # these are not in the file
    folder: Path = field(default=Path(), init=False)
    lengthened: list[str] = field(default_factory=list, init=False)  # folders of points

    def overrides(self, values: Json) -> Json:
        """Dotted key -> value, for `Scene.read`, at these values of the swept keys."""
        swept = {key: value for first, value in values.items() for key in self.keys[first]}
        return self.fixed | swept

    def points_in(self, *states: State) -> list[SweepPoint]:
        return [point for point in self.points if point.state in states]

    @property
    def unfinished(self) -> list[SweepPoint]:
        return [point for point in self.points if point.state != "finished"]

    def combinations(self) -> list[tuple[Json, list[SweepPoint]]]:
        """The values of all keys but `seed`, each with its points: its replicas, if the seed is
        swept."""
        groups: dict[str, tuple[Json, list[SweepPoint]]] = {}
        for point in self.points:
            values = without_seed(point.values)
            groups.setdefault(json.dumps(values), (values, []))[1].append(point)
        return list(groups.values())

    def update_states(self) -> None:
        """Read the states of all points, with a warning for those that are longer than planned."""
        self.lengthened.clear()
        for point in self.points:
            self.update_state(point)
        if names := self.lengthened:
            more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
            warnings.warn(
                f"{self.folder}: the last stage of {', '.join(names[:MOST_NAMED])}{more} has"
                " another duration than in the sweep. The runs count as they are",
                RigidMDWarning,
                stacklevel=1,  # the same line for all callers: one warning
            )

    def update_state(self, point: SweepPoint) -> None:
        """Read the state of a point from its folder. A failed point keeps its state until it has
        finished."""
        folder = self.folder / point.folder
        with contextlib.suppress(OutputError):
            summary = read_json(folder / SUMMARY, Summary) or Summary(interrupted=True)
            is_same_run = point.ran_sha256 in (None, summary.scene_sha256)
            if not summary.interrupted:
                if has_other_end := not is_same_run and self._has_other_end(point, summary):
                    self.lengthened.append(point.folder)
                if is_same_run or has_other_end:
                    point.state, point.message = "finished", None
                    point.ran_sha256 = point.ran_sha256 or summary.scene_sha256
                    return
        if point.state != "failed":
            point.state = "interrupted" if (folder / MARKER).is_file() else "waiting"

    def _has_other_end(self, point: SweepPoint, summary: Summary) -> bool:
        """Whether the run of a point differs from the run that the sweep has made by the duration
        of its last stage only."""
        with contextlib.suppress(RigidMDError):
            scene = Scene.read(self.folder / point.folder / SCENE)
            if not is_molecular(scene) or scene_digest(scene) != summary.scene_sha256:
                return False
            *stages, last = scene.stages
            planned = self.common | self.overrides(point.values)
            keys = (f"stages.{name}.duration_ps" for name in (len(stages), last.name))
            duration = next((planned[key] for key in keys if key in planned), None)
            last = last.model_copy(update={"duration_ps": duration})
            as_planned = scene.model_copy(update={"stages": (*stages, last)})
            return scene_digest(as_planned) == point.ran_sha256
        return False

    def write(self) -> None:
        """Write sweep.json as a whole. Raises OutputError."""
        content = asdict(self)
        del content["folder"], content["lengthened"]
        write_json(self.folder / MANIFEST, content, indent=1)


def without_seed(values: Json) -> Json:
    return {key: value for key, value in values.items() if key != SEED}


def is_sweep(folder: Path) -> bool:
    return (folder / MANIFEST).is_file()


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a sweep, with the states that the folders of its points show. Raises
    OutputError."""
    remedy = f"; {option('force')} starts the sweep again"
    manifest = read_json(folder / MANIFEST, Manifest, remedy)
    if manifest is None:
        raise OutputError(f"{folder} holds no sweep. `rigidmd sweep SCENE --set ...` makes one")
    keys, points = manifest.keys, manifest.points
    names = {point.folder for point in points if Path(point.folder).name == point.folder}
    problem = ""
    if len(names - {"", ".", ".."}) < len(points):
        problem = "points with invalid names of folders"
    if any(point.values.keys() != keys.keys() for point in points):
        problem = "points without values of all keys"
    if any(key not in together for key, together in keys.items()):
        problem = "keys that are missing in their own groups"
    if problem:
        path = folder / MANIFEST
        raise OutputError(f"{path} is not a valid manifest of a sweep: {problem}{remedy}")
    for name in names:
        check_inside(folder / name)
    manifest.folder = folder
    manifest.update_states()
    return manifest


def clear_sweep(folder: Path, names: Iterable[str]) -> None:
    """Remove the files of a sweep, and the files of its runs in folders with these names. Raises
    OutputError."""
    run_folders = [folder / name for name in names if not (folder / name).is_symlink()]
    for run_or_sweep_folder in [*run_folders, folder]:
        if not run_or_sweep_folder.is_dir():
            continue
        with writing(run_or_sweep_folder, "cleared"):
            for name in written_by_runs(run_or_sweep_folder):
                path = run_or_sweep_folder / name
                for written in (path, *offsets_of(path)):
                    written.unlink(missing_ok=True)
            (run_or_sweep_folder / MARKER).unlink(missing_ok=True)
            if run_or_sweep_folder != folder:
                (run_or_sweep_folder / LOCK).unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # it holds other files
                    run_or_sweep_folder.rmdir()


def short_keys(keys: Iterable[str]) -> dict[str, str]:
    """Key -> the shortest end that no other key has: temperature_K of stages.0.temperature_K."""
    ends: dict[str, list[str]] = {}
    for key in keys:
        parts = key.split(".")
        ends[key] = [".".join(parts[k:]) for k in reversed(range(len(parts)))]
    count = Counter(end for ends_of_key in ends.values() for end in ends_of_key)
    short = {}
    for key, ends_of_key in ends.items():
        unique = next((end for end in ends_of_key if count[end] == 1), key)
        short[key] = re.sub(r"[^\w.+\-]", "-", unique)
    return short


#: Last parts of keys -> units on axes.
UNITS = {
    "K": "K",
    "fs": "fs",
    "ps": "ps",
    "A": "Å",
    "bar": "bar",
    "g_cm3": "g/cm³",
    "nm": "nm",
    "s": "s",
    "kg": "kg",
    "m": "m",
    "kJ_mol": "kJ/mol",
    "V_per_nm": "V/nm",
    "per_ps": "1/ps",
    "deg": "°",
    "u": "u",
    "rad": "rad",
}


def readable_key(key: str) -> str:
    """A key with its unit, for readers: "temperature of stages.0 (K)"."""
    *table, name = key.split(".")
    end = max((end for end in UNITS if name.endswith(f"_{end}")), key=len, default="")
    label = name.removesuffix(f"_{end}").replace("_", " ")
    label += f" of {'.'.join(table)}" if table else ""
    return label + (f" ({UNITS[end]})" if end else "")


def value_name(value: object) -> str:
    """A value in the name of a folder: letters, digits and . + - only. Equal values have equal
    names."""
    match value:
        case bool():
            return str(value).lower()
        case float() if value.is_integer() and abs(value) < 1e15:
            return str(int(value))
        case int() | float():
            return repr(value)
        case list() | tuple() if all(isinstance(number, int | float) for number in value):
            return "x".join(map(value_name, value))
    plain = re.sub(r"[^\w.+\-]", "-", str(value)).lstrip(".")
    if plain == value and len(plain) <= LONGEST // 3:
        return plain
    return f"{plain[: LONGEST // 3]}-{_short_digest(repr(value), 6)}"


def _short_digest(text: str, length: int) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:length]


def point_name(values: Mapping[str, object], short: Mapping[str, str]) -> str:
    """The name of a point's folder: temperature_K=280_seed=1."""
    name = "_".join(f"{short[key]}={value_name(value)}" for key, value in values.items())
    return name if len(name) <= LONGEST else f"{name[:LONGEST]}-{_short_digest(name, 8)}"


def describe_values(values: Mapping[str, object], short: Mapping[str, str]) -> str:
    """Values for messages: temperature_K = 280, seed = 1."""
    return ", ".join(f"{short[key]} = {value_name(value)}" for key, value in values.items())
