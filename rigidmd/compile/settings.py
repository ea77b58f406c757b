"""Checks of settings of the process and of Numba. Imported before Numba, which reads them when it
is loaded."""

import os
import warnings

from rigidmd.core.process import check_address_space, without_local_settings
from rigidmd.errors import SettingError

NUMBA_THREAD_LIMIT = 4096

# With these settings libraries would hang, compile nothing, or print a traceback.
check_address_space()
threads = os.environ.get("NUMBA_NUM_THREADS")
if threads and not (
    threads.isascii() and threads.isdigit() and 0 < int(threads[:9]) <= NUMBA_THREAD_LIMIT
):
    raise SettingError(
        f"NUMBA_NUM_THREADS is {threads[:40]!r}, must be a whole number from 1 to"
        f" {NUMBA_THREAD_LIMIT}"
    )
with warnings.catch_warnings(), without_local_settings():
    warnings.filterwarnings("error", "Environment variable 'NUMBA_", RuntimeWarning)
    try:
        import numba
    except RuntimeWarning as warning:  # names the variable between its first two quotes
        name = str(warning).split("'")[1]
        raise SettingError(
            f"{name} is {os.environ[name][:40]!r}, which Numba cannot read: unset it, or give it a"
            " value that Numba's manual names"
        ) from None
# Numba looks for its file again whenever it compiles.
numba.core.config._config_fname = (  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]
    ""
)
if numba.config.DISABLE_JIT:  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]
    raise SettingError(
        "NUMBA_DISABLE_JIT is set: Numba would compile nothing, and the kernels run only as"
        " compiled code. Unset it"
    )
