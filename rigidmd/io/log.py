"""The files log.csv and pressure_tensor.csv. Lines are soon on the disk, so that a killed run keeps its samples.

The first columns of log.csv are the same as in OpenMM's StateDataReporter.
"""

import csv
import io
import time as clock
from collections.abc import Sequence
from math import inf
from operator import attrgetter
from pathlib import Path

import numpy as np

from rigidmd.core.files import AppendedFile
from rigidmd.engines import samples
from rigidmd.engines.samples import Sample
from rigidmd.errors import OutputError
from rigidmd.io.run_files import read_columns

#: Seconds that a line waits for others, which together take a tenth of the time. Lines at longer intervals do not wait.
DELAY, SELDOM = 0.5, 0.05
#: Columns of log.csv that are written on request.
TENSOR = tuple(name for name in samples.COLUMNS if name.startswith("pressure_") and len(name) == len("pressure_xx"))


def columns(tensor: bool = True, user_terms: Sequence[str] = ()) -> dict[str, str]:
    """Name of each column -> its header, with or without the pressure tensor, and with user-defined forces."""
    described = samples.COLUMNS | samples.user_columns(user_terms)
    written = {name: column.header for name, column in described.items() if column.header}
    return written if tensor else {name: header for name, header in written.items() if name not in TENSOR}


class Log(AppendedFile):
    """Writes samples to log.csv, numbers with all significant digits, missing values empty. Raises OutputError.

    kept : earlier value of the property `kept`, from which the file is continued; None begins a new file
    user_terms : names of user-defined forces
    """

    def __init__(self, path: Path, tensor: bool, kept: Sequence[int] | None = None, user_terms: Sequence[str] = ()):
        self._columns = columns(tensor, user_terms)
        shared = [name for name in self._columns if name not in user_terms]
        self._values = attrgetter(*shared)
        self._time = shared.index("time")
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
        row = [*self._values(sample), *sample.user_energies]
        row[self._time] = round(sample.time, 9)
        self._rows.append(row)
        now = clock.monotonic()
        before, self._came = self._came, now
        if now - before >= SELDOM or now - self._written >= DELAY:
            self.flush()
            self._written = now

    def flush(self) -> None:
        """Write the waiting lines. Lines that cannot be written are lost, because the error stops the run."""
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
HEADER = [samples.COLUMNS[name].header for name in ("time", *TENSOR)]


def tensor_row(sample: Sample) -> list[float]:
    """A line of pressure_tensor.csv: time (ps) and the six components of the tensor, bar."""
    return [round(sample.time, 9), *(getattr(sample, name) for name in TENSOR)]


class TensorFile(AppendedFile):
    """Writes pressure_tensor.csv, for viscosities. See `Log` for `kept`. Raises OutputError."""

    def __init__(self, path: Path, kept: Sequence[int] | None = None):
        super().__init__(path, kept)
        if kept is None:
            self.append((",".join(f'"{title}"' for title in HEADER) + "\n").encode())

    def write(self, row: list[float]) -> None:
        self.append((",".join(map(repr, row)) + "\n").encode())


def read_tensor(path: Path) -> np.ndarray | None:
    """Complete lines (n, 7) of pressure_tensor.csv; None without a file. Raises OutputError."""
    if (found := read_columns(path)) is None:
        return None
    if list(found.cells) != HEADER:
        raise OutputError(f"{path} is not a pressure tensor of rigidmd: its columns must be {', '.join(HEADER)}")
    return np.array([found.numbers(header, finite=True) for header in HEADER]).T
