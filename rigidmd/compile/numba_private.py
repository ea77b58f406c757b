"""The private parts of Numba on which rigidmd relies. tests/test_compile.py tests each assumption.

- `FunctionCache` reads its folder from `numba.config.CACHE_DIR` when it is created, and its index is an
  `IndexDataCacheFile`, whose class may be changed. The methods of `CacheIndex` load and save its index and data.
- A dispatcher uses `_cache` only when it compiles.
- `get_call_template` compiles for the types of its arguments.
- `no_cpython_wrapper` and `no_cfunc_wrapper` are options of a function: it then has no wrapper for Python.
- `_nrt` is an option too: if it is False, references are not counted.
- A `Compiler` creates its library unless its state has one. A library optimises its module in `_optimize_final_module`
  and makes machine code in `_finalize_final_module`. The variables of a module that point to environments have names
  that begin with `_ZN08NumbaEnv`; Numba sets them in machine code.
- A `CFunc` compiles for given types, accepts another cache, and calls `_compile_uncached` if the cache has no code.
"""

import contextlib
import copy
import functools
import hashlib
import pickle
import secrets
import threading
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
from llvmlite import binding
from llvmlite.binding.newpassmanagers import FunctionPassManager, create_pass_builder, create_pipeline_tuning_options
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.registry import CPUDispatcher

from rigidmd.compile.cache import cache_folder, shared_folder
from rigidmd.core.user_modules import GENERATED_PREFIX
from rigidmd.errors import RigidMDWarning


class CacheIndex(IndexDataCacheFile):
    """Index of a cache: compiled functions by the types of their arguments.

    Code for types from outside the package has a separate index, because an index cannot be read if one of its types
    cannot be imported. Such code is stored only if the name of the module follows from its source
    (`core.user_modules`). Changes of other modules are not noticed, so that old code would run.
    The files of machine code have random names. Numba numbers them, and two processes that compiled at the same time
    for different types wrote to the same file, after which every run crashed. Every file begins with a checksum; a
    damaged file is ignored, and its code is compiled again. A folder for all users is also read, see
    `cache.shared_folder`.
    """

    def load(self, key):
        """A compiled function; None if it is not stored."""
        index = self._index_for(key)
        return None if index is None else index._load(key)

    def save(self, key, data):
        """Store a compiled function."""
        index = self._index_for(key)
        if index is not None:
            super(CacheIndex, index).save(key, data)

    def _index_for(self, key) -> "CacheIndex | None":
        """The index for the types of a key; None if their code is not stored."""
        modules = sorted(set(_outside_modules(getattr(key[0], "args", key[0]))))
        if not modules:
            return self
        if not all(name.startswith(GENERATED_PREFIX) for name in modules):
            return None
        index = copy.copy(self)
        digest = hashlib.sha256(" ".join(modules).encode()).hexdigest()[:16]
        index._index_path = f"{self._index_path}.{digest}"
        return index

    def _load(self, key):
        found = super().load(key)
        shared = shared_folder()
        if found is None and shared is not None:
            index = copy.copy(self)
            index._cache_path = self._cache_path.replace(cache_folder(), shared, 1)
            index._index_path = self._index_path.replace(cache_folder(), shared, 1)
            found = super(CacheIndex, index).load(key)
        return found

    def _data_name(self, number):
        return f"{super()._data_name(number)}.{secrets.token_hex(8)}"

    def _load_index(self):
        try:
            version, stamp, overloads = self._read(self._index_path)
        except (OSError, ImportError, AttributeError):
            return {}
        return overloads if (version, stamp) == (self._version, self._source_stamp) else {}

    def _save_index(self, overloads):
        self._write(self._index_path, (self._version, self._source_stamp, overloads))

    def _load_data(self, name):
        return self._read(self._data_path(name))

    def _save_data(self, name, data):
        self._write(self._data_path(name), data)

    def _write(self, path: str, value) -> None:
        content = self._dump(value)
        with self._open_for_write(path) as file:
            file.write(hashlib.sha256(content).digest() + content)

    def _read(self, path: str):
        data = Path(path).read_bytes()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[size:]).digest() != data[:size]:
            message = f"{path} is damaged; its code is compiled again"
            warn_once(message)
            raise OSError(message)
        return pickle.loads(data[size:])


def _outside_modules(kind) -> Iterator[str]:
    """Modules outside the package that define named tuples in a Numba type."""
    if isinstance(kind, tuple):
        inner = kind
    elif isinstance(kind, types.BaseTuple):
        inner = kind.types
        module = getattr(getattr(kind, "instance_class", tuple), "__module__", "builtins")
        if module.split(".")[0] not in ("rigidmd", "builtins"):
            yield module
    else:  # types of `compile.code`: `CodeType`, `TaskArguments`
        inner = (*getattr(kind, "task_types", ()), *([kind.content] if hasattr(kind, "content") else ()))
    for part in inner:
        yield from _outside_modules(part)


@functools.cache
def warn_once(message: str) -> None:
    """Issue a warning the first time."""
    warnings.warn(message, RigidMDWarning, stacklevel=2)


def _without_literal(kind: types.Type) -> types.Type:
    return types.unliteral(kind) if isinstance(kind, types.IntegerLiteral | types.BooleanLiteral) else kind


