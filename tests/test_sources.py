"""What the keys of compiled code depend on: the definitions that a kernel reaches, and nothing
else."""

import os
import re
import shutil
import subprocess
import sys

import pytest
from support import ROOT

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
def test_texts_layout_and_methods_are_no_part_of_a_definition(old, new):
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


def test_an_edited_docstring_compiles_nothing_and_an_edited_number_does(tmp_path):
    ignored = shutil.ignore_patterns("docs", "__pycache__", "models")
    shutil.copytree(ROOT / "rigidmd", tmp_path / "rigidmd", ignore=ignored)
    path = tmp_path / "rigidmd" / "forces" / "neighbors" / "sites.py"
    environment = os.environ | {
        "RIGIDMD_CACHE": str(tmp_path / "cache"),
        "PYTHONPATH": str(tmp_path),
        "PYTHONDONTWRITEBYTECODE": "1",  # Python itself finds that by time and size
    }

    def asked() -> str:
        command = [sys.executable, "-c", ASKED]
        done = subprocess.run(
            command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return done.stdout.strip()

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
    before = path.stat()  # which a copy or an image may give to another text
    path.write_text(re.sub("SERIAL_MOLECULES = [0-9]+", "SERIAL_MOLECULES = 60", edited))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    assert asked() == "16 0"
    path.write_text(text)
    assert asked() == "1 1"
