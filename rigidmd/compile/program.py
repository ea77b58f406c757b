"""Programs: tables of passes, which one runner executes.

A pass is the address of a task, the address of its arguments, the number of its blocks, bits for
when it acts, and the job to which it belongs. Python makes the table from what a scene has.
The runner is compiled once for everything: it calls row after row, those of one job together, and
stops where a pass sets a status. The types of the arguments choose the code of a pass, and nothing
above it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigidmd.compile.code import CompiledTask, addresses_of, arguments_type
from rigidmd.compile.kernels import kernel
from rigidmd.compile.machine import MOST_BLOCKS
from rigidmd.compile.records import NumbaStruct
from rigidmd.compile.thread_pool import (
    ADDRESS,
    AFTER,
    ARGUMENTS,
    AT_ONCE,
    BEGINS,
    BLOCKS,
    COLUMNS,
    MOST_ROWS,
    WITH,
    call_address,
    run_job,
    run_on_all_threads,
)

#: Acts whenever the program runs.
ALWAYS = -1
#: The job of a pass that runs when all before it are done, and which the next one waits for. Only
#: such a pass may call blocks of other tasks on all threads.
ALONE = 0
#: A chain in which each block of a pass follows the same block of the pass before, if both have the
#: same number of blocks.
JOINED = -1


class Pass(NamedTuple):
    """A row of a program."""

    text: str  # what it does, for `rigidmd check --program`
    task: CompiledTask
    content: tuple  # its arguments
    blocks: int = 1
    when: int = ALWAYS  # bits
    # neighbouring passes with the same number are one job, in which chains run at the same time
    job: int = ALONE
    chain: int = 0


class Rows(NamedTuple):
    """The passes of a program as compiled code reads them. A pass that fails writes a code into
    `status`."""

    address: np.ndarray  # (rows,) intp, of the machine code
    arguments: np.ndarray  # (rows,) intp, of the arguments
    blocks: np.ndarray  # (rows,)
    when: np.ndarray  # (rows,) bits
    job: np.ndarray  # (rows,)
    chain: np.ndarray  # (rows,)
    table: np.ndarray  # (rows, COLUMNS) memory for the table of a job
    status: np.ndarray  # (1,) 0 while all is well


class Program:
    """The passes of a program, with their machine code; keeps alive what its rows refer to.

    passes : with examples of the arguments, of the types that `bind` gives
    uses : bits; passes that act at none of these are neither compiled nor called
    status : (1,) int64, into which passes write
    """

    def __init__(self, passes: Sequence[Pass], uses: int, status: np.ndarray):
        self._uses = uses
        used = self._used(passes)
        self._kinds = [arguments_type(one.content) for one in used]
        addresses = addresses_of(
            [(one.task, kind) for one, kind in zip(used, self._kinds, strict=True)]
        )
        when = np.array([one.when for one in used], np.intp)
        arguments, blocks, job, chain = np.zeros((4, len(used)), np.intp)
        table = np.zeros((len(used), COLUMNS), np.intp)
        self.rows = Rows(addresses, arguments, blocks, when, job, chain, table, status)
        # by array of addresses: the array, the arguments, and those of `measure_block`
        self._bound: dict[int, tuple[np.ndarray, list[NumbaStruct], list[NumbaStruct]]] = {}
        self._spent: np.ndarray | None = None
        self._unmeasured = addresses

    def bind(self, passes: Sequence[Pass], arguments: np.ndarray | None = None) -> None:
        """Set the arguments of all passes, in `rows` or in another array of addresses (rows,).

        Raises TypeError if the arguments of a pass have another type than the example.
        """
        target = self.rows.arguments if arguments is None else arguments
        used = self._used(passes)
        structs = [NumbaStruct(one.content) for one in used]
        for one, kind in zip(used, self._kinds, strict=True):
            if (other := arguments_type(one.content)) is not kind and other != kind:
                name = one.task.name[1]
                raise TypeError(f"{name} was compiled for {kind}, not for {other}")
        self.rows.blocks[:] = [one.blocks for one in used]
        self.rows.job[:] = [one.job for one in used]
        self.rows.chain[:] = [one.chain for one in used]
        self._set_arguments(target, structs)

    def _set_arguments(self, target: np.ndarray, structs: list[NumbaStruct]) -> None:
        used = structs
        if self._spent is not None:
            rows = zip(self._unmeasured.tolist(), structs, self._spent, strict=True)
            used = [NumbaStruct((task, struct.address, spent)) for task, struct, spent in rows]
        self._bound[id(target)] = target, structs, used
        target[:] = [struct.address for struct in used]

    def measure(self) -> np.ndarray:
        """Measure all blocks from now on. Returns the array (rows, blocks, 8) to whose [..., 0]
        their times are added, ns; threads write to different cache lines."""
        from rigidmd.compile.stopwatch import measure_block  # for profiles only

        if self._spent is None:
            self._unmeasured = self.rows.address.copy()
            self._spent = np.zeros((len(self._unmeasured), MOST_BLOCKS, 8), int)
            kind = arguments_type((0, 0, np.zeros((MOST_BLOCKS, 8), int)))
            self.rows.address[:] = addresses_of([(measure_block, kind)])
            for target, structs, _ in list(self._bound.values()):
                self._set_arguments(target, structs)
        return self._spent

    def _used(self, passes: Sequence[Pass]) -> list[Pass]:
        return [one for one in passes if one.when & self._uses]


@kernel
def run_from(rows, when, row):
    """Call the passes from number row[0] on that act at `when`, bits. Returns the first status that
    is not 0, and the next call begins with its pass; or 0 after the last pass, and the next call
    begins with the first one."""
    rows.status[0] = 0
    while row[0] < len(rows.address):
        if rows.when[row[0]] & when != 0:
            call_row(rows, rows.arguments, row[0])
            if rows.status[0] != 0:
                return rows.status[0]
        row[0] += 1
    row[0] = 0
    return 0


@kernel(inline=True)
def call_row(rows, arguments, k):
    """Call pass k by itself; its status is in `rows`."""
    if rows.blocks[k] == 1:
        call_address(rows.address[k], arguments[k], 0)
    else:
        run_on_all_threads(rows.address[k], arguments[k], rows.blocks[k])


@kernel
def run_passes(rows, arguments, when):
    """Call the passes that act at `when`, bits; returns the first status that is not 0, or 0.
    arguments : their addresses, of `rows` or others"""
    rows.status[0] = 0
    count = 0  # of rows in the table of the next job
    job, chain = ALONE, 0  # of the last one
    for k in range(len(rows.address)):
        if rows.when[k] & when == 0:
            continue
        if rows.job[k] != job or count == MOST_ROWS:
            count = _run_collected(rows, count)
            if rows.status[0] != 0:
                return rows.status[0]
        if rows.job[k] == ALONE:
            call_row(rows, arguments, k)
            if rows.status[0] != 0:
                return rows.status[0]
        else:
            row = rows.table[count]
            row[ADDRESS], row[ARGUMENTS] = rows.address[k], arguments[k]
            row[BLOCKS], row[BEGINS] = rows.blocks[k], AT_ONCE
            if count > 0 and rows.chain[k] == chain:
                has_same_blocks = row[BLOCKS] == rows.table[count - 1, BLOCKS]
                row[BEGINS] = WITH if chain == JOINED and has_same_blocks else AFTER
            count += 1
        job, chain = rows.job[k], rows.chain[k]
    _run_collected(rows, count)
    return rows.status[0]


@kernel
def _run_collected(rows, count):
    """Run the first rows of the table of a job. Returns the number of rows in the next table: 0."""
    if count > 0:
        run_job(rows.table.ctypes.data, count, rows.status.ctypes.data)
    return 0
