"""What the folder of a run holds: its scene, its summary, and the columns of its log or motion."""

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.assemble.body import BodySystem, build_body
from rigidmd.assemble.system import System, build
from rigidmd.core.state import State
from rigidmd.errors import CheckpointError, OutputError
from rigidmd.measure import samples
from rigidmd.measure.columns import BODY
from rigidmd.measure.motion import Snapshot, motion
from rigidmd.output.checkpoint import latest
from rigidmd.output.folder import LOG, MOTION, SCENE, SUMMARY, check_is_run
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.scene.stage import Stage

#: Name of a column -> its header in log.csv, and back.
HEADERS = {column.header: name for name, column in samples.COLUMNS.items() if column.header}


@dataclass(frozen=True)
class Record:
    """A run as its folder tells it.

    summary : None of a run that did not end
    columns : (t,) each; of molecules by the names of `results[...]`, of a body by those of motion.csv
    missing : sentences about what is not there, and why
    """

    folder: Path
    scene: MolecularScene | BodyScene
    system: System | BodySystem
    summary: dict[str, Any] | None
    columns: dict[str, np.ndarray]
    missing: list[str]

    @property
    def is_body(self) -> bool:
        """Whether it is a single body."""
        return isinstance(self.scene, BodyScene)

    @property
    def body(self) -> BodySystem:
        """The system of a single body. Raises TypeError for molecules."""
        if not isinstance(self.system, BodySystem):
            raise TypeError("this is a run of molecules")
        return self.system

    @property
    def molecules(self) -> System:
        """The system of molecules. Raises TypeError for a single body."""
        if not isinstance(self.system, System):
            raise TypeError("this is a run of a single body")
        return self.system

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, ps for molecules, s for a body."""
        return self.columns["t" if self.is_body else "time"]

    @property
    def moving(self) -> np.ndarray:
        """Which samples (t,) are of motion: none of minimisations, in which no time passes."""
        stages = getattr(self.scene, "stages", ())
        return np.array(
            [not (stages and stages[k].is_minimisation) for k in self.columns.get("stage", self.time)], bool
        )

    @property
    def time_unit(self) -> str:
        """Of `time`."""
        return "s" if self.is_body else "ps"


def read_record(folder: Path) -> Record:
    """Read the folder of a run, ended or not. Raises OutputError if it is none, or holds nothing to look at."""
    check_is_run(folder)
    scene = Scene.read(folder / SCENE)
    summary, missing = _summary(folder)
    if isinstance(scene, BodyScene):
        system = build_body(scene)
        columns = _motion(folder, system, missing)
    else:
        system = build(scene, bare=True)
        columns = _log(folder, scene.stages)
    if not columns or len(next(iter(columns.values()))) == 0:
        raise OutputError(f"{folder}: the run wrote no samples yet; `rigidmd resume {folder}` goes on with it")
    return Record(folder, scene, system, summary, columns, missing)


def _summary(folder: Path) -> tuple[dict[str, Any] | None, list[str]]:
    path = folder / SUMMARY
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None, [
            f"This run has not ended: there is no {SUMMARY}. What follows is what it wrote so far; "
            f"`rigidmd resume {folder}` goes on with it."
        ]
    except (OSError, ValueError) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None
    if not isinstance(found, dict):
        raise OutputError(f"{path} is no summary of a run")
    ended = "This run was interrupted; what follows is what it wrote so far."
    return found, [ended] if found.get("interrupted") else []


def _table(path: Path) -> dict[str, list[str]]:
    """The columns of a CSV file by their headers; a last line that is cut off is left out. Raises OutputError."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            head, *lines = list(csv.reader(file)) or [[]]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None
    lines = [line for line in lines if len(line) == len(head)]
    return {header: [line[k] for line in lines] for k, header in enumerate(head)}


def _numbers(path: Path, header: str, cells: list[str]) -> np.ndarray:
    """A column as numbers; what is empty is NaN. Raises OutputError."""
    try:
        return np.array([float(cell or "nan") for cell in cells])
    except ValueError:
        raise OutputError(f"{path}: column {header!r} holds what is no number") from None


def _log(folder: Path, stages: Sequence[Stage]) -> dict[str, np.ndarray]:
    """Columns of log.csv by the names of `results[...]`, with the index of the stage."""
    path = folder / LOG
    table = {HEADERS[header]: (header, cells) for header, cells in _table(path).items() if header in HEADERS}
    if lacking := [name for name in ("time", "stage_name") if name not in table]:
        raise OutputError(f"{path} is no log of rigidmd: it has no column {samples.COLUMNS[lacking[0]].header!r}")
    found = {
        name: np.array(cells) if name == "stage_name" else _numbers(path, header, cells)
        for name, (header, cells) in table.items()
    }
    return found | {"stage": _stage_of(found["stage_name"], found["time"], stages)}


def _stage_of(names: np.ndarray, time: np.ndarray, stages: Sequence[Stage]) -> np.ndarray:
    """Index of the stage of each line. Several stages may have one name; their times tell them apart."""
    found, first, end = np.full(len(names), len(stages) - 1), 0, 0.0
    for k, stage in enumerate(stages[:-1]):
        end += stage.duration
        own = (names[first:] == stage.label) & (time[first:] <= end + 0.5e-3 * stage.timestep_fs)
        count = len(own) if own.all() else int(own.argmin())
        found[first : first + count] = k
        first += count
    return found


def _columns_of(system: BodySystem) -> list[str]:
    """Columns that every motion of a body has."""
    families = ["time", "position", "kinetic", "potential", "energy", "work"]
    if system.turns:
        families += ["rotation", "quaternion", "euler_angles", "omega_body", "omega_lab", "L_lab"]
    return [name for family in families for name in BODY[family].names]


def _motion(folder: Path, system: BodySystem, missing: list[str]) -> dict[str, np.ndarray]:
    """Columns of motion.csv; of a run that did not write it, those of its last checkpoint."""
    path = folder / MOTION
    if path.is_file():
        found = {header: _numbers(path, header, cells) for header, cells in _table(path).items()}
        for name in _columns_of(system):
            if name not in found:
                raise OutputError(f"{path} is not the motion of this run: it has no column {name!r}")
            if not np.isfinite(found[name]).all():
                raise OutputError(f"{path}: column {name!r} holds what is no finite number")
        return found
    try:
        kept, _ = latest(folder)
    except CheckpointError:
        return {}
    for owner in kept.told.get("of", {}):
        part = kept.of(owner).arrays
        if "t" in part and set(State._fields) <= set(part):
            states = zip(*(part[name] for name in State._fields), strict=True)
            snapshots = [Snapshot(t, State(*state)) for t, state in zip(part["t"].tolist(), states, strict=True)]
            missing.append(f"{MOTION} is written at the end; the motion shown is that of the last checkpoint.")
            return motion(system, snapshots).columns
    return {}
