"""pressure_tensor.csv: the pressure tensor over time at an interval of its own, for viscosities."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rigidmd.core.files import AppendedFile
from rigidmd.errors import OutputError

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
        """Add a line."""
        self.append((",".join(map(repr, row)) + "\n").encode())


def read_tensor(path: Path) -> np.ndarray | None:
    """Lines (n, 7) of the file; None without one. A last line that is cut off is left out. Raises OutputError."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            head, *lines = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OutputError(f"{path} cannot be read: {error}") from None
    if head != HEADER:
        raise OutputError(f"{path} is no pressure tensor of rigidmd: its columns must be {', '.join(HEADER)}")
    try:
        found = np.array([line for line in lines if len(line) == len(HEADER)], float).reshape(-1, len(HEADER))
    except ValueError:
        raise OutputError(f"{path} holds what is no number") from None
    if not np.isfinite(found).all():
        raise OutputError(f"{path} holds what is no finite number")
    return found
