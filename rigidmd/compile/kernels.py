"""Kernels: functions compiled by Numba, with the compiler options that rigidmd needs.

Private parts of Numba and llvmlite, each tested by tests/compile/test_kernels.py:

- A dispatcher uses `_cache` only when it compiles.
- A dispatcher calls `_compilation_chain_init_hook`, which loads the extensions of other packages,
  before it reads its cache, and a compilation loads them again.
- `get_call_template` compiles for the types of its arguments.
- `no_cpython_wrapper` and `no_cfunc_wrapper` are options of a function: it then has no wrapper for
  Python.
- `_nrt` is an option too: if it is False, references are not counted.
- A `Compiler` creates its library unless its state has one. A library optimises its module in
  `_optimize_final_module` and makes machine code in `_finalize_final_module`. The variables of a
  module that point to environments have names that begin with `_ZN08NumbaEnv`; Numba sets them in
  machine code.
- `front_end` removes passes from the pipeline of Numba, and remembers the calls that it resolved.
- A `CFunc` compiles for given types, accepts another cache, and calls `_compile_uncached` if the
  cache has no code.
"""

import functools
import inspect
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numba
from llvmlite import binding
from llvmlite.binding.newpassmanagers import (
    FunctionPassManager,
    create_pass_builder,
    create_pipeline_tuning_options,
)
from numba import types
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.errors import NumbaError
from numba.core.registry import CPUDispatcher
from numba.extending import overload

from rigidmd.compile.cache import open_cache
from rigidmd.compile.front_end import pipeline_of_kernels, remember_resolved_calls
from rigidmd.compile.records import Record
from rigidmd.compile.sources import register_implementation

remember_resolved_calls()

#: Error that compiling a user's function may raise.
CompileError = NumbaError


Function = TypeVar("Function", bound=Callable)


@typing.overload
def kernel(
    function: Function,
    *,
    inline: bool = False,
    count_references: bool = True,
    from_python: bool = False,
) -> Function: ...
@typing.overload
def kernel(
    *, inline: bool = False, count_references: bool = True, from_python: bool = False
) -> Callable[[Function], Function]: ...
def kernel(
    function: Callable | None = None,
    *,
    inline: bool = False,
    count_references: bool = True,
    from_python: bool = False,
) -> Callable:
    """`numba.njit`, cached on disk.

    There are no fast-math flags. With them LLVM rounds a force differently if its energy is
    computed too, so that a run would depend on its observers, and a run from the cache once
    differed in its last bits from one that compiled. Which products and sums of vectors are
    multiply-adds follows from the source, see `simd_types`.

    inline: LLVM inlines the function into every caller. For functions in an inner loop: a term is
    passed as its fields, forty arguments or more, and such a call costs more than a pair of sites.
    count_references: False for a loop that makes views of arrays but neither allocates nor returns
    arrays, and for all functions that it calls. Atomic reference counting raised a vector of pairs
    from 7 ns to 47 ns. Such a loop must read elements by index, because iteration over a view
    crashed. Its caller must not rebind, in a loop, arrays that it passes, because the new arrays
    were freed while in use.
    from_python: True if Python calls the function, which then runs without Python's lock.
    """
    if function is None:
        return lambda f: kernel(
            f, inline=inline, count_references=count_references, from_python=from_python
        )
    options = compiler_options(inline, count_references)
    options |= {
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": not from_python,
        "nogil": from_python,
    }
    compiled = numba.njit(**options | ({} if from_python else LINKED_OPTIONS))(function)
    compiled.__class__ = KernelDispatcher if from_python else InnerKernel
    del compiled._cache  # the null cache that Numba sets
    return compiled


def implements(
    stub: Callable, kinds: type | tuple[type, ...] = (), *, chooses: bool = False, **options: bool
) -> Callable[[Function], Function]:
    """`numba.extending.overload` with the options of `kernel`: an overload does not inherit those
    of its caller.

    kinds : NamedTuple classes; the function implements `stub` if its first argument is of one of
        these. Without them the function is called with the types of the arguments, and returns an
        implementation for them, or None
    chooses : for classes, that the function is called with the types too
    options : `inline` and `count_references` as for `kernel`, and others of `overload`
    """
    compiled_with = {
        name: options.pop(name) for name in ("inline", "count_references") if name in options
    }
    register = overload(
        stub, jit_options=compiler_options(**compiled_with) | LINKED_OPTIONS, **options
    )
    classes = kinds if isinstance(kinds, tuple) else (kinds,)

    def register_for_kinds(function):
        register_implementation(stub, classes, function)
        if not classes:
            return register(function)

        def choose(*given):
            if not any(is_a(given[0], one) for one in classes):
                return None
            return function(*given) if chooses else function

        choose.__signature__ = inspect.signature(function)  # pyright: ignore[reportFunctionMemberAccess]
        register(choose)
        return function

    return register_for_kinds


