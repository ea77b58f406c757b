"""`python -m rigidmd.core.bound_process MODULE ARGUMENTS`: run a module as a program that ends with
its parent process.

The parent holds the other end of the standard input. When it has died, in any way, that input ends,
and this process gets SIGTERM: a run then stops with a checkpoint.
"""

import os
import runpy
import signal
import sys
import threading


def main() -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    sys.argv[:] = sys.argv[1:]
    runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)


def _end_with_parent() -> None:
    while os.read(0, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)


if __name__ == "__main__":
    main()
