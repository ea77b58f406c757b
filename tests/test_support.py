"""The door of the tests: what goes past tests/support.py, and what support.py lists."""

import ast
import re
from collections import Counter

import pytest
import support
from support import ROOT

TESTS = ROOT / "tests"
PUBLIC = {
    "rigidmd",
    "rigidmd.ase",
    "rigidmd.commands.cli",
    "rigidmd.errors",
    "rigidmd.run",
    "rigidmd.scene",
    "rigidmd.units",
}
OPEN = "the assumptions about Numba and the rules of compiled code are what it tests"
DIRECT = "a test imports what it tests from its module"
#: Past the door: file -> the inner packages that it imports itself, why.
PAST = {
    "support.py": (["rigidmd"], "is the door"),
    "test_compile.py": (["rigidmd.compile", "rigidmd.forces.terms"], OPEN),
    "test_program.py": (
        [
            "rigidmd.compile",
            "rigidmd.dynamics.step_loop",
            "rigidmd.engines.cpu.program",
            "rigidmd.forces.neighbors",
        ],
        OPEN,
    ),
    "test_sources.py": (["rigidmd.compile.sources", "rigidmd.forces"], OPEN),
    "test_simd.py": (["rigidmd.compile"], OPEN),
    "test_threads.py": (["rigidmd.compile"], OPEN),
    "test_checks.py": (["rigidmd.compile"], "a script of a user who compiles a function"),
    "test_fields.py": (
        ["rigidmd.compile", "rigidmd.core.state", "rigidmd.forces.terms"],
        "a new field as a file of the package",
    ),
    "test_forces.py": (
        ["rigidmd.compile", "rigidmd.forces"],
        "a new pair potential as a file of the package",
    ),
    "test_run.py": (
        ["rigidmd.commands.arguments", "rigidmd.compile.cache"],
        "a command in a file of its own, and a compiler that is called",
    ),
    "test_strangers.py": (
        ["rigidmd.core.process", "rigidmd.compile", "rigidmd.scene.models"],
        "scripts in little memory, and processes in a hostile folder, which load nothing else",
    ),
    "test_engine_settings.py": (["rigidmd.engines.openmm.system"], DIRECT),
    "test_minimise.py": (
        ["rigidmd.engines.cpu.engine", "rigidmd.run.molecular", "rigidmd.run.minimise"],
        DIRECT,
    ),
    "test_mixtures.py": (["rigidmd.engines.external"], DIRECT),
    "test_notebook.py": (["rigidmd.run.loop"], DIRECT),
    "test_plausibility.py": (["rigidmd.assemble.plausibility", "rigidmd.scene.models"], DIRECT),
    "test_schema_walk.py": (["rigidmd.scene.base"], DIRECT),
}
FILES = sorted(TESTS.rglob("*.py"))


def inner_imports(source):
    """(line, module) of all imports of inner modules in Python text, and in the text of scripts
    inside of it."""
    for node in ast.walk(ast.parse(source)):
        found = []
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            found = [name if is_module(name) else node.module for name in names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            script = re.findall(r"(?:^|[\n;] *)(?:from|import) (rigidmd[\w.]*)", node.value)
            found = [name for name in script if is_module(name)]
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") in (
            "setattr",
            "delattr",
        ):
            asked = node.args[0]
            if isinstance(asked, ast.Constant) and str(asked.value).startswith("rigidmd."):
                found = [str(asked.value).rpartition(".")[0]]
        yield from (
            (node.lineno, name)
            for name in found
            if name.split(".")[0] == "rigidmd" and name not in PUBLIC
        )


def is_module(name):
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").is_file()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(TESTS).as_posix())
def test_tests_take_inner_names_from_support(path):
    """A module that moves then changes a line of support.py. What is to go past it is listed in
    PAST with its reason."""
    allowed, _ = PAST.get(path.name, ([], None))
    strange = sorted(
        f"{path.relative_to(ROOT)}:{line}: {module}"
        for line, module in inner_imports(path.read_text())
        if not any(module == package or module.startswith(f"{package}.") for package in allowed)
    )
    assert not strange, "\n".join(["import from support, and list the names there:", *strange])


def test_every_reason_is_still_needed():
    for name in PAST:
        assert list(inner_imports((TESTS / name).read_text())), (
            f"{name} imports nothing from inside: strike it from PAST"
        )


def names_wanted():
    """How often each name is imported from support, in code and in scripts that are text."""
    wanted = Counter()
    for path in FILES:
        text = path.read_text()
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ImportFrom) and node.module == "support":
                wanted.update(alias.name for alias in node.names)
            elif (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and "from support import" in node.value
            ):
                for names in re.findall(r"from support import ([\w, ]+)", node.value):
                    wanted.update(names.split(", "))
    return wanted


def test_names_of_support_are_there_once_and_wanted():
    listed = [name for names in support.HOMES.values() for name in names.split()]
    listed += [*support.RENAMED, *support.MODULES]
    assert sorted(name for name, count in Counter(listed).items() if count > 1) == []
    assert sorted(set(listed) & set(vars(support))) == []  # they would hide the inner ones
    for name in listed:
        assert getattr(support, name) is not None, name
    wanted = names_wanted()
    assert sorted(name for name in listed if not wanted[name]) == [], (
        "no test imports them: strike them out"
    )
    with pytest.raises(AttributeError, match=r"support\.py has no 'nothing'"):
        _ = support.nothing
