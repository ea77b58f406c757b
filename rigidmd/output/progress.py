"""Progress of a run: a bar on a terminal or in a notebook, elsewhere a line now and then."""

import contextlib
import sys
import time as clock
import warnings
from collections.abc import Callable, Iterator

#: Seconds between two lines.
PAUSE = 30.0


def in_notebook() -> bool:
    """Whether this is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


@contextlib.contextmanager
def progress_of(total: float, unit: str, shown: bool | None) -> Iterator[Callable[[float], object]]:
    """A function to call with each advance, in `unit` of time. shown : None shows it only in a notebook."""
    notebook = in_notebook()
    if not (notebook if shown is None else shown):
        yield lambda advance: None
        return
    if not (notebook or sys.stderr.isatty()):
        yield _Lines(total, unit).advance
        return
    with warnings.catch_warnings():  # without ipywidgets a bar of text is shown; no warning is needed
        warnings.filterwarnings("ignore", message=".*IProgress not found")
        from tqdm.auto import tqdm
    form = "{l_bar}{bar}| {n:.1f}/{total:.1f} " + unit + " [{elapsed}<{remaining}]"
    with tqdm(total=total, bar_format=form, leave=False, mininterval=0.2) as bar:
        yield bar.update


class _Lines:
    """Time done, rate and time left, as lines on standard error."""

    def __init__(self, total: float, unit: str):
        self._total, self._unit, self._done = total, unit, 0.0
        self._began = self._last = clock.monotonic()

    def advance(self, amount: float) -> None:
        """Count, and print a line if the last one is old enough."""
        from tqdm import tqdm

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