def chosen_by_type(choose: Callable | None = None, **options: bool) -> Callable[..., Any]:
    """A function for compiled code. The decorated function is called with the Numba types of the
    arguments, and returns the implementation for them; options as for `implements`, which can add
    implementations where it returns None."""
    if choose is None:
        return lambda f: chosen_by_type(f, **options)

    @functools.wraps(choose)
    def stub(*arguments):
        raise TypeError(f"{choose.__name__} is for compiled code only")

    implements(stub, **options)(choose)
    return stub


def compile_user_function(
    function: Callable, inline: bool = False, checks_indices: bool = False
) -> Callable:
    """A user's function for compiled code, with the options of a kernel; it is not cached on disk
    by itself.

    checks_indices : whether an index beyond an array raises IndexError
    """
    options = compiler_options(inline) | ({"boundscheck": True} if checks_indices else {})
    return numba.njit(**options)(getattr(function, "py_func", function))


def compiler_options(inline: bool = False, count_references: bool = True) -> dict:
    """Numba options of a kernel."""
    options = {"error_model": "numpy"} | ({"forceinline": True} if inline else {})
    return options if count_references else options | {"_nrt": False}


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type is a NamedTuple class or a record of it; for overloads that choose by
    type."""
    is_tuple = isinstance(numba_type, types.BaseNamedTuple | Record)
    return is_tuple and numba_type.instance_class is named_tuple


def _without_literal(kind: types.Type) -> types.Type:
    return (
        types.unliteral(kind)
        if isinstance(kind, types.IntegerLiteral | types.BooleanLiteral)
        else kind
    )


class KernelDispatcher(CPUDispatcher):
    """A dispatcher with the cache of rigidmd, which is opened at the first compilation."""

    _cache = functools.cached_property(lambda self: open_cache(self.py_func))

    def _compilation_chain_init_hook(self):
        """Load no extensions of Numba before it is known that something has to be compiled, which
        loads them."""

    def get_call_template(self, args, kws):
        """Like Numba's, but not for each value of a constant argument, for which it would compile a
        function again."""
        return super().get_call_template(
            tuple(map(_without_literal, args)), {k: _without_literal(v) for k, v in kws.items()}
        )


class LinkedLibrary(JITCodeLibrary):
    """The code of a function that only compiled code calls, without separate machine code.

    Numba optimises the code of every function and makes machine code of it, links it into its
    callers, and does both again there. Here only the outermost function is optimised, with all that
    it calls: the kernels of water compile in 41 s instead of 49 s.
    """

    def _optimize_functions(self, ll_module):
        ll_module.data_layout = self._codegen._data_layout
        builder = create_pass_builder(self._codegen._tm, create_pipeline_tuning_options())
        for function in ll_module.functions:  # only the passes of Numba that make the code smaller
            passes = FunctionPassManager()
            passes.add_sroa_pass()
            passes.add_dead_code_elimination_pass()
            passes.run(function, builder)

    def _optimize_final_module(self):
        # A module with addresses of this process cannot be stored; optimising removes unused ones.
        if any(
            one.name.startswith("numba.dynamic.globals")
            for one in self._final_module.global_variables
        ):
            super()._optimize_final_module()

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        code = self._final_module
        names = [one.name for one in code.global_variables if one.name.startswith("_ZN08NumbaEnv")]
        variables = "".join(f'@"{name}" = common global i64 0\n' for name in names)
        self._final_module = binding.parse_assembly(
            f"{self._codegen._create_empty_module(self.name)}\n{variables}"
        )
        super()._finalize_final_module()
        self._environments, self._final_module = self._final_module, code


class LinkedCompiler(Compiler):
    """Compiles functions that only compiled code calls."""

    def define_pipelines(self):
        """The passes, after creating the library."""
        self.state.library = LinkedLibrary(
            self.state.targetctx.codegen(), self.state.func_id.func_qualname
        )
        self.state.library.enable_object_caching()
        return [pipeline_of_kernels(self)]


class InnerKernel(KernelDispatcher):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would unpack
    every term.

    Calling a kernel without a wrapper from Python would crash, so `__call__` raises TypeError.
    Without wrappers, and without copies between slices of arrays, whose checks Numba also compiles,
    the kernels of systems/water.toml compiled in 40 s instead of 66 s.
    """

    def __call__(self, *arguments):
        raise TypeError(
            f"{self.py_func.__name__} is for compiled code only; for Python, use"
            " kernel(from_python=True)"
        )


#: Options of a function that only compiled code calls.
LINKED_OPTIONS = {"pipeline_class": LinkedCompiler}


def compile_callback(
    function: Callable, arguments: tuple, options: dict, stored_only: bool = False
) -> CFunc:
    """A function compiled for these types of arguments, or read from the cache; it is called by
    address.

    stored_only : raise `NotStored` if it is not in the cache
    """
    code = CFunc(function, (arguments, types.void), locals={}, options=options)
    code._cache = open_cache(function)
    if stored_only:
        code._compile_uncached = _refuse
    code.compile()
    return code


class NotStored(Exception):
    """Raised instead of compiling."""


def _refuse():
    raise NotStored
