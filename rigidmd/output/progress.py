"""Progress of a run: a bar on a terminal or in a notebook, elsewhere a line now and then."""

import contextlib
import html
import io
import sys
import time as clock
from collections.abc import Callable, Iterator
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


@contextlib.contextmanager
def progress_of(
    total: float, unit: str, shown: bool | None, spot: Spot | None = None
) -> Iterator[Callable[[float], object]]:
    """A function to call with each advance, in `unit` of time.

    shown : None shows it only in a notebook; spot : where a notebook shows it, and keeps it at the end
    """
    if not is_shown(shown):
        yield lambda advance: None
        return
    if in_notebook():
        # with miniters no thread of tqdm's shows it, whose output would have no cell
        with _NotebookBar(spot or Spot(), total=total, unit=unit, mininterval=0.2, miniters=0) as bar:
            yield bar.update
        return
    if not sys.stderr.isatty():
        yield _Lines(total, unit).advance
        return
    form = "{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit + " [{elapsed}<{remaining}]"
    with tqdm(total=total, bar_format=form, leave=False, mininterval=0.2) as bar:
        yield bar.update


class _NotebookBar(tqdm):
    """A bar of HTML, which any notebook shows without widgets, and keeps with its file."""

    def __init__(self, spot: Spot, **options: Any):
        self._spot, self._ended = spot, False
        super().__init__(file=io.StringIO(), **options)

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
            rate = told["rate"] or (done / elapsed if elapsed > 0 else 0.0)
            left = f", {tqdm.format_interval((total - done) / rate)} left" if rate > 0 and not self._ended else ""
            text += f", {tqdm.format_interval(elapsed)}{left}"
        bar = (
            f'<progress value="{share:.4f}" max="1" style="width:18em;max-width:50%;vertical-align:middle"></progress>'
        )
        self._spot.show(
            {
                "text/html": f'<div style="font-variant-numeric:tabular-nums">{bar} <small>{text}</small></div>',
                "text/plain": f"{100 * share:.0f} %: {text}",
            }
        )


class _Lines:
    """Time done, rate and time left, as lines on standard error."""

    def __init__(self, total: float, unit: str):
        self._total, self._unit, self._done = total, unit, 0.0
        self._began = self._last = clock.monotonic()

    def advance(self, amount: float) -> None:
        """Count, and print a line if the last one is old enough."""
        self._done += amount
        now = clock.monotonic()
        if now - self._last < PAUSE:
            return
        self._last = now
        rate = self._done / (now - self._began)
        left = tqdm.format_interval((self._total - self._done) / rate) if rate > 0 else "?"
        print(
            f"  {self._done:.4g} of {self._total:.4g} {self._unit}, {rate:.3g} {self._unit}/s, {left} left",
            file=sys.stderr,
            flush=True,
        )
