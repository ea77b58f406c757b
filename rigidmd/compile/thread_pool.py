"""A pool of threads that run the blocks of a job, without OpenMP: one per core, waiting inside
compiled code.

A job is a table of rows: a task, its arguments and the number of its blocks. A row may wait until
the row before it is done, as forces on a grid wait for the grid, or begin at once. So blocks of one
chain of rows fill the time in which another chain has none left, and threads wait at the end of a
job, not of a row.

The calling thread is in the loop over steps. The worker threads are Python threads that never leave
`_run_worker` and do not hold Python's lock. The calling thread publishes a job and runs blocks
itself. Workers that are awake run blocks too, until none is left. In each row a thread begins with
its own work range, which is the same in every job, so that data that it has computed are still in
the cache of its core; then it continues with ranges that other threads have not begun. The calling
thread does not wait for workers that have begun no range, for example because their core is busy
with another program. So a job costs a few transfers of a cache line between cores, not the start of
a parallel region and a barrier of all threads at its end.

If the pool is busy, with another calling thread or because a block itself has blocks, the calling
thread runs all its blocks alone. The blocks of a task, not the threads, determine the bits of a
result.

Measured once on two shared cores against the threading layers of Numba (`prange` over the blocks):
an empty task of 16 blocks takes 0.6 µs, with OpenMP 1.9 µs and with the work queue 70 µs. With
OpenMP 500 argon atoms make 14 % fewer steps per second and 512 waters 22 %; with the work queue 8
and 4 times fewer.

Atomic operations and the calls of Python's locks are LLVM IR that llvmlite builds; nothing of Numba
is private.
"""

import ctypes
import os
import threading
import time
import timeit

import llvmlite.binding
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rigidmd.compile.kernels import compile_callback, compiler_options, kernel
from rigidmd.compile.machine import IS_X86, MOST_BLOCKS, MOST_THREADS, POINTER, function_at

INT64 = ir.IntType(64)
#: When a row of a job begins: at once; when the row before it is done; or each of its blocks right
#: after the same block of the row before it, on the same thread.
AT_ONCE, AFTER, WITH = range(3)
#: Columns of the table of a job: addresses of the task and of its arguments, number of blocks, one
#: of the above.
ADDRESS, ARGUMENTS, BLOCKS, BEGINS = range(4)
COLUMNS = 4
MOST_ROWS = 64  # of a job
MOST_RANGES = MOST_BLOCKS  # of a row; if there are more blocks, a work range has several

# Indices of 64-bit cells in the memory of the pool. A cache line has 8; different threads write to
# different lines.
LINE = 8
# address of `_run_job`; threads in use; polls of a waiting thread before it sleeps; always 0
RUN_JOB, THREADS, POLLS, ZERO = range(4)
BUSY = LINE  # 1 while a calling thread uses the pool
JOB = 2 * LINE  # even number of the present job; odd while a job is being written
ROWS, STATUS = 3 * LINE, 3 * LINE + 1  # of the job: number of rows, address of its status
EVENTS = 4 * LINE  # grows with each new job and each row that is done
ROWS_DONE = 5 * LINE
# of each row, after its columns: ranges that are left; the last job in which it was done; for each
# range, the last job in which a thread began it
FIRST_ROW = 6 * LINE
LEFT, DONE, BEGUN = LINE, LINE + 1, 2 * LINE
ROW = BEGUN + MOST_RANGES
# of each thread, the calling one first: 1 while it sleeps; the lock on which it sleeps
FIRST_THREAD = FIRST_ROW + MOST_ROWS * ROW
SLEEPS, LOCK = range(2)
SYMBOL = "rigidmd_thread_pool"
ALLOCATE, ACQUIRE, RELEASE = (
    "PyThread_allocate_lock",
    "PyThread_acquire_lock",
    "PyThread_release_lock",
)
#: Time in seconds for which a waiting thread polls before it sleeps: longer than the time between
#: two jobs, and too short to disturb other programs. With 1 ms, steps of 4096 and 216 waters with
#: PME take as long on two idle cores, but 1.21 and 1.26 times as long if a program has one of them.
POLLING_TIME = 50e-6


