"""log.csv: one line a sample, soon on the disk, so that a killed run keeps its samples.

The first columns are those of OpenMM's StateDataReporter.
"""

import csv
import io
import time as clock
from collections.abc import Sequence
from math import inf
from operator import attrgetter
from pathlib import Path

from rigidmd.core.files import AppendedFile
from rigidmd.engines import samples
from rigidmd.engines.samples import Sample

#: Seconds that a line may wait for others, which together take a tenth of the time, and after which it waits for none.
DELAY, SELDOM = 0.5, 0.05
#: Columns that are written on request.
TENSOR = tuple(name for name in samples.COLUMNS if name.startswith("pressure_") and len(name) == len("pressure_xx"))


def columns(tensor: bool = True, own: Sequence[str] = ()) -> dict[str, str]:
    """Name of each column -> its header; with or without the pressure tensor; own : the user's own forces."""
    described = samples.COLUMNS | samples.own_columns(own)
    written = {name: column.header for name, column in described.items() if column.header}
    return written if tensor else {name: header for name, header in written.items() if name not in TENSOR}


class Log(AppendedFile):
    """Writes samples to a CSV file, numbers with all significant digits; missing values are empty. Raises OutputError.

    kept : `kept` of an earlier time, at which an existing file goes on; None begins a new file
    own : names of the user's own forces
    """

    def __init__(self, path: Path, tensor: bool, kept: Sequence[int] | None = None, own: Sequence[str] = ()):
        self._columns = columns(tensor, own)
        shared = [name for name in self._columns if name not in own]
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
        """Bytes so far, all of them on the disk, and their checksum."""
        self.flush()
        return super().kept

    def write(self, sample: Sample) -> None:
        """Add a line. It is written at once if none came shortly before."""
        row = [*self._values(sample), *sample.own]
        row[self._time] = round(sample.time, 9)
        self._rows.append(row)
        now = clock.monotonic()
        before, self._came = self._came, now
        if now - before >= SELDOM or now - self._written >= DELAY:
            self.flush()
            self._written = now

    def flush(self) -> None:
        """Write all lines so far. Those that cannot be written are lost, as their sample stops the run."""
        rows, self._rows = self._rows, []
        if not rows:
            return
        lines = io.StringIO(newline="")
        writer = csv.writer(lines, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
        writer.writerows([None if x != x else x for x in row] for row in rows)  # NaN
        self.append(lines.getvalue().encode())

    def close(self) -> None:
        """Write the rest and close the file."""
        try:
            self.flush()
        finally:
            super().close()
