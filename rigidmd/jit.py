"""The door to Numba: how kernels are compiled and cached, and how an overload knows which term it was given.

Numba's disk cache looks only at the file of the function itself; a change in a helper in another file would leave
callers running old code. So the cache lives in a folder named by a digest of every source that compiled code can come
from: any change of one of them starts a new folder. `RIGIDMD_CACHE` names another place for it.
"""

import atexit
import contextlib
import functools
import hashlib
import os
import re
import secrets
import shutil
import tempfile
import time
from pathlib import Path

# Threads that spin while they wait stand in each other's way as soon as anything else wants a core: with a second
# program running, 500 argon atoms fell from 4,700 to 130 steps/s, and to 1,700 when waiting threads sleep. Alone,
# sleeping costs 8 % there and 3 % on 216 waters. Read by the OpenMP library when it is loaded; set it to override.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.ccallback import CFunc
from numba.core.codegen import get_host_cpu_features
from numba.core.errors import TypingError
from numba.core.imputils import impl_ret_borrowed
from numba.core.registry import CPUDispatcher
from numba.extending import NativeValue, intrinsic, models, overload, register_model, typeof_impl, unbox

PACKAGE = Path(__file__).parent
#: Files and folders that compiled code comes from; tests/test_rooms.py sees that no other file has a kernel.
COMPILED = ("jit.py", "errors.py", "units.py", "core", "mechanics", "forces", "dynamics")
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


