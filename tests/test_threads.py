"""How threads wait: what is set when nobody says, and that who says is heard."""

import os
import subprocess
import sys

import pytest
from conftest import ROOT

NAMES = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")


def left_set(tmp_path, **said):
    """What a new process has set of `NAMES` once it has imported the door to Numba."""
    plain = {key: value for key, value in os.environ.items() if key not in NAMES}
    code = f"import os, rigidmd.compile; print([os.environ.get(name) for name in {NAMES}])"
    environment = plain | said | {"RIGIDMD_CACHE": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_threads_that_wait_look_for_a_moment_before_they_sleep(tmp_path):
    assert left_set(tmp_path) == "['PASSIVE', '1000']"


@pytest.mark.parametrize(
    ("said", "kept"),
    [
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "['ACTIVE', None]"),
        ({"OMP_WAIT_POLICY": "PASSIVE"}, "['PASSIVE', None]"),
        ({"GOMP_SPINCOUNT": "7"}, "[None, '7']"),
    ],
)
def test_what_a_user_says_of_waiting_is_kept(tmp_path, said, kept):
    assert left_set(tmp_path, **said) == kept


def test_benchmarks_measure_what_a_user_gets(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests" / "benchmarks")
    from peer_engines import environment

    for name in (*NAMES, "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"):
        monkeypatch.setenv(name, "2")
        assert name not in environment()
    assert environment()["PATH"] == os.environ["PATH"]


@pytest.mark.parametrize(("layer", "word"), [("omp", "OpenMP"), ("workqueue", "Numba's own threads")])
def test_check_says_how_many_threads_there_are_and_what_starts_them(layer, word):
    code = (
        "from rigidmd.assemble.describe import describe; from rigidmd.scene import Scene; "
        "print(describe(Scene.read('systems/water.toml')))"
    )
    environment = os.environ | {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2"}
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert f"computing: 2 threads ({word}), double precision" in done.stdout, done.stderr
