"""The door to Numba: how kernels are compiled and cached, and how an overload knows which term it was given.

Numba's disk cache looks only at the file of the function itself; a change in a helper in another file would leave
callers running old code. So the cache lives in a folder named by a digest of every source that compiled code can come
from: any change of one of them starts a new folder. `RIGIDMD_CACHE` names another place for it.
"""

import atexit
import contextlib
import hashlib
import os
import re
import secrets
import shutil
import tempfile
import time
from pathlib import Path

# Threads that wait look 1000 times, for 50 to 100 µs, before they sleep. On two cores 4096 SPC/E (mixed, 2 fs) did 590
# to 611 steps/s so, 340 to 385 where they slept at once, and 335 on one thread. Beside a busy program that was 265 and
# 325, and 67 with 20,000 looks: a thread that waits awake holds the core that another needs. On a machine where threads
# wake fast, two made 1.55 times the steps of one so and 1.6 times asleep at once, beside a busy program 0.90 and 0.94
# times. The count is for GCC's OpenMP, where it stands above the policy; the policy is for others. Both are read when
# OpenMP is loaded. What a user has set himself is left alone.
if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
    os.environ.update(OMP_WAIT_POLICY="PASSIVE", GOMP_SPINCOUNT="1000")

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.caching import IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import get_host_cpu_features
from numba.core.imputils import impl_ret_borrowed
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic, models, overload, register_model

PACKAGE = Path(__file__).parent
#: Files and folders that compiled code comes from; tests/test_rooms.py sees that no other file has a kernel.
COMPILED = ("jit.py", "errors.py", "units.py", "mechanics", "forces", "dynamics")
ADDRESS = ir.IntType(8).as_pointer()
UNUSED_AFTER_DAYS = 30.0
BLOCKS = 16  # that threads share: enough for 16 of them

# Reassociation and contraction let LLVM keep sums in registers and use FMA. The flags that assume away NaN and
# infinity are left out: a bad number must stay visible.
PAIR_FLAGS = {"reassoc", "contract", "nsz", "arcp"}


def _simd_bits() -> int:
    """Bits of the vectors that pair loops use: the widest that this machine computes with."""
    if named := os.environ.get("RIGIDMD_SIMD_BITS"):
        return int(named)
    features = get_host_cpu_features().split(",")
    return 512 if "+avx512f" in features else 256 if "+avx2" in features else 128


SIMD_BITS = _simd_bits()


def source_digest() -> str:
    """Hexadecimal digest of the sources of compiled code, of Numba's version and of the width of vectors."""
    digest = hashlib.sha256(f"{numba.__version__} {SIMD_BITS}".encode())
    for path in sorted(path for name in COMPILED for path in _sources(PACKAGE / name)):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _sources(place: Path) -> list[Path]:
    return [place] if place.is_file() else list(place.rglob("*.py"))


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
            numba.get_num_threads()
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


