"""Progress of a run: a bar on a terminal or in a notebook, elsewhere a line now and then."""

import html
import io
import sys
import time as clock
from typing import Any

from tqdm import tqdm

#: Seconds between two lines.
PAUSE = 30.0


def in_notebook() -> bool:
    """Whether this is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


def is_shown(shown: bool | None) -> bool:
    """Whether progress is shown: None shows it only in a notebook."""
    return in_notebook() if shown is None else shown


class Spot:
    """A place in the output of a notebook's cell, whose content can be replaced."""

    def __init__(self):
        self._handle: Any = None

    def show(self, bundle: dict[str, Any], metadata: dict[str, Any] | None = None) -> None:
        """Put something there: its forms by their MIME types."""
        if self._handle is None:
            from IPython.display import DisplayHandle

            self._handle = DisplayHandle()
            self._handle.display(bundle, raw=True, metadata=metadata)
        else:
            self._handle.update(bundle, raw=True, metadata=metadata)

    def tell(self, sentence: str) -> None:
        """Put a sentence there."""
        self.show({"text/html": f'<small style="opacity:.7">{html.escape(sentence)}</small>', "text/plain": sentence})


def announce(sentence: str, spot: Spot) -> None:
    """Announce something that takes a moment: in a notebook in this spot, else as a line on standard error."""
    if in_notebook():
        spot.tell(f"{sentence} ...")
    else:
        print(f"  {sentence} ...", file=sys.stderr, flush=True)


def progress_of(total: float, unit: str, shown: bool | None, spot: Spot | None = None) -> "Bar":
    """A bar, to be used in a `with` statement, whose `update` takes each advance, in `unit` of time.

    shown : None shows it only in a notebook; spot : where a notebook shows it, and keeps it at the end
    """
    if not is_shown(shown):
        return Bar(disable=True)
    if in_notebook():
        return _NotebookBar(spot or Spot(), total=total, unit=unit)
    if not sys.stderr.isatty():
        return _Lines(total=total, unit=unit)
    return Bar(total=total, bar_format="{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit + " [{elapsed}<{remaining}]")


class Bar(tqdm):
    """A bar on a terminal. Its rate is that of what it has seen done, without pauses."""

    def __init__(self, **options: Any):
        # with miniters no thread of tqdm's shows it, whose output would have no cell in a notebook
        super().__init__(**{"leave": False, "mininterval": 0.2, "miniters": 0, "smoothing": 0.0} | options)
        self._time, self.initial = clock.monotonic, 0.0
        self.start_t = self.last_print_t = self._marked = clock.monotonic()

    def skip(self, amount: float) -> None:
        """Count what was done before."""
        self.n += amount
        self.initial += amount

    def unpause(self) -> None:
        """Leave out the time since the last advance, which something else took: compiling, minimising."""
        pause, self._marked = clock.monotonic() - self._marked, clock.monotonic()
        self.start_t += pause
        self.last_print_t += pause

    def update(self, n: float | None = 1) -> bool | None:
        """Count an advance, up to the total, and show it now and then."""
        self._marked = clock.monotonic()
        return super().update(n if self.disable else min(n or 0.0, self.total - self.n))

    @property
    def rate(self) -> float:
        """Done in a second; 0 while nothing is."""
        elapsed = clock.monotonic() - self.start_t
        return (self.n - self.initial) / elapsed if elapsed > 0 else 0.0

    @property
    def left(self) -> str:
        """How long the rest takes, in words; empty while nothing is known."""
        return f", {tqdm.format_interval(round((self.total - self.n) / self.rate))} left" if self.rate > 0 else ""


class _NotebookBar(Bar):
    """A bar of HTML, which any notebook shows without widgets, and keeps with its file."""

    def __init__(self, spot: Spot, **options: Any):
        self._spot, self._ended = spot, False
        super().__init__(file=io.StringIO(), leave=True, **options)

    def close(self) -> None:
        """Show how far it came; nothing is left to wait for."""
        self._ended = True
        super().close()

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Show how far it is; tqdm calls this now and then."""
        told = self.format_dict
        done, total, elapsed = told["n"], told["total"], told["elapsed"]
        text = f"{done:.4g} of {total:.4g} {told['unit']}"
        if done >= total * (1 - 1e-9):
            share, text = 1.0, f"{total:.4g} {told['unit']} in {elapsed:.3g} s"
        else:
            share = done / total
            text += f", {tqdm.format_interval(elapsed)}{'' if self._ended or elapsed == 0 else self.left}"
        bar = (
            f'<progress value="{share:.4f}" max="1" style="width:18em;max-width:50%;vertical-align:middle"></progress>'
        )
        self._spot.show(
            {
                "text/html": f'<div style="font-variant-numeric:tabular-nums">{bar} <small>{text}</small></div>',
                "text/plain": f"{100 * share:.0f} %: {text}",
            }
        )


class _Lines(Bar):
    """Time done, rate and time left, as lines on standard error."""

    def __init__(self, **options: Any):
        super().__init__(file=io.StringIO(), mininterval=PAUSE, delay=PAUSE, **options)

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Print a line, unless it is the empty one of the end."""
        if msg is None:
            done = f"  {self.n:.4g} of {self.total:.4g} {self.unit}, {self.rate:.3g} {self.unit}/s{self.left}"
            print(done, file=sys.stderr, flush=True)
