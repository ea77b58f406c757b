"""The driver of mixed errors, `python tests/support/faults.py`: a little of it on every change, an hour in
the soak tier."""

import re
import subprocess
import sys

import pytest
from support.common import ROOT

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the driver forks, and reads /proc")


def drive(*arguments: str) -> int:
    """Number of cases that the driver executed without a failure."""
    command = [sys.executable, str(ROOT / "tests" / "faults.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return int(re.search(r"^(\d+) cases .* 0 failures$", done.stdout, re.MULTILINE)[1])


def test_runs_survive_mixed_faults():
    """The first cases of a fixed series."""
    assert drive("--first", "1", "--cases", "4") == 4


@pytest.mark.soak
@pytest.mark.parametrize("series", [[], ["--wide"]], ids=["narrow", "wide"])
def test_runs_survive_mixed_faults_for_an_hour(series):
    """Another series each time; the message of a failure has the line that replays it."""
    assert drive("--minutes", "60", *series) > 100
