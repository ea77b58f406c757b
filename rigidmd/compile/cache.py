"""The cache of compiled code: its folder and its index.

Numba's disk cache checks only the file of the function itself: after a change of a function in
another file, callers would run the old code. So each index is named by a digest of the definitions
that its kernel reaches (`sources`), and the folder by one of this package, the version of Numba and
its settings. An edited docstring compiles nothing, a changed function what calls it. The
environment variable `RIGIDMD_CACHE` sets another parent folder.

The cache holds machine code and pickles, which are executed. It is therefore used only if this
user, or root, owns its folders and files and nobody else may write to them. Without such a folder,
code is stored in a temporary one, which only this process uses. A cache that fails costs time and
nothing else.

Private parts of Numba, tested by tests/compile/test_cache.py: a `FunctionCache` reads its folder
from `numba.config.CACHE_DIR` when it is created, in a subfolder named by
`get_suitable_cache_subpath`. Its class and that of its index, an `IndexDataCacheFile`, may be
changed. The methods of `CacheIndex` load and save its index and data. `load_overload` of a
`FunctionCache` refreshes the context of the target before `_load_overload` reads, and a compilation
refreshes it again.
"""

import atexit
import contextlib
import copy
import functools
import hashlib
import inspect
import os
import pickle
import re
import secrets
import shutil
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numba
from filelock import FileLock, Timeout
from numba import types
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache, _CacheLocator
from numba.core.runtime import rtsys

from rigidmd.compile import sources
from rigidmd.compile.machine import CODE_SETTINGS, SIMD_BITS
from rigidmd.core.files import untrusted_reason
from rigidmd.core.user_modules import GENERATED_PREFIX
from rigidmd.errors import RigidMDWarning

UNUSED_AFTER_DAYS = 30.0
INDEX_WAIT = 20.0  # for the index that another process changes, s
OTHERS_WRITE = 0o022  # permissions of group and others


@functools.cache
def compiler_digest() -> str:
    """Hexadecimal digest of this package, Numba's version and settings, and the width of
    vectors."""
    settings = f"{numba.__version__} {SIMD_BITS} {CODE_SETTINGS} {sources.package_digest()}"
    return hashlib.sha256(settings.encode()).hexdigest()[:16]


class CacheFolders(NamedTuple):
    """The folders of compiled code, see `cache_folders`.

    written : folder that this process writes to; None if there is none
    shared : another folder that it reads, such as one for all users; None if there is none
    problem : why code is not stored for other processes; empty if it is
    """

    written: str | None
    shared: str | None
    problem: str


def _base_folder() -> Path | None:
    """The folder of the caches for all versions of the sources; None if this user has no home
    folder."""
    if named := os.environ.get("RIGIDMD_CACHE"):
        return Path(named).absolute()
    import platformdirs

    try:
        base = Path(platformdirs.user_cache_path("rigidmd"))
    except RuntimeError:
        return None
    return base if base.is_absolute() else None  # older versions of platformdirs return "~/.cache"


@functools.cache
def cache_folders() -> CacheFolders:
    """The folders of compiled code, which are made when the first kernel is compiled.

    Folders of other versions, and files, that were not used for a month are removed.
    """
    base = _base_folder()
    if base is None:
        return CacheFolders(_temporary_folder(), None, "this user has no home folder")
    base = Path(os.path.realpath(base))
    sources.read_stored(base)
    folder = base / f"kernels-{compiler_digest()}"
    if problem := _unwritable_reason(base, folder):
        is_shared = not any(_untrusted_folder(one) for one in (base, folder))
        return CacheFolders(_temporary_folder(), str(folder) if is_shared else None, problem)
    for one in (base, folder):
        if problem := _untrusted_folder(one):
            _warn_once(f"compiled code in {base} is not used, as {problem}")
            return CacheFolders(_temporary_folder(), None, problem)
    _remove_unused(base)
    return CacheFolders(str(folder), None, "")


