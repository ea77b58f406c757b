"""The private parts of Numba that this package relies on. tests/test_compile.py tests each assumption.

- `FunctionCache` reads its folder from `numba.config.CACHE_DIR` when it is created, and keeps its index in an
  `IndexDataCacheFile`, whose class may be changed.
- A dispatcher uses `_cache` only when it compiles.
- `get_call_template` compiles for the types of arguments that it is given.
- `no_cpython_wrapper` and `no_cfunc_wrapper` are options of a function: it then has no wrapper for Python.
- `_nrt` is an option too: if it is False, references are not counted.
- A `CFunc` compiles for given types and accepts a cache that we set.
"""

import contextlib
import secrets
from collections.abc import Callable, Iterator

import numba
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.registry import CPUDispatcher

from rigidmd.compile.cache import cache_folder


class Index(IndexDataCacheFile):
    """Index of a cache: compiled functions by the types of their arguments.

    An index with a type from a module that cannot be imported, for example a user's own term, counts as empty, so that
    other programs can still use the cache. The files of machine code have random names: Numba numbers them, and two
    processes that compiled at the same time for different types wrote to the same file, after which every run crashed.
    """

    def _data_name(self, number):
        return f"{super()._data_name(number)}.{secrets.token_hex(8)}"

    def _load_index(self):
        try:
            return super()._load_index()
        except (ImportError, AttributeError):
            return {}


def _of_any_value(kind: types.Type) -> types.Type:
    return types.unliteral(kind) if isinstance(kind, types.IntegerLiteral | types.BooleanLiteral) else kind


class Kernel(CPUDispatcher):
    """A dispatcher with our own cache, which is opened at the first compilation."""

    @property
    def _cache(self):
        found = self.__dict__.get("_opened")
        if found is None:
            found = self.__dict__["_opened"] = _opened_cache(self.py_func)
        return found

    @_cache.setter
    def _cache(self, none) -> None:
        """Ignored: Numba sets a null cache when it creates a dispatcher."""

    def get_call_template(self, args, kws):
        """As Numba's, for numbers of any value: it would compile a function again for each constant argument."""
        return super().get_call_template(tuple(map(_of_any_value, args)), {k: _of_any_value(v) for k, v in kws.items()})


class Inner(Kernel):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would unpack every term.

    Calling a kernel without a wrapper from Python would crash, so `__call__` raises TypeError. Without wrappers, and
    without copies between slices of arrays, whose checks Numba also compiles, the kernels of systems/water.toml
    compiled in 40 s instead of 66 s.
    """

    def __call__(self, *arguments):
        raise TypeError(f"{self.py_func.__name__} is for compiled code only; for Python, use kernel(outer=True)")


def _opened_cache(function: Callable) -> FunctionCache:
    with _own_folder():
        found = FunctionCache(function)
    found._cache_file.__class__ = Index
    return found


@contextlib.contextmanager
def _own_folder() -> Iterator[None]:
    """Set our cache folder for the moment, so that other users of Numba keep theirs."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def dispatcher(function: Callable, options: dict, outer: bool) -> CPUDispatcher:
    """A function that is compiled with these options of Numba, or read from our cache, when it is first called.

    outer : whether Python calls it, for which it needs a wrapper
    """
    options = options | {"no_cfunc_wrapper": True, "no_cpython_wrapper": not outer}
    compiled = numba.njit(**options)(function)
    compiled.__class__ = Kernel if outer else Inner
    return compiled


def callback(function: Callable, arguments: tuple, options: dict) -> CFunc:
    """A function compiled for these types of arguments, or read from our cache; it is called by address."""
    code = CFunc(function, (arguments, types.void), locals={}, options=options)
    code._cache = _opened_cache(function)
    code.compile()
    return code


def uncounted(counted: bool) -> dict:
    """Options of a function in which references to arrays are counted, or are not."""
    return {} if counted else {"_nrt": False}
