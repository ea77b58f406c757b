"""Nothing in the working directory is executed or obeyed."""

import os
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numba
import pytest
from support.common import ROOT

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.core.process import python_process

#: Packages that rigidmd, or what it needs, imports.
PACKAGES = (
    "MDAnalysis ase dask distributed filelock gemmi gsd lazy_loader llvmlite matplotlib numba numpy pandas platformdirs pydantic "
    "pymbar rigidmd rocket_fft scipy tomli_w tqdm yaml"
)


@pytest.fixture(scope="module")
def hostile(tmp_path_factory):
    """A folder with a module of every name, each of which leaves a mark, and with configuration
    files of libraries."""
    folder = tmp_path_factory.mktemp("hostile")
    mark = f"open({str(folder / 'MARK')!r}, 'a').write(__name__ + ' ')\n"
    for name in sys.stdlib_module_names:
        (folder / f"{name}.py").write_text(mark)
    for name in PACKAGES.split():
        (folder / name).mkdir()
        (folder / name / "__init__.py").write_text(mark)
    for name in ("sitecustomize", "usercustomize"):
        (folder / f"{name}.py").write_text(mark)
    (folder / "matplotlibrc").write_text(
        "figure.facecolor: red\nfont.size: 40\nbackend: none_such\nlines.linewidth: x\n"
    )
    (folder / ".numba_config.yaml").write_text(
        "opt: 0\nboundscheck: 1\ndisable_jit: 1\ncpu_name: generic\n"
    )
    return folder


def command_in(folder, *words, **environment):
    """A command as the program `rigidmd` runs it, which does not put the working directory on the
    search path."""
    done = subprocess.run(
        [sys.executable, "-P", "-m", "rigidmd", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        env=os.environ | environment,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


SHORT_TOP = ["--set", "run.duration_s=0.02"]


def test_nothing_in_the_working_directory_is_executed_or_obeyed(
    hostile, tmp_path, monkeypatch, draws
):
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "systems" / "heavy_top_3.toml", hostile / "top.toml")
    shutil.copy(ROOT / "systems" / "heavy_top_3.toml", tmp_path / "top.toml")
    command_in(hostile, "run", "top.toml", "-o", "run", *SHORT_TOP)
    assert main(["run", "top.toml", "-o", "run", *SHORT_TOP]) == 0
    swept = ["--set", "run.duration_s=0.01,0.02", "--set", "output.figures=false"]
    command_in(hostile, "sweep", "top.toml", "-o", "sweep", *swept, "--jobs", "1")
    assert not (hostile / "MARK").exists(), (hostile / "MARK").read_text()
    same = [
        path.name
        for path in (tmp_path / "run").iterdir()
        if path.suffix in (".png", ".csv", ".svg")
    ]
    assert len(same) >= 3
    for name in same:
        assert (hostile / "run" / name).read_bytes() == (tmp_path / "run" / name).read_bytes(), name


LIQUID = """
seed = 5
[[molecules]]
model = "argon"
count = 60
[box]
density_g_cm3 = 1.2
[forces]
cutoff_A = 6.0
[start]
temperature_K = 90.0
[[stages]]
ensemble = "nvt"
temperature_K = 90.0
duration_ps = 1.0
[output]
log_interval_ps = 0.02
trajectory_interval_ps = 0.02
"""


def run_and_analyse(folder, command):
    """A short run of a liquid in a folder, with two analyses, by `command(*words)`."""
    (folder / "liquid.toml").write_text(LIQUID)
    command("run", "liquid.toml", "-o", "liquid")
    command("analyse", "liquid", "--only", "rdf,msd")
    return {
        path.name: path.read_bytes()
        for path in (folder / "liquid").iterdir()
        if path.suffix in (".png", ".csv", ".xtc", ".gro")
    }


def test_analyses_execute_and_obey_nothing_in_the_working_directory(hostile, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    expected = run_and_analyse(tmp_path, lambda *words: main(list(words)))
    assert {"rdf.csv", "msd.csv", "log.csv"} <= expected.keys()
    assert run_and_analyse(hostile, partial(command_in, hostile)) == expected
    assert not (hostile / "MARK").exists(), (hostile / "MARK").read_text()


@pytest.mark.soak
def test_a_liquid_is_compiled_by_nothing_in_the_working_directory(hostile, tmp_path):
    """From an empty cache, which a second process helps to fill."""
    warm = run_and_analyse(tmp_path, partial(command_in, tmp_path))
    shutil.rmtree(hostile / "liquid", ignore_errors=True)
    empty = {"RIGIDMD_CACHE": str(tmp_path / "cache"), "RIGIDMD_COMPILERS": "2"}
    cold = run_and_analyse(hostile, partial(command_in, hostile, **empty))
    assert any((tmp_path / "cache").rglob("*.nbc.*"))
    assert cold == warm
    assert not (hostile / "MARK").exists(), (hostile / "MARK").read_text()


def test_the_second_compiling_process_imports_nothing_from_the_working_directory(hostile):
    """And so the one that reads a frame, and that of a point of a sweep: all are made by
    `python_process`."""
    made = python_process(
        "-c", "import pickle, json, struct, numpy, rigidmd.compile; print(rigidmd.__file__)"
    )
    done = subprocess.run(**made, cwd=hostile, capture_output=True, text=True)
    assert Path(done.stdout.strip()) == Path(rigidmd.__file__), done.stderr
    assert not (hostile / "MARK").exists(), (hostile / "MARK").read_text()
    settings = "import rigidmd.compile, numba; print(numba.config.OPT, numba.config.DISABLE_JIT, numba.config.CPU_NAME)"
    done = subprocess.run(
        **python_process("-c", settings), cwd=hostile, capture_output=True, text=True
    )
    assert done.stdout.strip() == f"{numba.config.OPT} 0 {numba.config.CPU_NAME}", done.stderr


def test_every_process_of_python_is_started_without_the_working_directory():
    """A call with `sys.executable` elsewhere in the package has the option -P."""
    for path in (ROOT / "rigidmd").rglob("*.py"):
        for line in path.read_text().splitlines():
            if re.search(r"\[sys\.executable\b", line):
                assert '"-P"' in line, f"{path}: {line.strip()}"
