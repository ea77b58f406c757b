"""Columns of a run against its time, as a figure, and the figures of a run by their names."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.engines.body_motion import Motion
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.columns import MATRIX, Column
from rigidmd.engines.samples import Samples
from rigidmd.engines.system import System
from rigidmd.figures.picture import Picture
from rigidmd.figures.run import run_figures
from rigidmd.figures.style import INK
from rigidmd.run.record import Record
from rigidmd.scene.validation import did_you_mean
from rigidmd.view.plots import Panel, draw_panel

if TYPE_CHECKING:
    from rigidmd.figures.picture import Picture
    from rigidmd.run.results import Results

#: Inches: width of a figure, height of a panel, of what is around them.
WIDTH, HEIGHT, AROUND = 7.2, 2.0, 0.6


def record_of(
    system: System | BodySystem,
    samples: Samples | Motion,
    summary: dict[str, Any] | None,
    names: Sequence[str] | None = None,
) -> Record:
    """A run in memory as a record, with all its columns or those of these names and their time."""
    if isinstance(samples, Motion):
        columns = samples.columns if names is None else {name: samples.columns[name] for name in ["time", *names]}
    else:
        wanted = samples.described if names is None else dict.fromkeys(["time", "stage", *names])
        columns = {name: samples[name] for name in wanted}
    return Record(Path(), system.scene, system, summary, columns, [])


def plot(results: "Results", names: tuple[str, ...], log: bool) -> "Picture":
    """The figure of these columns, of the name of a figure, or the first figure of the run. Raises KeyError."""
    figures = {}
    if not set(names[:1]) & set(results.units):
        figures = run_figures(results.system, results.samples, results.summary)
    if not names:
        if not figures:
            raise ValueError(f"too few samples for a figure: {len(results.samples)}")
        return next(iter(figures.values()))
    if len(names) == 1 and names[0] in figures:
        return figures[names[0]]
    check_names(names, results.samples.described, figures)
    record = record_of(results.system, results.samples, results.summary, list(names))
    return columns_figure(record, names, results.samples.described, log)


def check_names(names: Sequence[str], described: dict[str, Column], figures: Any = ()) -> None:
    """Raise KeyError, with a suggestion, if one of these is no column of numbers."""
    known = [name for name, column in described.items() if column.unit and name != MATRIX]
    for name in names:
        if name in known:
            continue
        if name in described:
            raise KeyError(f"column {name!r} has {'matrices' if name == MATRIX else 'words'}, which are not plotted")
        said = did_you_mean(name, [*known, *figures]) or f"; there are {', '.join([*known, *figures])}"
        raise KeyError(f"no column {name!r}{said}")


def columns_figure(record: Record, names: Sequence[str], described: dict[str, Column], log: bool = False) -> Picture:
    """Columns against time, those of one unit in one panel."""
    units: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        units.setdefault(described[name].unit, []).append(name)
    figure = Picture(figsize=(WIDTH, HEIGHT * len(units) + AROUND), layout="constrained")
    axes = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (unit, members) in zip(axes, units.items(), strict=True):
        title = in_words(members[0], unit) if len(members) == 1 else ""
        told = "" if unit == "1" else f"{' ' * bool(title)}({unit})" if title else unit
        curves = [(in_words(name, unit), record.columns[name]) for name in members]
        draw_panel(axis, record, Panel("", [(label, np.abs(y) if log else y) for label, y in curves], log))
        if len(members) > 1:
            axis.legend(frameon=False, fontsize=8, labelcolor=INK)
        axis.set_ylabel(f"{title}{told}", fontsize=9, color=INK)
    axes[-1].set_xlabel(f"time ({record.time_unit})", fontsize=9, color=INK)
    figure.suptitle(record.scene.name, color=INK, x=0.01, ha="left", fontsize=11)
    return figure


def in_words(name: str, unit: str) -> str:
    """The name of a column as it stands at an axis: pressure_bar is the pressure in bar."""
    return name.removesuffix(f"_{unit}").replace("_", " ")
