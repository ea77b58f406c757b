"""How OpenMP threads wait for work. Imported before Numba, because OpenMP reads these settings when it is loaded."""

import os

# A thread that waits for work polls 1000 times, for 50 to 100 µs, and then sleeps. A thread that polls for longer keeps
# a core busy that another program may need; a thread that sleeps at once must be woken for every parallel loop, and
# where that is slow, a second thread gains little. Both depend on the machine. To measure them, compare the steps/s of
#     GOMP_SPINCOUNT=0 rigidmd run systems/water.toml --threads 2 --set molecules.0.count=1728
# with those for 1000 and `infinity`, on an idle machine and beside another busy program.
# GCC's OpenMP reads the count, which overrides the policy; other implementations read the policy. Settings of the user
# are not changed.
if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
    os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="1000")
