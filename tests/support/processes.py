"""Processes that tests start. They test the package that the tests themselves import (conftest.py),
and none outlives its test."""

import os
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

#: Seconds that a test of the soak tier, which has no limit of time, waits for a process. On a busy
#: machine a process can take 20 times as long as alone.
WAIT = 900.0


def search_path(*folders: Path) -> dict[str, str]:
    """The variable by which a process finds the package under test, then modules in some
    folders."""
    return {"PYTHONPATH": os.pathsep.join([os.environ["PYTHONPATH"], *map(str, folders)])}


def with_settings(**settings: str) -> dict[str, str]:
    """The environment with these settings of the compiler alone, whatever it had before."""
    ours = ("NUMBA_", "RIGIDMD_SIMD_BITS")
    return {key: value for key, value in os.environ.items() if not key.startswith(ours)} | settings


@contextmanager
def process(command: list[str], **options) -> Iterator[subprocess.Popen]:
    """A process that ends at the latest with the block."""
    with subprocess.Popen(command, **options) as started:
        try:
            yield started
        finally:
            started.kill()  # no error after its end


def wait_until(condition: Callable[[], bool], started: subprocess.Popen) -> None:
    """Wait until something is true that a process makes so before it ends."""
    while not condition():
        assert started.poll() is None, started.stderr and started.stderr.read()
        time.sleep(0.005)
