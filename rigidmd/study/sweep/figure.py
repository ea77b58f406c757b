"""Which observables of a sweep are drawn, and against what."""

from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.output.sweep_figure import Axis, Curve, Panel, draw_sweep
from rigidmd.output.sweep_folder import FIGURE, SEED
from rigidmd.output.sweep_names import in_words, short_keys, value_name
from rigidmd.study.sweep.table import DRIFT, MAIN, MAIN_OF_BODY, Row, Table

DENSITY, PRESSURE = "Density (g/mL)", "Pressure (bar)"
#: Change of the density, as a fraction, from which on it is drawn in place of the pressure.
MOVES = 1e-9
MOST_PANELS = 4


def write_figure(table: Table, name: str) -> Path | None:
    """Write sweep.png; None without anything to draw. Raises OutputError."""
    shown = _shown(table)
    rows = [row for row in table.rows if row.runs]
    if not shown or not rows:
        return None
    path = table.folder / FIGURE
    if not table.keys:
        axis, panels = Axis(SEED), [_of_replicas(rows[0], column) for column in shown]
    else:
        key = _across(table)
        axis, places = _places(table, key)
        panels = [Panel(column, _curves(table, rows, key, column, places)) for column in shown]
    counts = sorted({len(row.runs) for row in rows})
    runs = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    over = f"means over {runs} runs, with" if counts[-1] > 1 else "with"
    over = over if table.keys else f"each run, and {over}"
    draw_sweep(path, f"{name}: {over} one standard error" if _has_errors(rows, shown) else name, axis, panels)
    return path


def _shown(table: Table) -> list[str]:
    """Columns that are drawn: the density instead of the pressure where a barostat moves the box."""
    there = [column for column in (*MAIN, *MAIN_OF_BODY) if column in table.columns]
    if DENSITY in there:
        moves = any(
            (run[DENSITY][1] or 0.0) > MOVES * run[DENSITY][0] for row in table.rows for run in row.runs.values()
        )
        there.remove(PRESSURE if moves and PRESSURE in there else DENSITY)
    if len(there) > MOST_PANELS and DRIFT in there:
        there.remove(DRIFT)
    return there[:MOST_PANELS]


def _has_errors(rows: list[Row], shown: list[str]) -> bool:
    return any(row[column][1] is not None for row in rows for column in shown)


def _across(table: Table) -> str:
    """The key along the axis: the first one with numbers, else the first."""
    return next((key for key in table.keys if _is_number([row.values[key] for row in table.rows])), table.keys[0])


def _is_number(values: list[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)


def _places(table: Table, key: str) -> tuple[Axis, dict[str, float]]:
    """The axis, and value -> place on it."""
    values = [row.values[key] for row in table.rows]
    if _is_number(values):
        return Axis(key), {value_name(value): float(value) for value in values}
    words = list(dict.fromkeys(map(value_name, values)))
    return Axis(key, words), {word: float(k) for k, word in enumerate(words)}


def _curves(table: Table, rows: list[Row], key: str, column: str, places: dict[str, float]) -> list[Curve]:
    """A curve for each combination of the other keys."""
    others = short_keys(other for other in table.keys if other != key)
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(in_words({other: row.values[other] for other in others}, others), []).append(row)
    found = []
    for label, own in groups.items():
        points = sorted((places[value_name(row.values[key])], *_numbers(row, column)) for row in own)
        x, values, errors = (np.array(part) for part in zip(*points, strict=True))
        found.append(Curve(label, x, values, errors))
    return found


def _numbers(row: Row, column: str) -> tuple[float, float]:
    value, error = row[column]
    return value, np.nan if error is None else error


def _of_replicas(row: Row, column: str) -> Panel:
    """Each run with its own error, and the mean over all with its."""
    points = [(float(seed or 0), *run[column]) for seed, run in row.runs.items() if column in run]
    if not points:
        return Panel(column, [Curve("", np.zeros(0), np.zeros(0), np.zeros(0))])
    x, values, errors = (np.array([np.nan if y is None else y for y in part]) for part in zip(*points, strict=True))
    return Panel(column, [Curve("", x, values, errors)], _numbers(row, column))
