"""The cache: its index, folders of others, damaged files, full disks."""

import json
import os
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numba
import pytest
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from support.processes import search_path

from rigidmd.compile import (
    TaskArguments,
    kernel,
)
from rigidmd.compile.cache import CacheIndex, cache_folder, compiling_announced

ROOT = Path(__file__).parents[2]  # processes import this file, and should import no more for it


# --- what Numba does not promise ------------------------------------------------------------------


@kernel(from_python=True)
def doubled(x):
    return _twice(x)


@kernel
def _twice(x):
    return x + x


def test_a_cache_takes_its_folder_from_the_configuration_when_it_is_made():
    before = numba.config.CACHE_DIR
    assert doubled(2.0) == 4.0
    assert before == numba.config.CACHE_DIR
    assert doubled._cache.cache_path.startswith(cache_folder())
    assert isinstance(doubled._cache, FunctionCache)


def test_the_index_of_a_cache_may_be_of_our_class():
    assert doubled(2.0) == 4.0
    assert issubclass(CacheIndex, IndexDataCacheFile)
    assert type(doubled._cache._cache_file) is CacheIndex
    names = os.listdir(doubled._cache.cache_path)
    assert any(
        re.fullmatch(r"test_cache\.doubled-\d+\.py\d+\.\d+\.nbc\.[0-9a-f]{16}", name)
        for name in names
    )


# --- the cache ------------------------------------------------------------------------------------


def test_the_cache_folder_is_swept_of_nothing_but_our_own(tmp_path):
    sources = "sources-0123456789abcdef.json"
    folders = [
        tmp_path / name for name in ("thesis", "kernels-0123456789abcdef", "0123456789abcdef")
    ]
    files = [tmp_path / name for name in (sources, f"my-{sources}", "sources-of-mine.json")]
    for folder in folders:
        folder.mkdir()
    for file in files:
        file.touch()
    for path in (*folders, *files):
        os.utime(path, (1e9, 1e9))
    asked = "from rigidmd.compile.cache import cache_folder; cache_folder()"
    subprocess.run(
        [sys.executable, "-c", asked], env=os.environ | {"RIGIDMD_CACHE": str(tmp_path)}, check=True
    )
    assert [folder.exists() for folder in folders] == [True, False, True]
    assert [file.exists() for file in files] == [False, True, True]


def test_a_folder_in_which_nothing_is_kept_is_named(tmp_path, monkeypatch):
    from rigidmd.compile import cache

    (tmp_path / "file").touch()
    for named, expected in (
        ("new", "kept on disk: the next run starts at once"),
        ("file/x", "RIGIDMD_CACHE names"),
    ):
        monkeypatch.setenv("RIGIDMD_CACHE", str(tmp_path / named))
        cache.cache_folders.cache_clear()
        assert expected in cache.describe_cache()
    assert f"not kept, as {tmp_path / 'file/x'} cannot be written" in cache.describe_cache()
    monkeypatch.undo()
    cache.cache_folders.cache_clear()


def test_nothing_is_made_before_the_first_kernel_is_compiled(tmp_path):
    asked = "import rigidmd.forces.terms, rigidmd.dynamics.step_loop, rigidmd.dynamics.noise"
    environment = os.environ | {"RIGIDMD_CACHE": str(tmp_path / "cache")}
    subprocess.run([sys.executable, "-c", asked], env=environment, cwd=ROOT, check=True)
    assert not (tmp_path / "cache").exists()


KERNEL = "from rigidmd.compile import kernel\n@kernel(from_python=True)\ndef twice(x):\n    return 2 * x\n"


#: Loads and calls the kernel with each of several caches; prints what it returned, how often its
#: code was read, and the warnings.
WITH_CACHES = """
import importlib, json, os, sys, warnings
from rigidmd.compile import cache
results = []
for folder in sys.argv[1:]:
    os.environ["RIGIDMD_CACHE"] = folder
    cache.cache_folders.cache_clear()
    sys.modules.pop("own", None)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        twice = importlib.import_module("own").twice
        result = f"{twice(21)} {sum(twice.stats.cache_hits.values())}"
    results.append([result, " ".join(str(one.message) for one in caught)])
print(json.dumps(results))
"""