@functools.cache
def source_digest() -> str:
    """Hexadecimal digest of the sources of compiled code, of Numba's version and of the width of vectors."""
    digest = hashlib.sha256(f"{numba.__version__} {SIMD_BITS}".encode())
    for path in sorted(path for name in COMPILED for path in _sources(PACKAGE / name)):
        digest.update(path.relative_to(PACKAGE).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _sources(place: Path) -> list[Path]:
    return [place] if place.is_file() else list(place.rglob("*.py"))


@functools.cache
def cache_folder() -> str:
    """A writable folder for compiled code; caches of older sources that nobody used for a month are removed.

    Nothing is read, made or removed before the first kernel is compiled.
    """
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


def _opened_cache(function) -> FunctionCache:
    with _own_cache():
        found = FunctionCache(function)
    found._cache_file.__class__ = Index
    return found


class Inner(Kernel):
    """A kernel that only compiled code calls. It has no wrapper for Python, which would take every term apart.

    To call one that has none ends in a crash. Without wrappers, and without copies between slices of arrays, whose
    checks Numba compiles too, all that systems/water.toml needs compiled in 40 s instead of 66.
    """

    def __call__(self, *arguments):
        raise TypeError(f"{self.py_func.__name__} is for compiled code; for Python it has to be a kernel(outer=True)")


def kernel(function=None, *, parallel=False, fastmath=False, inline=False, counted=True, outer=False):
    """`numba.njit`, cached on disk in `cache_folder()`. Other users of Numba keep their own cache folder.

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
    compiled = numba.njit(**options)(function)
    compiled.__class__ = Kernel if outer else Inner
    return compiled


@contextlib.contextmanager
def _own_cache():
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = cache_folder()
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


class Task:
    """A function of (parcel, block) that compiled code calls by its address, see `Code`.

    What is called by name is compiled again with every caller, and the callers' callers: the pair loop five times on
    its way up to the loop over steps, and that for every kind of scene. By address it is compiled once.
    """

    def __init__(self, function, **options):
        self.function, self.options = function, options
        self.compiled = {}

    def address(self, parcel: Parcel) -> int:
        """Where the machine code for a parcel of this type is; compiled, or taken from the cache."""
        if parcel not in self.compiled:
            # Code from the cache that starts threads needs them to be there. Numba sees to that, but loses sight of it
            # where what was compiled called something that itself came from the cache; that ended in a crash.
            numba.get_num_threads()
            code = CFunc(self.function, ((parcel, types.intp), types.void), locals={}, options=self.options)
            code._cache = _opened_cache(self.function)
            code.compile()
            self.compiled[parcel] = code
        return self.compiled[parcel].address


def task(*, fastmath=False, counted=True):
    """Make a `Task` of a function, with options as those of `kernel`."""
    return lambda function: Task(function, **_options(fastmath, False), **_counting(counted))


class Code:
    """Machine code of tasks, by name, each for contents of one type, which `call` and `call_blocks` hold it to.

    Code(fill=(_fill, pairs), place=(_place, (pairs, sites, state))) compiles the tasks, or takes them from the cache.
    """

    def __init__(self, **tasks: tuple[Task, object]):
        parcels = {name: Parcel(numba.typeof(content)) for name, (_, content) in tasks.items()}
        self._addresses = np.array([tasks[name][0].address(parcel) for name, parcel in parcels.items()], np.uintp)
        self.table = self._addresses.ctypes.data
        self.numba_type = CodeType(tuple(parcels.items()))


class CodeType(types.Type):
    """Numba type of a `Code`: which tasks it has, and what each may be called with."""

    def __init__(self, parcels: tuple[tuple[str, Parcel], ...]):
        self.parcels = parcels
        # a digest: the name is part of that of every function that is compiled for it
        super().__init__(f"code({hashlib.sha256(repr(parcels).encode()).hexdigest()[:16]})")

    def place(self, name: str, parcel: Parcel) -> int:
        """Which of its addresses is that of a task. Raises TypeError where it was compiled for something else."""
        names = [known for known, _ in self.parcels]
        if name not in names:
            raise TypingError(f"there is no machine code of {name}; there is that of {', '.join(names)}")
        if self.parcels[names.index(name)][1] != parcel:
            raise TypingError(f"{name} was compiled for {self.parcels[names.index(name)][1]}, not for {parcel}")
        return names.index(name)


@typeof_impl.register(Code)
def _typeof_code(value, context):
    return value.numba_type


@register_model(CodeType)
class _CodeModel(models.PrimitiveModel):
    def __init__(self, manager, code):
        super().__init__(manager, code, ir.IntType(64))


@unbox(CodeType)
def _unbox_code(kind, value, context):
    table = context.pyapi.object_getattr_string(value, "table")
    address = context.pyapi.long_as_ulonglong(table)
    context.pyapi.decref(table)
    return NativeValue(address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred()))


@intrinsic(prefer_literal=True)
def _address_of(typing, code, name, parcel):
    """Where the machine code of a task is."""
    if not isinstance(name, types.StringLiteral):
        raise TypingError("the name of a task must be a literal")
    place = code.place(name.literal_value, parcel)

    def emit(context, builder, signature, arguments):
        table = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.load(builder.gep(table, [ir.IntType(64)(place)]))

    return types.intp(code, name, parcel), emit


@intrinsic
def _jump(typing, address, parcel, block):
    """Call what is at an address."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [ADDRESS, ir.IntType(64)])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, parcel, types.intp), emit


@kernel(parallel=True)
def _jump_threaded(address, parcel, blocks):
    for block in numba.prange(blocks):
        _jump(address, parcel, block)


@kernel
def _jump_blocks(address, parcel, blocks):
    if blocks == 1:
        _jump(address, parcel, 0)
    else:
        _jump_threaded(address, parcel, blocks)


def call(code, name, parcel):
    """Call a task by its name, which is a literal, for block 0. What it was not compiled for does not compile."""
    raise TypeError("compiled code only")


def call_blocks(code, name, parcel, blocks):
    """Call a task for every block, on all threads if there are several."""
    raise TypeError("compiled code only")


@overload(call, prefer_literal=True, jit_options=_options(False, True))
def _call(code, name, parcel):
    return lambda code, name, parcel: _jump(_address_of(code, name, parcel), parcel, 0)


@overload(call_blocks, prefer_literal=True, jit_options=_options(False, True))
def _call_blocks(code, name, parcel, blocks):
    return lambda code, name, parcel, blocks: _jump_blocks(_address_of(code, name, parcel), parcel, blocks)
