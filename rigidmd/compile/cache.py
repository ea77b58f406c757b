"""The folder of the cache of compiled code.

Numba's disk cache checks only the file of the function itself: after a change of a function in another file, callers
would run the old code. So the name of the folder contains a digest of all compiled sources, and any change of a source
starts a new folder. The environment variable `RIGIDMD_CACHE` sets another parent folder.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import re
import shutil
import tempfile
import time
from pathlib import Path

import numba

from rigidmd.compile.machine import CODE_SETTINGS, SIMD_BITS

PACKAGE = Path(__file__).parent.parent
#: Files and folders with kernels; tests/test_architecture.py checks that no other file has one.
COMPILED = (
    "errors.py", "units.py", "core", "compile", "mechanics", "forces", "dynamics", "analysis/pair_histogram.py",
    "engines/protocol.py", "engines/cpu", "engines/ode",
)  # fmt: skip
UNUSED_AFTER_DAYS = 30.0


@functools.cache
def source_digest() -> str:
    """Hexadecimal digest of compiled sources, Numba's version and settings, and the width of vectors."""
    digest = hashlib.sha256(f"{numba.__version__} {SIMD_BITS} {CODE_SETTINGS}".encode())
    for path in sorted(path for name in COMPILED for path in _sources(PACKAGE / name)):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _sources(path: Path) -> list[Path]:
    return [path] if path.is_file() else list(path.rglob("*.py"))


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
