"""What compiles functions of users."""

from collections.abc import Callable

import numba
from numba.core.errors import NumbaError

from rigidmd.compile.kernels import options_of

#: What compiling a user's code may raise.
CompileError = NumbaError


def foreign(function: Callable, inline: bool = False) -> Callable:
    """A user's function for compiled code, with the options that a kernel has; it is not kept on disk by itself."""
    return numba.njit(**options_of(inline))(getattr(function, "py_func", function))
