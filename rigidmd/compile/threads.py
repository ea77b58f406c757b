"""The setting of threads. Imported before Numba, which reads it when it is loaded."""

import os

from rigidmd.errors import SettingError

NUMBAS_LIMIT = 4096


def _check(settings: "os._Environ[str]") -> None:
    """Raise SettingError for a number on which Numba stops with an error of its own."""
    threads = settings.get("NUMBA_NUM_THREADS")
    if threads and not (threads.isascii() and threads.isdigit() and 0 < int(threads[:9]) <= NUMBAS_LIMIT):
        raise SettingError(f"NUMBA_NUM_THREADS is {threads[:40]!r}, must be a whole number from 1 to {NUMBAS_LIMIT}")


_check(os.environ)
