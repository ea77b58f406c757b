"""log.csv: one line a sample, flushed at once, so that a killed run keeps its samples.

The first columns are those of OpenMM's StateDataReporter.
"""

import csv
import io
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path

from rigidmd.core.files import AppendedFile
from rigidmd.measure import samples
from rigidmd.measure.samples import Sample

#: Columns that are written on request.
TENSOR = tuple(name for name in samples.COLUMNS if name.startswith("pressure_") and len(name) == len("pressure_xx"))


def columns(tensor: bool = True, own: Sequence[str] = ()) -> dict[str, str]:
    """Name of each column -> its header; with or without the pressure tensor; own : the user's own forces."""
    described = samples.COLUMNS | samples.own_columns(own)
    written = {name: column.header for name, column in described.items() if column.header}
    return written if tensor else {name: header for name, header in written.items() if name not in TENSOR}


class Log:
    """Writes samples to a CSV file, numbers with all significant digits; missing values are empty. Raises OutputError.

    kept : `kept` of an earlier time, at which an existing file goes on; None begins a new file
    own : names of the user's own forces
    """

    def __init__(self, path: Path, tensor: bool, kept: Sequence[int] | None = None, own: Sequence[str] = ()):
        self._columns = columns(tensor, own)
        shared = [name for name in self._columns if name not in own]
        self._values = attrgetter(*shared)
        self._file = AppendedFile(path, kept)
        if kept is None:
            self._append(list(self._columns.values()))

    @property
    def kept(self) -> tuple[int, int]:
        """Bytes so far, all of them on the disk, and their checksum."""
        return self._file.kept

    def write(self, sample: Sample) -> None:
        """Add a line."""
        row = [*self._values(sample._replace(time=round(sample.time, 9))), *sample.own]
        self._append([None if x != x else x for x in row])  # NaN

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _append(self, row: list) -> None:
        line = io.StringIO(newline="")
        csv.writer(line, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n").writerow(row)
        self._file.append(line.getvalue().encode())
