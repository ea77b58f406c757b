"""Curves of a run that goes on, drawn anew in a notebook as it goes."""

import time as clock
from typing import TYPE_CHECKING, cast

from rigidmd.engines.columns import BODY_COLUMNS
from rigidmd.io.progress import Spot, in_notebook
from rigidmd.run.moment import Moment
from rigidmd.run.observers import Observer
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.validation import settled
from rigidmd.view.columns import check_names, columns_figure, record_of

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation

#: Columns that are drawn if none are named; of a body the first of these that it has.
MOLECULES, BODY = ("temperature", "drift"), ("energy_error", "energy")
#: Drawing takes at most this share of the time of a run.
SHARE = 0.2


class LivePlot(Observer):
    """Draws columns of the samples so far, in a notebook, in one place of the cell's output; elsewhere it does nothing.

    columns : names, as of `results[...]`; default: temperature and drift, of a body energy_error
    interval : of the run (ps, s for a body) between two looks; default: that of its samples
    pause : least seconds between two pictures; drawing takes at most a fifth of the time
    """

    ends = draws = True

    def __init__(self, *columns: str, interval: float | None = None, pause: float = 0.5):
        self.interval = self._asked = interval
        self._columns, self._pause = columns, pause
        self._spot: Spot | None = None

    def begin(self, run: "Simulation") -> None:
        """Begin a picture. Raises KeyError if a column is not one of this run."""
        self._run, self._due = run, 0.0
        scene = cast(MolecularScene | BodyScene, run.scene)
        if isinstance(scene, BodyScene):
            described, every = BODY_COLUMNS, settled(scene.output.interval_s)
        else:
            described, every = run._samples().described, scene.output.log_interval_ps
        self.interval = every if self._asked is None else self._asked
        check_names(self._columns, described)
        self._spot = Spot() if in_notebook() else None

    def see(self, moment: Moment) -> None:
        """Draw if the last picture is old enough."""
        if self._spot is not None and clock.monotonic() >= self._due:
            self._draw()

    def end(self, run: "Simulation", results: "Results") -> None:
        """The last picture, which stays."""
        self._draw()

    def failed(self, run: "Simulation") -> str:
        """The picture of what was computed before a run failed."""
        self._draw()
        return ""

    def _draw(self) -> None:
        if self._spot is None:
            return
        began, samples = clock.monotonic(), self._run._samples()
        if len(samples) < 2:
            return
        described = samples.described
        own = MOLECULES if "drift" in described else [name for name in BODY if name in described][:1]
        names = self._columns or own
        check_names(names, described)
        record = record_of(self._run.system, samples, None, names)
        png, size = columns_figure(record, names, described).png()
        self._spot.show({"image/png": png, "text/plain": f"{', '.join(names)} against time"}, {"image/png": size})
        now = clock.monotonic()
        self._due = now + max(self._pause, (now - began) * (1 / SHARE - 1))
