"""The door to Numba: how kernels are compiled and cached, and how an overload knows which term it was given.

Numba's disk cache looks only at the file of the function itself; a change in a helper in another file would leave
callers running old code. So the cache lives in a folder named by a digest of all sources of the package: any change of
any file starts a new one. `RIGIDMD_CACHE` names another place for it.
"""

import atexit
import contextlib
import hashlib
import os
import re
import shutil
import tempfile
import time
from pathlib import Path

# Threads that spin while they wait stand in each other's way as soon as anything else wants a core: with a second
# program running, 500 argon atoms fell from 4,700 to 130 steps/s, and to 1,700 when waiting threads sleep. Alone,
# sleeping costs 8 % there and 3 % on 216 waters. Read by the OpenMP library when it is loaded; set it to override.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba
from numba import types
from numba.core.caching import IndexDataCacheFile
from numba.extending import overload

PACKAGE = Path(__file__).parent
UNUSED_AFTER_DAYS = 30.0

# Reassociation and contraction let LLVM keep sums in registers and use FMA. The flags that assume away NaN and
# infinity are left out: a bad number must stay visible.
PAIR_FLAGS = {"reassoc", "contract", "nsz", "arcp"}


def source_digest() -> str:
    """Hexadecimal digest of every source file of the package and of Numba's version."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> str:
    """A writable folder for compiled code; caches of older sources that nobody used for a month are removed."""
    if named := os.environ.get("RIGIDMD_CACHE"):
        base = Path(named)
    else:
        import platformdirs

        base = Path(platformdirs.user_cache_path("rigidmd"))
    folder = base / f"kernels-{source_digest()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        own = tempfile.mkdtemp(prefix="rigidmd-cache-")  # a read-only home: compile, keep it for this process only
        atexit.register(shutil.rmtree, own, ignore_errors=True)
        return own
    for old in base.iterdir():
        with contextlib.suppress(OSError):
            ours = re.fullmatch(r"kernels-[0-9a-f]{16}", old.name) and old.is_dir()
            if ours and time.time() - old.stat().st_mtime > UNUSED_AFTER_DAYS * 86400:
                shutil.rmtree(old)
    return str(folder)


CACHE_FOLDER = _cache_folder()


class Index(IndexDataCacheFile):
    """What is compiled, by the types of the arguments. One with types of a module that is not there counts as absent.

    A term of somebody's own would otherwise leave an index that nobody else can read.
    """

    def _load_index(self):
        try:
            return super()._load_index()
        except (ImportError, AttributeError):
            return {}


def kernel(function=None, *, parallel=False, fastmath=False, inline=False):
    """`numba.njit`, cached on disk under `CACHE_FOLDER`. Other users of Numba keep their own cache folder.

    inline: make LLVM inline it wherever it is called, for what runs in an inner loop. Terms are passed as their fields,
    forty arguments and more, and a call costs more than a pair of sites.
    """
    if function is None:
        return lambda f: kernel(f, parallel=parallel, fastmath=fastmath, inline=inline)
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = CACHE_FOLDER
    options = _options(fastmath, inline) | ({"parallel": True} if parallel else {})
    try:
        compiled = numba.njit(cache=True, **options)(function)
    finally:
        numba.config.CACHE_DIR = before
    compiled._cache._cache_file.__class__ = Index
    return compiled


def implements(stub, fastmath=False, inline=False):
    """`numba.extending.overload` with the options of `kernel`, which an overload does not inherit from its caller."""
    return overload(stub, jit_options=_options(fastmath, inline))


def _options(fastmath, inline: bool) -> dict:
    return {"error_model": "numpy", "fastmath": fastmath} | ({"forceinline": True} if inline else {})


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type is that of the given NamedTuple class; what overloads choose by."""
    return isinstance(numba_type, types.BaseNamedTuple) and numba_type.instance_class is named_tuple
