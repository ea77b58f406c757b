"""Progress of a run: a bar on a terminal or in a notebook, elsewhere a line at intervals."""

import html
import io
import os
import sys
import threading
import time as clock
from typing import TYPE_CHECKING, TextIO, TypedDict, Unpack

from tqdm import tqdm

from rigidmd.core.toml import Json

if TYPE_CHECKING:
    from IPython.display import DisplayHandle

#: Seconds between two lines.
PAUSE = 30.0


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


def is_shown(*, shown: bool | None) -> bool:
    """Whether progress is shown: None shows it only in a notebook."""
    return in_notebook() if shown is None else shown


class DisplayArea:
    """A part of the output of a notebook cell, whose content can be replaced."""

    def __init__(self):
        self._handle: DisplayHandle | None = None

    def show(self, bundle: Json, metadata: Json | None = None) -> None:
        if self._handle is None:
            from IPython.display import DisplayHandle

            self._handle = DisplayHandle()
            self._handle.display(bundle, raw=True, metadata=metadata)
        else:
            self._handle.update(bundle, raw=True, metadata=metadata)


def announce(sentence: str, spot: DisplayArea) -> None:
    """Announce an operation that takes a moment: in a notebook in this area, else as a line on
    standard error."""
    if in_notebook():
        faint = f'<small style="opacity:.7">{html.escape(sentence)} ...</small>'
        spot.show({"text/html": faint, "text/plain": f"{sentence} ..."})
    else:
        print(f"  {sentence} ...", file=sys.stderr, flush=True)


def progress_of(
    total: float, unit: str, *, shown: bool | None, spot: DisplayArea | None = None
) -> "Bar":
    """A bar for a `with` statement. Its `update` is called with each advance, in `unit` of time.
    `shown`: None shows it only in a notebook. `spot`: the area in which a notebook shows it, also
    at the end."""
    if not is_shown(shown=shown):
        return Bar(disable=True)
    if in_notebook():
        return _NotebookBar(spot or DisplayArea(), total=total, unit=unit)
    if not sys.stderr.isatty():
        return _Lines(total=total, unit=unit)
    return Bar(
        total=total,
        ncols=columns(),
        nrows=ROWS,
        bar_format="{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit + " [{elapsed}<{remaining}]",
    )


class BarOptions(TypedDict, total=False):
    """Arguments of tqdm."""

    total: float
    unit: str
    bar_format: str
    disable: bool
    leave: bool
    file: TextIO
    mininterval: float
    delay: float
    ncols: int
    nrows: int


ROWS = 24  # of a terminal, which limits how many bars it shows


def columns() -> int:
    """The width of a bar. A terminal that does not have its size counts as one of 80 columns."""
    try:
        width = os.get_terminal_size(sys.stderr.fileno()).columns
    except (OSError, ValueError):
        width = 0
    return (width or 80) - 1


class Bar(tqdm):
    """A bar on a terminal. Its rate is without pauses."""

    def __init__(self, **options: Unpack[BarOptions]):
        # with miniters no thread of tqdm shows the bar; the output of a thread would have no cell
        # in a notebook
        defaults: BarOptions = {"leave": False, "mininterval": 0.2}
        super().__init__(**(defaults | options), miniters=0, smoothing=0.0)
        self._time, self.initial = clock.monotonic, 0.0
        self.start_t = self.last_print_t = self._marked = clock.monotonic()

    def skip(self, amount: float) -> None:
        self.n += amount
        self.initial += amount

    def unpause(self) -> None:
        """Leave out the time since the last advance, which was spent on compiling or minimising."""
        pause, self._marked = clock.monotonic() - self._marked, clock.monotonic()
        self.start_t += pause
        self.last_print_t += pause

    def update(self, n: float | None = 1) -> bool | None:
        """Count an advance, up to the total, and show it at intervals."""
        self._marked = clock.monotonic()
        return super().update(n if self.disable else min(n or 0.0, self.total - self.n))

    @property
    def rate(self) -> float:
        """Amount per second, 0 before the first advance."""
        elapsed = clock.monotonic() - self.start_t
        return (self.n - self.initial) / elapsed if elapsed > 0 else 0.0

    @property
    def left(self) -> str:
        """The remaining time as text. Empty before the first advance."""
        if self.rate > 0:
            return f", {tqdm.format_interval(round((self.total - self.n) / self.rate))} left"
        return ""


Bar.set_lock(threading.RLock())  # tqdm's is for several processes too, and slow to import


class _NotebookBar(Bar):
    """A bar of HTML, which any notebook shows without widgets and saves in its file."""

    def __init__(self, spot: DisplayArea, total: float, unit: str):
        self._spot, self._ended = spot, False
        super().__init__(file=io.StringIO(), leave=True, total=total, unit=unit)

    def close(self) -> None:
        self._ended = True
        super().close()

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Show the progress. tqdm calls this at intervals."""
        status = self.format_dict
        done, total, elapsed = status["n"], status["total"], status["elapsed"]
        text = f"{done:.4g} of {total:.4g} {status['unit']}"
        if done >= total * (1 - 1e-9):
            fraction = 1.0
            text = f"{total:.4g} {status['unit']} in {elapsed:.3g} s"
        else:
            fraction = done / total
            left = "" if self._ended or elapsed == 0 else self.left
            text += f", {tqdm.format_interval(elapsed)}{left}"
        style = "width:18em;max-width:50%;vertical-align:middle"
        bar = f'<progress value="{fraction:.4f}" max="1" style="{style}"></progress>'
        content = (
            f'<div style="font-variant-numeric:tabular-nums">{bar} <small>{text}</small></div>'
        )
        self._spot.show({"text/html": content, "text/plain": f"{100 * fraction:.0f} %: {text}"})


class _Lines(Bar):
    """Progress as lines on standard error: time done, rate and time left."""

    def __init__(self, total: float, unit: str):
        super().__init__(file=io.StringIO(), mininterval=PAUSE, delay=PAUSE, total=total, unit=unit)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Print a line, except for the empty message at the end."""
        if msg is None:
            done = (
                f"  {self.n:.4g} of {self.total:.4g} {self.unit}, {self.rate:.3g}"
                f" {self.unit}/s{self.left}"
            )
            print(done, file=sys.stderr, flush=True)
