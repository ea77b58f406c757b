"""Where compiled code is kept.

Numba's disk cache checks only the file of the function itself: after a change of a helper in another file, callers
would go on running the old code. So the cache is a folder named by a digest of all sources that are compiled, and any
change of a source starts a new folder. The environment variable `RIGIDMD_CACHE` moves the folders elsewhere.
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
#: Files and folders with compiled code; tests/test_architecture.py checks that no other file has a kernel.
COMPILED = (
    "errors.py", "units.py", "core", "compile", "mechanics", "forces", "dynamics", "analysis/pair_histogram.py",
    "engines/protocol.py", "engines/cpu.py", "engines/ode.py",
)  # fmt: skip
UNUSED_AFTER_DAYS = 30.0


@functools.cache
def source_digest() -> str:
    """Hexadecimal digest of the sources of compiled code, Numba's version and settings, and the width of vectors."""
    digest = hashlib.sha256(f"{numba.__version__} {SIMD_BITS} {CODE_SETTINGS}".encode())
    for path in sorted(path for name in COMPILED for path in _sources(PACKAGE / name)):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _sources(place: Path) -> list[Path]:
    return [place] if place.is_file() else list(place.rglob("*.py"))


def _named_folder() -> Path:
    """The folder for compiled code of these sources, writable or not."""
    if named := os.environ.get("RIGIDMD_CACHE"):
        base = Path(named).absolute()
    else:
        import platformdirs

        base = Path(platformdirs.user_cache_path("rigidmd"))
    return base / f"kernels-{source_digest()}"


@functools.cache
def shared_folder() -> str | None:
    """A folder of compiled code that can be read but not written, such as one for all users; None if there is none."""
    folder = _named_folder()
    return str(folder) if cache_folder() != str(folder) and folder.is_dir() else None


def is_persistent() -> bool:
    """Whether what is compiled is kept where other processes read it."""
    return cache_folder() == str(_named_folder())


def describe_cache() -> str:
    """Whether what is compiled is kept, for messages."""
    if is_persistent():
        return "kept on disk: the next run starts at once"
    folder = _named_folder().parent
    return f"not kept, as {folder} cannot be written: the next run compiles again; RIGIDMD_CACHE names another folder"


@functools.cache
def cache_folder() -> str:
    """A writable folder for compiled code. Caches of older sources that were not used for a month are removed.

    Nothing is read, created or removed before the first kernel is compiled.
    """
    folder = _named_folder()
    base = folder.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        own = tempfile.mkdtemp(prefix="rigidmd-cache-")  # the home is read-only: keep the code for this process only
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        return own
    for old in base.iterdir():
        with contextlib.suppress(OSError):
            ours = re.fullmatch(r"kernels-[0-9a-f]{16}", old.name) and old.is_dir()
            if ours and time.time() - old.stat().st_mtime > UNUSED_AFTER_DAYS * 86400:
                shutil.rmtree(old)
    return str(folder)
