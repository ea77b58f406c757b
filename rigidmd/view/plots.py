"""Plots of columns against time: small ones for pages, where animations add a cursor, figures, and
live ones."""

import time as clock
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from rigidmd.engines.body_motion import Motion
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.samples import BODY_COLUMNS, MATRIX, Column, Samples
from rigidmd.engines.system import System
from rigidmd.figures.picture import Picture
from rigidmd.figures.run import run_figures
from rigidmd.figures.style import (
    COLORS,
    FAINT,
    INK,
    new_figure,
    open_axis,
    shown_range,
    thin_series,
)
from rigidmd.io.progress import DisplayArea, in_notebook
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.record import Record
from rigidmd.run.results import Results
from rigidmd.run.simulation import Simulation
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.validation import did_you_mean, not_none
from rigidmd.view.page import figure as figure_part

#: Inches: narrow, to be readable on a phone.
WIDTH, HEIGHT = 4.4, 2.3
#: Errors of exactly 0 are drawn at this value.
FLOOR = 1e-17


class Panel(NamedTuple):
    """Curves on one axis: a title with the unit, (label, values) each; logarithmic or not."""

    title: str
    curves: list[tuple[str, np.ndarray]]
    log: bool = False


def panels(record: Record) -> list[Panel]:
    all_panels = _body_panels(record) if record.is_body else _molecular_panels(record)
    return [panel for panel in all_panels if panel.curves]


def _molecular_panels(record: Record) -> list[Panel]:
    columns, n, shown = record.columns, len(record.system.model.species), record.moving

    def curves(per: int = 1, **labels: str) -> list[tuple[str, np.ndarray]]:
        recorded = [
            name for name in labels if name in columns and np.isfinite(columns[name][shown]).any()
        ]
        return [(labels[name], columns[name] / per) for name in recorded]

    panel_list = [
        Panel(
            "temperature (K)",
            curves(temperature_translation="translation", temperature_rotation="rotation"),
        ),
        Panel("potential energy (kJ/mol per molecule)", curves(n, potential="")),
        Panel(
            "drift of the conserved energy in a stage (kJ/mol per molecule)", curves(n, drift="")
        ),
        Panel("pressure (bar)", curves(pressure_bar="")),
    ]
    if "density" in columns and np.ptp(np.nan_to_num(columns["density"])) > 0:
        panel_list.append(Panel("density (g/cm³)", curves(density="")))
        panel_list.append(Panel("edges of the box (Å)", curves(a="a", b="b", c="c")))
    return panel_list


def _body_panels(record: Record) -> list[Panel]:
    columns = record.columns
    panel_list = []
    if "theta" in columns:
        panel_list.append(Panel("θ (°)", [("", np.degrees(columns["theta"]))]))
        for name, key in (
            ("φ", "phi"),
            ("ψ", "psi"),
        ):  # one panel each: precession is much slower than spin
            angle = np.unwrap(columns[key])
            unit, size = ("turns", 2 * np.pi) if np.ptp(angle) > 2 * np.pi else ("°", np.pi / 180)
            panel_list.append(Panel(f"{name} ({unit})", [("", angle / size)]))
        omega = [("ω" + "₁₂₃"[k], columns[f"omega_body_{k + 1}"]) for k in range(3)]
        panel_list.append(Panel("ω along the body's axes (rad/s)", omega))
    if "x" in columns and any(np.ptp(columns[k]) > 0 for k in "xyz") and record.system.translates:
        panel_list.append(Panel("centre of mass (m)", [(k, columns[k]) for k in "xyz"]))
    parts = [
        (name, columns[name]) for name in ("kinetic", "potential", "energy") if name in columns
    ]
    panel_list.append(Panel("energies (J)", parts))
    known = [
        name
        for name, values in columns.items()
        if name.endswith("_error") and np.isfinite(values).any()
    ]
    errors = [
        (name.removesuffix("_error"), np.maximum(np.abs(columns[name]), FLOOR)) for name in known
    ]
    panel_list.append(
        Panel(f"relative errors of what is conserved (0 is drawn at {FLOOR:.0e})", errors, log=True)
    )
    return panel_list


