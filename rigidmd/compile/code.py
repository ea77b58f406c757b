"""Tasks: machine code that is called by address. Each address carries the type for which the code
was compiled."""

import contextlib
import ctypes
import hashlib
import importlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextvars import ContextVar
from functools import cache

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.core.imputils import impl_ret_borrowed
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

from rigidmd.compile import thread_pool
from rigidmd.compile.cache import is_persistent, lock_in_cache
from rigidmd.compile.kernels import NotStored, chosen_by_type, compile_callback, compiler_options
from rigidmd.compile.machine import MOST_THREADS, POINTER, cast_pointer
from rigidmd.compile.records import (
    NumbaStruct,
    by_reference,
    load_invariant,
    referenced_type,
    remember_by_structure,
    stored_by_reference,
)
from rigidmd.core.process import python_process
from rigidmd.core.signals import SEPARATE_GROUP
from rigidmd.errors import SettingError

#: Longest time to wait for the code of another process, s.
LONGEST_WAIT = 120.0


# --- tasks ----------------------------------------------------------------------------------------


class TaskArguments(types.Type):
    """Numba type of the address of a task's arguments, a value of any type whose named tuples are
    records."""

    def __init__(self, content):
        self.content = by_reference(content)
        super().__init__(f"task_arguments({self.content})")
        # The same in every process, because types are pickled. To hash forty arrays takes a
        # millisecond, and every search for the code of a task needs the hash.
        self._hash = int(hashlib.sha256(repr(self.content).encode()).hexdigest()[:15], 16)

    def __hash__(self):
        return self._hash

    @property
    def key(self):
        """The type of the arguments. The name does not identify it: classes of the same name have
        the same."""
        return self.content


@remember_by_structure
def arguments_type(content: object) -> TaskArguments:
    """The type of the address of a task's arguments."""
    return TaskArguments(referenced_type(content))


register_model(TaskArguments)(models.OpaqueModel)  # the pointers that Numba keeps in variables


@intrinsic
def pack_arguments(typing, content):
    """The address of a value on the stack, valid until the calling function returns."""

    def emit(context, builder, signature, arguments):
        value = stored_by_reference(context, builder, content, arguments[0])
        return builder.bitcast(cgutils.alloca_once_value(builder, value), cgutils.voidptr_t)

    return TaskArguments(content)(content), emit


@intrinsic
def load_arguments(typing, task_arguments):
    """The value at the address of task arguments."""

    def emit(context, builder, signature, arguments):
        kind = context.get_value_type(task_arguments.content)
        content = load_invariant(builder, cast_pointer(builder, arguments[0], kind), kind)
        return impl_ret_borrowed(context, builder, task_arguments.content, content)

    return task_arguments.content(task_arguments), emit


class CompiledTask:
    """A function of (task_arguments, block) that compiled code calls by address, see `Code`.

    Numba compiles a function that is called by name again into every caller, and into their
    callers: the pair loop five times on the way up to the loop over steps, for every kind of scene.
    Called by address, it is compiled once.
    """

    def __init__(self, function, **options):
        self.function, self.options = function, options
        self.name = function.__module__, function.__name__
        self.compiled = {}

    def address(self, arguments_type: TaskArguments) -> int:
        """Address of the machine code for arguments of this type, which is compiled or read from
        the cache.

        Processes that need the same code compile it once: the others wait, and read it from the
        cache.
        """
        if not self.is_ready(arguments_type):
            digest = hashlib.sha256(repr((self.name, arguments_type)).encode()).hexdigest()[:16]
            with lock_in_cache(digest, LONGEST_WAIT):
                code = compile_callback(self.function, (arguments_type, types.intp), self.options)
            # the code of another thread may already be in use
            self.compiled.setdefault(arguments_type, code)
        return self.compiled[arguments_type].address

    def is_ready(self, arguments_type: TaskArguments) -> bool:
        """Whether `address` has nothing to compile. Code in the cache is read."""
        if arguments_type not in self.compiled:
            thread_pool.start_workers()
            with contextlib.suppress(NotStored):
                code = compile_callback(
                    self.function, (arguments_type, types.intp), self.options, stored_only=True
                )
                self.compiled.setdefault(arguments_type, code)
        return arguments_type in self.compiled


