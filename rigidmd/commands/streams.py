"""Standard output and standard error: messages, progress, and streams that are closed, full, or
without a reader."""

import contextlib
import io
import os
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, TextIO, cast

from rigidmd.errors import OutputError, visible

if TYPE_CHECKING:
    from tqdm import tqdm


def announce(message: str) -> None:
    """Report on the standard error what begins."""
    print(f"  {message} ...", file=sys.stderr, flush=True)


def warn(message: str) -> None:
    """Print a warning on the standard error, in a line without a bar."""
    bars_hidden = contextlib.nullcontext()
    if "tqdm" in sys.modules:
        from tqdm import tqdm

        bars_hidden = tqdm.external_write_mode(sys.stderr)
    with bars_hidden:
        print(f"rigidmd: warning: {visible(message)}", file=sys.stderr)


@contextlib.contextmanager
def progress_bar(begins: str = "") -> Iterator[Callable]:
    """A bar on a terminal, which disappears at its end: a function of the fraction that is done and
    a description.

    begins : what starts at the fraction 0, when all arguments have been checked
    """
    # the left part has the description
    with _terminal_bar("{l_bar}{bar}| [{elapsed}<{remaining}]") as bar:

        def progress(fraction: float, description: str = "") -> None:
            if begins and fraction == 0:
                bar.clear()
                announce(begins)
            bar.set_description_str(description, refresh=False)
            bar.update(fraction - bar.n)

        yield progress


@contextlib.contextmanager
def shown_working(message: str) -> Iterator[None]:
    """Within it, a terminal shows what takes a while, in a line that disappears."""
    with _terminal_bar("  {desc} ...", message):
        yield


def _terminal_bar(form: str, description: str | None = None) -> "tqdm":
    """A bar on a terminal, which disappears at its end. Elsewhere nothing is shown."""
    from tqdm import tqdm

    from rigidmd.io.progress import ROWS, columns

    return tqdm(
        total=1.0,
        desc=description,
        disable=None,
        leave=False,
        bar_format=form,
        ncols=columns(),
        nrows=ROWS,
    )


def open_streams() -> None:
    """Open what was closed before the start, so that no file of a run gets the number of a standard
    stream. What the encoding of a terminal lacks is written as an escape and does not end the
    run."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  (until the process ends)
        if isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


@contextlib.contextmanager
def checked_streams(*, lasting: bool) -> Iterator[None]:
    """Within it a stream that cannot be written raises OutputError, or BrokenPipeError if its
    reader has gone.

    lasting : raise neither. The stream goes silent
    """
    stdout = cast(TextIO, _Checked(sys.stdout, lasting=lasting))
    stderr = cast(TextIO, _Checked(sys.stderr, lasting=lasting))
    with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
        yield
        stdout.flush()


class _Checked:
    """A text stream that goes silent when it cannot be written, and raises an error unless it is a
    lasting one."""

    def __init__(self, stream: TextIO, *, lasting: bool):
        self._stream, self._lasting = stream, lasting

    def write(self, text: str) -> int:
        with self._errors_reported():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._errors_reported():
            self._stream.flush()

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)

    @contextlib.contextmanager
    def _errors_reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # further output goes to the null device, with what the stream still holds
            with contextlib.suppress(
                OSError, ValueError
            ):  # a stream in memory has no number, and does not fail
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)
            if self._lasting:
                return
            if isinstance(error, BrokenPipeError):
                raise
            raise OutputError(f"standard output cannot be written: {error.strerror}") from None
