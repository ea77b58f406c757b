"""The JSON and CSV files of runs: writers of log.csv and pressure_tensor.csv, and readers of all of
them.

Files are untrusted input, so sizes are limited and data validated. Written lines are soon on the
disk, so that a killed run keeps its samples. The first columns of log.csv are the same as in
OpenMM's StateDataReporter.
"""

import csv
import io
import time as clock
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from math import inf
from pathlib import Path
from typing import Annotated, NamedTuple, TextIO, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from rigidmd.core.files import AppendedFile, unreadable_reason, writing
from rigidmd.core.quantities import QUANTITIES, Quantity
from rigidmd.core.toml import shorten_repr
from rigidmd.engines.samples import Sample
from rigidmd.errors import OutputError
from rigidmd.io.folder import check_inside
from rigidmd.scene.validation import Flag, Number, validation_messages

#: Limits: bytes of a JSON file and of a CSV file, characters of a line of CSV, absolute value of a
#: number.
LARGEST_JSON = 5e7
LARGEST_TABLE = 4e9
LONGEST_LINE = 100_000
LARGEST_NUMBER = 1e100

T = TypeVar("T")
adapter_of = lru_cache(TypeAdapter)
Bounded = Annotated[Number, Field(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]


class StageSummary(BaseModel):
    """The values of a stage in summary.json that are read. Pages compute the others again."""

    model_config = ConfigDict(extra="allow")

    name: str
    choice: str | None = None
    timestep_fs: Bounded | None = None
    stable_timestep_fs: Bounded | None = None
    computing_s: Bounded = 0.0
    moves_tried: int = 0
    moves_accepted: int = 0
    drift_kT_ns_per_degree_of_freedom: Bounded | None = None
    drift_error_kT_ns_per_degree_of_freedom: Bounded | None = None


class Summary(BaseModel):
    """The part of summary.json that is read and not only shown, for molecules and bodies, by any
    version."""

    model_config = ConfigDict(extra="allow")

    interrupted: Flag = False
    notes: list[str] = []
    stages: list[StageSummary] = []
    scene_sha256: str | None = None
    input_sha256: dict[str, str] = {}
    processor_features: list[str] = []
    preparing_s: Bounded | None = None
    computing_s: Bounded | None = None
    wall_s: Bounded | None = None
    timestep_s: Bounded | None = None
    stable_timestep_s: Bounded | None = None


def read_json(path: Path, kind: type[T], remedy: str = "") -> T | None:
    """The validated JSON file, or None. Raises OutputError with file and field, and `remedy` for a
    damaged file."""
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
    """Whether a file exists. Raises OutputError for a link out of its folder, for a folder or
    device, and for a file larger than `largest`."""
    if not path.exists() and not path.is_symlink():
        return False
    check_inside(path)
    if reason := unreadable_reason(path, largest):
        is_clause = reason.startswith(("is", "has"))
        raise OutputError(
            f"{path} cannot be read: it {reason}" if is_clause else f"{path}: {reason}"
        )
    return True


class Columns(NamedTuple):
    """A CSV file: header -> cells of all complete lines."""

    path: Path
    cells: dict[str, list[str]]

    def numbers(self, header: str, finite: bool = False) -> np.ndarray:
        """A column as numbers. An empty cell is NaN, or an error if all must be `finite`. Raises
        OutputError."""
        try:
            values = np.array([float(cell or "nan") for cell in self.cells[header]])
        except ValueError:
            raise OutputError(
                f"{self.path}: column {header!r} has a cell that is not a number"
            ) from None
        empty = np.array([not cell for cell in self.cells[header]], bool)
        if not ((np.abs(values) <= LARGEST_NUMBER) | (empty & (not finite))).all():
            raise OutputError(
                f"{self.path}: column {header!r} has a cell that is not a finite number below 1e100"
            )
        return values


def read_columns(path: Path) -> Columns | None:
    """A CSV file. None without a file. An incomplete last line is left out. Raises OutputError."""
    if not _is_there(path, LARGEST_TABLE):
        return None
    try:
        with writing(path, "read"), path.open(encoding="utf-8", newline="") as file:
            rows = csv.reader(_lines(file))
            head = next(rows, [])
            if repeated := [header for header in head if head.count(header) > 1]:
                raise OutputError(f"{path} has the column {repeated[0]!r} twice")
            lines = [line for line in rows if len(line) == len(head)]
    except (UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None
    headers = map(_current_header, head)
    return Columns(path, {header: [line[k] for line in lines] for k, header in enumerate(headers)})


def _current_header(header: str) -> str:
    """A header as it is now. Earlier versions wrote energies and densities as OpenMM does."""
    return header.replace("(kJ/mole", "(kJ/mol").replace("(g/mL)", "(g/cm^3)")


def _lines(file: TextIO) -> Iterator[str]:
    """The complete lines of a file. Raises csv.Error for a line that is too long."""
    while line := file.readline(LONGEST_LINE):
        if line.endswith("\n"):
            yield line
        elif len(line) == LONGEST_LINE:
            raise csv.Error(f"a line has more than {LONGEST_LINE} characters")


#: Seconds that a line waits for others, which together take a tenth of the time. Lines at longer
#: intervals do not wait.
DELAY, SELDOM = 0.5, 0.05


def columns(
    described: Mapping[str, Quantity] = QUANTITIES, *, tensor: bool = True
) -> dict[str, str]:
    """Name of each column of log.csv -> its header, with or without the pressure tensor."""
    return {
        name: quantity.header
        for name, quantity in described.items()
        if quantity.header and (tensor or not quantity.of_tensor)
    }


def row_of(sample: Sample, names: Iterable[str]) -> list:
    """The values of columns in a line of a file."""
    return [round(sample.time, 9) if name == "time" else getattr(sample, name) for name in names]


class Log(AppendedFile):
    """Writes samples to a file, numbers with all significant digits, missing values empty. Raises
    OutputError.

    kept : earlier value of the property `kept`, from which the file is continued. None begins a new
        file
    columns : name -> header, see `columns`
    """

    def __init__(self, path: Path, columns: dict[str, str], kept: Sequence[int] | None = None):
        self._columns = columns
        self._rows: list[list] = []
        self._written = self._came = -inf
        super().__init__(path, kept)
        if kept is None:
            self._rows.append(list(self._columns.values()))
            self.flush()

    @property
    def kept(self) -> tuple[int, int]:
        """Number of bytes, all on the disk, and their checksum."""
        self.flush()
        return super().kept

    def write(self, sample: Sample) -> None:
        """Add a line. It is written at once unless another one came shortly before."""
        self._rows.append(row_of(sample, self._columns))
        now = clock.monotonic()
        before, self._came = self._came, now
        if now - before >= SELDOM or now - self._written >= DELAY:
            self.flush()
            self._written = now

    def flush(self) -> None:
        """Write the waiting lines. Lines that cannot be written are lost, because the error stops
        the run."""
        rows, self._rows = self._rows, []
        if not rows:
            return
        lines = io.StringIO(newline="")
        writer = csv.writer(lines, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
        writer.writerows([None if x != x else x for x in row] for row in rows)  # NaN
        self.append(lines.getvalue().encode())

    def close(self) -> None:
        try:
            self.flush()
        finally:
            super().close()


TENSOR_FILE = "pressure_tensor.csv"
#: Its columns: name -> header.
TENSOR = {name: row.header for name, row in QUANTITIES.items() if name == "time" or row.of_tensor}


def read_tensor(path: Path) -> np.ndarray | None:
    """Complete lines (n, 7) of pressure_tensor.csv. None without a file. Raises OutputError."""
    if (columns_read := read_columns(path)) is None:
        return None
    headers = list(TENSOR.values())
    if list(columns_read.cells) != headers:
        raise OutputError(
            f"{path} is not a pressure tensor of rigidmd: its columns must be {', '.join(headers)}"
        )
    return np.array([columns_read.numbers(header, finite=True) for header in headers]).T
