"""Tables of reports: columns with functions of a row. They become text for a terminal, CSV, and HTML (`view.page`)."""

import csv
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rigidmd.io.write import columns_text, write_csv


def format_cell(value: Any) -> str:
    """A value with three digits; "-" for None."""
    if value is None or isinstance(value, str):
        return "-" if value is None else value
    return f"{value:.3g}" if value == 0 or 1e-3 <= abs(value) < 1e5 else f"{value:.1e}"


class Column(NamedTuple):
    header: str  # with the unit
    value: Callable[[Any], Any]  # of a row: a number, text, or None
    short: str = ""  # header for a terminal, if it is another one


def with_error(header: str, measured: Callable[[Any], Sequence[Any] | None], error_header: str = "±") -> list[Column]:
    """Columns of a value and its error. measured(row) : both, or None"""
    pair = lambda row: measured(row) or (None, None)  # noqa: E731
    return [Column(header, lambda row: pair(row)[0]), Column(error_header, lambda row: pair(row)[1])]


class Table(NamedTuple):
    columns: list[Column]
    rows: Sequence[Any]

    def values(self, row: Any) -> list[Any]:
        return [column.value(row) for column in self.columns]

    def shown(self) -> tuple[list[str], list[list[str]]]:
        """Headers and cells as text, for readers."""
        return [c.header for c in self.columns], [list(map(format_cell, self.values(row))) for row in self.rows]

    def text(self, left: Sequence[int] = (0,)) -> str:
        """The table for a terminal, without columns that have no values. left : indices of columns aligned left"""
        _, cells = self.shown()
        kept = [k for k in range(len(self.columns)) if any(line[k] not in ("", "-") for line in cells)]
        lines = [[column.short or column.header for column in self.columns], *cells]
        return columns_text([[line[k] for k in kept] for line in lines], [kept.index(k) for k in left if k in kept])

    def write(self, path: Path, quoting: Any = csv.QUOTE_MINIMAL) -> None:
        """Write the table as CSV. Raises OutputError."""
        write_csv(path, [[column.header for column in self.columns], *map(self.values, self.rows)], quoting)
