"""Signals of processes."""

import os
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

from rigidmd.core.toml import Json

#: The signal that ends a run with a checkpoint, besides Ctrl-C.
STOP_SIGNAL = signal.SIGTERM
#: Arguments of `subprocess.Popen` for a process that gets no Ctrl-C of this one's terminal.
SEPARATE_GROUP: Json = {"start_new_session": True}


def has_handler(number: int) -> bool:
    """Whether this program handles a signal: in Python, or in C as `faulthandler.register` does,
    which only Linux shows."""
    if signal.getsignal(number) != signal.SIG_DFL:
        return True
    with suppress(OSError):
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("SigCgt:"):
                return bool(int(line.split()[1], 16) >> (number - 1) & 1)
    return False


def kill_group(process: subprocess.Popen) -> None:
    """End a process of `SEPARATE_GROUP` at once, with those that it has started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
