"""Machine code that is called by address. Each address carries the type for which the code was compiled."""

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
from rigidmd.compile.pointers import cast_pointer, function_at, pointer_to


class TaskArguments(types.Type):
    """Numba type of the address of a task's arguments, a value of any type."""

    def __init__(self, content):
        self.content = content
        super().__init__(f"task_arguments({content})")

    @property
    def key(self):
        """The type of the arguments. The name does not identify it: classes of the same name have the same."""
        return self.content


@register_model(TaskArguments)
class _TaskArgumentsModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, cgutils.voidptr_t)  # the pointers that Numba keeps in variables


@intrinsic
def pack_arguments(typing, content):
    """The address of a value on the stack, valid until the calling function returns."""

    def emit(context, builder, signature, arguments):
        return builder.bitcast(cgutils.alloca_once_value(builder, arguments[0]), cgutils.voidptr_t)

    return TaskArguments(content)(content), emit


@intrinsic
def load_arguments(typing, task_arguments):
    """The value at the address of task arguments."""

    def emit(context, builder, signature, arguments):
        kind = context.get_value_type(task_arguments.content)
        content = builder.load(cast_pointer(builder, arguments[0], kind), typ=kind)
        return impl_ret_borrowed(context, builder, task_arguments.content, content)

    return task_arguments.content(task_arguments), emit


class CompiledTask:
    """A function of (task_arguments, block) that compiled code calls by address, see `Code`.

    Numba compiles a function that is called by name again into every caller, and into their callers: the pair loop five
    times on the way up to the loop over steps, for every kind of scene. Called by address, it is compiled once.
    """

    def __init__(self, function, **options):
        self.function, self.options = function, options
        self.compiled = {}

    def address(self, arguments_type: TaskArguments) -> int:
        """Address of the machine code for arguments of this type, which is compiled or read from the cache."""
        if arguments_type not in self.compiled:
            second_process.wait_for(*self.name, arguments_type)
            thread_pool.start_workers()
            code = compile_callback(self.function, (arguments_type, types.intp), self.options)
            self.compiled.setdefault(arguments_type, code)  # the code of another thread may already be in use
        return self.compiled[arguments_type].address

    @property
    def name(self) -> tuple[str, str]:
        """Its module, and its name in that module."""
        return self.function.__module__, self.function.__name__

    def is_ready(self, arguments_type: TaskArguments) -> bool:
        """Whether `address` has nothing to compile."""
        if arguments_type not in self.compiled:
            thread_pool.start_workers()
            code = load_callback(self.function, (arguments_type, types.intp), self.options)
            if code is None:
                return False
            self.compiled.setdefault(arguments_type, code)
        return True


def task(*, count_references=True):
    """Decorator that makes a `CompiledTask` of a function, with the options of `kernel`."""
    return lambda function: CompiledTask(function, **compiler_options(False), **reference_counting(count_references))


#: Held while codes are compiled together: of several runs at once, one compiles and the others read its result.
_compiling = threading.RLock()
#: Tasks of each `Code` while they are only collected and not compiled, in this thread; None otherwise.
_collected: ContextVar[list[tuple[CompiledTask, TaskArguments]] | None] = ContextVar("collected", default=None)


def compile_together(make: Callable[[], object]) -> None:
    """Compile every `Code` that a function makes, with the help of a second process if that saves time.

    The function is first called only to collect the tasks and types of its codes. These have no addresses, so it must
    not call them.
    """
    if second_process.compiler_processes() == 1:
        return
    with _compiling:
        collected: list[tuple[CompiledTask, TaskArguments]] = []
        before = _collected.set(collected)
        try:
            make()
        finally:
            _collected.reset(before)
        missing = [(*one.name, kind) for one, kind in dict.fromkeys(collected) if not one.is_ready(kind)]
        if len(missing) >= second_process.FEWEST_TASKS:
            with second_process.use_helper(missing):
                make()


class Code:
    """Machine code of named tasks, each for arguments of one type; `call` and `call_blocks` check that type.

    Code(fill=(_fill, pairs), sites=(_sites, (pairs, sites, state))) compiles the tasks, or reads them from the cache.
    """

    def __init__(self, **tasks: tuple[CompiledTask, object]):
        kinds = {name: TaskArguments(numba.typeof(content)) for name, (_, content) in tasks.items()}
        pairs = [(tasks[name][0], kind) for name, kind in kinds.items()]
        collected = _collected.get()
        if collected is not None:
            collected.extend(pairs)
        self._addresses = np.array([one.address(kind) if collected is None else 0 for one, kind in pairs], np.uintp)
        self.address_value = self._addresses.ctypes.data
        self.numba_type = CodeType(tuple(kinds.items()))
        self._names = list(tasks)

    def address(self, name: str) -> int:
        """Address of a task."""
        return int(self._addresses[self._names.index(name)])

    def to_struct(self, content: object) -> NumbaStruct:
        """Arguments in memory, for every task. Raises TypingError if one was compiled for another type."""
        struct = NumbaStruct(content)
        for name in self._names:
            self.numba_type.index_of(name, TaskArguments(struct.kind))
        return struct


