"""Signals to a run. Python handles them in its main thread only; in others these do nothing."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def handled(handler: Callable[[int], None], *numbers: int) -> Iterator[None]:
    """Within it these signals call a function with their number."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda number, frame: handler(number)) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within it Ctrl-C is not lost in a compiler, which may swallow it or end in an error of its own.

    Raises KeyboardInterrupt at the end if Ctrl-C came and nothing raised it.
    """
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:  # a program has its own way
        yield
        return
    pressed = False

    def interrupt(number: int) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    try:
        with handled(interrupt, signal.SIGINT):
            yield
    except Exception:
        if pressed:
            raise KeyboardInterrupt from None
        raise
    if pressed:
        raise KeyboardInterrupt
