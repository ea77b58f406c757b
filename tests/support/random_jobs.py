"""Random jobs of the thread pool from several calling threads, while the number of threads changes:

    python -m support.random_jobs SECONDS CALLERS POLLS

Each block checks that it is called once, after the rows and blocks that it follows, and within its
job. Exit code 1 if one was not.
"""

import random
import sys
import threading
import time

import numba
import numpy as np

from rigidmd.compile import NumbaStruct, kernel, load_arguments, set_threads, task
from rigidmd.compile.code import addresses_of, arguments_type
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.compile.thread_pool import (
    AFTER,
    AT_ONCE,
    COLUMNS,
    MOST_ROWS,
    POLLS,
    WITH,
    _add,
    _pool,
    _read,
    _write,
    run_job,
)

#: Cells: whether a job runs, errors; then, each in a cache line, the blocks of a row that were done.
RUNS, ERRORS, DONE = 0, 1, 8
TABLES, MOST_BLOCKS_OF_ROW = 60, 200


@task(count_references=False)
def _check_block(arguments, block):
    k, begins, blocks_before, work, failing, cells, calls, status = load_arguments(arguments)
    at = cells.ctypes.data
    is_early = begins == AFTER and _read(at, DONE + 8 * (k - 1)) != blocks_before
    is_alone = begins == WITH and calls[k - 1, block] != 1
    if _read(at, RUNS) != 1 or is_early or is_alone or calls[k, block] != 0:
        _add(at, ERRORS, 1)
    calls[k, block] += 1
    total = 0.0
    for n in range(work):
        total += np.sqrt(n + block)
    if total < 0:
        calls[k, block] = 7
    _add(at, DONE + 8 * k, 1)
    if failing == block:
        status[0] = 1


@kernel(from_python=True)
def _run(table, rows, cells, calls, status):
    at = cells.ctypes.data
    status[0] = 0
    for k in range(rows):
        _write(at, DONE + 8 * k, 0)
        calls[k, : table[k, 2]] = 0
    _write(at, RUNS, 1)
    run_job(table.ctypes.data, rows, status.ctypes.data)
    _write(at, RUNS, 0)
    for k in range(rows):
        total = calls[k, : table[k, 2]].sum()
        if total != _read(at, DONE + 8 * k) or (status[0] == 0 and total != table[k, 2]):
            _add(at, ERRORS, 1)


@numba.njit(nogil=True)
def _run_several(order, tables, rows, cells, calls, status):
    for n in order:
        _run(tables[n], rows[n], cells, calls, status)


class Jobs:
    """Random tables for one calling thread."""

    def __init__(self, choose: random.Random):
        self.cells = np.zeros(DONE + 8 * MOST_ROWS, np.int64)
        calls, status = np.zeros((MOST_ROWS, MOST_BLOCKS_OF_ROW), np.int64), np.zeros(1, np.int64)
        tables = np.zeros((TABLES, MOST_ROWS, COLUMNS), np.int64)
        rows = np.array([choose.choice([1, 1, 2, 3, 5, 8, MOST_ROWS]) for _ in range(TABLES)])
        self.structs = []
        for table, count in zip(tables, rows, strict=True):
            is_failing, before = choose.random() < 0.15, 0
            for k in range(count):
                begins = choose.choice([AT_ONCE, AFTER, AFTER, WITH]) if k else AT_ONCE
                blocks = choose.choice([1, 1, 2, 3, 16, 16, 17, 128, 129, 200])
                blocks = before if begins == WITH else blocks
                failing = choose.randrange(blocks) if is_failing and choose.random() < 0.3 else -1
                work = choose.choice([0, 0, 10, 100, 2000])
                content = (k, begins, before, work, failing, self.cells, calls, status)
                self.structs.append(NumbaStruct(content))
                table[k] = 0, self.structs[-1].address, blocks, begins
                before = blocks
        kind = arguments_type(self.structs[-1].value)
        tables[..., 0] = addresses_of([(_check_block, kind)])
        self._arguments = tables, rows, self.cells, calls, status

    def run(self, order: np.ndarray) -> None:
        _run_several(order, *self._arguments)


def main(seconds: float, callers: int, polls: int) -> int:
    choose = random.Random(MOST_THREADS)
    jobs = [Jobs(choose) for _ in range(callers)]
    set_threads(MOST_THREADS)
    for one in jobs:
        one.run(np.arange(2))
    _pool.cells[POLLS] = polls  # few, so that threads sleep often
    end = time.monotonic() + seconds

    def run_until_the_end(number: int) -> None:
        generator = np.random.default_rng(number)
        while time.monotonic() < end:
            jobs[number].run(generator.integers(0, TABLES, 30))

    threads = [threading.Thread(target=run_until_the_end, args=(k,)) for k in range(callers)]
    for thread in threads:
        thread.start()
    while any(thread.is_alive() for thread in threads):
        time.sleep(0.003)
        set_threads(choose.randint(1, MOST_THREADS))
    return int(any(one.cells[ERRORS] for one in jobs))


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