class CodeType(AddressType):
    """Numba type of a `Code`: its tasks, and the type of arguments that each accepts."""

    def __init__(self, task_types: tuple[tuple[str, TaskArguments], ...]):
        self.task_types = task_types
        # a digest, because this name becomes part of the name of every function compiled for it
        digest = hashlib.sha256(repr(task_types).encode()).hexdigest()[:16]
        super().__init__(f"code({digest})")
        # The same in every process, because types are pickled. Numba needs the hash in every call from Python, and
        # hashing all these types takes half a millisecond.
        self._hash = int(digest[:15], 16)

    def __hash__(self):
        return self._hash

    @property
    def key(self):
        return self.task_types

    def index_of(self, name: str, kind: TaskArguments) -> int:
        """Index of a task's address. Raises TypingError if the task is unknown or accepts another type of arguments."""
        names = [known for known, _ in self.task_types]
        if name not in names:
            raise TypingError(f"unknown task {name}; the tasks are {', '.join(names)}")
        if self.task_types[names.index(name)][1] != kind:
            raise TypingError(f"{name} was compiled for {self.task_types[names.index(name)][1]}, not for {kind}")
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
    number = context.pyapi.object_getattr_string(value, "address_value")
    address = context.pyapi.long_as_ulonglong(number)
    context.pyapi.decref(number)
    return NativeValue(address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred()))


@intrinsic(prefer_literal=True)
def address_of(typing, code, name, task_arguments):
    """Address of the machine code of a task, for arguments of the type for which it was compiled."""
    if not isinstance(name, types.StringLiteral):
        raise TypingError("the name of a task must be a literal")
    index = code.index_of(name.literal_value, task_arguments)

    def emit(context, builder, signature, arguments):
        word = ir.IntType(64)
        table = builder.inttoptr(arguments[0], pointer_to(word))
        return builder.load(builder.gep(table, [word(index)], source_etype=word), typ=word)

    return types.intp(code, name, task_arguments), emit


@intrinsic
def _call_at(typing, address, task_arguments, block):
    """Call the machine code at an address."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [cgutils.voidptr_t, ir.IntType(64)])
        builder.call(function_at(builder, arguments[0], kind), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, task_arguments, types.intp), emit


class BoundTask:
    """A task with its arguments, for Python to call without holding its lock.

    A call takes a microsecond. Numba's dispatcher would inspect every array in every call, and after a segment of
    computing neither they nor that code are in the cache of the core.

    content : a tuple; its arrays are kept, and their present values are the input of the task
    """

    def __init__(self, task: CompiledTask, content: tuple):
        code = Code(task=(task, content))
        self._content = code.to_struct(content)
        self._function = ctypes.CFUNCTYPE(None, ctypes.c_ssize_t, ctypes.c_ssize_t)(code.address("task"))

    def __call__(self) -> None:
        self._function(self._content.address, 0)


@kernel
def _call_blocks_at(address, task_arguments, blocks):
    if blocks == 1:
        _call_at(address, task_arguments, 0)
    else:
        thread_pool.run_on_all_threads(address, task_arguments, blocks)


def call(code, name, task_arguments):
    """Call a task for block 0 by its name, a literal. Arguments of another type are a compilation error."""
    raise TypeError("compiled code only")


def call_blocks(code, name, task_arguments, blocks):
    """Call a task for every block; on all threads if there are several blocks."""
    raise TypeError("compiled code only")


@overload(call, prefer_literal=True, jit_options=compiler_options(True) | LINKED_OPTIONS)
def _call(code, name, task_arguments):
    return lambda code, name, task_arguments: _call_at(address_of(code, name, task_arguments), task_arguments, 0)


@overload(call_blocks, prefer_literal=True, jit_options=compiler_options(True) | LINKED_OPTIONS)
def _call_blocks(code, name, task_arguments, blocks):
    return lambda code, name, task_arguments, blocks: _call_blocks_at(
        address_of(code, name, task_arguments), task_arguments, blocks
    )
