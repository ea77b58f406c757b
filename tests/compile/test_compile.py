"""The interface to Numba: what we assume of it beyond its promises, addresses and their types, the
cache, and the rules that sources keep."""

import ast
import ctypes
import json
import operator
import os
import platform
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from struct import calcsize
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.typing.templates import ConcreteTemplate
from support.processes import search_path, with_settings
from support.thread_kernels import add

from rigidmd.compile import (
    BoundTask,
    Code,
    NumbaStruct,
    TaskArguments,
    call,
    call_blocks,
    kernel,
    load_arguments,
    pack_arguments,
    task,
)
from rigidmd.compile.cache import CacheIndex, cache_folder, compiling_announced
from rigidmd.compile.front_end import UNUSED_PASSES
from rigidmd.compile.kernels import InnerKernel, KernelDispatcher, LinkedLibrary, compile_callback
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.compile.records import (
    ARRAY_FIELDS,
    array_format,
    by_reference,
    referenced_type,
    structure_of,
)

ROOT = Path(__file__).parents[2]  # processes import this file, and should import no more for it

# --- what Numba does not promise ------------------------------------------------------------------


#: A kernel that allocates, and two that call it.
LATER = """
import numpy as np
from rigidmd.compile import kernel


@kernel
def inner(x):
    return np.add(x, x)


@kernel(from_python=True)
def twice(x):
    return inner(x)


@kernel(from_python=True)
def four_times(x):
    return inner(inner(x))
"""


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
        re.fullmatch(r"test_compile\.doubled-\d+\.py\d+\.\d+\.nbc\.[0-9a-f]{16}", name)
        for name in names
    )


def test_a_dispatcher_opens_its_cache_only_to_compile():
    @kernel(from_python=True)
    def unused(x):
        return x

    assert isinstance(unused, CPUDispatcher) and type(unused) is KernelDispatcher
    assert "_cache" not in vars(unused)


@pytest.fixture
def empty_cache(tmp_path, monkeypatch):
    """Kernels that a test defines are compiled in it: Numba does not show code that comes from the
    cache."""
    monkeypatch.setattr("rigidmd.compile.cache.cache_folder", lambda: str(tmp_path))


def llvm_of(dispatcher):
    (compiled,) = dispatcher.overloads.values()
    return compiled.library.get_llvm_str()


@pytest.mark.usefixtures("empty_cache")
def test_an_inner_kernel_has_no_wrapper_and_says_so():
    @kernel
    def inner(x):
        return x + x

    @kernel(from_python=True)
    def outer(x):
        return x + x

    assert type(inner) is InnerKernel
    with pytest.raises(
        TypeError,
        match=r"inner is for compiled code only; for Python, use kernel\(from_python=True\)",
    ):
        inner(2.0)
    inner.compile((types.float64,))
    outer(2.0)
    assert "cpython" not in llvm_of(inner) and "cpython" in llvm_of(outer)


@pytest.mark.usefixtures("empty_cache")
@pytest.mark.parametrize("counted", [True, False])
def test_references_are_not_counted_where_it_is_asked_for(counted):
    @kernel(from_python=True, count_references=counted)
    def after(values, count):
        part = values
        for _ in range(count):
            part = part[1:]
        return part[0]

    assert after(np.arange(3.0), 2) == 2.0
    assert ("call void @NRT_" in llvm_of(after)) == counted


@pytest.mark.usefixtures("empty_cache")
def test_an_inner_kernel_has_no_machine_code_and_is_optimised_in_its_caller():
    @kernel
    def inner(x):
        return x + x

    @kernel(from_python=True)
    def outer(x):
        return inner(x) + 1.0

    assert outer(2.0) == 5.0
    (linked,) = inner.overloads.values()
    (whole,) = outer.overloads.values()
    assert type(linked.library) is LinkedLibrary and type(whole.library) is JITCodeLibrary
    assert linked.library.get_pointer_to_function(linked.fndesc.llvm_func_name) == 0
    assert whole.library.get_pointer_to_function(whole.fndesc.llvm_cpython_wrapper_name) != 0
    assert "alloca" not in linked.library.get_llvm_str()  # made smaller before it is linked
    assert f"call i32 @{linked.fndesc.llvm_func_name}" not in llvm_of(outer)  # inlined


