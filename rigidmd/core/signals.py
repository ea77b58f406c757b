"""Signals of processes, on all systems.

Windows has neither SIGTERM for another process, which it can only kill, nor SIGUSR1. Its Ctrl-Break
stops a run as SIGTERM does elsewhere, and no signal requests a checkpoint.
"""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

from rigidmd.core.toml import Json

if sys.platform == "win32":
    #: The signal that ends a run with a checkpoint, besides Ctrl-C.
    STOP_SIGNAL = signal.SIGBREAK
    #: Signals that request a checkpoint.
    CHECKPOINT_SIGNALS: tuple[signal.Signals, ...] = ()
    #: Arguments of `subprocess.Popen` for a process that gets no Ctrl-C of this one's terminal.
    SEPARATE_GROUP: Json = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
else:
    STOP_SIGNAL = signal.SIGTERM
    CHECKPOINT_SIGNALS = (signal.SIGUSR1,)
    SEPARATE_GROUP: Json = {"start_new_session": True}
#: Number of the signal that ends a process at once, which Windows has no name for.
KILL_SIGNAL = 9


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


def stop_process(process: subprocess.Popen) -> None:
    """Let a process of `SEPARATE_GROUP` end with a checkpoint."""
    process.send_signal(signal.CTRL_BREAK_EVENT if sys.platform == "win32" else signal.SIGTERM)


def stop_this_process() -> None:
    """End this process as `stop_process` does."""
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGBREAK)  # os.kill would end it at once
    else:
        os.kill(os.getpid(), signal.SIGTERM)


def kill_group(process: subprocess.Popen) -> None:
    """End a process of `SEPARATE_GROUP` at once, with those that it has started. On Windows without
    them."""
    if sys.platform == "win32":
        process.kill()
    else:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
