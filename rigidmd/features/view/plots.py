"""Plots of columns against time: small ones for pages, where animations add a cursor, figures, and
live ones."""

import time as clock
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from rigidmd.core.quantities import Quantity, current_name
from rigidmd.core.toml import Json
from rigidmd.engines.samples import MATRIX, SampleTable
from rigidmd.engines.sites import AnySystem
from rigidmd.features.view.figures.panels import Panel, draw_rows, stack
from rigidmd.features.view.figures.picture import Picture
from rigidmd.features.view.figures.style import new_figure
from rigidmd.features.view.kind_display import display_of, panels, run_figures, timeline
from rigidmd.features.view.page import figure as figure_part
from rigidmd.io.progress import DisplayArea, in_notebook
from rigidmd.run.observers import Moment, Observer
from rigidmd.run.record import Record
from rigidmd.run.results import Results
from rigidmd.run.simulation import Simulation
from rigidmd.scene.validation import did_you_mean

#: Inches: narrow, to be readable on a phone.
WIDTH, HEIGHT = 4.4, 2.3


def plots_part(record: Record) -> str:
    """All plots as HTML. Attributes for the animation: data-box, the ends of the axis as fractions
    of the figure (left, right, top, bottom), data-from and data-to, the limits of its times."""
    figures = []
    for k, (times, panel) in enumerate(panels(record)):
        figure = new_figure(WIDTH, HEIGHT, layout=None)
        (axis,) = draw_rows(figure, [[(times, panel)]], (0.0, 0.0, WIDTH, HEIGHT))
        svg = figure_part(figure, f"panel{k}", panel.title)
        box, (left, right) = axis.get_position(), axis.get_xlim()
        ends = " ".join(f"{end:.5f}" for end in (box.x0, box.x1, 1 - box.y1, 1 - box.y0))
        limits = f'data-from="{left:.9g}" data-to="{right:.9g}"'
        figures.append(f'<figure data-box="{ends}" {limits}>{svg}</figure>')
    return f'<div class="plots">{"".join(figures)}</div>'


def record_of(
    system: AnySystem,
    samples: SampleTable,
    summary: Json | None,
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
    results : Results
        Results of a run
    *columns : str
        Names of columns, drawn against time, with one panel for each unit. Default: the main figure
        of the run (energy.png, or the path of the axis of a body), or the name of another figure of
        a body ("angles", "ellipsoids", "path", "invariants")
    log : bool, optional
        Absolute values on a logarithmic axis

    Returns
    -------
    Picture
        A Matplotlib figure

    Raises
    ------
    KeyError
        For an unknown column.
    ValueError
        With too few samples.
    """
    figures = {}
    if not set(columns[:1]) & set(results.units):
        figures = run_figures(results.system, results.samples, results.summary)
    if not columns and not figures:
        raise ValueError(f"too few samples for a figure: {len(results.samples)}")
    wanted = columns or tuple(figures)[:1]
    if len(wanted) == 1 and wanted[0] in figures:
        return figures[wanted[0]]
    columns = check_names(columns, results.samples.described, figures)
    record = record_of(results.system, results.samples, results.summary, list(columns))
    return columns_figure(record, columns, results.samples.described, log=log)


def check_names(
    names: Sequence[str], described: Mapping[str, Quantity], figures: Iterable[str] = ()
) -> tuple[str, ...]:
    """The current names of columns of numbers. Raises KeyError, with a suggestion, for any other
    name."""
    known = [name for name, column in described.items() if column.unit and name != MATRIX]
    names = tuple(current_name(name, described) for name in names)
    for name in (name for name in names if name not in known):
        if name in described:
            kind = "matrices" if name == MATRIX else "text"
            raise KeyError(f"column {name!r} has {kind}, which are not plotted")
        others = f"; there are {', '.join([*known, *figures])}"
        raise KeyError(f"no column {name!r}{did_you_mean(name, [*known, *figures]) or others}")
    return names


def columns_figure(
    record: Record, names: Sequence[str], described: Mapping[str, Quantity], *, log: bool = False
) -> Picture:
    """Columns against time, with one panel for each unit."""
    units: dict[str, list[str]] = {}
    for name in dict.fromkeys(names):
        units.setdefault(described[name].unit, []).append(name)
    times = timeline(record.system, record.columns)
    rows = []
    for unit, members in units.items():
        labels = [name.removesuffix(f"_{unit}").replace("_", " ") for name in members]
        values = [record.columns[name] for name in members]
        curves = [(label, np.abs(y) if log else y) for label, y in zip(labels, values, strict=True)]
        axis = unit if unit != "1" else ""
        rows.append([(times, Panel(", ".join(labels), curves, axis, log=log))])
    return stack(rows, record.scene.name)


#: Drawing takes at most this fraction of the time of a run.
TIME_FRACTION = 0.2


class LivePlot(Observer):
    """Draws columns of the samples so far in the output of a notebook cell. It has no effect
    elsewhere.

    Parameters
    ----------
    *columns : str
        Names, as in `results[...]`. Default: temperature and drift, for a body energy_error
    interval : float, optional
        Time of the run between two drawings, ps, for a body s. Default: the interval of its samples
    pause : float, optional
        Least seconds between two drawings, which take at most a fifth of the time
    """

    ends = draws = True

    def __init__(self, *columns: str, interval: float | None = None, pause: float = 0.5):
        self.interval = self._asked = interval
        self._columns, self._pause = columns, pause
        self._spot: DisplayArea | None = None

    def begin(self, run: Simulation) -> None:
        """Prepare the drawing.

        Parameters
        ----------
        run : Simulation
            The simulation that starts

        Raises
        ------
        KeyError
            For an unknown column.
        """
        self._run, self._due = run, 0.0
        described, every = display_of(run.scene).live_samples(run)
        self.interval = every if self._asked is None else self._asked
        self._columns = check_names(self._columns, described)
        self._spot = DisplayArea() if in_notebook() else None

    def observe(self, moment: Moment) -> None:
        if clock.monotonic() >= self._due:
            self._draw()

    def end(self, run: Simulation, results: Results) -> None:
        self._draw()

    def failed(self, run: Simulation) -> str:
        self._draw()
        return ""

    def _draw(self) -> None:
        if self._spot is None:
            return
        began = clock.monotonic()
        samples = self._run._part.samples()
        if len(samples) < 2:
            return
        described = samples.described
        names = self._columns or display_of(self._run.scene).live_columns(described)
        check_names(names, described)
        record = record_of(self._run.system, samples, None, names)
        png, size = columns_figure(record, names, described).png()
        text = f"{', '.join(names)} against time"
        self._spot.show({"image/png": png, "text/plain": text}, {"image/png": size})
        now = clock.monotonic()
        self._due = now + max(self._pause, (now - began) * (1 / TIME_FRACTION - 1))