def _on_cell(emit_on, *values, result=types.int64):
    """Signature and code of an intrinsic (address of the pool's memory, cell, *values), all
    integers."""

    def emit(context, builder, signature, arguments):
        address = builder.add(arguments[0], builder.mul(arguments[1], INT64(8)))
        return emit_on(builder, builder.inttoptr(address, POINTER), *arguments[2:])

    return result(types.intp, types.intp, *(types.int64 for _ in values)), emit


@intrinsic
def _read(typing, pool, cell):
    """The number in a cell."""
    return _on_cell(lambda b, at: b.load_atomic(at, "seq_cst", 8, typ=INT64))


@intrinsic
def _write(typing, pool, cell, value):
    """Write a number into a cell; returns the previous one."""
    return _on_cell(lambda b, at, value: b.atomic_rmw("xchg", at, value, "seq_cst"), value)


@intrinsic
def _add(typing, pool, cell, value):
    """Add a number to a cell; returns the previous one."""
    return _on_cell(lambda b, at, value: b.atomic_rmw("add", at, value, "seq_cst"), value)


@intrinsic
def _replace(typing, pool, cell, old, new):
    """Replace the number in a cell if it is `old`; returns whether it was."""

    def emit(builder, at, old, new):
        return builder.extract_value(builder.cmpxchg(at, old, new, "seq_cst", "seq_cst"), 1)

    return _on_cell(emit, old, new, result=types.boolean)


def _python_function(name: str, *more: ir.Constant):
    """An intrinsic (address of a lock) that calls a C function of Python which does not need
    Python's lock."""

    def typed(typing, lock):
        def emit(context, builder, signature, arguments):
            kind = ir.FunctionType(
                ir.IntType(32) if more else ir.VoidType(), [INT64, *(one.type for one in more)]
            )
            function = builder.module.globals.get(name) or ir.Function(builder.module, kind, name)
            builder.call(function, [arguments[0], *more])
            return context.get_dummy_value()

        return types.void(types.int64), emit

    return intrinsic(typed)


#: Sleep until a lock is released, once for each release.
_sleep = _python_function(ACQUIRE, ir.IntType(32)(1))
#: Wake the thread that sleeps on a lock.
_wake = _python_function(RELEASE)


@intrinsic
def _pause(typing):
    """Leave the core to its other hardware thread for a moment."""

    def emit(context, builder, signature, arguments):
        if IS_X86:
            kind = ir.FunctionType(ir.VoidType(), [])
            builder.call(builder.module.declare_intrinsic("llvm.x86.sse2.pause", (), kind), [])
        return context.get_dummy_value()

    return types.void(), emit


def _as_integer(builder, content):
    return content if isinstance(content.type, ir.IntType) else builder.ptrtoint(content, INT64)


@intrinsic
def call_address(typing, address, task_arguments, block):
    """Call the task at an address with a block and with arguments, or their address (a
    `NumbaStruct` has one)."""

    def emit(context, builder, signature, arguments):
        address, content, block = arguments
        kind = ir.FunctionType(ir.VoidType(), [INT64, INT64])
        builder.call(function_at(builder, address, kind), [_as_integer(builder, content), block])
        return context.get_dummy_value()

    content = types.intp if isinstance(task_arguments, types.Integer) else task_arguments
    return types.void(types.intp, content, types.intp), emit


@kernel(inline=True, count_references=False)
def _end_of_group(table, columns, k, rows):
    """The number of the first row after row k and those `WITH` it."""
    k += 1
    while k < rows and _read(table, k * columns + BEGINS) == WITH:
        k += 1
    return k


@kernel(count_references=False)
def _call_group(table, columns, k, rows, status, first, end):
    """Call blocks first ... end - 1 of row k of a table, each with the same block of the rows
    `WITH` it, while the status is 0."""
    end_of_group = _end_of_group(table, columns, k, rows)
    for block in range(first, end):
        for row in range(k * columns, end_of_group * columns, columns):
            if _read(status, 0) == 0:
                call_address(_read(table, row + ADDRESS), _read(table, row + ARGUMENTS), block)