def compiled_in(folders, tmp_path, before=""):
    """Run a kernel with the cache in each of some folders, all in one process: for each what it
    returned and how often its code was read, and its warnings."""
    if not (tmp_path / "own.py").exists():  # kernels are kept by the time of their file
        (tmp_path / "own.py").write_text(KERNEL)
    environment = os.environ | {
        "RIGIDMD_CACHE": str(folders[0]),
        "XDG_CACHE_HOME": str(tmp_path / "numba"),  # where Numba tries to write next
        **search_path(tmp_path),
    }
    command = [sys.executable, "-c", f"{before}\n{WITH_CACHES}", *map(str, folders)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return [tuple(one) for one in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A folder with a kernel, and a cache in it that has the kernel."""
    folder = tmp_path_factory.mktemp("kept")
    assert compiled_in([folder / "cache"] * 2, folder) == [("42 0", ""), ("42 1", "")]
    assert compiled_in([folder / "cache"], folder) == [("42 1", "")]
    return folder


def copies(kept, tmp_path, count):
    """Copies of a cache."""
    return [shutil.copytree(kept / "cache", tmp_path / f"cache_{k}") for k in range(count)]


def test_a_damaged_file_of_the_cache_counts_as_absent(kept, tmp_path):
    """An index or code that is empty, cut or has a bit flipped."""
    damages = [(e, d) for e in (".nbi", ".nbc") for d in ("empty", "cut", "flipped")]
    caches = copies(kept, tmp_path, len(damages))
    for cache, (ending, damage) in zip(caches, damages, strict=True):
        path = folders_of(cache, ending)[-1]
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 16
        path.write_bytes({"empty": b"", "cut": bytes(data[:40]), "flipped": bytes(data)}[damage])
    for damage, (result, warned) in zip(damages, compiled_in(caches, kept), strict=True):
        assert result == "42 0", damage
        assert warned.count("is damaged; its code is compiled again") == 1, damage
    assert compiled_in(caches, kept) == [("42 1", "")] * len(damages)


def test_a_cache_that_cannot_be_written_is_read(kept):
    before = sorted(kept.rglob("*"))
    read_only = (
        "import os, tempfile\n"
        "allow = tempfile.TemporaryFile\n"
        "def refuse(*, dir):\n"
        "    if str(dir).startswith(os.environ['RIGIDMD_CACHE']): raise OSError(30, 'Read-only file system')\n"
        "    return allow(dir=dir)\n"
        "tempfile.TemporaryFile = refuse"
    )
    assert compiled_in([kept / "cache"], kept, read_only) == [("42 1", "")]
    assert sorted(kept.rglob("*")) == before


def test_a_function_of_another_text_is_compiled_whatever_its_time_and_size(tmp_path):
    caches = [tmp_path / "cache"]
    assert compiled_in(caches, tmp_path) == [("42 0", "")]
    path = tmp_path / "own.py"
    before = path.stat()
    path.write_text(KERNEL.replace("2 * x", "3 * x"))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    shutil.rmtree(tmp_path / "__pycache__", ignore_errors=True)  # the byte code of Python is as old
    assert compiled_in(caches, tmp_path) == [("63 0", "")]


def test_code_of_a_task_is_found_by_the_classes_of_its_arguments():
    """A kernel reaches what implements functions for the potentials in its records, so that their
    definitions are part of its key."""
    from rigidmd.forces.potentials import coulomb, lennard_jones

    index = CacheIndex("/nowhere", "f", 0)

    def path_for(content):
        return index._index_for(((TaskArguments(content),), ()))._index_path

    number = types.float64
    classes = (lennard_jones.LennardJonesOneKind, coulomb.ReactionField)
    terms = [types.NamedTuple([number] * len(one._fields), one) for one in classes]
    nested = [types.Tuple([number, types.Tuple([one])]) for one in terms]
    assert len({path_for(content) for content in (number, *terms)}) == 3
    assert [path_for(content) for content in nested] == [path_for(content) for content in terms]


# --- the index of the cache, which several processes change ---------------------------------------


#: A class in a module that is called like one of the package, but whose file lies elsewhere.
STRANGE_TERM = """
import sys, types
module = types.ModuleType("rigidmd.forces.strange")
module.__file__ = "/nowhere/strange.py"
sys.modules[module.__name__] = module
exec("from typing import NamedTuple\\nclass Term(NamedTuple):\\n    x: float", vars(module))
"""
SUM = "from rigidmd.compile import kernel\n@kernel(from_python=True)\ndef double(x):\n    return x[0] + x[0]\n"


def hits_with(tmp_path, before: str, value: str) -> int:
    """How often a process reads the code of a kernel for a value from the cache."""
    (tmp_path / "sums.py").exists() or (tmp_path / "sums.py").write_text(SUM)
    script = f"{before}\nfrom sums import double; double({value}); print(sum(double.stats.cache_hits.values()))"
    environment = os.environ | {
        "RIGIDMD_CACHE": str(tmp_path / "cache"),
        **search_path(tmp_path),
    }
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
    )
    return int(done.stdout)


def test_kernels_are_found_after_a_process_with_a_module_that_others_lack(tmp_path):
    assert hits_with(tmp_path, "", "(1.0,)") == 0
    assert hits_with(tmp_path, STRANGE_TERM, "module.Term(1.0)") == 0
    assert hits_with(tmp_path, "", "(1.0,)); double((1,)") == 1  # the second one is compiled
    assert hits_with(tmp_path, "", "(1.0,)); double((1,)") == 2


def test_an_index_that_cannot_be_read_is_not_replaced(tmp_path):
    as_ours = f"{STRANGE_TERM}\nfrom rigidmd.compile import cache; cache._is_of_package = lambda module: True"
    assert hits_with(tmp_path, as_ours, "module.Term(1.0)") == 0
    assert hits_with(tmp_path, "", "(1.0,)") == 0
    assert hits_with(tmp_path, as_ours, "module.Term(1.0)") == 1


def test_an_index_loses_nothing_that_is_stored_at_the_same_time(tmp_path):
    keys = [((types.UniTuple(types.float64, n),), ()) for n in range(1, 25)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda key: CacheIndex(str(tmp_path), "f", 0).save(key, f"code {key}"), keys))
    found = [CacheIndex(str(tmp_path), "f", 0).load(key) for key in keys]
    assert found == [f"code {key}" for key in keys]


def test_compiling_is_announced_only_if_something_is_compiled(tmp_path):
    said, key = [], ((types.UniTuple(types.float64, 3),), ())
    for expected in (["compiling"], ["compiling"]):
        with compiling_announced(lambda: said.append("compiling")):
            if CacheIndex(str(tmp_path), "f", 0).load(key) is None:
                CacheIndex(str(tmp_path), "f", 0).load(((types.none,), ()))
                CacheIndex(str(tmp_path), "f", 0).save(key, "code")
        assert said == expected


# --- folders of others ----------------------------------------------------------------------------


def folders_of(cache, ending):
    """The folders from the cache to its file of the kernel, and that file."""
    (path,) = (path for path in cache.rglob(f"*twice*{ending}*") if ending in path.name)
    return [cache, path.parent.parent, path.parent, path]


def test_code_that_others_may_write_is_not_used(kept, tmp_path):
    cases = [(0, 0o020, ".nbi"), (1, 0o002, ".nbi"), (2, 0o020, ".nbi"), (3, 0o002, ".nbc")]
    caches = copies(kept, tmp_path, len(cases))
    for cache, (which, bits, ending) in zip(caches, cases, strict=True):
        path = folders_of(cache, ending)[which]
        path.chmod(path.stat().st_mode | bits)
    for case, (result, warned) in zip(cases, compiled_in(caches, kept), strict=True):
        assert result == "42 0", case
        assert warned.count("may be written by others (chmod go-w forbids that)") == 1, case


def test_code_of_another_user_is_not_used(kept, tmp_path):
    caches = copies(kept, tmp_path, 2)
    paths = [folders_of(cache, ".nbi")[k] for cache, k in zip(caches, (1, 3), strict=True)]
    before = f"""
import os, rigidmd.core.files as files
true = files.untrusted_reason
def of_another(found):
    fields = list(found)
    fields[4] += 1000 * (found.st_ino in {[path.stat().st_ino for path in paths]})
    return true(os.stat_result(fields))
files.untrusted_reason = of_another
"""
    for result, warned in compiled_in(caches, kept, before):
        assert result == "42 0" and warned.count("belongs to another user") == 1


def test_code_behind_a_link_in_the_cache_is_not_used(kept, tmp_path):
    by_user, inside = copies(kept, tmp_path, 2)
    by_user.rename(tmp_path / "other")
    by_user.symlink_to(tmp_path / "other")  # the user's choice of a folder
    kernels = folders_of(inside, ".nbi")[1]
    kernels.rename(tmp_path / "elsewhere")
    kernels.symlink_to(tmp_path / "elsewhere")
    used, (result, warned) = compiled_in([by_user, inside], kept)
    assert used == ("42 1", "")
    assert result == "42 0" and "is a link" in warned


@pytest.mark.parametrize("home", ["raise RuntimeError('no home')", "return '~/.cache/rigidmd'"])
def test_without_a_home_folder_the_cache_is_a_temporary_one(home, tmp_path):
    """Relative to the working directory it could hold code of others."""
    script = (
        f"import platformdirs\ndef path(name):\n    {home}\nplatformdirs.user_cache_path = path\n"
        "from rigidmd.compile import cache\n"
        "print(cache.describe_cache(), cache.is_persistent(), cache.cache_folder())"
    )
    environment = {name: value for name, value in os.environ.items() if name != "RIGIDMD_CACHE"}
    environment |= {"TMPDIR": str(tmp_path)}
    (tmp_path / "here").mkdir()
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        cwd=tmp_path / "here",
        capture_output=True,
        text=True,
    )
    assert (
        "not kept, as this user has no home folder: the next run compiles again" in done.stdout
    ), done.stderr
    assert f" False {tmp_path}/rigidmd-cache-" in done.stdout
    assert (
        list((tmp_path / "here").iterdir()) == [] and list(tmp_path.glob("rigidmd-cache-*")) == []
    )


@pytest.mark.parametrize(
    "function", ["IndexDataCacheFile._open_for_write", "tempfile.TemporaryFile", "tempfile.mkdtemp"]
)
def test_a_full_disk_costs_time_only(function, tmp_path):
    full = (
        "import tempfile, numba\nfrom numba.core.caching import IndexDataCacheFile\nimport rigidmd.compile\n"
        "def full(*where, **named):\n    raise OSError(28, 'No space left on device')\n"
        f"{function} = full\n"
    )
    if function == "tempfile.mkdtemp":  # neither in the cache nor elsewhere
        full += "tempfile.TemporaryFile = full\n"
    [(result, warned)] = compiled_in([tmp_path / "cache"], tmp_path, full)
    assert result == "42 0"
    assert warned.count("No space left on device") == (
        function == "IndexDataCacheFile._open_for_write"
    )
    assert "Traceback" not in warned
