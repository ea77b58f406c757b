"""Code of users in files: trust, cache, examples."""

import runpy

import numba
import pytest
from support.common import ROOT
from support.potentials import POINTS, SCRIPTS, Pair, Spring, points

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.compile.cache import CacheIndex
from rigidmd.compile.kernels import CompileError
from rigidmd.core import user_modules
from rigidmd.errors import SceneError
from rigidmd.features.potentials.user_code.compiled import describe_compile_error

# --- code in files --------------------------------------------------------------------------------


MINE = """
from typing import NamedTuple
import rigidmd

class Trap(NamedTuple):
    stiffness: float
    absolute_positions = True

@rigidmd.compiled_force(Trap)
def add(term, state, load, tally):
    for m in range(len(state.position)):
        for k in range(3):
            load.force[m, k] -= term.stiffness * state.position[m, k]
            if tally is not None:
                tally[0] += 0.5 * term.stiffness * state.position[m, k] ** 2

def trap(stiffness_kJ_mol_A2):
    return Trap(100 * stiffness_kJ_mol_A2)

ready = Trap(1.0)
"""


def test_a_file_of_code_runs_only_where_it_is_trusted(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(f"{MINE}\n# {tmp_path}")  # not trusted by an earlier test
    custom = {"module": "mine.py", "name": "trap", "parameters": {"stiffness_kJ_mol_A2": 1.0}}
    import tomli_w

    (tmp_path / "s.toml").write_text(tomli_w.dumps(POINTS | {"forces": {"custom": [custom]}}))
    assert main(["check", "s.toml"]) == 2
    assert "mine.py is Python code, which can do whatever you can" in capsys.readouterr().err
    assert main(["check", "s.toml", "--trust", "nosuch.py"]) == 2
    assert main(["run", "s.toml", "--trust", "mine.py"]) == 0
    capsys.readouterr()
    spring = rigidmd.Simulation(points(), forces=[Spring()]).run()
    assert main(["energy", "s.toml", "--json"]) == 0  # this process trusts it by now
    import json

    assert json.loads(capsys.readouterr().out)["components"]["trap"] == pytest.approx(
        spring["spring"][0], rel=1e-12
    )
    # the file and its digest go with the run, which repeats
    (copy,) = (tmp_path / "runs" / "s").glob("input_*mine.py")
    assert copy.read_bytes() == (tmp_path / "mine.py").read_bytes()
    assert main(["run", "runs/s/scene.toml", "-o", "again", "--trust", str(copy)]) == 0
    assert main(["compare", "runs/s", "again"]) == 0
    # a changed file is another one
    (tmp_path / "mine.py").write_text(MINE.replace("0.5", "0.25"))
    assert main(["check", "s.toml"]) == 2
    assert main(["run", "s.toml", "-o", "third", "--trust", "mine.py"]) == 2
    assert "is not the derivative of the energy" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, entry, word",
    [
        (
            "import nosuchmodule",
            {"name": "x"},
            "ModuleNotFoundError: No module named 'nosuchmodule'",
        ),
        ("def f(:", {"name": "x"}, "line 1 raised SyntaxError"),
        (MINE, {"name": "tarp"}, "has no tarp; did you mean .*trap"),
        (MINE, {"name": "trap"}, r"trap\(...\) raised TypeError"),
        (MINE, {"name": "ready", "parameters": {"k": 1.0}}, "parameters would have no effect"),
        ("x = 3", {"name": "x"}, "3 is not a force"),
    ],
)
def test_a_file_that_is_useless_is_reported(text, entry, word, tmp_path):
    (tmp_path / "mine.py").write_text(text)
    rigidmd.trust_file(tmp_path / "mine.py")
    scene = rigidmd.Scene.from_dict(
        POINTS | {"forces": {"custom": [{"module": "mine.py", **entry}]}}, tmp_path
    )
    with pytest.raises(SceneError, match=word):
        build(scene)


def test_code_for_classes_of_users_has_an_index_of_its_own():
    index = CacheIndex("/nowhere", "f", 0)
    source = b"from typing import NamedTuple\nclass Term(NamedTuple):\n    x: float\n"
    kept = user_modules.module_of(source, "<test>").Term
    assert user_modules.module_of(source, "<test>").Term is kept  # one class for one text
    assert user_modules.module_of(source + b"\n", "<test>").Term is not kept

    def key(value):
        return ((numba.typeof((value, 1.0)),), ())

    common = index._index_for(key(1.0))._index_path
    assert index._index_for(key(2.0))._index_path == common
    assert index._index_for(key(Pair(1.0, 2.0))) is None  # of a module that may change: not kept
    of_file = user_modules.module_of(source, "<test>", user_modules.USER_FILE_PREFIX).Term
    assert index._index_for(key(of_file(1.0))) is None  # it may hold what it has read
    apart = index._index_for(key(kept(1.0)))
    assert apart._index_path not in (common, None)


# --- thermostats ----------------------------------------------------------------------------------


def test_errors_of_numba_have_no_colours():
    error = CompileError("Failed in nopython mode\n\x1b[1m\x1b[31mNameError: no ramp\x1b[0m")
    assert describe_compile_error(error) == ": NameError: no ramp"


# --- examples -------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_every_example_of_an_extension_runs_and_is_short(path, monkeypatch):
    from rigidmd.features.analysis import registry

    monkeypatch.setattr(registry, "KNOWN", dict(registry.KNOWN))
    assert len(path.read_text().splitlines()) <= 50
    assert path.read_text().startswith("# ")
    runpy.run_path(str(path), run_name="__main__")


def test_scripts_are_listed_and_copied(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["examples"]) == 0
    listed = capsys.readouterr().out
    assert all(f"  {path.stem} " in listed for path in SCRIPTS)
    assert main(["new", "mie"]) == 0
    assert "python mie.py" in capsys.readouterr().out
    assert (tmp_path / "mie.py").read_bytes() == (
        ROOT / "systems" / "scripts" / "mie.py"
    ).read_bytes()
    assert main(["new", "mie", "-o", "mine.toml", "--force"]) == 2
    assert "must end in .py" in capsys.readouterr().err