def test_an_inner_kernel_is_kept_and_linked_into_other_kernels_later(tmp_path):
    (tmp_path / "own.py").write_text(LATER)
    environment = os.environ | {
        "RIGIDMD_CACHE": str(tmp_path / "cache"),
        **search_path(tmp_path),
    }
    for name, printed in (
        ("twice", "[2. 4.] 0"),
        ("four_times", "[4. 8.] 1"),
        ("four_times", "[4. 8.] 0"),
    ):
        script = f"import numpy as np, own; print(own.{name}(np.array([1.0, 2.0])), sum(own.inner.stats.cache_hits.values()))"
        done = subprocess.run(
            [sys.executable, "-c", script],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip() == printed


def test_a_callback_is_compiled_for_given_types_and_cached():
    code = compile_callback(lambda x, k: None, (types.float64, types.intp), {})
    assert code.address and type(code._cache._cache_file) is CacheIndex


# --- values in memory -----------------------------------------------------------------------------


class Mixed(NamedTuple):
    """Values of every kind that a term may have."""

    small: np.int8
    flags: tuple
    plane: np.ndarray
    nothing: None
    single: np.float32
    flag: bool
    inner: tuple
    number: float
    count: int
    turned: np.ndarray
    code: Code | None


@task()
def _tell(task_arguments, block):
    mixed, found = load_arguments(task_arguments)
    found[0], found[1], found[2] = mixed.small, mixed.flags[0], mixed.flags[1]
    found[3], found[4], found[5] = mixed.plane[1, 2], mixed.single, mixed.flag
    found[6], found[7] = mixed.inner[0], mixed.inner[1][0][1]
    found[8], found[9], found[10] = mixed.number, mixed.count, mixed.turned[2, 1]
    found[11] = mixed.plane.shape[0] + len(mixed.inner[1][0])
    mixed.plane[0, 0] = -1.0


def test_arrays_are_stored_as_assumed():
    kind, context = types.Array(types.float64, 2, "C"), cpu_target.target_context
    model = context.data_model_manager[kind]
    sizes = [
        context.get_abi_sizeof(context.get_value_type(model.get_member_fe_type(name)))
        for name in model._fields
    ]
    size = context.get_abi_sizeof(context.get_value_type(kind))
    stored = list(zip(model._fields, sizes, strict=True))
    assumed = list(zip(ARRAY_FIELDS, [8, 8, 8, 8, 8, 16, 16], strict=True))
    assert (stored, size) == (assumed, calcsize(array_format(2))), (
        f"Numba {numba.__version__} stores an array as {stored} (name, bytes), {size} bytes in all;"
        f" rigidmd/compile/records.py assumes {assumed}: change `ARRAY_FIELDS` there"
    )


def test_values_are_stored_as_in_compiled_code():
    plane, found = np.arange(6.0).reshape(2, 3), np.zeros(12)
    inner = (np.uint16(65000), (np.array([7, 8, 9], np.int32),))
    turned, code = (
        np.arange(6, dtype=np.float32).reshape(2, 3).T,
        Code(add=(add, (np.zeros(3), 0.0))),
    )
    mixed = Mixed(
        np.int8(-3),
        (True, False),
        plane,
        None,
        np.float32(0.5),
        True,
        inner,
        2.5,
        -(2**40),
        turned,
        code,
    )
    BoundTask(_tell, (mixed, found))()
    assert found.tolist() == [-3, 1, 0, 5, 0.5, 1, 65000, 8, 2.5, -(2**40), 5, 5]
    assert plane[0, 0] == -1.0
    context, struct = cpu_target.target_context, NumbaStruct(mixed)
    for memory, kind in (struct._memory, struct.kind), (*struct._records, struct.kind.content):
        expected = context.get_abi_sizeof(context.get_value_type(kind))
        assert ctypes.sizeof(memory) - 1 == expected  # a buffer of text ends with a zero


class OtherMixed(NamedTuple):
    x: object


@pytest.mark.parametrize(
    "values",
    [
        [np.zeros(3), np.zeros(3, np.float32), np.zeros((3, 1)), np.zeros(6)[::2], 0.0, None],
        [np.zeros((2, 3)), np.zeros((2, 3)).T, np.zeros((4, 3))[::2], np.zeros((2, 3), "<i4")],
        [1, 1.0, True, np.int8(1), np.int16(1), np.float32(1), np.bool_(True), 2**63, -(2**62)],
        [(1, 2), (1, 2.0), (1,), (), ((1,),), ((1, 2),), Mixed(*range(11)), OtherMixed(1)],
        [OtherMixed(np.zeros(2)), OtherMixed(np.zeros((2, 2))), OtherMixed(1), (np.zeros(2),)],
    ],
)
def test_remembered_types_are_those_of_numba(values):
    """Also of values that were seen before."""
    read_only = np.zeros(3)
    read_only.flags.writeable = False
    for value in 2 * [*values, read_only]:
        assert referenced_type(value) == by_reference(numba.typeof(value))
    assert len({*map(structure_of, values)}) >= len({*map(referenced_type, values)})


def test_what_cannot_be_stored_or_has_another_type_is_named():
    with pytest.raises(TypeError, match="unicode_type cannot be an argument of a task"):
        NumbaStruct((1.0, "text"))
    code = Code(add=(add, (np.zeros(3), 0.0)))
    assert code.to_struct((np.zeros(2), 1.0)).kind == numba.typeof((np.zeros(3), 0.0))
    with pytest.raises(
        TypingError, match=r"add was compiled for .*float64, 1d.*, not for .*float32, 1d"
    ):
        code.to_struct((np.zeros(3, np.float32), 0.0))


# --- addresses ------------------------------------------------------------------------------------


class Content(NamedTuple):
    """What a kernel is given: an array, and code for it."""

    values: np.ndarray
    code: Code


@kernel(from_python=True)
def add_once_and_in_blocks(content, blocks):
    call(content.code, "add", pack_arguments((content.values, 1.0)))
    call_blocks(content.code, "add", pack_arguments((content.values, 2.0)), blocks)


@kernel(from_python=True)
def call_what_is_not_there(content):
    call(content.code, "subtract", pack_arguments((content.values, 1.0)))


def content_of(values):
    return Content(values, Code(add=(add, (np.zeros(3), 0.0))))


def test_a_task_is_called_by_its_address():
    content = content_of(np.zeros(5))
    add_once_and_in_blocks(content, 5)
    assert content.values.tolist() == [3, 2, 2, 2, 2]


@pytest.mark.parametrize(
    "strange", [np.zeros((4, 4)).T[1], np.zeros(4, np.float32), np.zeros((2, 2))]
)
def test_an_address_is_not_called_with_what_it_was_not_compiled_for(strange):
    with pytest.raises(TypingError, match="add was compiled for task_arguments"):
        add_once_and_in_blocks(content_of(strange), 2)


def test_a_task_that_is_not_there_is_named():
    with pytest.raises(TypingError, match="unknown task subtract; the tasks are add"):
        call_what_is_not_there(content_of(np.zeros(2)))


def test_every_block_is_worked_on_once_whichever_thread_takes_it():
    content = content_of(np.zeros(3000))
    for _ in range(20):
        add_once_and_in_blocks(content, 3000)
    assert content.values[0] == 60 and (content.values[1:] == 40).all()


# --- a second process -----------------------------------------------------------------------------

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


def test_compiling_goes_on_alone_where_the_second_process_ends(tmp_path):
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


MACHINE = (
    "from rigidmd.compile import cache, machine; print(machine.SIMD_BITS, cache.compiler_digest())"
)


def machine_with(**settings):
    """Bits of vectors, and the name of the cache, where the environment has these settings."""
    command = [sys.executable, "-c", MACHINE]
    done = subprocess.run(command, env=with_settings(**settings), capture_output=True, text=True)
    return done.stdout.split()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the processors are those of x86")
@pytest.mark.parametrize(
    ("name", "bits"),
    [("generic", "128"), ("nehalem", "128"), ("haswell", "256"), ("skylake-avx512", "512")],
)
def test_vectors_are_as_wide_as_those_of_the_processor_that_is_named(name, bits):
    assert machine_with(NUMBA_CPU_NAME=name, NUMBA_CPU_FEATURES="")[0] == bits


def test_settings_that_change_code_have_a_cache_of_their_own():
    usual = machine_with()
    assert machine_with(NUMBA_OPT="3", NUMBA_NUM_THREADS="1", NUMBA_DEBUG_CACHE="0") == usual
    changed = [
        machine_with(**{name: value})
        for name, value in (
            ("NUMBA_OPT", "0"),
            ("NUMBA_BOUNDSCHECK", "1"),
            ("NUMBA_SLP_VECTORIZE", "1"),
        )
    ]
    assert len({digest for _, digest in [usual, *changed]}) == 4


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


def test_a_kernel_is_compiled_once_for_all_constant_arguments():
    @kernel
    def plus(x, n):
        return x + n

    @kernel(from_python=True)
    def several(x):
        return plus(x, 1) + plus(x, 2) + plus(x, 3)

    assert several(1.0) == 9.0
    assert len(plus.signatures) == 1


@pytest.mark.usefixtures("empty_cache")
def test_a_call_is_resolved_once_for_each_list_of_types(monkeypatch):
    resolved = []
    apply = ConcreteTemplate.apply
    monkeypatch.setattr(
        ConcreteTemplate,
        "apply",
        lambda self, args, kws: resolved.append((self.key, *args)) or apply(self, args, kws),
    )
    quotients = []
    for _ in range(2):

        @kernel(from_python=True)
        def quotient(x, y):
            return x // y

        quotients.append(quotient(7.0, 2.0))
    assert quotients == [3.0, 3.0]
    assert resolved.count((operator.floordiv, types.float64, types.float64)) <= 1


@pytest.mark.usefixtures("empty_cache")
def test_an_inner_kernel_is_compiled_without_passes_for_what_no_kernel_has():
    @kernel
    def inner(x):
        return x + x

    inner.compile((types.float64,))
    (compiled,) = inner.overloads.values()
    done = set(compiled.metadata["pipeline_times"]["kernels"])
    assert any(name.endswith("native_lowering") for name in done)
    assert not any(name.endswith(one.name()) for name in done for one in UNUSED_PASSES)


# --- rules that sources keep ----------------------------------------------------------------------


def test_code_for_llvm_does_not_rely_on_typed_pointers():
    """llvmlite removes them: loads and address computations name their type."""
    needed, found = {"load": "typ", "load_atomic": "typ", "gep": "source_etype"}, []
    for path in (ROOT / "rigidmd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
                continue
            name, of_builder = node.func.attr, ast.unparse(node.func.value) in ("builder", "b")
            lacks = of_builder and needed.get(name) not in (
                None,
                *(key.arg for key in node.keywords),
            )
            if name == "as_pointer" or lacks:
                found.append(f"{path.name}:{node.lineno}: {ast.unparse(node)}")
    assert found == []


def compiled_functions():
    """(name, tree, the options) of all compiled functions."""
    for path in (ROOT / "rigidmd").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            for mark in node.decorator_list if isinstance(node, ast.FunctionDef) else ():
                call = mark if isinstance(mark, ast.Call) else ast.Call(mark, [], [])
                kind = getattr(call.func, "id", "")
                if kind in ("kernel", "task", "implements", "chosen_by_type"):
                    keys = {key.arg: ast.unparse(key.value) for key in call.keywords}
                    name = (
                        ast.unparse(call.args[0]).rpartition(".")[2]
                        if kind == "implements"
                        else node.name
                    )
                    yield name, node, keys


def test_loops_without_counted_references_take_elements_by_their_index():
    """Iterating over a view of an array, uncounted, ended in a crash; over ranges and tuples it is
    safe."""
    uncounted = [
        (name, tree)
        for name, tree, keys in compiled_functions()
        if keys.get("count_references") == "False"
    ]
    assert {"block_forces", "set_local", "update_list"} <= {name for name, _ in uncounted}
    strange = []
    for name, tree in uncounted:
        for node in ast.walk(tree):
            over = node.iter if isinstance(node, ast.For) else None
            if isinstance(over, ast.Call) and ast.unparse(over.func) == "enumerate":
                over = over.args[0]
            if over is not None and not isinstance(over, ast.Tuple):
                safe = isinstance(over, ast.Call) and ast.unparse(over.func) in (
                    "range",
                    "literal_unroll",
                )
                strange += [] if safe else [f"{name}: for ... in {ast.unparse(over)}"]
    assert strange == []
