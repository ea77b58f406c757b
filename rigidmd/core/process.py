"""What belongs to the whole process: runs in several threads change it one at a time."""

import contextlib
import threading
import warnings
from collections.abc import Iterator

#: Held while settings of the process are changed for a moment, and while a run compiles, which changes some too. Who
#: holds it may wait for the locks of Numba and of `compile`; who holds one of those must not wait for it.
ONE_AT_A_TIME = threading.RLock()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Within it no warning is shown. Python has one list of filters for all threads."""
    with ONE_AT_A_TIME, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
