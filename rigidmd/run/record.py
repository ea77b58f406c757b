"""Reading of the folder of a run: its scene, its summary, and its samples."""

import shlex
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from rigidmd.core.quantities import energy_of_force
from rigidmd.core.toml import Json
from rigidmd.engines import samples
from rigidmd.errors import OutputError, RigidMDWarning
from rigidmd.io.folder import SCENE, SUMMARY, check_is_run
from rigidmd.io.run_files import Summary, read_json
from rigidmd.run.kind import kind_of
from rigidmd.scene import Scene

if TYPE_CHECKING:
    from rigidmd.engines.sites import AnySystem
    from rigidmd.engines.system import System
    from rigidmd.scene import OneScene

SystemT = TypeVar("SystemT", bound="AnySystem", covariant=True)


@dataclass(frozen=True)
class Record(Generic[SystemT]):
    """The contents of the folder of a run.

    summary : None if the run has not ended
    columns : (t,) each, by the names of `results[...]`
    missing : sentences about data that are missing, and why
    """

    folder: Path
    scene: "OneScene"
    system: SystemT
    summary: Json | None
    columns: dict[str, np.ndarray]
    missing: list[str]

    @property
    def time(self) -> np.ndarray:
        """Times of the samples, in `time_unit`."""
        return self.columns["time"]

    @property
    def log(self: "Record[System]") -> samples.Samples:
        """The samples of a run of molecules. NaN in columns that log.csv does not have."""
        described = self.system.quantities
        # energies of user-defined forces, which the system is read without
        users = [name for name in self.columns if name not in described]
        described = described | {name: energy_of_force(name) for name in users}
        unknown = np.full(len(self.time), np.nan)
        table = [self.columns.get(name, unknown) for name in samples.numbers(described)]
        labels = [stage.label for stage in self.system.scene.stages]
        return samples.Samples(labels, described, np.column_stack(table).astype(float))

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
        return self.scene.time_unit


def read_record(folder: Path) -> Record:
    """Read the folder of a run, ended or not. Raises OutputError if it is no such folder, or has no
    samples."""
    check_is_run(folder)
    with warnings.catch_warnings():  # the scene of a run of the version before has former names
        warnings.filterwarnings("ignore", "the key .* is", RigidMDWarning)
        scene = Scene.read(folder / SCENE)
    summary = read_json(folder / SUMMARY, Summary)
    missing = []
    resume = f"`rigidmd resume {shlex.quote(str(folder))}` continues it"
    if summary is None:
        ended = f"This run has not ended: there is no {SUMMARY}"
        missing.append(f"{ended}. These are its results so far; {resume}.")
    elif summary.interrupted:
        missing.append("This run was interrupted. These are its results so far.")
    kind = kind_of(scene)
    system = kind.build(scene, user_code=False)
    columns = kind.columns_of_run(folder, system, missing)
    if not columns or len(next(iter(columns.values()))) == 0:
        raise OutputError(f"{folder}: the run has not written samples yet. {resume}")
    return Record(
        folder, scene, system, summary and summary.model_dump(exclude_unset=True), columns, missing
    )
