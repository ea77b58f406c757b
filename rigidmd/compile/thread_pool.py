"""Threads that share the blocks of a task, without OpenMP: they wait inside compiled code, a thread for each core.

One thread, the leader, is in the loop over steps; the helpers are Python threads that never leave `_help` and hold no
lock of Python's. A leader writes down a task, its parcel and the number of blocks, and claims blocks itself; helpers
that are awake claim blocks too, until there are none. Each thread begins with a share of its own, the same in every
task, so that what it has computed is still in its core's memory when it is needed; then it helps with what others have
left. Nobody waits for a helper that has claimed no block: one that sleeps, or whose core is busy with another program,
is not missed. So a task costs a few exchanges of a line of memory between cores, not an entry into a parallel region
and a barrier of all threads at its end.

A leader that finds the crew at work, for another leader or because a block has blocks of its own, does all its blocks
alone. The blocks of a task, not the threads, decide the bits of a result.
"""

import ctypes
import os
import threading
import time

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rigidmd.compile.kernels import compiler_options, kernel
from rigidmd.compile.machine import IS_X86, MOST_BLOCKS, MOST_THREADS
from rigidmd.compile.numba_private import compile_callback, reference_counting

WORD = ir.IntType(64)
#: Cells of the crew's memory, 8 to a line of cache: cells that different threads write are on lines of their own.
LEAD, HELPERS, POLLS = 0, 1, 2  # address of `_lead`; helpers that may help; looks of a waiting thread before it sleeps
AT_WORK = 8  # 1 while a leader has the crew
JOB = 16  # the number of the present job, even; odd while one is written down
ADDRESS, PARCEL, BLOCKS = 24, 25, 26  # the job
DONE = 32  # parts of it that are done
LEADER_SLEEPS, LEADERS_BELL = 40, 41  # 1 while the leader sleeps; the lock on which it sleeps
CLAIMED = 48  # for each part of a job the number of the last job in which it was claimed
PARTS = MOST_BLOCKS  # at most; where there are more blocks, several are a part
FIRST_HELPER, LINE = CLAIMED + PARTS, 8  # a line for each helper: 1 while it sleeps, and its lock
SLEEPS, BELL = 0, 1
SYMBOL = "rigidmd_crew"
ALLOCATE, ACQUIRE, RELEASE = "PyThread_allocate_lock", "PyThread_acquire_lock", "PyThread_release_lock"
#: A thread that waits looks again and again for so long, in seconds, before it sleeps: longer than from one task to the
#: next, shorter than another program would mind.
WAIT = 50e-6


def _on_cell(emit_on, result=types.int64):
    """An intrinsic (address of the crew, cell, ...) of whole numbers."""

    def typed(typing, crew, cell, *values):
        def emit(context, builder, signature, arguments):
            at = builder.inttoptr(builder.add(arguments[0], builder.mul(arguments[1], WORD(8))), WORD.as_pointer())
            return emit_on(builder, at, *arguments[2:])

        return result(types.intp, types.intp, *(types.int64 for _ in values)), emit

    return typed


@intrinsic
def _read(typing, crew, cell):
    """The number in a cell."""
    return _on_cell(lambda b, at: b.load_atomic(at, "seq_cst", 8))(typing, crew, cell)


@intrinsic
def _write(typing, crew, cell, value):
    """Write a number into a cell; returns the one before."""
    return _on_cell(lambda b, at, value: b.atomic_rmw("xchg", at, value, "seq_cst"))(typing, crew, cell, value)


@intrinsic
def _add(typing, crew, cell, value):
    """Add a number to that in a cell; returns the one before."""
    return _on_cell(lambda b, at, value: b.atomic_rmw("add", at, value, "seq_cst"))(typing, crew, cell, value)


@intrinsic
def _replace(typing, crew, cell, old, new):
    """Write a number into a cell if it holds another, and whether it did."""

    def emit(builder, at, old, new):
        return builder.extract_value(builder.cmpxchg(at, old, new, "seq_cst", "seq_cst"), 1)

    return _on_cell(emit, types.boolean)(typing, crew, cell, old, new)


@intrinsic
def _pause(typing):
    """Leave the core to its other thread for a moment."""

    def emit(context, builder, signature, arguments):
        if IS_X86:
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), kind), [])
        return context.get_dummy_value()

    return types.void(), emit