def plots_part(record: Record) -> str:
    """All plots as HTML. Attributes for the animation: data-left and data-right, the ends of the
    time axis as fractions of the width, data-from and data-to, its limits."""
    figures = []
    for k, panel in enumerate(panels(record)):
        figure = new_figure(WIDTH, HEIGHT)
        axis = figure.subplots()
        draw_panel(axis, record, panel)
        axis.set_title(panel.title, loc="left", fontsize=9, color=INK)
        axis.set_xlabel(f"time ({record.time_unit})", fontsize=8, color=INK)
        svg = figure_part(figure, f"panel{k}", panel.title)  # sets the position of the axis
        box, (left, right) = axis.get_position(), axis.get_xlim()
        where = (
            f'data-left="{box.x0:.5f}" data-right="{box.x1:.5f}" data-from="{left:.9g}"'
            f' data-to="{right:.9g}"'
        )
        figures.append(f"<figure {where}>{svg}</figure>")
    return f'<div class="plots">{"".join(figures)}</div>'


def draw_panel(axis, record: Record, panel: Panel) -> None:
    """Draw the curves of a panel, without minimisations, with the beginnings of stages."""
    shown, ranges = record.moving, []
    time, stages = record.time[shown], record.columns.get("stage", np.zeros(len(shown)))[shown]
    for color, (label, values) in zip(cycle(COLORS), panel.curves, strict=False):
        axis.plot(*thin_series(time, values[shown], 600), color=color, lw=0.9, label=label or None)
        ranges.append(None if panel.log or record.is_body else shown_range(values[shown], stages))
    if panel.log:
        axis.set_yscale("log")
    else:
        axis.ticklabel_format(axis="y", useOffset=False)
    if None not in ranges:
        axis.set_ylim(min(low for low, _ in ranges), max(high for _, high in ranges))
    for k in np.flatnonzero(stages[1:] != stages[:-1]):
        axis.axvline(time[k], color=FAINT, lw=0.6, ls=":")
    axis.margins(x=0)
    open_axis(axis, labelsize=8)
    if len(panel.curves) > 1:
        axis.legend(
            frameon=False,
            fontsize=8,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.02),
            handlelength=1.2,
            borderaxespad=0.2,
            labelcolor=INK,
        )


#: Inches: width of a figure, height of a panel, height of labels around the panels.
FIGURE_WIDTH, PANEL_HEIGHT, FIGURE_MARGIN = 7.2, 2.0, 0.6


def record_of(
    system: System | BodySystem,
    samples: Samples | Motion,
    summary: dict[str, Any] | None,
    names: Sequence[str] | None = None,
) -> Record:
    """A run in memory as a record, with all its columns or with the named ones and the time."""
    wanted = samples.described if names is None else ("time", "stage", *names)
    columns = {
        name: samples[name] for name in wanted if name in samples.described and name != MATRIX
    }
    return Record(Path(), system.scene, system, summary, columns, [])


def plot(results: Results, *columns: str, log: bool = False) -> Picture:
    """A Matplotlib figure of a run, which a notebook displays and `savefig` writes.

    Parameters
    ----------
    columns
        Names of columns, drawn against time, with one panel for each unit; default: the main figure
        of the run (energy.png, or the path of the axis of a body); or the name of another figure of
        a body ("angles", "ellipsoids", "path", "invariants")
    log
        Absolute values on a logarithmic axis. Raises KeyError
    """
    figures = {}
    if not set(columns[:1]) & set(results.units):
        figures = run_figures(results.system, results.samples, results.summary)
    if not columns and not figures:
        raise ValueError(f"too few samples for a figure: {len(results.samples)}")
    wanted = columns or tuple(figures)[:1]
    if len(wanted) == 1 and wanted[0] in figures:
        return figures[wanted[0]]
    check_names(columns, results.samples.described, figures)
    record = record_of(results.system, results.samples, results.summary, list(columns))
    return columns_figure(record, columns, results.samples.described, log)


