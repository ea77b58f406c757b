"""Machine code that is called by address. Each address carries the type that the code was compiled for."""

import ctypes
import hashlib
import threading
from collections.abc import Callable
from contextvars import ContextVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.imputils import impl_ret_borrowed
from numba.extending import NativeValue, intrinsic, models, overload, register_model, typeof_impl, unbox

from rigidmd.compile import second_process, thread_pool
from rigidmd.compile.kernels import compiler_options, kernel
from rigidmd.compile.layout import AddressType, NumbaStruct
from rigidmd.compile.numba_private import LINKED_OPTIONS, compile_callback, load_callback, reference_counting

ADDRESS = ir.IntType(8).as_pointer()


class TaskArguments(types.Type):
    """Numba type of the address of a value of any type."""

    def __init__(self, content):
        self.content = content
        super().__init__(f"parcel({content})")

    @property
    def key(self):
        """The type of the content: its name is that of any other class of the same name."""
        return self.content


@register_model(TaskArguments)
class _ParcelModel(models.PrimitiveModel):
    def __init__(self, manager, parcel):
        super().__init__(manager, parcel, ADDRESS)


@intrinsic
def pack_arguments(typing, content):
    """The parcel of a value. It must be opened before the calling function returns."""

    def emit(context, builder, signature, arguments):
        return builder.bitcast(cgutils.alloca_once_value(builder, arguments[0]), ADDRESS)

    return TaskArguments(content)(content), emit


@intrinsic
def load_arguments(typing, parcel):
    """The value in a parcel."""

    def emit(context, builder, signature, arguments):
        kind = context.get_value_type(parcel.content).as_pointer()
        content = builder.load(builder.bitcast(arguments[0], kind))
        return impl_ret_borrowed(context, builder, parcel.content, content)

    return parcel.content(parcel), emit


class Task:
    """A function of (parcel, block) that compiled code calls by address, see `Code`.

    Numba compiles a function that is called by name again into every caller, and into their callers: the pair loop five
    times on the way up to the loop over steps, for every kind of scene. Called by address, it is compiled once.
    """

    def __init__(self, function, **options):
        self.function, self.options = function, options
        self.compiled = {}

    def address(self, parcel: TaskArguments) -> int:
        """Address of the machine code for a parcel of this type, which is compiled or read from the cache."""
        if parcel not in self.compiled:
            second_process.wait_for(*self.name, parcel)
            thread_pool.start_workers()
            code = compile_callback(self.function, (parcel, types.intp), self.options)
            self.compiled.setdefault(parcel, code)  # another thread may use what it has made meanwhile
        return self.compiled[parcel].address

    @property
    def name(self) -> tuple[str, str]:
        """Its module, and its name there."""
        return self.function.__module__, self.function.__name__

    def is_ready(self, parcel: TaskArguments) -> bool:
        """Whether `address` has nothing to compile."""
        if parcel not in self.compiled:
            thread_pool.start_workers()
            code = load_callback(self.function, (parcel, types.intp), self.options)
            if code is None:
                return False
            self.compiled.setdefault(parcel, code)
        return True


def task(*, counted=True):
    """Turn a function into a `Task`; the options are those of `kernel`."""
    return lambda function: Task(function, **compiler_options(False), **reference_counting(counted))


#: Held while codes are compiled together: of several runs at once, one compiles what the others then read.
_compiling = threading.RLock()
#: Tasks of each `Code` that this thread makes, while it compiles nothing; None otherwise.
_plan: ContextVar[list[tuple[Task, TaskArguments]] | None] = ContextVar("plan", default=None)


def compile_together(make: Callable[[], object]) -> None:
    """Compile every `Code` that a function makes, with the help of a second process if that is worth while.

    The function is first called for the tasks and types of its codes alone: these have no addresses, and it must not
    call them.
    """
    if second_process.compiler_processes() == 1:
        return
    with _compiling:
        wanted: list[tuple[Task, TaskArguments]] = []
        before = _plan.set(wanted)
        try:
            make()
        finally:
            _plan.reset(before)
        missing = [(*one.name, parcel) for one, parcel in dict.fromkeys(wanted) if not one.is_ready(parcel)]
        if len(missing) >= second_process.FEWEST_TASKS:
            with second_process.use_helper(missing):
                make()


