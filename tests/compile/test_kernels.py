"""Kernels: what Numba does not promise, inner kernels, addresses and their types."""

import operator
import os
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
from numba import types
from numba.core.codegen import JITCodeLibrary
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher
from numba.core.typing.templates import ConcreteTemplate
from support.processes import search_path
from support.thread_kernels import add

from rigidmd.compile import (
    Code,
    call_blocks,
    kernel,
    pack_arguments,
)
from rigidmd.compile.cache import CacheIndex
from rigidmd.compile.front_end import UNUSED_PASSES
from rigidmd.compile.kernels import InnerKernel, KernelDispatcher, LinkedLibrary, compile_callback

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
def test_an_inner_kernel_has_no_wrapper_and_states_it():
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
def test_references_are_not_counted_where_it_is_requested(counted):
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


# --- addresses ------------------------------------------------------------------------------------


class Content(NamedTuple):
    """What a kernel is given: an array, and code for it."""

    values: np.ndarray
    code: Code


@kernel(from_python=True)
def add_once_and_in_blocks(content, blocks):
    call_blocks(content.code, "add", pack_arguments((content.values, 1.0)), 1)
    call_blocks(content.code, "add", pack_arguments((content.values, 2.0)), blocks)


@kernel(from_python=True)
def call_what_is_not_there(content):
    call_blocks(content.code, "subtract", pack_arguments((content.values, 1.0)), 1)


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


# --- folders of others ----------------------------------------------------------------------------


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
