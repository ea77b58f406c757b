"""What we use of Numba that it does not promise to keep. tests/test_compile.py has a test of each assumption.

- `FunctionCache` takes its folder from `numba.config.CACHE_DIR` when it is made, and keeps its index in an
  `IndexDataCacheFile`, whose class may be changed.
- A dispatcher reads its cache from `_cache`, and only to compile.
- `no_cpython_wrapper` and `no_cfunc_wrapper` are options of a function: it then has no wrapper for Python.
- `_nrt` is an option too: without it references are not counted.
- A `CFunc` compiles for given types and takes a cache of ours.
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
    """What is compiled, by the types of the arguments. One with types of a module that is not there counts as absent.

    A term of somebody's own would otherwise leave an index that nobody else can read. Files of machine code have names
    of their own: Numba numbers them, and two processes that compile at once, for different types, would write under one
    number what the index then gives to either; seen, it ended in a crash of every later run.
    """

    def _data_name(self, number):
        return f"{super()._data_name(number)}.{secrets.token_hex(8)}"

    def _load_index(self):
        try:
            return super()._load_index()
        except (ImportError, AttributeError):
            return {}


class Kernel(CPUDispatcher):
    """A dispatcher with a cache of ours, which it opens when it first compiles."""

    @property
    def _cache(self):
        found = self.__dict__.get("_opened")
        if found is None:
            found = self.__dict__["_opened"] = _opened_cache(self.py_func)
        return found

    @_cache.setter
    def _cache(self, none) -> None:
        """Numba sets one that does nothing when it makes a dispatcher."""


class Inner(Kernel):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would take every term apart.

    To call one that has none ends in a crash. Without wrappers, and without copies between slices of arrays, whose
    checks Numba compiles too, all that systems/water.toml needs compiled in 40 s instead of 66.
    """

    def __call__(self, *arguments):
        raise TypeError(f"{self.py_func.__name__} is for compiled code; for Python it has to be a kernel(outer=True)")


def _opened_cache(function: Callable) -> FunctionCache:
    with _own_folder():
        found = FunctionCache(function)
    found._cache_file.__class__ = Index
    return found


@contextlib.contextmanager
def _own_folder() -> Iterator[None]:
    """Other users of Numba keep their own cache folder."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def dispatcher(function: Callable, options: dict, outer: bool) -> CPUDispatcher:
    """A function to be compiled with these options of Numba when it is first called, from our cache if it is there.

    outer : whether Python calls it, which takes a wrapper
    """
    options = options | {"no_cfunc_wrapper": True, "no_cpython_wrapper": not outer}
    compiled = numba.njit(**options)(function)
    compiled.__class__ = Kernel if outer else Inner
    return compiled


def callback(function: Callable, arguments: tuple, options: dict) -> CFunc:
    """A function compiled for these types of arguments, for its address; from our cache if it is there."""
    code = CFunc(function, (arguments, types.void), locals={}, options=options)
    code._cache = _opened_cache(function)
    code.compile()
    return code


def uncounted(counted: bool) -> dict:
    """Options of a function in which references to arrays are not counted, or of one in which they are."""
    return {} if counted else {"_nrt": False}
