"""Files that are written as a whole: CSV, JSON, arrays, tables of reports. The target is checked
before the work."""

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from rigidmd.core.files import atomic_file, write_text
from rigidmd.errors import OutputError, option


def check_target(
    path: Path,
    extensions: tuple[str, ...],
    *,
    force: bool,
    what: str = "file",
    inputs: Iterable[Path] = (),
) -> None:
    """Raise OutputError if a file cannot be written to a path or would replace another one. Changes
    nothing. `inputs`: files from which it is made, which are never replaced."""
    if path.suffix not in extensions:
        raise OutputError(f"{path}: the name of this {what} ends in {' or '.join(extensions)}")
    if path.is_dir():
        raise OutputError(f"{path} is a folder. Name a file")
    if not path.parent.is_dir():
        raise OutputError(f"{path} cannot be written: the folder {path.parent} does not exist")
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise OutputError(f"{path} is an input of this {what}; {option('file')} names another file")
    if path.exists() and not force:
        raise OutputError(
            f"{path} exists; {option('force')} replaces it, {option('file')} names another file"
        )


def write_json(
    path: Path,
    data: object,
    indent: int | None = None,
    *,
    ensure_ascii: bool = True,
    allow_nan: bool = True,
) -> None:
    """Write data as `json.dumps` does. Raises OutputError, as all writers here do."""
    text = json.dumps(data, indent=indent, ensure_ascii=ensure_ascii, allow_nan=allow_nan)
    write_text(path, f"{text}\n")


def write_csv(path: Path, rows: Iterable[Sequence[object]], *, quote_text: bool = False) -> None:
    """Write rows as CSV, with texts in quotation marks where needed, or always."""
    stream = io.StringIO(newline="")
    quoting = csv.QUOTE_MINIMAL
    if quote_text:
        quoting = csv.QUOTE_NONNUMERIC
    csv.writer(stream, quoting=quoting, lineterminator="\n").writerows(rows)
    write_text(path, stream.getvalue())


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    """Write columns as CSV, one line per sample, numbers with 17 digits, which keep every bit."""
    line = ",".join(["%.17g"] * len(columns)) + "\n"
    rows = np.column_stack(list(columns.values())).tolist()
    write_text(path, "".join([",".join(columns) + "\n", *(line % tuple(row) for row in rows)]))


def write_npz(path: Path, columns: dict[str, np.ndarray]) -> None:
    with atomic_file(path) as temporary:
        np.savez(temporary, **columns)  # pyright: ignore[reportArgumentType]  (no column is called allow_pickle)


def nine_digits(value: float | None) -> float | None:
    """A number rounded to nine digits, for files. None if it is missing or not finite."""
    return None if value is None or not np.isfinite(value) else float(f"{value:.9g}")


def columns_text(lines: Sequence[Sequence[str]], left: Sequence[int] = (0,)) -> str:
    """Lines of cells as a table. The columns with indices `left` are aligned left, all others
    right."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    align = [str.ljust if k in left else str.rjust for k in range(len(widths))]
    padded = [
        [a(cell, w) for a, cell, w in zip(align, line, widths, strict=True)] for line in lines
    ]
    return "\n".join("  ".join(line).rstrip() for line in padded)


#: A number, text, or nothing.
Cell = float | str | None
Row = TypeVar("Row")


def format_cell(value: Cell) -> str:
    """A value with three digits. "-" for None."""
    if value is None or isinstance(value, str):
        return "-" if value is None else value
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e5 else f"{value:.1e}"


class Column(NamedTuple, Generic[Row]):
    header: str  # with the unit
    value: Callable[[Row], Cell]
    short: str = ""  # header for a terminal, if it is another one


class ReportTable(NamedTuple, Generic[Row]):
    columns: list[Column[Row]]
    rows: Sequence[Row]

    def values(self, row: Row) -> list[Cell]:
        return [column.value(row) for column in self.columns]

    def shown(self) -> tuple[list[str], list[list[str]]]:
        """Headers and cells as text, for readers."""
        return [c.header for c in self.columns], [
            list(map(format_cell, self.values(row))) for row in self.rows
        ]

    def text(self, left: Sequence[int] = (0,)) -> str:
        """The table for a terminal, without columns that have no values. left : indices of columns
        aligned left"""
        _, cells = self.shown()
        count = len(self.columns)
        filled = [any(line[k] not in ("", "-") for line in cells) for k in range(count)]
        shown_columns = [k for k in range(count) if filled[k]]
        header = [column.short or column.header for column in self.columns]
        lines = [[line[k] for k in shown_columns] for line in (header, *cells)]
        aligned_left = [shown_columns.index(k) for k in left if k in shown_columns]
        return columns_text(lines, aligned_left)

    def write(self, path: Path, quote_text: bool = False) -> None:
        """Write the table as CSV, see `write_csv`. Raises OutputError."""
        write_csv(
            path,
            [[column.header for column in self.columns], *map(self.values, self.rows)],
            quote_text=quote_text,
        )