def _unwritable_reason(base: Path, folder: Path) -> str:
    """Make the folder of a cache; why nothing can be written to it, empty if something can be."""
    try:
        base.parent.mkdir(parents=True, exist_ok=True)
        base.mkdir(mode=0o700, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return f"{base} cannot be written ({error.strerror})"
    return ""


def _untrusted_folder(folder: Path) -> str:
    """Why code in a folder is not used; empty if it is."""
    try:
        reason = untrusted_reason(folder.lstat())
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
    return reason and f"{folder} {reason}"


def _temporary_folder() -> str | None:
    """A folder for this process only, removed at its end; None if there cannot be one."""
    try:
        folder = tempfile.mkdtemp(prefix="rigidmd-cache-")
    except OSError:
        return None
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _remove_unused(base: Path) -> None:
    """Remove the folders and lists of sources that were not used for a month, and in the other
    folders the files of which this is true."""
    for path in base.glob("sources-*.json"):
        with contextlib.suppress(OSError):
            if re.fullmatch(r"sources-[0-9a-f]{16}\.json", path.name) and _is_unused(path):
                path.unlink()
    for folder in base.iterdir():
        if not re.fullmatch(r"kernels-[0-9a-f]{16}", folder.name) or not folder.is_dir():
            continue
        with contextlib.suppress(OSError):
            if _is_unused(folder):
                shutil.rmtree(folder)
                continue
            for path in folder.glob("*/*.nb[ic]*"):
                if _is_unused(path):
                    path.unlink()


def _is_unused(path: Path) -> bool:
    return time.time() - path.stat().st_mtime > UNUSED_AFTER_DAYS * 86400


def cache_folder() -> str | None:
    """The folder that compiled code is written to; None if there is none."""
    return cache_folders().written


def is_persistent() -> bool:
    """Whether compiled code is stored where other processes read it."""
    return not cache_folders().problem


def describe_cache() -> str:
    """Whether compiled code is stored, for messages."""
    if is_persistent():
        return "kept on disk: the next run starts at once"
    return (
        f"not kept, as {cache_folders().problem}: the next run compiles again; RIGIDMD_CACHE names"
        " another folder"
    )


@contextlib.contextmanager
def lock_in_cache(name: str, longest_wait: float) -> Iterator[None]:
    """Hold a lock of this name within the block, against other processes and threads.

    On a file system without locks, or after the wait, the block runs without it.
    """
    with contextlib.ExitStack() as held:
        if folder := cache_folder():
            with contextlib.suppress(OSError, NotImplementedError, Timeout):
                held.enter_context(FileLock(Path(folder) / f"{name}.lock", timeout=longest_wait))
        yield


#: Called when a function has to be compiled, see `compiling_announced`.
_announcements: list[Callable[[], None]] = []


@contextlib.contextmanager
def compiling_announced(announce: Callable[[], None]) -> Iterator[None]:
    """Within the block, `announce` is called once before something is compiled; never if all code
    is stored."""
    _announcements.append(announce)
    try:
        yield
    finally:
        with contextlib.suppress(ValueError):
            _announcements.remove(announce)


def _announce_compiling() -> None:
    while _announcements:
        _announcements.pop()()


_warn_once = functools.cache(
    functools.partial(warnings.warn, category=RigidMDWarning, stacklevel=2)
)


class UnreadableError(Exception):
    """A file of the cache has a type that this process does not have."""


class CacheIndex(IndexDataCacheFile):
    """Index of a cache: compiled functions by the types of their arguments.

    Each index belongs to the definitions that its function reaches, with the classes in the types
    of its arguments, so that an index can be read where these classes are. Code for types of
    modules from outside of the
    package is stored only if the name of the module follows from its source (`core.user_modules`).
    Changes of other modules are not noticed, so that old code would run. An index that this process
    cannot read is not replaced: other processes may be able to read it.
    The files of machine code have random names. Numba numbers them, and two processes that compiled
    at the same time for different types wrote to the same file, after which every run crashed.
    Every file begins with a checksum; a damaged file is ignored, and its code is compiled again. A
    folder for all users is also read, see `cache_folders`.
    """

    function: Callable | None = None  # whose code it has

    def load(self, key):
        """A compiled function; None if it is not stored."""
        index, shared = self._index_for(key), cache_folders().shared
        found = None if index is None else index._load_from_index(key)
        if found is None and index is not None and shared is not None:
            there = copy.copy(index)
            there._cache_path = index._cache_path.replace(str(cache_folder()), shared, 1)
            there._index_path = index._index_path.replace(str(cache_folder()), shared, 1)
            found = there._load_from_index(key)
        if found is None:
            _announce_compiling()
        return found

    def save(self, key, data):
        """Store a compiled function. Raises OSError."""
        index = self._index_for(key)
        if index is None:
            return
        name = hashlib.sha256(index._index_path.encode()).hexdigest()[:16]
        with lock_in_cache(name, INDEX_WAIT), contextlib.suppress(UnreadableError):
            super(CacheIndex, index).save(key, data)

    def _load_from_index(self, key):
        try:
            return super().load(key)
        except UnreadableError:
            return None

    def _index_for(self, key) -> "CacheIndex | None":
        """The index for the types of a key and the present sources; None if their code is not
        stored."""
        classes = set(_classes_in(getattr(key[0], "args", key[0])))
        outside = {one.__module__ for one in classes if not _is_of_package(one.__module__)}
        if not all(name.startswith(GENERATED_PREFIX) for name in outside):
            return None
        roots = {sources.node_of(one) for one in classes}
        if self.function is not None:
            roots.add(sources.node_of(self.function))
        index = copy.copy(self)
        index._index_path = f"{self._index_path}.{sources.closure_digest(roots)}"
        return index

    def _data_name(self, number):
        return f"{super()._data_name(number)}.{secrets.token_hex(8)}"

    def _load_index(self):
        try:
            version, stamp, overloads = self._read(self._index_path)
        except OSError:
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
            # whatever the umask, others must not write to it
            os.fchmod(file.fileno(), os.fstat(file.fileno()).st_mode & ~OTHERS_WRITE)
            file.write(hashlib.sha256(content).digest() + content)

    def _read(self, path: str):
        """The content of a file. Raises OSError, or UnreadableError if this process lacks a type in
        it."""
        with open(path, "rb") as file:
            with contextlib.suppress(OSError):
                os.utime(path)  # it is in use
            if reason := untrusted_reason(os.fstat(file.fileno())):
                message = (
                    f"compiled code in {Path(path).parent} is not used, as a file in it {reason}"
                )
                _warn_once(message)
                raise OSError(message)
            data = file.read()
        size = hashlib.sha256().digest_size
        if hashlib.sha256(data[size:]).digest() != data[:size]:
            message = f"{path} is damaged; its code is compiled again"
            _warn_once(message)
            raise OSError(message)
        try:
            return pickle.loads(data[size:])
        except (ImportError, AttributeError) as error:
            raise UnreadableError(str(error)) from None


def _classes_in(kind) -> Iterator[type]:
    """The classes of named tuples in a Numba type."""
    if isinstance(kind, tuple):
        inner = kind
    elif isinstance(kind, types.BaseTuple):
        inner = kind.types
        if isinstance(kind, types.BaseNamedTuple):
            yield kind.instance_class
    else:  # types of `compile`: `CodeType`, `TaskArguments`, `Record`
        inner = (
            *getattr(kind, "task_types", ()),
            *([kind.content] if hasattr(kind, "content") else ()),
        )
    for part in inner:
        yield from _classes_in(part)


@functools.cache
def _is_of_package(module: str) -> bool:
    """Whether every process has a module: its file lies in the package. Its name alone does not
    show that."""
    file = getattr(sys.modules.get(module), "__file__", None)
    return module == "builtins" or (file is not None and Path(file).is_relative_to(sources.PACKAGE))


class KernelCache(FunctionCache):
    """The cache of a function, which costs time only if it cannot be written."""

    def load_overload(self, sig, target_context):
        """A compiled function; None if it is not stored.

        Numba would first load what compiling needs: its support of NumPy, and the extensions of
        other packages, 300 modules or 0.3 s. Code that is read needs the memory of Numba's arrays
        only.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig, data):
        """Store a compiled function, unless that fails."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            reason = f"{cache_folder()} cannot be written: {error.strerror or error}"
            _warn_once(f"compiled code is not kept, as {reason}; the next run compiles again")


#: Held while a setting of Numba is changed. A thread that holds it must not wait for another lock:
#: Numba may hold one.
_config_lock = threading.Lock()


def open_cache(function: Callable) -> FunctionCache | NullCache:
    """The cache of a function in the folder of rigidmd; other users of Numba keep their folder.

    Without a usable folder, nothing is stored. Numba alone would then use a folder next to the
    source of the function.
    """
    folder = cache_folder()
    if folder is None or not _make_subfolder(folder, function):
        _announce_compiling()
        return NullCache()
    with _config_lock:
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, folder
        try:
            found = FunctionCache(function)
        except (OSError, RuntimeError):  # no folder can be written, also not those of Numba
            return NullCache()
        finally:
            numba.config.CACHE_DIR = before
    if not Path(found.cache_path).is_relative_to(folder):
        return NullCache()
    found.__class__ = KernelCache
    found._cache_file = _index_of(function, found)
    return found


def _index_of(function: Callable, cache: FunctionCache) -> CacheIndex:
    """The index of the compiled code of a function. A function of the package is identified by its
    definitions, so that a line that moves compiles nothing again; another one by its line and the
    text of its file, if it has one."""
    name = cache._impl.filename_base
    stamp = cache._cache_file._source_stamp  # of a file its time and size, which may stay
    with contextlib.suppress(OSError):
        stamp = sources.text_digest(Path(inspect.getfile(function)).read_bytes())
    if _is_of_package(function.__module__) and "<locals>" not in function.__qualname__:
        name = re.sub(r"-\d+\.py", ".py", name)  # Numba's name of the file has the line
        stamp = ""
    index = CacheIndex(cache.cache_path, name, stamp)
    index.function = function
    return index


def _make_subfolder(folder: str, function: Callable) -> bool:
    """Make the folder for the functions of a source file, before Numba makes it; whether it can be
    used."""
    subfolder = Path(folder) / _CacheLocator.get_suitable_cache_subpath(inspect.getfile(function))
    try:
        subfolder.mkdir(mode=0o700, exist_ok=True)
        problem = _untrusted_folder(subfolder)
    except OSError as error:
        problem = f"{folder} cannot be written: {error.strerror}"
    if problem:
        _warn_once(f"compiled code is not kept, as {problem}; the next run compiles again")
    return not problem