def check_names(names: Sequence[str], described: dict[str, Column], figures: Any = ()) -> None:
    """Raise KeyError, with a suggestion, for a name that is not a column of numbers."""
    known = [name for name, column in described.items() if column.unit and name != MATRIX]
    for name in (name for name in names if name not in known):
        if name in described:
            raise KeyError(
                f"column {name!r} has {'matrices' if name == MATRIX else 'text'}, which are not"
                " plotted"
            )
        hint = (
            did_you_mean(name, [*known, *figures]) or f"; there are {', '.join([*known, *figures])}"
        )
        raise KeyError(f"no column {name!r}{hint}")


def columns_figure(
    record: Record, names: Sequence[str], described: dict[str, Column], log: bool = False
) -> Picture:
    """Columns against time, with one panel for each unit."""
    units: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        units.setdefault(described[name].unit, []).append(name)
    figure = new_figure(
        FIGURE_WIDTH, PANEL_HEIGHT * len(units) + FIGURE_MARGIN, title=record.scene.name
    )
    axes = figure.subplots(len(units), 1, sharex=True, squeeze=False)[:, 0]
    for axis, (unit, members) in zip(axes, units.items(), strict=True):
        title = axis_label(members[0], unit) if len(members) == 1 else ""
        suffix = "" if unit == "1" else f"{' ' * bool(title)}({unit})" if title else unit
        curves = [(axis_label(name, unit), record.columns[name]) for name in members]
        draw_panel(
            axis, record, Panel("", [(label, np.abs(y) if log else y) for label, y in curves], log)
        )
        if len(members) > 1:
            axis.legend(frameon=False, fontsize=8, labelcolor=INK)
        axis.set_ylabel(f"{title}{suffix}", fontsize=9, color=INK)
    axes[-1].set_xlabel(f"time ({record.time_unit})", fontsize=9, color=INK)
    return figure


def axis_label(name: str, unit: str) -> str:
    """The name of a column without its unit, for an axis: pressure_bar is the pressure in bar."""
    return name.removesuffix(f"_{unit}").replace("_", " ")


#: Default columns; for a body the first one that it has.
MOLECULES, BODY = ("temperature", "drift"), ("energy_error", "energy")
#: Drawing takes at most this fraction of the time of a run.
TIME_FRACTION = 0.2


class LivePlot(Observer):
    """Draws columns of the samples so far in the output of a notebook cell; elsewhere it does
    nothing.

    Parameters
    ----------
    columns
        names, as in `results[...]`; default: temperature and drift, for a body energy_error
    interval
        Of the run (ps, s for a body) between two drawings; default: the interval of its samples
    pause
        Least seconds between two drawings, which take at most a fifth of the time
    """

    ends = draws = True

    def __init__(self, *columns: str, interval: float | None = None, pause: float = 0.5):
        self.interval = self._asked = interval
        self._columns, self._pause = columns, pause
        self._spot: DisplayArea | None = None

    def begin(self, run: Simulation) -> None:
        """Prepare the drawing.

        Raises
        ------
        KeyError
            For an unknown column.
        """
        self._run, self._due = run, 0.0
        scene = cast(MolecularScene | BodyScene, run.scene)
        if isinstance(scene, BodyScene):
            described, every = BODY_COLUMNS, not_none(scene.output.interval_s)
        else:
            described, every = run._part.samples().described, scene.output.log_interval_ps
        self.interval = every if self._asked is None else self._asked
        check_names(self._columns, described)
        self._spot = DisplayArea() if in_notebook() else None

    def see(self, moment: Moment) -> None:
        if self._spot is not None and clock.monotonic() >= self._due:
            self._draw()

    def end(self, run: Simulation, results: Results) -> None:
        self._draw()

    def failed(self, run: Simulation) -> str:
        self._draw()
        return ""

    def _draw(self) -> None:
        if self._spot is None:
            return
        began, samples = clock.monotonic(), self._run._part.samples()
        if len(samples) < 2:
            return
        described = samples.described
        default = (
            MOLECULES if "drift" in described else [name for name in BODY if name in described][:1]
        )
        names = self._columns or default
        check_names(names, described)
        png, size = columns_figure(
            record_of(self._run.system, samples, None, names), names, described
        ).png()
        self._spot.show(
            {"image/png": png, "text/plain": f"{', '.join(names)} against time"},
            {"image/png": size},
        )
        now = clock.monotonic()
        self._due = now + max(self._pause, (now - began) * (1 / TIME_FRACTION - 1))
