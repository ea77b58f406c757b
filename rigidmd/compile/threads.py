"""Settings of threads. Imported before Numba, because Numba and OpenMP read them when they are loaded."""

import os

from rigidmd.errors import SettingError

MOST_THREADS = 4096
LAYERS = ("default", "safe", "threadsafe", "forksafe", "tbb", "omp", "workqueue")


def _check(settings: "os._Environ[str]") -> None:
    """Raise SettingError for settings on which Numba stops with an error of its own, or hangs."""
    threads, layer = settings.get("NUMBA_NUM_THREADS"), settings.get("NUMBA_THREADING_LAYER")
    if threads and not (threads.isascii() and threads.isdigit() and 0 < int(threads[:9]) <= MOST_THREADS):
        raise SettingError(f"NUMBA_NUM_THREADS is {threads[:40]!r}, must be a whole number from 1 to {MOST_THREADS}")
    if layer and layer not in LAYERS:
        raise SettingError(f"NUMBA_THREADING_LAYER is {layer[:40]!r}, must be one of {', '.join(LAYERS)}")


_check(os.environ)

# A thread that waits for work polls 1000 times, for 50 to 100 µs, and then sleeps. A thread that polls for longer keeps
# a core busy that another program may need; a thread that sleeps at once must be woken for every parallel loop, and
# where that is slow, a second thread gains little. Both depend on the machine. To measure them, compare the steps/s of
#     GOMP_SPINCOUNT=0 rigidmd run systems/water.toml --threads 2 --set molecules.0.count=1728
# with those for 1000 and `infinity`, on an idle machine and beside another busy program.
# GCC's OpenMP reads the count, which overrides the policy; other implementations read the policy. Settings of the user
# are not changed.
if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
    os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="1000")
