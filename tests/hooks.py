"""What a session of these tests adds to pytest: the order of files, limits of time, and in CI the
skips that are allowed.

`CI=true` in the environment makes a skipped test that is not in `ALLOWED` a failure of the session.
`RIGIDMD_CI_WITHOUT` names what could not be installed, separated by spaces (`chromium gromacs
ffmpeg`): .ci/run sets both.
"""

import os
import re
from pathlib import Path

import pytest

#: Files that take longest with cold kernels, the longest first: a file is run by one worker, so
#: they begin first. By CPU seconds of a cold run on two cores: 223 of forces, 232 of docs, 200 of
#: run, 196 of ewald, 25 of notebook. The first two have no kernels in common, which both workers
#: would compile.
LONGEST = (
    "forces",
    "body_engine",
    "ewald",
    "docs",
    "run",
    "dynamics",
    "resume",
    "user_code",
    "compile",
    "view",
    "minimise",
    "sweep",
    "ase",
    "simd",
    "python",
    "bodies",
    "threads",
    "fuzz",
    "trajectory_structures",
    "engine_settings",
    "notebook",
)
RANKS = {f"test_{name}.py": rank for rank, name in enumerate(LONGEST)}

#: Reasons to skip that are properties of a machine, which CI cannot install.
MACHINE = (
    "root may write everywhere",  # the folder without permissions: CI runs as root in a container
    "no small file system can be made here",  # a full disk: mounting needs CAP_SYS_ADMIN
    "where there is one core",
    "this machine has one core",
    "one core",
    "an instruction of AVX-512",
    "vectors are not wider than the stack",
    "this is what all tests run with here",  # vectors of 128 bits
    "the processors are those of x86",
)
#: Reasons to skip that are allowed where the program could not be installed.
PROGRAMS = {
    "chromium": "Chromium is not installed",
    "gromacs": "(GROMACS is not installed|no gmx here)",
    "ffmpeg": "ffmpeg is not installed",
    "reference": "no outside reference data at",
}

IN_CI = os.environ.get("CI", "").lower() in ("1", "true", "yes")
ALLOWED = [re.escape(reason) for reason in MACHINE]
ALLOWED += [
    r"no .*/spce_monoclinic_sample_periodic4\.txt"
]  # a file of NIST that the shared folder does not have
ALLOWED += [
    "could not import 'tblite.ase'"
]  # a semi-empirical method, which no extra of the project installs
ALLOWED += [
    PROGRAMS[name] for name in os.environ.get("RIGIDMD_CI_WITHOUT", "").split() if name in PROGRAMS
]

_skipped: list[str] = []


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files come first; a test of the soak tier has no limit of time."""
    items.sort(key=lambda item: RANKS.get(item.path.name, len(RANKS)))
    for item in items:
        if item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.timeout(0))


def _note(report: pytest.TestReport | pytest.CollectReport) -> None:
    if not report.skipped or hasattr(report, "wasxfail") or not isinstance(report.longrepr, tuple):
        return
    path, _, reason = report.longrepr
    if not any(re.match(allowed, reason.removeprefix("Skipped: ")) for allowed in ALLOWED):
        _skipped.append(f"{report.nodeid or Path(path).name}: {reason}")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that was skipped for a reason that is not allowed."""
    _note(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Note a file that was skipped for a reason that is not allowed."""
    _note(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a session with such skips has failed."""
    if IN_CI and _skipped and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter) -> None:
    """In CI list them."""
    if IN_CI and _skipped:
        terminalreporter.section("skipped tests that CI does not allow (tests/hooks.py)", red=True)
        for line in sorted(set(_skipped)):
            terminalreporter.line(line)