def _of_python(name: str, *more: ir.Constant):
    """An intrinsic (address of a lock) that calls one of Python's functions, which needs no lock of Python's itself."""

    def typed(typing, bell):
        def emit(context, builder, signature, arguments):
            kind = ir.FunctionType(ir.IntType(32) if more else ir.VoidType(), [WORD, *(one.type for one in more)])
            function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
            builder.call(function, [arguments[0], *more])
            return context.get_dummy_value()

        return types.void(types.int64), emit

    return typed


@intrinsic
def _sleep(typing, bell):
    """Sleep until the bell is rung, once for each ring."""
    return _of_python(ACQUIRE, ir.IntType(32)(1))(typing, bell)


@intrinsic
def _ring(typing, bell):
    """Wake the thread that sleeps on a bell."""
    return _of_python(RELEASE)(typing, bell)


@intrinsic
def call_address(typing, address, parcel, block):
    """Call the task at an address for a parcel, or a `Laid` value, at another."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(ir.VoidType(), [WORD, WORD])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), arguments[1:])
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.intp), emit


@kernel(counted=False)
def _take(crew, job, address, parcel, blocks, own, threads):
    """Do what is left of a job, as thread `own` of so many; whether the last part to be done was among it.

    Even threads begin with the first part of their share and go up, odd ones with the last and go down: two threads
    meet where they have done the same.
    """
    parts = min(blocks, PARTS)
    last = False
    up = own % 2 == 0
    part = own * parts // threads if up else (own + 1) * parts // threads - 1
    for _ in range(parts):
        claimed = _read(crew, CLAIMED + part)
        # A part of an earlier job has this number or a later one: all were claimed before the next job was written.
        if claimed < job and _replace(crew, CLAIMED + part, claimed, job):
            for block in range(part * blocks // parts, (part + 1) * blocks // parts):
                call_address(address, parcel, block)
            last |= _add(crew, DONE, 1) + 1 == parts
        part = (part + (1 if up else parts - 1)) % parts
    return last


def _help(crew, own):
    """What helper `own` does, for ever."""
    line = FIRST_HELPER + LINE * own
    looks = finished = 0
    while True:
        job, helpers = _read(crew, JOB), _read(crew, HELPERS)
        address, parcel, blocks = _read(crew, ADDRESS), _read(crew, PARCEL), _read(crew, BLOCKS)
        # what was read is of this job if its number is still the same
        if job != finished and job % 2 == 0 and own < helpers and _read(crew, JOB) == job:
            if _take(crew, job, address, parcel, blocks, own + 1, helpers + 1) and _replace(crew, LEADER_SLEEPS, 1, 0):
                _ring(_read(crew, LEADERS_BELL))
            finished = job
            looks = 0
        elif looks < _read(crew, POLLS):
            looks += 1
            _pause()
        else:
            looks = 0
            _write(crew, line + SLEEPS, 1)
            if _read(crew, JOB) == job or not _replace(crew, line + SLEEPS, 1, 0):
                _sleep(_read(crew, line + BELL))


def _lead(crew, address, parcel, blocks):
    """Do all blocks of a job, with the crew if it is free."""
    helpers = _read(crew, HELPERS)
    if helpers == 0 or not _replace(crew, AT_WORK, 0, 1):
        for block in range(blocks):
            call_address(address, parcel, block)
        return
    parts = min(blocks, PARTS)
    job = (_read(crew, JOB) // 2 + 1) * 2
    _write(crew, JOB, job - 1)
    _write(crew, ADDRESS, address)
    _write(crew, PARCEL, parcel)
    _write(crew, BLOCKS, blocks)
    _write(crew, DONE, 0)
    _write(crew, JOB, job)
    for own in range(min(helpers, parts - 1)):
        line = FIRST_HELPER + LINE * own
        if _read(crew, line + SLEEPS) == 1 and _replace(crew, line + SLEEPS, 1, 0):
            _ring(_read(crew, line + BELL))
    _take(crew, job, address, parcel, blocks, 0, helpers + 1)
    looks = 0
    while _read(crew, DONE) < parts:
        looks += 1
        if looks < _read(crew, POLLS):
            _pause()
        else:
            looks = 0
            _write(crew, LEADER_SLEEPS, 1)
            if _read(crew, DONE) < parts or not _replace(crew, LEADER_SLEEPS, 1, 0):
                _sleep(_read(crew, LEADERS_BELL))
    _write(crew, AT_WORK, 0)


def _look(crew, looks):
    """Look as a thread that waits does, so many times."""
    for _ in range(looks):
        _read(crew, JOB)
        _pause()


@intrinsic
def run_on_all_threads(typing, address, parcel, blocks):
    """Call the task at an address for every block of its parcel, on all threads. `start_workers` must have been called."""

    def emit(context, builder, signature, arguments):
        memory = builder.module.globals.get(SYMBOL) or ir.GlobalVariable(builder.module, WORD, SYMBOL)
        kind = ir.FunctionType(ir.VoidType(), [WORD] * 4)
        lead = builder.inttoptr(builder.load(memory), kind.as_pointer())
        parcel = builder.ptrtoint(arguments[1], WORD)
        builder.call(lead, [builder.ptrtoint(memory, WORD), arguments[0], parcel, arguments[2]])
        return context.get_dummy_value()

    return types.void(types.intp, parcel, types.intp), emit


class _Crew:
    """The crew of this process: its memory, and the helpers that have been hired."""

    def __init__(self):
        own = np.zeros(FIRST_HELPER + LINE * (MOST_THREADS + 1), np.int64)
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(own))  # helpers may still look at it while Python ends
        self.cells = own[-own.ctypes.data % 64 // 8 :]
        llvmlite.binding.add_symbol(SYMBOL, self.cells.ctypes.data)
        for name in (ACQUIRE, RELEASE):
            llvmlite.binding.add_symbol(name, ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value)
        self.wanted = MOST_THREADS
        self.hired = 0
        self.code: list = []
        self._hiring = threading.RLock()

    def start_workers(self) -> None:
        """Compile what the crew does, or read it from the cache, and hire the helpers that are wanted."""
        with self._hiring:
            if not self.code:
                options = compiler_options(False) | reference_counting(False)
                self.code = [
                    compile_callback(function, (types.int64,) * count, options)
                    for function, count in ((_lead, 4), (_help, 2), (_look, 2))
                ]
                self.cells[LEAD] = self.code[0].address
                self.cells[LEADERS_BELL] = _bell()
                self.cells[POLLS] = self._polls()
            self.hire()

    def hire(self) -> None:
        """Hire the helpers that are missing, and let as many help as are wanted. Does nothing before `start_workers`."""
        if not self.code:
            return
        with self._hiring:
            helpers = self.wanted - 1
            for own in range(self.hired, helpers):
                line = FIRST_HELPER + LINE * own
                self.cells[line + BELL] = _bell()
                does, arguments = self._c_function(1), (self.cells.ctypes.data, own)
                threading.Thread(target=does, args=arguments, name=f"rigidmd-{own + 1}", daemon=True).start()
                while self.cells[line + SLEEPS] == 0:  # on its way it needs Python's lock, which a run may keep
                    time.sleep(WAIT)
                self.hired += 1
            self.cells[HELPERS] = helpers

    def _c_function(self, which: int):
        """A function with two numbers that runs without Python's lock."""
        return ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)(self.code[which].address)

    def _polls(self) -> int:
        """Looks in the time `WAIT`."""
        look, count, fastest = self._c_function(2), 500, float("inf")
        for _ in range(3):
            began = time.perf_counter()
            look(self.cells.ctypes.data, count)
            fastest = min(fastest, time.perf_counter() - began)
        return max(1, int(count * WAIT / fastest))

    def forget(self) -> None:
        """After a fork: no helper has come along."""
        self.hired, self._hiring = 0, threading.RLock()
        self.cells[[HELPERS, AT_WORK, LEADER_SLEEPS]] = 0
        self.cells[FIRST_HELPER:] = 0
        self.cells[CLAIMED:FIRST_HELPER] = self.cells[JOB]  # nothing is left of a job that another thread had begun
        if self.code:
            self.cells[LEADERS_BELL] = _bell()


def _bell() -> int:
    """A lock of Python's that is taken: who takes it sleeps until it is released."""
    allocate, acquire = getattr(ctypes.pythonapi, ALLOCATE), getattr(ctypes.pythonapi, ACQUIRE)
    allocate.restype, acquire.argtypes = ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_int)
    lock = allocate()
    acquire(lock, 1)
    return lock


_crew = _Crew()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_crew.forget)


def start_workers() -> None:
    """Make the crew ready, at the first call: a leader can then share out blocks."""
    _crew.begin()


def set_threads(count: int) -> None:
    """Let so many threads compute, the leader and its helpers; results do not depend on it."""
    _crew.wanted = count
    if count - 1 != _crew.cells[HELPERS]:  # so it is after a fork too
        _crew.hire()