def task(*, count_references=True):
    """Decorator that makes a `CompiledTask` of a function, with the options of `kernel`."""
    return lambda function: CompiledTask(
        function, **compiler_options(count_references=count_references)
    )


def addresses_of(pairs: Sequence[tuple[CompiledTask, TaskArguments]]) -> np.ndarray:
    """Addresses (n,) of the machine code of tasks for types of arguments, which is compiled or read
    from the cache.

    While tasks are only collected (`compile_together`), the addresses are 0.
    """
    collected = _collected.get()
    if collected is not None:
        collected.extend(pairs)
        return np.zeros(len(pairs), np.intp)
    return np.array([one.address(kind) for one, kind in pairs], np.intp)


class Code:
    """Machine code of named tasks, each for arguments of one type; `call` and `call_blocks` check
    that type.

    Code(fill=(_fill, pairs), sites=(_sites, (pairs, sites, state))) compiles the tasks, or reads
    them from the cache.
    """

    def __init__(self, **tasks: tuple[CompiledTask, object]):
        kinds = {name: arguments_type(content) for name, (_, content) in tasks.items()}
        self._addresses = addresses_of([(tasks[name][0], kind) for name, kind in kinds.items()])
        self.address_value = self._addresses.ctypes.data
        self.numba_type = code_type(tuple(kinds.items()))
        self._names = list(tasks)

    def address(self, name: str) -> int:
        """Address of a task."""
        return int(self._addresses[self._names.index(name)])

    def to_struct(self, content: object) -> NumbaStruct:
        """Arguments in memory, for every task. Raises TypingError if one was compiled for another
        type."""
        struct, kind = NumbaStruct(content), arguments_type(content)
        for name in self._names:
            self.numba_type.index_of(name, kind)
        return struct


class CodeType(types.Type):
    """Numba type of a `Code`: its tasks, and the type of arguments that each accepts. Its value is
    `address_value`."""

    bitwidth = 64

    def __init__(self, task_types: tuple[tuple[str, TaskArguments], ...]):
        self.task_types = task_types
        # a digest, because this name becomes part of the name of every function compiled for it
        digest = hashlib.sha256(repr(task_types).encode()).hexdigest()[:16]
        super().__init__(f"code({digest})")
        # The same in every process, because types are pickled. Numba needs the hash in every call
        # from Python, and hashing all these types takes half a millisecond.
        self._hash = int(digest[:15], 16)

    def __hash__(self):
        return self._hash

    @property
    def key(self):
        return self.task_types

    def index_of(self, name: str, kind: TaskArguments) -> int:
        """Index of a task's address. Raises TypingError if the task is unknown or accepts another
        type of arguments."""
        names = [known for known, _ in self.task_types]
        if name not in names:
            raise TypingError(f"unknown task {name}; the tasks are {', '.join(names)}")
        if self.task_types[names.index(name)][1] != kind:
            raise TypingError(
                f"{name} was compiled for {self.task_types[names.index(name)][1]}, not for {kind}"
            )
        return names.index(name)


@cache
def code_type(task_types: tuple[tuple[str, TaskArguments], ...]) -> CodeType:
    """The type of a `Code` with these tasks."""
    return CodeType(task_types)


@typeof_impl.register(Code)
def _typeof_code(value, context):
    return value.numba_type


register_model(CodeType)(models.IntegerModel)


@unbox(CodeType)
def _unbox_code(kind, value, context):
    number = context.pyapi.object_getattr_string(value, "address_value")
    address = context.pyapi.long_as_ulonglong(number)
    context.pyapi.decref(number)
    return NativeValue(
        address, is_error=cgutils.is_not_null(context.builder, context.pyapi.err_occurred())
    )


@intrinsic(prefer_literal=True)
def address_of(typing, code, name, task_arguments):
    """Address of the machine code of a task, for arguments of the type for which it was
    compiled."""
    if not isinstance(name, types.StringLiteral):
        raise TypingError("the name of a task must be a literal")
    index = code.index_of(name.literal_value, task_arguments)

    def emit(context, builder, signature, arguments):
        word = ir.IntType(64)
        table = builder.inttoptr(arguments[0], POINTER)
        return builder.load(builder.gep(table, [word(index)], source_etype=word), typ=word)

    return types.intp(code, name, task_arguments), emit