class Inner(CPUDispatcher):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would take every term apart.

    To call one that has none ends in a crash. Without wrappers, and without copies between slices of arrays, whose
    checks Numba compiles too, all that systems/water.toml needs compiled in 40 s instead of 66.
    """

    def __call__(self, *arguments):
        raise TypeError(f"{self.py_func.__name__} is for compiled code; for Python it has to be a kernel(outer=True)")


def kernel(function=None, *, parallel=False, fastmath=False, inline=False, counted=True, outer=False):
    """`numba.njit`, cached on disk under `CACHE_FOLDER`. Other users of Numba keep their own cache folder.

    inline: make LLVM inline it wherever it is called, for what runs in an inner loop. Terms are passed as their fields,
    forty arguments and more, and a call costs more than a pair of sites. And for whatever has fastmath: a function that
    is called by its name may be there twice, by itself and compiled into its caller, with sums in another order, and
    which of them is taken depends on what else the process has compiled; seen, a run had other last bits when it came
    from the cache.
    counted: False for a loop that takes views of arrays in passing but neither allocates nor returns any, and all it
    calls: the references are then not counted. Counting, atomic, made 47 ns of the 7 that a vector of pairs takes.
    Such a loop takes elements by their index: iterating over a view ended in a crash. Its caller never assigns anew, in
    a loop of its own, arrays that it passes: the new ones were freed while they were in use.
    outer: whether Python calls it.
    """
    if function is None:
        return lambda f: kernel(f, parallel=parallel, fastmath=fastmath, inline=inline, counted=counted, outer=outer)
    options = _options(fastmath, inline) | ({"parallel": True, "_nrt": True} if parallel else _counting(counted))
    options |= {"no_cfunc_wrapper": True, "no_cpython_wrapper": not outer}
    with _own_cache():
        compiled = numba.njit(cache=True, **options)(function)
    compiled._cache._cache_file.__class__ = Index
    if not outer:
        compiled.__class__ = Inner
    return compiled


@contextlib.contextmanager
def _own_cache():
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = CACHE_FOLDER
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


def implements(stub, fastmath=False, inline=False, counted=True):
    """`numba.extending.overload` with the options of `kernel`, which an overload does not inherit from its caller."""
    return overload(stub, jit_options=_options(fastmath, inline) | _counting(counted))


def _options(fastmath, inline: bool) -> dict:
    return {"error_model": "numpy", "fastmath": fastmath} | ({"forceinline": True} if inline else {})


def _counting(counted: bool) -> dict:
    return {} if counted else {"_nrt": False}


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type is that of the given NamedTuple class; what overloads choose by."""
    return isinstance(numba_type, types.BaseNamedTuple) and numba_type.instance_class is named_tuple


class Parcel(types.Type):
    """Numba type of the address of a value of any type."""

    def __init__(self, content):
        self.content = content
        super().__init__(f"parcel({content})")


@register_model(Parcel)
class _ParcelModel(models.PrimitiveModel):
    def __init__(self, manager, parcel):
        super().__init__(manager, parcel, ADDRESS)


@intrinsic
def packed(typing, content):
    """The parcel of a value, to be opened before the calling function returns."""

    def emit(context, builder, signature, arguments):
        return builder.bitcast(cgutils.alloca_once_value(builder, arguments[0]), ADDRESS)

    return Parcel(content)(content), emit


@intrinsic
def opened(typing, parcel):
    """The value in a parcel."""

    def emit(context, builder, signature, arguments):
        kind = context.get_value_type(parcel.content).as_pointer()
        content = builder.load(builder.bitcast(arguments[0], kind))
        return impl_ret_borrowed(context, builder, parcel.content, content)

    return parcel.content(parcel), emit


class Work:
    """A function of (parcel, block) that compiled code calls by its address.

    What is called by name is compiled again with every caller, and the callers' callers: the pair loop five times on
    its way up to the loop over steps, and that for every kind of scene. By address it is compiled once.
    """

    def __init__(self, function, **options):
        self.function, self.options = function, options
        self.compiled = {}

    def address(self, content) -> int:
        """Where the machine code for a parcel of this value is; compiled, or taken from the cache."""
        parcel = Parcel(numba.typeof(content))
        if parcel not in self.compiled:
            # Code from the cache that starts threads needs them to be there. Numba sees to that, but loses sight of it
            # where what was compiled called something that itself came from the cache; that ended in a crash.
            numba.get_num_threads()
            with _own_cache():
                code = CFunc(self.function, ((parcel, types.intp), types.void), locals={}, options=self.options)
                code.enable_caching()
                code._cache._cache_file.__class__ = Index
                code.compile()
            self.compiled[parcel] = code
        return self.compiled[parcel].address


def work(*, fastmath=False, counted=True):
    """Make a `Work` of a function, with options as those of `kernel`."""
    return lambda function: Work(function, **_options(fastmath, False), **_counting(counted))


@intrinsic
def call(typing, address, parcel, block):
    """Call a `Work` by its address."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [ADDRESS, ir.IntType(64)])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, parcel, types.intp), emit


@kernel(parallel=True)
def _call_threaded(address, parcel, blocks):
    for block in numba.prange(blocks):
        call(address, parcel, block)


@kernel
def call_blocks(address, parcel, blocks):
    """Call a `Work` for every block, on all threads if there are several."""
    if blocks == 1:
        call(address, parcel, 0)
    else:
        _call_threaded(address, parcel, blocks)
