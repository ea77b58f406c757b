"""motion.csv and motion.npz: the columns of a single body's motion with all digits."""

from pathlib import Path

import numpy as np

from rigidmd.core.files import whole_file


def write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    """One line a sample; numbers with 17 digits, which keep every bit."""
    with whole_file(path) as temporary:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(temporary, rows, fmt="%.17g", delimiter=",", header=",".join(columns), comments="", encoding="utf-8")


def write_npz(path: Path, columns: dict[str, np.ndarray]) -> None:
    """The same columns as arrays by name."""
    with whole_file(path) as temporary:
        np.savez(temporary, **columns)  # pyright: ignore[reportArgumentType]  (no column is called allow_pickle)
