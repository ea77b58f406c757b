"""What the keys of compiled code depend on: the definitions that a kernel reaches, and nothing
else."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from support.common import ROOT

from rigidmd.compile.sources import closure_digest, implementations, node_of, read_source

TEXT = '''
"""A module."""
from math import pi
from rigidmd.units import COULOMB

LIMIT = 3  # of something


class Term(NamedTuple):
    """A term."""

    size: float  # in Å
    halved = False

    def workspace(self):
        """Not compiled."""
        return LIMIT


def area(term):
    """The area."""
    return pi * term.size**2 * COULOMB
'''


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"""The area."""', '"""Another text,\n    of two lines."""'),
        ('    """The area."""\n', ""),
        ("# of something", "# of something else"),
        ("LIMIT = 3", "\n\nLIMIT    =    3"),
        ("return LIMIT", "return 2 * LIMIT"),
    ],
)
def test_texts_layout_and_methods_are_not_a_part_of_a_definition(old, new):
    assert TEXT.count(old) == 1
    assert read_source(TEXT.replace(old, new)) == read_source(TEXT)


@pytest.mark.parametrize(
    ("old", "new", "name"),
    [
        ("**2", "**3", "area"),
        ("LIMIT = 3", "LIMIT = 4", "LIMIT"),
        ("halved = False", "halved = True", "Term"),
        ("size: float", "size: int", "Term"),
    ],
)
def test_a_changed_definition_has_another_digest(old, new, name):
    before, after = read_source(TEXT).definitions, read_source(TEXT.replace(old, new)).definitions
    assert [key for key in before if before[key] != after[key]] == [name]
    assert before.keys() == after.keys()


def test_names_and_imports_of_a_definition():
    source = read_source(TEXT)
    assert set(source.definitions["area"].names) == {"pi", "COULOMB", "term.size"}
    assert source.imports["COULOMB"] == ["rigidmd.units", "COULOMB"]


def test_a_kernel_reaches_its_implementations_for_the_classes_of_its_arguments():
    from rigidmd.compile import sources
    from rigidmd.forces.neighbors import pair_loop
    from rigidmd.forces.potentials import coulomb, lennard_jones

    loop = node_of(pair_loop._sum_forces.function)
    argon, charges = node_of(lennard_jones.LennardJonesOneKind), node_of(coulomb.ReactionField)
    implemented = {
        one.kind: one.function for one in implementations if one.of == node_of(pair_loop.pair)
    }
    assert {argon, charges} <= implemented.keys()
    assert implemented[argon] not in sources._reached([loop])
    reached = sources._reached([loop, argon])
    assert implemented[argon] in reached
    assert implemented[charges] not in reached
    assert ("rigidmd.forces.neighbors.lists", "end_of_row") in reached
    assert len({closure_digest(roots) for roots in ([loop], [loop, argon], [loop, charges])}) == 3


ASKED = """
from rigidmd.forces.neighbors.sites import blocks_of
print(blocks_of(100), sum(blocks_of.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path):
    """A module of a copy of the package, and a function that runs it: it returns the number of
    blocks, and how often its code was read."""
    ignored = shutil.ignore_patterns("docs", "__pycache__", "models")
    shutil.copytree(ROOT / "rigidmd", tmp_path / "rigidmd", ignore=ignored)
    environment = os.environ | {
        "RIGIDMD_CACHE": str(tmp_path / "cache"),
        "PYTHONPATH": str(tmp_path),
        "PYTHONDONTWRITEBYTECODE": "1",  # Python itself finds that by time and size
    }

    def asked(**more) -> str:
        command, environ = [sys.executable, "-c", ASKED], environment | more
        done = subprocess.run(command, env=environ, cwd=tmp_path, capture_output=True, text=True)
        return done.stdout.strip() or done.stderr.splitlines()[-1]

    return tmp_path / "rigidmd" / "forces" / "neighbors" / "sites.py", asked


def edited_unseen(path, old, new):
    """Change a text, but not the time or the size of its file, as a copy or an image may."""
    before, text = path.stat(), path.read_text()
    assert text.count(old) == 1 and len(old) == len(new)
    path.write_text(text.replace(old, new))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def test_an_edited_docstring_compiles_nothing_and_an_edited_number_does(package):
    path, asked = package
    text = path.read_text()
    assert [asked(), asked()] == ["1 0", "1 1"]
    edited = text.replace('"""Number of blocks', '"""\n    The number of blocks').replace(
        "# Up to", "# For up to"
    )
    assert edited != text
    path.write_text(f"# A line above.\n{edited}")
    assert asked() == "1 1"
    other = path.parent / "rows.py"
    other.write_text(f"{other.read_text()}\nUNRELATED = 1\n")
    assert asked() == "1 1"
    path.write_text(re.sub("SERIAL_MOLECULES = [0-9]+", "SERIAL_MOLECULES = 50", edited))
    assert asked() == "16 0"
    edited_unseen(path, "SERIAL_MOLECULES = 50", "SERIAL_MOLECULES = 60")
    assert asked() == "16 0"
    path.write_text(text)
    assert asked() == "1 1"


def test_byte_code_of_an_earlier_text_is_refused(package):
    """Python would run it, and its machine code would be stored for the present text."""
    path, asked = package
    assert asked(PYTHONDONTWRITEBYTECODE="") == "1 0"
    edited_unseen(path, "SERIAL_MOLECULES = 128", "SERIAL_MOLECULES = 127")
    assert "is byte code of an earlier sites.py" in asked()
    shutil.rmtree(path.parent / "__pycache__")
    assert asked() == "1 0"
