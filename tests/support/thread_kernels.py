"""Tasks that tests of `rigidmd.compile` run, also in processes that import no more than these: they
add, and count blocks and threads."""

import numpy as np

from rigidmd.compile import Code, call_blocks, kernel, load_arguments, pack_arguments, task
from rigidmd.compile.thread_pool import _pause, _read, _write


@task(count_references=False)
def add(task_arguments, block):
    values, x = load_arguments(task_arguments)
    values[block] += x


@task()
def count_blocks(task_arguments, block):
    seen, work = load_arguments(task_arguments)
    total = 0.0
    for n in range(work):
        total += np.sqrt(n + block)
    seen[block, 0] += 1
    seen[block, 1] = total


@kernel(from_python=True)
def run_blocks(code, seen, work, times):
    for _ in range(times):
        call_blocks(code, "count", pack_arguments((seen, work)), len(seen))


def counted(blocks: int, work: int = 10, times: int = 1) -> np.ndarray:
    """How often each block was done, and its sum."""
    seen = np.zeros((blocks, 2))
    run_blocks(Code(count=(count_blocks, (seen, work))), seen, work, times)
    return seen


@task()
def meet(task_arguments, block):
    """Wait until the other of two blocks has begun, or for this many observations; note whether it
    has. `first` is added to the number of the block."""
    first, at, most = load_arguments(task_arguments)
    which = first + block
    _write(at, which, 1)
    looks = 0
    while _read(at, 1 - which) == 0 and looks < most:
        looks += 1
        _pause()
    _write(at, 2 + which, _read(at, 1 - which))


@kernel(from_python=True)
def run_meeting(code, at, most):
    call_blocks(code, "meet", pack_arguments((0, at, most)), 2)


def met(most: int) -> list[int]:
    """For each of two blocks whether the other had begun before it ended: one thread does them one
    after another."""
    cells = np.zeros(4, np.int64)
    run_meeting(Code(meet=(meet, (0, cells.ctypes.data, most))), cells.ctypes.data, most)
    return cells[2:].tolist()
