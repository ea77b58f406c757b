"""How threads wait for one another. Imported before Numba, because OpenMP reads it when it is loaded."""

import os

# Threads that spin while they wait stand in each other's way as soon as anything else wants a core: with a second
# program running, 500 argon atoms fell from 4,700 to 130 steps/s, and to 1,700 when waiting threads sleep. Alone,
# sleeping costs 8 % there and 3 % on 216 waters. Read by the OpenMP library when it is loaded; set it to override.
if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
    os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="1000")