class BoundTask:
    """A task with its arguments, for Python to call without holding its lock.

    A call takes a microsecond. Numba's dispatcher would inspect every array in every call, and
    after a segment of computing neither they nor that code are in the cache of the core.

    content : a tuple; its arrays are kept, and their present values are the input of the task
    """

    def __init__(self, task: CompiledTask, content: tuple):
        code = Code(task=(task, content))
        self._content = code.to_struct(content)
        self._function = ctypes.CFUNCTYPE(None, ctypes.c_ssize_t, ctypes.c_ssize_t)(
            code.address("task")
        )

    def __call__(self) -> None:
        self._function(self._content.address, 0)


@chosen_by_type(inline=True, prefer_literal=True)
def call_blocks(code, name, task_arguments, blocks):
    """Call a task for every block; on all threads if there are several blocks."""

    def call_blocks(code, name, task_arguments, blocks):
        address = address_of(code, name, task_arguments)
        if blocks == 1:
            thread_pool.call_address(address, task_arguments, 0)
        else:
            thread_pool.run_on_all_threads(address, task_arguments, blocks)

    return call_blocks


# --- two processes that compile -------------------------------------------------------------------

#: Held while codes are compiled together: of several runs at once, one compiles and the others read
#: its result.
_compiling = threading.RLock()
#: Tasks of each `Code` while they are only collected and not compiled, in this thread; None
#: otherwise.
_collected: ContextVar[list[tuple[CompiledTask, TaskArguments]] | None] = ContextVar(
    "collected", default=None
)
#: Least number of tasks for a second process; for fewer, importing the package there takes longer.
FEWEST_TASKS = 3
#: Program of the second process.
SECOND_PROGRAM = "from rigidmd.compile import code; code.compile_requested()"


def compile_together(make: Callable[[], object]) -> None:
    """Compile every `Code` that a function makes, in two processes if that saves time.

    Python and LLVM compile one function at a time per process. A second process begins with the
    last task, and this one with the first: on two idle cores the first steps of 216 waters come
    after 37 s instead of 54 s. The environment variable `RIGIDMD_COMPILERS` is the number of
    processes, 1 or 2. The function is first called only to collect the tasks and types of its
    codes. These have no addresses, so it must not call them.
    """
    if (named := os.environ.get("RIGIDMD_COMPILERS", "2")) not in ("1", "2"):
        raise SettingError(f"RIGIDMD_COMPILERS is {named[:40]!r}, must be 1 or 2")
    if named == "1" or MOST_THREADS == 1 or not sys.executable or not is_persistent():
        return
    with _compiling:
        collected: list[tuple[CompiledTask, TaskArguments]] = []
        before = _collected.set(collected)
        try:
            make()
        finally:
            _collected.reset(before)
        missing = [
            (*one.name, kind) for one, kind in dict.fromkeys(collected) if not one.is_ready(kind)
        ]
        if len(missing) >= FEWEST_TASKS:
            with second_process(missing):
                make()


@contextlib.contextmanager
def second_process(wanted: Sequence[tuple[str, str, TaskArguments]]) -> Iterator[None]:
    """Within the block a second process compiles tasks (module, name, type), unless their types
    cannot be pickled."""
    process = None
    with contextlib.suppress(OSError, pickle.PicklingError, TypeError, AttributeError):
        content = pickle.dumps(wanted)
        process = subprocess.Popen(
            **python_process("-c", SECOND_PROGRAM),
            stdin=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            **SEPARATE_GROUP,  # Ctrl-C goes to this process, which then ends the other
        )
        assert process.stdin is not None
        process.stdin.write(content)
        process.stdin.close()
    try:
        yield
    finally:
        if process is not None:
            process.kill()
            process.wait()


def compile_requested() -> None:
    """In the second process: compile the tasks listed on standard input, the last one first."""
    for module, name, arguments_type in reversed(pickle.load(sys.stdin.buffer)):
        getattr(importlib.import_module(module), name).address(arguments_type)
