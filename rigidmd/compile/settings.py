"""Settings of Numba in the environment. Imported before Numba, which reads them when it is loaded."""

import os
import warnings

from rigidmd.errors import SettingError

NUMBAS_LIMIT = 4096


def _check_settings() -> None:
    """Raise SettingError for a setting with which Numba would stop, compile nothing, or print a traceback."""
    threads = os.environ.get("NUMBA_NUM_THREADS")
    if threads and not (threads.isascii() and threads.isdigit() and 0 < int(threads[:9]) <= NUMBAS_LIMIT):
        raise SettingError(f"NUMBA_NUM_THREADS is {threads[:40]!r}, must be a whole number from 1 to {NUMBAS_LIMIT}")
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "Environment variable 'NUMBA_", RuntimeWarning)
        try:
            import numba
        except RuntimeWarning as unread:  # it names the variable between the first two quotes
            name = str(unread).split("'")[1]
            raise SettingError(
                f"{name} is {os.environ[name][:40]!r}, which Numba cannot read: unset it, or give it a value that "
                "Numba's manual names"
            ) from None
    if numba.config.DISABLE_JIT:  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]
        raise SettingError(
            "NUMBA_DISABLE_JIT is set: Numba would compile nothing, and the kernels run only as compiled code. Unset it"
        )


_check_settings()
