"""Curves of a run in progress, redrawn in a notebook."""

import time as clock
from typing import TYPE_CHECKING, cast

from rigidmd.engines.samples import BODY_COLUMNS
from rigidmd.io.progress import DisplayArea, in_notebook
from rigidmd.run.observers import Moment, Observer
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.validation import not_none
from rigidmd.view.plots import check_names, columns_figure, record_of

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation

#: Default columns; for a body the first one that it has.
MOLECULES, BODY = ("temperature", "drift"), ("energy_error", "energy")
#: Drawing takes at most this fraction of the time of a run.
TIME_FRACTION = 0.2


class LivePlot(Observer):
    """Draws columns of the samples so far in the output of a notebook cell; elsewhere it does nothing.

    columns : names, as in `results[...]`; default: temperature and drift, for a body energy_error
    interval : of the run (ps, s for a body) between two drawings; default: the interval of its samples
    pause : least seconds between two drawings, which take at most a fifth of the time
    """

    ends = draws = True

    def __init__(self, *columns: str, interval: float | None = None, pause: float = 0.5):
        self.interval = self._asked = interval
        self._columns, self._pause = columns, pause
        self._spot: DisplayArea | None = None

    def begin(self, run: "Simulation") -> None:
        """Prepare the drawing. Raises KeyError for an unknown column."""
        self._run, self._due = run, 0.0
        scene = cast(MolecularScene | BodyScene, run.scene)
        if isinstance(scene, BodyScene):
            described, every = BODY_COLUMNS, not_none(scene.output.interval_s)
        else:
            described, every = run.part.samples().described, scene.output.log_interval_ps
        self.interval = every if self._asked is None else self._asked
        check_names(self._columns, described)
        self._spot = DisplayArea() if in_notebook() else None

    def see(self, moment: Moment) -> None:
        if self._spot is not None and clock.monotonic() >= self._due:
            self._draw()

    def end(self, run: "Simulation", results: "Results") -> None:
        self._draw()

    def failed(self, run: "Simulation") -> str:
        self._draw()
        return ""

    def _draw(self) -> None:
        if self._spot is None:
            return
        began, samples = clock.monotonic(), self._run.part.samples()
        if len(samples) < 2:
            return
        described = samples.described
        default = MOLECULES if "drift" in described else [name for name in BODY if name in described][:1]
        names = self._columns or default
        check_names(names, described)
        record = record_of(self._run.system, samples, None, names)
        png, size = columns_figure(record, names, described).png()
        self._spot.show({"image/png": png, "text/plain": f"{', '.join(names)} against time"}, {"image/png": size})
        now = clock.monotonic()
        self._due = now + max(self._pause, (now - began) * (1 / TIME_FRACTION - 1))
