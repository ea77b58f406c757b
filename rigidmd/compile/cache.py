"""The cache of compiled code: its folder and its index.

Numba's disk cache checks only the file of the function itself: after a change of a function in another file, callers
would run the old code. So the name of the folder contains a digest of all compiled sources, and any change of a source
starts a new folder. The environment variable `RIGIDMD_CACHE` sets another parent folder.

Private parts of Numba, each tested by tests/test_compile.py: a `FunctionCache` reads its folder from
`numba.config.CACHE_DIR` when it is created, and its index is an `IndexDataCacheFile`, whose class may be changed. The
methods of `CacheIndex` load and save its index and data.
"""

import atexit
import contextlib
import copy
import functools
import hashlib
import os
import pickle
import re
import secrets
import shutil
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numba
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile

from rigidmd.compile.machine import CODE_SETTINGS, SIMD_BITS
from rigidmd.core.user_modules import GENERATED_PREFIX
from rigidmd.errors import RigidMDWarning

PACKAGE = Path(__file__).parent.parent
#: Files and folders with kernels; tests/test_architecture.py checks that no other file has one.
COMPILED = (
    "errors.py", "units.py", "core/files.py", "core/integrators.py", "core/process.py", "core/state.py", "core/toml.py",
    "core/user_modules.py", "compile", "mechanics", "forces", "dynamics", "analysis/pair_histogram.py",
    "engines/protocol.py", "engines/cpu", "engines/ode",
)  # fmt: skip
UNUSED_AFTER_DAYS = 30.0


@functools.cache
def source_digest() -> str:
    """Hexadecimal digest of compiled sources, Numba's version and settings, and the width of vectors."""
    digest = hashlib.sha256(f"{numba.__version__} {SIMD_BITS} {CODE_SETTINGS}".encode())
    named = [PACKAGE / name for name in COMPILED]
    for path in sorted(path for one in named for path in ([one] if one.is_file() else one.rglob("*.py"))):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _folder_of_sources() -> Path:
    """The cache folder for the present sources, writable or not."""
    if named := os.environ.get("RIGIDMD_CACHE"):
        base = Path(named).absolute()
    else:
        import platformdirs

        base = Path(platformdirs.user_cache_path("rigidmd"))
    return base / f"kernels-{source_digest()}"


@functools.cache
def shared_folder() -> str | None:
    """A cache folder that can be read but not written, such as one for all users; None without one."""
    folder = _folder_of_sources()
    return str(folder) if cache_folder() != str(folder) and folder.is_dir() else None


def is_persistent() -> bool:
    """Whether compiled code is stored where other processes read it."""
    return cache_folder() == str(_folder_of_sources())


def describe_cache() -> str:
    """Whether compiled code is stored, for messages."""
    if is_persistent():
        return "kept on disk: the next run starts at once"
    folder = _folder_of_sources().parent
    return f"not kept, as {folder} cannot be written: the next run compiles again; RIGIDMD_CACHE names another folder"


@functools.cache
def cache_folder() -> str:
    """A writable folder for compiled code, created when the first kernel is compiled.

    Folders of older sources that were not used for a month are removed.
    """
    folder = _folder_of_sources()
    base = folder.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        temporary = tempfile.mkdtemp(prefix="rigidmd-cache-")  # the folder is read-only: cache for this process only
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return temporary
    for old in base.iterdir():
        with contextlib.suppress(OSError):
            is_cache = re.fullmatch(r"kernels-[0-9a-f]{16}", old.name) and old.is_dir()
            if is_cache and time.time() - old.stat().st_mtime > UNUSED_AFTER_DAYS * 86400:
                shutil.rmtree(old)
    return str(folder)


_warn_once = functools.cache(functools.partial(warnings.warn, category=RigidMDWarning, stacklevel=2))


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
        index, shared = self._index_for(key), shared_folder()
        found = None if index is None else super(CacheIndex, index).load(key)
        if found is None and index is not None and shared is not None:
            there = copy.copy(index)
            there._cache_path = index._cache_path.replace(cache_folder(), shared, 1)
            there._index_path = index._index_path.replace(cache_folder(), shared, 1)
            found = super(CacheIndex, there).load(key)
        return found

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
            _warn_once(message)
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


#: Held while a setting of Numba is changed. A thread that holds it must not wait for another lock: Numba may hold one.
_config_lock = threading.Lock()


def open_cache(function: Callable) -> FunctionCache:
    """The cache of a function in the folder of rigidmd; other users of Numba keep their folder."""
    with _config_lock:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, cache_folder()
        try:
            found = FunctionCache(function)
        finally:
            numba.config.CACHE_DIR = before
    found._cache_file.__class__ = CacheIndex
    return found
