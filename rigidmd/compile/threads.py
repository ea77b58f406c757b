"""How OpenMP threads wait for work. Imported before Numba, because OpenMP reads these settings when it is loaded."""

import os

# Threads that wait look 1000 times, for 50 to 100 µs, before they sleep. A thread that spins for long holds the core
# that another program needs: beside one, 500 argon atoms fell from 4,700 to 130 steps/s, and to 1,700 where threads
# sleep at once. Where threads wake slowly, sleeping at once makes a second thread worthless: 4096 SPC/E (mixed, 2 fs)
# did 340 to 385 steps/s on two cores so, 335 on one, 590 to 611 with 1000 looks. Where they wake fast it costs little:
# two threads made 1.55 times the steps of one, 1.6 times asleep at once; on a machine that gave both of them together
# 1.1 cores, 0.86 and 1.02. The count is for GCC's OpenMP, where it stands above the policy; the policy is for others.
# Both are read when OpenMP is loaded. What a user has set is left alone.
if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
    os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="1000")
