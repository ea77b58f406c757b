"""Signals to a run. Python handles them in its main thread only; in other threads these functions do nothing."""

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def signal_handler(handler: Callable[[int], None], *numbers: int) -> Iterator[None]:
    """Context in which these signals call a function with their number."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda number, frame: handler(number)) for number in numbers}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def stop_signals() -> list[int]:
    """The signals that end runs: Ctrl-C, and SIGTERM unless the program has its own handler."""
    return [signal.SIGINT, *([signal.SIGTERM] if signal.getsignal(signal.SIGTERM) == signal.SIG_DFL else [])]


#: Seconds until a Ctrl-C is repeated that came where Python ignores exceptions.
RETRY_DELAY = 0.05


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Context in which Ctrl-C is not lost in a compiler, which ignores it while LLVM calls Python, or raises another
    error. Raises KeyboardInterrupt, at the latest at its end."""
    has_handler = signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    if has_handler or threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed, again, ignored = False, [], sys.unraisablehook

    def interrupt(number: int) -> None:
        nonlocal pressed
        pressed = True
        raise KeyboardInterrupt

    def try_again(unraisable: "sys.UnraisableHookArgs") -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            ignored(unraisable)
            return
        again.append(threading.Timer(RETRY_DELAY, _thread.interrupt_main))
        again[-1].start()

    sys.unraisablehook = try_again
    try:
        with signal_handler(interrupt, signal.SIGINT):
            try:
                yield
            finally:
                for timer in again:
                    timer.cancel()
    except Exception:  # a compiler that was interrupted ends in errors of many types
        if pressed:
            raise KeyboardInterrupt from None
        raise
    finally:
        sys.unraisablehook = ignored
    if pressed:
        raise KeyboardInterrupt
