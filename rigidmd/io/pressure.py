"""pressure_tensor.csv: the pressure tensor over time at an interval of its own, for viscosities."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidmd.core.files import AppendedFile
from rigidmd.errors import OutputError
from rigidmd.io.run_files import read_columns

TENSOR_FILE = "pressure_tensor.csv"
COMPONENTS = ("xx", "yy", "zz", "xy", "xz", "yz")
HEADER = ["Time (ps)", *(f"Pressure {name} (bar)" for name in COMPONENTS)]


def tensor_row(time: float, tensor: np.ndarray) -> list[float]:
    """A line: time (ps) and six components of a symmetric tensor (3, 3), bar."""
    return [round(time, 9), *(float(tensor["xyz".index(a), "xyz".index(b)]) for a, b in COMPONENTS)]


class TensorFile(AppendedFile):
    """Written line by line; `kept` of an earlier time is where an existing file is continued. Raises OutputError."""

    def __init__(self, path: Path, kept: Sequence[int] | None = None):
        super().__init__(path, kept)
        if kept is None:
            self.append((",".join(f'"{title}"' for title in HEADER) + "\n").encode())

    def write(self, row: list[float]) -> None:
        self.append((",".join(map(repr, row)) + "\n").encode())


def read_tensor(path: Path) -> np.ndarray | None:
    """Lines (n, 7) of the file; None without one. A last line that is cut off is left out. Raises OutputError."""
    if (found := read_columns(path)) is None:
        return None
    if list(found.cells) != HEADER:
        raise OutputError(f"{path} is no pressure tensor of rigidmd: its columns must be {', '.join(HEADER)}")
    return np.array([found.numbers(header, finite=True) for header in HEADER]).T