class KernelDispatcher(CPUDispatcher):
    """A dispatcher with the cache of rigidmd, which is opened at the first compilation."""

    @property
    def _cache(self):
        found = self.__dict__.get("_opened")
        if found is None:
            found = self.__dict__["_opened"] = _open_cache(self.py_func)
        return found

    @_cache.setter
    def _cache(self, none) -> None:
        """Ignored: Numba sets a null cache when it creates a dispatcher."""

    def get_call_template(self, args, kws):
        """Like Numba's, but not for each value of a constant argument, for which it would compile a function again."""
        return super().get_call_template(
            tuple(map(_without_literal, args)), {k: _without_literal(v) for k, v in kws.items()}
        )


class LinkedLibrary(JITCodeLibrary):
    """The code of a function that only compiled code calls, without separate machine code.

    Numba optimises the code of every function and makes machine code of it, links it into its callers, and does both
    again there. Here only the outermost function is optimised, with all that it calls: the kernels of water compile
    in 41 s instead of 49 s.
    """

    def _optimize_functions(self, ll_module):
        if not hasattr(FunctionPassManager, "add_sroa_pass"):  # llvmlite before 0.45
            super()._optimize_functions(ll_module)
            return
        ll_module.data_layout = self._codegen._data_layout
        builder = create_pass_builder(self._codegen._tm, create_pipeline_tuning_options())
        for function in ll_module.functions:  # only the passes of Numba that make the code smaller
            passes = FunctionPassManager()
            passes.add_sroa_pass()
            passes.add_dead_code_elimination_pass()
            passes.run(function, builder)

    def _optimize_final_module(self):
        if _has_addresses(self._final_module):
            super()._optimize_final_module()

    def _finalize_final_module(self):
        self._finalize_dynamic_globals()
        code = self._final_module
        names = [one.name for one in code.global_variables if one.name.startswith("_ZN08NumbaEnv")]
        variables = "".join(f'@"{name}" = common global i64 0\n' for name in names)
        self._final_module = binding.parse_assembly(f"{self._codegen._create_empty_module(self.name)}\n{variables}")
        super()._finalize_final_module()
        self._environments, self._final_module = self._final_module, code


def _has_addresses(module) -> bool:
    """Whether a module has addresses of this process, so that it cannot be stored. Optimising removes unused ones."""
    return any(one.name.startswith("numba.dynamic.globals") for one in module.global_variables)


class LinkedCompiler(Compiler):
    """Compiles functions that only compiled code calls."""

    def define_pipelines(self):
        """The passes, after creating the library."""
        self.state.library = LinkedLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        return super().define_pipelines()


class InnerKernel(KernelDispatcher):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would unpack every term.

    Calling a kernel without a wrapper from Python would crash, so `__call__` raises TypeError. Without wrappers, and
    without copies between slices of arrays, whose checks Numba also compiles, the kernels of systems/water.toml
    compiled in 40 s instead of 66 s.
    """

    def __call__(self, *arguments):
        raise TypeError(f"{self.py_func.__name__} is for compiled code only; for Python, use kernel(from_python=True)")


#: Options of a function that only compiled code calls.
LINKED_OPTIONS = {"pipeline_class": LinkedCompiler}

#: Held while a setting of Numba is changed. A thread that holds it must not wait for another lock: Numba may hold one.
_config_lock = threading.Lock()


def _open_cache(function: Callable) -> FunctionCache:
    with _config_lock, _use_cache_folder():
        found = FunctionCache(function)
    found._cache_file.__class__ = CacheIndex
    return found


@contextlib.contextmanager
def _use_cache_folder() -> Iterator[None]:
    """Set the cache folder of rigidmd temporarily, so that other users of Numba keep theirs."""
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def dispatcher(function: Callable, options: dict, from_python: bool) -> CPUDispatcher:
    """A function that is compiled with these options, or read from the cache, when it is first called.

    from_python : whether Python calls it, for which it needs a wrapper; it then runs without Python's lock
    """
    options = options | {"no_cfunc_wrapper": True, "no_cpython_wrapper": not from_python, "nogil": from_python}
    compiled = numba.njit(**options | ({} if from_python else LINKED_OPTIONS))(function)
    compiled.__class__ = KernelDispatcher if from_python else InnerKernel
    return compiled


def compile_callback(function: Callable, arguments: tuple, options: dict) -> CFunc:
    """A function compiled for these types of arguments, or read from the cache; it is called by address."""
    code = _callback_of(function, arguments, options)
    code.compile()
    return code


def load_callback(function: Callable, arguments: tuple, options: dict) -> CFunc | None:
    """The same, only if the cache has it; None if it must be compiled."""

    class NotStored(Exception):
        pass

    def compile_nothing():
        raise NotStored

    code = _callback_of(function, arguments, options)
    code._compile_uncached = compile_nothing
    try:
        code.compile()
    except NotStored:
        return None
    return code


def _callback_of(function: Callable, arguments: tuple, options: dict) -> CFunc:
    code = CFunc(function, (arguments, types.void), locals={}, options=options)
    code._cache = _open_cache(function)
    return code


def reference_counting(enabled: bool) -> dict:
    """Options of a function in which references to arrays are counted, or are not."""
    return {} if enabled else {"_nrt": False}
