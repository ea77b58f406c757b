"""Kernels: compiled functions, with the compiler options that this engine needs."""

import inspect
from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.core.errors import NumbaError
from numba.extending import overload

from rigidmd.compile.numba_private import LINKED_OPTIONS, dispatcher, reference_counting


def kernel(function: Callable | None = None, *, inline=False, counted=True, outer=False) -> Any:
    """`numba.njit`, cached on disk.

    There are no fast-math flags. With them LLVM rounds a force otherwise where its energy is computed beside it, and a
    run would depend on who looks at it; a run from the cache once differed in its last bits from one that compiled.
    Products and sums of vectors are multiply-adds by what the source says, see `lane_types`.

    inline: LLVM inlines the function wherever it is called. For functions in an inner loop: a term is passed as its
    fields, forty arguments or more, and such a call costs more than a pair of sites.
    counted: False for a loop that makes views of arrays but neither allocates nor returns arrays, and for all that it
    calls: references are then not counted. Atomic reference counting raised a vector of pairs from 7 ns to 47 ns. Such
    a loop must read elements by index: iteration over a view crashed. Its caller must not rebind, in a loop, arrays
    that it passes: the new arrays were freed while in use.
    outer: True if Python calls the function, which then runs without Python's lock.
    """
    if function is None:
        return lambda f: kernel(f, inline=inline, counted=counted, outer=outer)
    return dispatcher(function, compiler_options(inline) | reference_counting(counted), outer)


def implements(stub: Callable, kinds: type | tuple[type, ...] = (), *, inline=False, counted=True) -> Any:
    """`numba.extending.overload` with the options of `kernel`: an overload does not inherit those of its caller.

    kinds : NamedTuple classes; the function is then what `stub` does if its first argument is of one of these. Without
        them the function is called with the types of the arguments, and returns what `stub` does for them, or None
    """
    register = overload(stub, jit_options=compiler_options(inline) | reference_counting(counted) | LINKED_OPTIONS)
    if not kinds:
        return register
    classes = kinds if isinstance(kinds, tuple) else (kinds,)

    def register_for_kinds(function):
        def choose(*given):
            return function if any(is_a(given[0], one) for one in classes) else None

        choose.__signature__ = inspect.signature(function)  # pyright: ignore[reportFunctionMemberAccess]
        register(choose)
        return function

    return register_for_kinds


def compiler_options(inline: bool) -> dict:
    """Options that every kernel has."""
    return {"error_model": "numpy"} | ({"forceinline": True} if inline else {})


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type is that of the given NamedTuple class; overloads use this to choose."""
    return isinstance(numba_type, types.BaseNamedTuple) and numba_type.instance_class is named_tuple


#: What compiling a user's code may raise.
CompileError = NumbaError


def compile_user_function(function: Callable, inline: bool = False) -> Callable:
    """A user's function for compiled code, with the options that a kernel has; it is not kept on disk by itself."""
    return numba.njit(**compiler_options(inline))(getattr(function, "py_func", function))
