"""Reading of the folder of a run: its scene, its summary, and the columns of log.csv or
motion.csv."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.state import State
from rigidmd.core.toml import Json
from rigidmd.engines import samples
from rigidmd.engines.samples import BODY, BODY_COLUMNS
from rigidmd.engines.system import System
from rigidmd.errors import CheckpointError, OutputError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.motion import Snapshot, motion
from rigidmd.features.bodies.system import BodySystem
from rigidmd.io.checkpoint import latest
from rigidmd.io.folder import LOG, MOTION, SCENE, SUMMARY, check_is_run
from rigidmd.io.run_files import Summary, read_columns, read_json, read_motion
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.scene.stage import Stage

#: Header of a column of log.csv -> its name.
HEADERS = {column.header: name for name, column in samples.IN_LOGS.items() if column.header}


SystemT = TypeVar("SystemT", bound=System | BodySystem, covariant=True)


@dataclass(frozen=True)
class Record(Generic[SystemT]):
    """The contents of the folder of a run.

    summary : None if the run has not ended
    columns : (t,) each, by the names of `results[...]`
    missing : sentences about data that are missing, and why
    """

    folder: Path
    scene: MolecularScene | BodyScene
    system: SystemT
    summary: Json | None
    columns: dict[str, np.ndarray]
    missing: list[str]

    @property
    def is_body(self) -> bool:
        return isinstance(self.scene, BodyScene)

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, ps for molecules, s for a body."""
        return self.columns["time"]

    @property
    def log(self: "Record[System]") -> samples.Samples:
        """The samples of a run of molecules. NaN in columns that log.csv does not have."""
        more = self.system.more_columns
        # energies of user-defined forces, which the system is read without
        known = {*samples.IN_LOGS, *more}
        users = (name for name in self.columns if name not in known)
        columns = {name: samples.energy_column(name) for name in users} | more
        unknown = np.full(len(self.time), np.nan)
        table = np.column_stack(
            [self.columns.get(name, unknown) for name in (*samples.NUMBERS, *columns)]
        )
        return samples.Samples(
            [stage.label for stage in self.system.scene.stages], columns, table.astype(float)
        )

    @property
    def moving(self) -> np.ndarray:
        """Which samples (t,) are not of minimisations, in which no time passes."""
        if isinstance(self.scene, BodyScene):
            return np.ones(len(self.time), bool)
        return samples.moving(self.scene.stages, self.columns["stage"])

    @property
    def trajectory(self) -> Path:
        """Path of the trajectory. Raises OutputError if there is none."""
        name = self.scene.output.trajectory
        if not name:
            raise OutputError(
                f"{self.folder}: this run wrote no trajectory (output.trajectory = false)"
            )
        if not (self.folder / name).is_file():
            raise OutputError(f"{self.folder}: its trajectory {name} is missing")
        return self.folder / name

    @property
    def time_unit(self) -> str:
        return "s" if self.is_body else "ps"


def read_record(folder: Path) -> Record:
    """Read the folder of a run, ended or not. Raises OutputError if it is no such folder, or has no
    samples."""
    check_is_run(folder)
    scene = Scene.read(folder / SCENE)
    summary = read_json(folder / SUMMARY, Summary)
    missing = []
    resume = f"`rigidmd resume {shlex.quote(str(folder))}` continues it"
    if summary is None:
        ended = f"This run has not ended: there is no {SUMMARY}"
        missing.append(f"{ended}. These are its results so far; {resume}.")
    elif summary.interrupted:
        missing.append("This run was interrupted. These are its results so far.")
    if isinstance(scene, BodyScene):
        system = build_body(scene)
        columns = _motion(folder, system, missing)
    else:
        system = build(scene, user_code=False)
        columns = _log(folder, system)
    if not columns or len(next(iter(columns.values()))) == 0:
        raise OutputError(f"{folder}: the run has not written samples yet. {resume}")
    return Record(
        folder, scene, system, summary and summary.model_dump(exclude_unset=True), columns, missing
    )


def _log(folder: Path, system: System) -> dict[str, np.ndarray]:
    """Columns of log.csv by their names in `results[...]`, with the index of the stage."""
    read = read_columns(folder / LOG)
    if read is None:
        raise OutputError(f"{folder / LOG} cannot be read: there is no such file")
    known = HEADERS | {column.header: name for name, column in system.more_columns.items()}
    unit = samples.energy_column("").header
    headers = {
        known.get(header) or header.removesuffix(unit): header
        for header in read.cells
        if header in known or header.endswith(unit)
    }
    if lacking := [name for name in ("step", "time", "stage_name") if name not in headers]:
        header = samples.COLUMNS[lacking[0]].header
        raise OutputError(f"{read.path} is not a log of rigidmd: it has no column {header!r}")
    columns = {
        name: np.array(read.cells[header])
        if name == "stage_name"
        else read.numbers(header, finite=name == "time")
        for name, header in headers.items()
    }
    return columns | {
        "stage": _stage_of(columns["stage_name"], columns["time"], system.scene.stages)
    }


def _stage_of(names: np.ndarray, time: np.ndarray, stages: Sequence[Stage]) -> np.ndarray:
    """Index of the stage of each row. Stages with the same name are distinguished by their
    times."""
    stage_of_row = np.full(len(names), len(stages) - 1)
    first = 0
    end = 0.0
    for k, stage in enumerate(stages[:-1]):
        end += stage.duration
        of_stage = (names[first:] == stage.label) & (time[first:] <= end + 0.5 * stage.step)
        count = len(of_stage) if of_stage.all() else int(of_stage.argmin())
        stage_of_row[first : first + count] = k
        first += count
    return stage_of_row


def _motion(folder: Path, system: BodySystem, missing: list[str]) -> dict[str, np.ndarray]:
    """Columns of motion.csv, or, of a run that has not written it, of its last checkpoint."""
    if (columns := read_motion(folder / MOTION)) is not None:
        # that every motion has
        families = [
            "time",
            "position",
            "kinetic",
            "potential",
            "energy",
            "work",
        ]
        if system.rotates:
            families += [
                "rotation",
                "quaternion",
                "euler_angles",
                "omega_body",
                "omega_lab",
                "L_lab",
            ]
        needed = [name for family in families for name in BODY[family].names]
        if lacking := [BODY_COLUMNS[name].header for name in needed if name not in columns.cells]:
            raise OutputError(
                f"{columns.path} is not the motion of this run: it has no column {lacking[0]!r}"
            )
        return {name: columns.numbers(name, finite=name in needed) for name in columns.cells}
    try:
        checkpoint, _ = latest(folder)
    except CheckpointError:
        return {}
    for owner in checkpoint.values.get("of", {}):
        part = checkpoint.of(owner).arrays
        if "stacked/t" in part:  # of `run.body.Sampler`
            states = zip(*(part[f"stacked/{name}"] for name in State._fields), strict=True)
            times = part["stacked/t"].tolist()
            snapshots = [Snapshot(t, State(*state)) for t, state in zip(times, states, strict=True)]
            missing.append(
                f"{MOTION} is written at the end. The motion shown ends at the last checkpoint."
            )
            return motion(system, snapshots).columns
    return {}
