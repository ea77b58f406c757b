"""log.csv: one line a sample, flushed at once, so that a killed run keeps its samples.

The first columns are those of OpenMM's StateDataReporter.
"""

import csv
from math import isnan
from pathlib import Path

from rigidmd.measure import samples
from rigidmd.measure.samples import Sample

#: Columns that are written on request.
TENSOR = tuple(name for name in samples.COLUMNS if name.startswith("pressure_") and len(name) == len("pressure_xx"))


def columns(tensor: bool = True) -> dict[str, str]:
    """Name of each column -> its header; with or without the pressure tensor."""
    written = {name: column.header for name, column in samples.COLUMNS.items() if column.header}
    return written if tensor else {name: header for name, header in written.items() if name not in TENSOR}


class Log:
    """Writes samples to a CSV file, numbers with all significant digits; missing values are empty."""

    def __init__(self, path: Path, tensor: bool):
        self._columns = columns(tensor)
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
        self._writer.writerow(self._columns.values())

    def write(self, sample: Sample) -> None:
        """Add a line."""
        row = [getattr(sample._replace(time=round(sample.time, 9)), name) for name in self._columns]
        self._writer.writerow([None if isinstance(x, float) and isnan(x) else x for x in row])
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