@kernel(count_references=False)
def _begin_range(pool, job, row, ranges, at, step):
    """Begin a range of a row that no thread has begun, the first one from number `at` on in steps
    of 1 or -1; returns its number, or -1 if there is none."""
    for _ in range(ranges):
        begun = _read(pool, row + BEGUN + at)
        # A range of an earlier job has this number or a later one: all were begun before the next
        # job was written.
        if begun < job and _replace(pool, row + BEGUN + at, begun, job):
            return at
        at = (at + step + ranges) % ranges
    return -1


@kernel(count_references=False)
def _run_ranges_of_row(pool, job, k, rows, thread, threads):
    """Run ranges of a row until none is left, or there are new events: rows before it may have
    become ready. Returns their number, and whether ranges may be left.

    Even threads begin with their first range and go up, odd ones with their last and go down: two
    neighbouring threads meet where they have computed the same data.
    """
    row = FIRST_ROW + k * ROW
    events, blocks = _read(pool, EVENTS), _read(pool, row + BLOCKS)
    ranges = _ranges_of(blocks)
    step = 1 - 2 * (thread % 2)
    at = thread * ranges // threads
    if step < 0:
        at = max(0, (thread + 1) * ranges // threads - 1)
    # what was read belongs to this job if its number is still the same
    if _read(pool, JOB) != job:
        return 0, True
    count = 0
    while True:
        at = _begin_range(pool, job, row, ranges, at, step)
        if at < 0:
            return count, False
        low, high = at * blocks // ranges, (at + 1) * blocks // ranges
        _call_group(pool + 8 * FIRST_ROW, ROW, k, rows, _read(pool, STATUS), low, high)
        count += 1
        if _read(pool, EVENTS) != events:
            return count, True


@kernel(inline=True, count_references=False)
def _ranges_of(blocks):
    return max(1, min(blocks, MOST_RANGES))  # one without blocks ends a row that has none


@kernel(count_references=False)
def _run_ranges(pool, thread):
    """Run ranges of the present job, those of its first rows first, until none can begin. Returns
    whether any was run."""
    job, rows, threads = _read(pool, JOB), _read(pool, ROWS), _read(pool, THREADS)
    if job % 2 == 1 or thread >= threads:
        return False
    has_run = False
    k = first = 0  # the rows before `first` have no range left
    while k < rows and _read(pool, JOB) == job:
        row = FIRST_ROW + k * ROW
        end = _end_of_group(pool + 8 * FIRST_ROW, ROW, k, rows)
        count, is_left = 0, True
        if _read(pool, row + BEGINS) == AT_ONCE or _read(pool, row - ROW + DONE) == job:
            count, is_left = _run_ranges_of_row(pool, job, k, rows, thread, threads)
        if k == first and not is_left:
            first = end
        k = end
        if count > 0:
            has_run = True
            if _add(pool, row + LEFT, -count) == count:
                _finish_group(pool, job, row, end, rows)
            k = first
    return has_run


@kernel(count_references=False)
def _finish_group(pool, job, row, end, rows):
    """Rows up to number end - 1 are done, from the one in cell `row` on."""
    count = 0
    for cell in range(row, FIRST_ROW + end * ROW, ROW):
        _write(pool, cell + DONE, job)
        count += 1
    is_last = _add(pool, ROWS_DONE, count) + count == rows
    following = FIRST_ROW + end * ROW
    if end < rows and _read(pool, following + BEGINS) == AFTER:
        _announce(pool, _ranges_of(_read(pool, following + BLOCKS)) - 1)
    else:
        _announce(pool, 0)
    if is_last:
        _wake_if_asleep(pool, 0)


@kernel(count_references=False)
def _announce(pool, wanted):
    """Let waiting threads see that there may be something to do, and wake at most `wanted` that
    sleep."""
    _add(pool, EVENTS, 1)
    for thread in range(_read(pool, THREADS)):
        if wanted <= 0:
            break
        wanted -= _wake_if_asleep(pool, thread)


@kernel(count_references=False)
def _wake_if_asleep(pool, thread):
    """Wake a thread; returns the number of threads that slept."""
    line = FIRST_THREAD + LINE * thread
    if _read(pool, line + SLEEPS) == 0 or not _replace(pool, line + SLEEPS, 1, 0):
        return 0
    _wake(_read(pool, line + LOCK))
    return 1


@kernel(count_references=False)
def _wait(pool, thread, events, polls):
    """Wait while the number of events is `events`; sleep after POLLS polls. Returns the polls since
    the thread had something to do, to which `polls` are counted, or since it slept."""
    while _read(pool, EVENTS) == events:
        if polls < _read(pool, POLLS):
            polls += 1
            _pause()
        else:
            polls = 0
            line = FIRST_THREAD + LINE * thread
            _write(pool, line + SLEEPS, 1)
            if _read(pool, EVENTS) == events or not _replace(pool, line + SLEEPS, 1, 0):
                _sleep(_read(pool, line + LOCK))
    return polls


def _run_worker(pool, thread):
    """Loop of a worker thread; never returns."""
    polls = 0
    while True:
        events = _read(pool, EVENTS)
        polls = 0 if _run_ranges(pool, thread) else _wait(pool, thread, events, polls)


def _run_job(pool, table, rows, status):
    """Run the rows of a table (rows, COLUMNS), with the workers if the pool is free.

    table, status : addresses; blocks are called while the status is 0
    """
    if _read(pool, THREADS) == 1 or not _replace(pool, BUSY, 0, 1):
        for k in range(rows):
            row = k * COLUMNS
            if _read(table, row + BEGINS) != WITH:
                _call_group(table, COLUMNS, k, rows, status, 0, _read(table, row + BLOCKS))
        return
    job = (_read(pool, JOB) // 2 + 1) * 2
    _write(pool, JOB, job - 1)
    ready = 0  # ranges
    for k in range(rows):
        row = FIRST_ROW + k * ROW
        for column in range(COLUMNS):
            # what is the same as before stays in the caches of all threads
            if _read(pool, row + column) != _read(table, k * COLUMNS + column):
                _write(pool, row + column, _read(table, k * COLUMNS + column))
        ranges = _ranges_of(_read(table, k * COLUMNS + BLOCKS))
        _write(pool, row + LEFT, ranges)
        ready += ranges if _read(table, k * COLUMNS + BEGINS) == AT_ONCE else 0
    _write(pool, ROWS, rows)
    _write(pool, STATUS, status)
    _write(pool, ROWS_DONE, 0)
    _write(pool, JOB, job)
    _announce(pool, ready - 1)
    polls = 0
    while True:
        events = _read(pool, EVENTS)
        has_run = _run_ranges(pool, 0)
        if _read(pool, ROWS_DONE) == rows:
            break
        polls = 0 if has_run else _wait(pool, 0, events, polls)
    _write(pool, BUSY, 0)


def _poll(pool, count):
    """Poll `count` times as a waiting thread does."""
    for _ in range(count):
        _read(pool, EVENTS)
        _pause()


def _call_run_job(builder, table, rows, status=None):
    """Code that calls `_run_job` with pointers to the table and the status. Without a status, it is
    0."""
    memory = builder.module.globals.get(SYMBOL) or ir.GlobalVariable(builder.module, INT64, SYMBOL)
    pool = builder.ptrtoint(memory, INT64)
    status = builder.add(pool, INT64(8 * ZERO)) if status is None else status
    kind = ir.FunctionType(ir.VoidType(), [INT64] * 4)
    run_job = function_at(builder, builder.load(memory, typ=INT64), kind)
    builder.call(run_job, [pool, table, rows, status])


@intrinsic
def run_job(typing, table, rows, status):
    """Run the first rows of a table, see `_run_job`. table, status : addresses.

    `start_workers` must have been called.
    """

    def emit(context, builder, signature, arguments):
        _call_run_job(builder, *arguments)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), emit


@intrinsic
def run_on_all_threads(typing, address, task_arguments, blocks):
    """Call the task at an address for every block, on all threads; `task_arguments` as for
    `call_address`.

    `start_workers` must have been called.
    """

    def emit(context, builder, signature, arguments):
        address, content, blocks = arguments
        table = cgutils.alloca_once(builder, ir.ArrayType(INT64, COLUMNS))
        table = builder.ptrtoint(table, INT64)
        values = address, _as_integer(builder, content), blocks, INT64(AT_ONCE)
        for column, value in enumerate(values):
            cell = builder.inttoptr(builder.add(table, INT64(8 * column)), POINTER)
            builder.store(value, cell)
        _call_run_job(builder, table, INT64(1))
        return context.get_dummy_value()

    content = types.intp if isinstance(task_arguments, types.Integer) else task_arguments
    return types.void(types.intp, content, types.intp), emit


class _ThreadPool:
    """The thread pool of this process: its memory, and the workers that were started."""

    def __init__(self):
        memory = np.zeros(FIRST_THREAD + LINE * (MOST_THREADS + 1), np.int64)
        # workers may still read it while Python exits
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(memory))
        self.cells = memory[-memory.ctypes.data % 64 // 8 :]
        llvmlite.binding.add_symbol(SYMBOL, self.cells.ctypes.data)
        for name in (ACQUIRE, RELEASE):
            llvmlite.binding.add_symbol(
                name, ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value
            )
        self.wanted = MOST_THREADS
        self.started = 1  # with the calling thread
        self.code: list = []
        self._starting = threading.RLock()

    def start(self) -> None:
        """Compile the loops of the pool, or read them from the cache. Start the missing workers,
        and use as many threads as are wanted."""
        with self._starting:
            if not self.code:
                options = compiler_options(count_references=False)
                code = [
                    compile_callback(function, (types.int64,) * count, options)
                    for function, count in ((_run_job, 4), (_run_worker, 2), (_poll, 2))
                ]
                self.cells[RUN_JOB] = code[0].address
                self.cells[FIRST_THREAD + LOCK] = _new_lock()
                self.code = code
                poll, count = self._c_function(2), 500
                fastest = min(
                    timeit.repeat(lambda: poll(self.cells.ctypes.data, count), number=1, repeat=3)
                )
                self.cells[POLLS] = max(1, int(count * POLLING_TIME / fastest))
            for thread in range(self.started, self.wanted):
                line = FIRST_THREAD + LINE * thread
                self.cells[line + LOCK] = _new_lock()
                loop, arguments = self._c_function(1), (self.cells.ctypes.data, thread)
                threading.Thread(
                    target=loop, args=arguments, name=f"rigidmd-{thread}", daemon=True
                ).start()
                while (
                    self.cells[line + SLEEPS] == 0
                ):  # to start it needs Python's lock, which a run may hold later
                    time.sleep(POLLING_TIME)
                self.started += 1
            self.cells[THREADS] = self.wanted

    def _c_function(self, which: int):
        """A function of two integers that runs without Python's lock."""
        return ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64)(self.code[which].address)

    def reset_after_fork(self) -> None:
        """A child process has no workers."""
        self.started, self._starting = 1, threading.RLock()
        self.cells[[THREADS, BUSY]] = 1, 0
        self.cells[FIRST_THREAD:] = 0
        # nothing is left of a job that another thread had begun
        for k in range(MOST_ROWS):
            self.cells[FIRST_ROW + k * ROW :][BEGUN:ROW] = self.cells[JOB]
        if self.code:
            self.cells[FIRST_THREAD + LOCK] = _new_lock()


def _new_lock() -> int:
    """A lock of Python, acquired: a thread that acquires it again sleeps until it is released."""
    allocate, acquire = getattr(ctypes.pythonapi, ALLOCATE), getattr(ctypes.pythonapi, ACQUIRE)
    allocate.restype, acquire.argtypes = ctypes.c_void_p, (ctypes.c_void_p, ctypes.c_int)
    lock = allocate()
    acquire(lock, 1)
    return lock


_pool = _ThreadPool()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.reset_after_fork)


#: Starts the thread pool at the first call; calling threads can then use it.
start_workers = _pool.start


def set_threads(count: int) -> None:
    """Number of threads that compute, the calling thread included; results do not depend on it."""
    _pool.wanted = count
    # not before the first task; also after a fork
    if _pool.code and count != _pool.cells[THREADS]:
        _pool.start()
