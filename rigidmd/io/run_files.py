"""Readers of the JSON and CSV files of runs. They may be from strangers, so sizes are limited and data validated."""

import csv
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rigidmd.core.files import unreadable_reason, writing
from rigidmd.core.toml import shorten_repr
from rigidmd.errors import OutputError
from rigidmd.scene.validation import Flag, Number, validation_messages

#: Limits: bytes of a JSON file and of a CSV file, characters of a line of CSV, absolute value of a number.
LARGEST_JSON, LARGEST_TABLE, LONGEST_LINE, LARGEST_NUMBER = 5e7, 4e9, 100_000, 1e100

T = TypeVar("T")
adapter_of = lru_cache(TypeAdapter)
Bounded = Annotated[Number, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]


class StageSummary(BaseModel):
    """The part of a stage in summary.json that is read."""

    model_config = ConfigDict(extra="allow")

    name: str
    integrator: str | None = None
    timestep_fs: Bounded | None = None
    stable_timestep_fs: Bounded | None = None
    drift_kJ_mol_ns_per_molecule: Bounded | None = None
    drift_error_kJ_mol_ns_per_molecule: Bounded | None = None
    drift_kT_ns_per_degree_of_freedom: Bounded | None = None
    drift_error_kT_ns_per_degree_of_freedom: Bounded | None = None
    energy_rms_kJ_mol_per_molecule: Bounded | None = None
    ns_per_day: Bounded | None = None


class Summary(BaseModel):
    """The part of summary.json that is read, for molecules and bodies, by any version."""

    model_config = ConfigDict(extra="allow")

    interrupted: Flag = False
    notes: list[str] = []
    stages: list[StageSummary] = []
    scene_sha256: str | None = None
    input_sha256: dict[str, str] = {}
    processor_features: list[str] = []
    threads: int | None = None
    vector_bits: int | None = None
    seed: int | None = None
    precision: str | None = None
    machine: str | None = None
    processor: str | None = None
    rigidmd_version: str | None = None
    numba_version: str | None = None
    llvmlite_version: str | None = None
    numpy_version: str | None = None
    python_version: str | None = None
    preparing_s: Bounded | None = None
    computing_s: Bounded | None = None
    wall_s: Bounded | None = None
    timestep_s: Bounded | None = None
    stable_timestep_s: Bounded | None = None


def read_json(path: Path, kind: type[T], remedy: str = "") -> T | None:
    """The validated content of a JSON file; None without a file. Raises OutputError with file and field, and `remedy`,
    the advice for a damaged file."""
    if not _is_there(path, LARGEST_JSON):
        return None
    try:
        with writing(path, "read"):
            content = path.read_bytes()
        return adapter_of(kind).validate_json(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "json_invalid":
            raise OutputError(f"{path} cannot be read: {first['msg']}{remedy}") from None
        message = f"is {shorten_repr(first['input'])}, must be a table"
        message = validation_messages(error, BaseModel)[0] if first["loc"] else message
        raise OutputError(f"{path}: {message}{remedy}") from None


def _is_there(path: Path, largest: float) -> bool:
    """Whether a file exists. Raises OutputError for a folder or device, and for a file larger than `largest`."""
    if not path.exists() and not path.is_symlink():
        return False
    if reason := unreadable_reason(path, largest):
        is_clause = reason.startswith(("is", "has"))
        raise OutputError(f"{path} cannot be read: it {reason}" if is_clause else f"{path}: {reason}")
    return True


class Columns(NamedTuple):
    """A CSV file: header -> cells of all complete lines."""

    path: Path
    cells: dict[str, list[str]]

    def numbers(self, header: str, finite: bool = False) -> np.ndarray:
        """A column as numbers. An empty cell is NaN, or an error if all must be `finite`. Raises OutputError."""
        try:
            found = np.array([float(cell or "nan") for cell in self.cells[header]])
        except ValueError:
            raise OutputError(f"{self.path}: column {header!r} has a cell that is not a number") from None
        empty = np.array([not cell for cell in self.cells[header]], bool)
        if not ((np.abs(found) <= LARGEST_NUMBER) | (empty & (not finite))).all():
            raise OutputError(f"{self.path}: column {header!r} has a cell that is not a finite number below 1e100")
        return found


def read_columns(path: Path) -> Columns | None:
    """A CSV file; None without a file. An incomplete last line is left out. Raises OutputError."""
    if not _is_there(path, LARGEST_TABLE):
        return None
    try:
        with writing(path, "read"), path.open(encoding="utf-8", newline="") as file:
            rows = csv.reader(_lines(file))
            head = next(rows, [])
            lines = [line for line in rows if len(line) == len(head)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None
    return Columns(path, {header: [line[k] for line in lines] for k, header in enumerate(head)})


def _lines(file: Any) -> Iterator[str]:
    """The complete lines of a file. Raises csv.Error for a line that is too long."""
    while line := file.readline(LONGEST_LINE):
        if line.endswith("\n"):
            yield line
        elif len(line) == LONGEST_LINE:
            raise csv.Error(f"a line has more than {LONGEST_LINE} characters")
