"""Kernels: functions compiled by Numba, with the compiler options that rigidmd needs."""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import numba
from numba import types
from numba.core.errors import NumbaError
from numba.extending import overload

from rigidmd.compile.numba_private import LINKED_OPTIONS, dispatcher, reference_counting

#: Error that compiling a user's function may raise.
CompileError = NumbaError


def kernel(
    function: Callable | None = None, *, inline: bool = False, count_references: bool = True, from_python: bool = False
) -> Any:
    """`numba.njit`, cached on disk.

    There are no fast-math flags. With them LLVM rounds a force differently if its energy is computed too, so that a run
    would depend on its observers, and a run from the cache once differed in its last bits from one that compiled.
    Which products and sums of vectors are multiply-adds follows from the source, see `simd_types`.

    inline: LLVM inlines the function into every caller. For functions in an inner loop: a term is passed as its fields,
    forty arguments or more, and such a call costs more than a pair of sites.
    count_references: False for a loop that makes views of arrays but neither allocates nor returns arrays, and for all
    functions that it calls. Atomic reference counting raised a vector of pairs from 7 ns to 47 ns. Such a loop must
    read elements by index, because iteration over a view crashed. Its caller must not rebind, in a loop, arrays that it
    passes, because the new arrays were freed while in use.
    from_python: True if Python calls the function, which then runs without Python's lock.
    """
    if function is None:
        return lambda f: kernel(f, inline=inline, count_references=count_references, from_python=from_python)
    return dispatcher(function, compiler_options(inline) | reference_counting(count_references), from_python)


def implements(
    stub: Callable, kinds: type | tuple[type, ...] = (), *, inline: bool = False, count_references: bool = True
) -> Any:
    """`numba.extending.overload` with the options of `kernel`: an overload does not inherit those of its caller.

    kinds : NamedTuple classes; the function implements `stub` if its first argument is of one of these. Without them
        the function is called with the types of the arguments, and returns an implementation for them, or None
    """
    options = compiler_options(inline) | reference_counting(count_references) | LINKED_OPTIONS
    register = overload(stub, jit_options=options)
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


def chosen_by_type(choose: Callable | None = None, *, inline: bool = False, count_references: bool = True) -> Any:
    """A function for compiled code. The decorated function is called with the Numba types of the arguments, and returns
    the implementation for them; options as for `kernel`. `implements` can add implementations where it returns None."""
    if choose is None:
        return lambda f: chosen_by_type(f, inline=inline, count_references=count_references)

    @functools.wraps(choose)
    def stub(*arguments):
        raise TypeError(f"{choose.__name__} is for compiled code only")

    implements(stub, inline=inline, count_references=count_references)(choose)
    return stub


def compile_user_function(function: Callable, inline: bool = False) -> Callable:
    """A user's function for compiled code, with the options of a kernel; it is not cached on disk by itself."""
    return numba.njit(**compiler_options(inline))(getattr(function, "py_func", function))


def compiler_options(inline: bool) -> dict:
    """Numba options that every kernel has."""
    return {"error_model": "numpy"} | ({"forceinline": True} if inline else {})


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type belongs to the given NamedTuple class; for overloads that choose by type."""
    return isinstance(numba_type, types.BaseNamedTuple) and numba_type.instance_class is named_tuple