class Code:
    """Machine code of named tasks, each for contents of one type; `call` and `call_blocks` check that type.

    Code(fill=(_fill, pairs), place=(_place, (pairs, sites, state))) compiles the tasks, or reads them from the cache.
    """

    def __init__(self, **tasks: tuple[Task, object]):
        parcels = {name: TaskArguments(numba.typeof(content)) for name, (_, content) in tasks.items()}
        of = [(tasks[name][0], parcel) for name, parcel in parcels.items()]
        plan = _plan.get()
        if plan is not None:
            plan.extend(of)
        self._addresses = np.array([one.address(parcel) if plan is None else 0 for one, parcel in of], np.uintp)
        self.word = self._addresses.ctypes.data
        self.numba_type = CodeType(tuple(parcels.items()))
        self._names = list(tasks)

    def address(self, name: str) -> int:
        """Address of a task."""
        return int(self._addresses[self._names.index(name)])

    def lay_down(self, content: object) -> NumbaStruct:
        """A content in memory, for every task. Raises TypingError if one was compiled for another type."""
        laid = NumbaStruct(content)
        for name in self._names:
            self.numba_type.place(name, TaskArguments(laid.kind))
        return laid


class CodeType(AddressType):
    """Numba type of a `Code`: its tasks, and the type of parcel that each accepts."""

    def __init__(self, parcels: tuple[tuple[str, TaskArguments], ...]):
        self.parcels = parcels
        # a digest, because this name becomes part of the name of every function compiled for it
        digest = hashlib.sha256(repr(parcels).encode()).hexdigest()[:16]
        super().__init__(f"code({digest})")
        # The same in every process: types are pickled. Numba asks for it in every call from Python, and to hash so many
        # types takes half a millisecond.
        self._hash = int(digest[:15], 16)

    def __hash__(self):
        return self._hash

    @property
    def key(self):
        """The tasks."""
        return self.parcels

    def place(self, name: str, parcel: TaskArguments) -> int:
        """Index of a task's address. Raises TypingError if there is no such task, or not for this type of parcel."""
        names = [known for known, _ in self.parcels]
        if name not in names:
            raise TypingError(f"there is no task {name}; the tasks are {', '.join(names)}")
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
    word = context.pyapi.object_getattr_string(value, "word")
    address = context.pyapi.long_as_ulonglong(word)
    context.pyapi.decref(word)
    return NativeValue(address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred()))


@intrinsic(prefer_literal=True)
def address_of(typing, code, name, parcel):
    """Address of the machine code of a task, for a parcel of the type that it was compiled for."""
    if not isinstance(name, types.StringLiteral):
        raise TypingError("the name of a task must be a literal")
    place = code.place(name.literal_value, parcel)

    def emit(context, builder, signature, arguments):
        table = builder.inttoptr(arguments[0], ir.IntType(64).as_pointer())
        return builder.load(builder.gep(table, [ir.IntType(64)(place)]))

    return types.intp(code, name, parcel), emit


@intrinsic
def _jump(typing, address, parcel, block):
    """Call the machine code at an address."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [ADDRESS, ir.IntType(64)])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, parcel, types.intp), emit


class BoundTask:
    """A task with its content, for Python to call without holding its lock.

    A call takes a microsecond. Numba would look at every array in every call: after a stretch of computing the core has
    to fetch all of them again, and the code that looks at them.

    content : a tuple; its arrays are kept, and those that change tell the task what to do
    """

    def __init__(self, task: Task, content: tuple):
        code = Code(task=(task, content))
        self._content = code.lay_down(content)
        self._function = ctypes.CFUNCTYPE(None, ctypes.c_ssize_t, ctypes.c_ssize_t)(code.address("task"))

    def __call__(self) -> None:
        self._function(self._content.address, 0)


@kernel
def _jump_blocks(address, parcel, blocks):
    if blocks == 1:
        _jump(address, parcel, 0)
    else:
        thread_pool.run_on_all_threads(address, parcel, blocks)


def call(code, name, parcel):
    """Call a task for block 0 by its name, a literal. A parcel of another type is an error of compilation."""
    raise TypeError("compiled code only")


def call_blocks(code, name, parcel, blocks):
    """Call a task for every block; on all threads if there are several blocks."""
    raise TypeError("compiled code only")


@overload(call, prefer_literal=True, jit_options=compiler_options(True) | LINKED_OPTIONS)
def _call(code, name, parcel):
    return lambda code, name, parcel: _jump(address_of(code, name, parcel), parcel, 0)


@overload(call_blocks, prefer_literal=True, jit_options=compiler_options(True) | LINKED_OPTIONS)
def _call_blocks(code, name, parcel, blocks):
    return lambda code, name, parcel, blocks: _jump_blocks(address_of(code, name, parcel), parcel, blocks)
