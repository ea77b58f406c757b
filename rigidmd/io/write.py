"""Files that are written as a whole: text, CSV, JSON, arrays; and the check of one before anything slow begins."""

import csv
import io
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.files import whole_file, write_text
from rigidmd.errors import OutputError


@contextmanager
def writing(path: Path, what: str = "written", hint: str = "") -> Iterator[None]:
    """Within it an OSError becomes an OutputError: PATH cannot be `what`, why, and a hint."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path} cannot be {what}: {error.strerror or error}{hint}") from None


def check_target(
    path: Path, endings: tuple[str, ...], force: bool, what: str = "file", inputs: Iterable[Path] = ()
) -> None:
    """Raise OutputError if a file cannot be written there or would replace one; changes nothing.

    inputs : files that it is made of, which are never replaced
    """
    if path.suffix not in endings:
        raise OutputError(f"{path}: the name of this {what} ends in {' or '.join(endings)}")
    if path.is_dir():
        raise OutputError(f"{path} is a folder; name a file")
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: there is no folder {path.parent}")
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise OutputError(f"{path} is what this {what} is made of; -o names another file")
    if path.exists() and not force:
        raise OutputError(f"{path} exists; --force replaces it, -o names another file")


def write_json(path: Path, data: Any, **options: Any) -> None:
    """Write data, with the options of `json.dumps`. Raises OutputError, as all of these do."""
    write_text(path, json.dumps(data, **options) + "\n")


def write_csv(path: Path, rows: Iterable[Sequence[Any]], quoting: Any = csv.QUOTE_MINIMAL) -> None:
    """Write rows of cells."""
    stream = io.StringIO(newline="")
    csv.writer(stream, quoting=quoting, lineterminator="\n").writerows(rows)
    write_text(path, stream.getvalue())


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns as CSV, one line a sample; numbers with 17 digits, which keep every bit."""
    with whole_file(path) as temporary:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(temporary, rows, fmt="%.17g", delimiter=",", header=",".join(columns), comments="", encoding="utf-8")


def write_npz(path: Path, columns: dict[str, np.ndarray]) -> None:
    """The same columns as arrays by name."""
    with whole_file(path) as temporary:
        np.savez(temporary, **columns)  # pyright: ignore[reportArgumentType]  (no column is called allow_pickle)


def nine_digits(value: float | None) -> float | None:
    """A number as tables in files have it; None without one."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.9g}")


def columns_text(lines: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Lines of cells as a table; the columns of these numbers are aligned left, all others right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = [
        [cell.ljust(w) if k in left else cell.rjust(w) for k, (cell, w) in enumerate(zip(line, widths, strict=True))]
        for line in lines
    ]
    return "\n".join("  ".join(line).rstrip() for line in padded)
