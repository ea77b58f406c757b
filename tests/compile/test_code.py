"""Codes of tasks: a second process that compiles."""

import os
import subprocess
import sys

import pytest
from support.common import ROOT
from support.processes import search_path

from rigidmd.compile.machine import MOST_THREADS

#: Compiles `add` for several types while another process does so too, from the other end; prints
#: what was read from the cache.
BOTH = """
import numba, numpy as np, time
from rigidmd.compile import TaskArguments, code
from support.thread_kernels import add
contents = [(np.zeros(3, kind), x) for kind in (float, "f4") for x in (0.0, 0)]
wanted = [(*add.name, TaskArguments(numba.typeof(content))) for content in contents]
with code.second_process(wanted):
    deadline = time.monotonic() + WAIT
    while time.monotonic() < deadline and not add.is_ready(wanted[-2][2]):
        time.sleep(0.05)
    for _, _, kind in wanted:
        add.address(kind)
print([add.compiled[kind]._cache_hits for _, _, kind in wanted][-2:])
"""


def with_compilers(count: str, asked: str, tmp_path) -> subprocess.CompletedProcess:
    environment = os.environ | {
        "RIGIDMD_CACHE": str(tmp_path / "cache"),
        "RIGIDMD_COMPILERS": count,
        **search_path(ROOT / "tests"),
    }
    return subprocess.run(
        [sys.executable, "-c", asked], env=environment, capture_output=True, text=True
    )


two_cores = pytest.mark.skipif(
    MOST_THREADS < 2, reason="where there is one core, one process compiles"
)


@two_cores
def test_a_second_process_compiles_the_last_tasks_first(tmp_path):
    done = with_compilers("2", BOTH.replace("WAIT", "900"), tmp_path)
    assert done.stdout.split("\n")[0] == "[1, 1]", done.stderr


def test_compiling_continues_alone_where_the_second_process_ends(tmp_path):
    lost = BOTH.replace("with code", "code.SECOND_PROGRAM = 'raise SystemExit'\nwith code").replace(
        "WAIT", "3"
    )
    done = with_compilers("2", lost, tmp_path)
    assert done.stdout.split("\n")[0] == "[0, 0]", done.stderr


#: As an engine does it: how often its codes are made, and whether each that is made last can be
#: called.
TOGETHER = """
import numpy as np
from rigidmd.compile import Code, compile_together
from support.thread_kernels import add
contents = [(np.zeros(3, kind), x) for kind in (float, "f4") for x in (0.0, 0)]
made = []
make = lambda: made.append([Code(add=(add, content)) for content in contents])
compile_together(make)
print([[code.address("add") != 0 for code in codes] for codes in made])
compile_together(make)
print(len(made), Code(add=(add, contents[0])).address("add") == made[1][0].address("add"))
"""


@two_cores
def test_codes_are_planned_and_then_compiled_together(tmp_path):
    """First without addresses; then with them; once more only planned, since nothing is left to
    compile."""
    done = with_compilers("2", TOGETHER, tmp_path)
    assert done.stdout.splitlines() == [f"[{[False] * 4}, {[True] * 4}]", "3 True"], done.stderr


def test_one_compiler_plans_nothing(tmp_path):
    before = TOGETHER.partition("compile_together(make)")[0]
    done = with_compilers("1", f"{before}compile_together(make)\nprint(made)", tmp_path)
    assert done.stdout.splitlines() == ["[]"], done.stderr


@pytest.mark.parametrize("named", ["0", "three", ""])
def test_a_wrong_number_of_compilers_is_one_sentence(named, tmp_path):
    asked = "from rigidmd.compile import compile_together\ncompile_together(list)"
    done = with_compilers(named, asked, tmp_path)
    assert f"RIGIDMD_COMPILERS is {named!r}, must be 1 or 2" in done.stderr
