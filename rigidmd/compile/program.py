"""Programs: tables of passes, which one runner executes.

A pass is the address of a task, the address of its arguments, the number of its blocks, and bits
for when it
acts. Python makes the table from what a scene has. The runner is compiled once for everything: it
calls row after row, and stops where a pass sets a status. The types of the arguments choose the
code of a pass, and nothing above it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rigidmd.compile.code import CompiledTask, addresses_of, arguments_type
from rigidmd.compile.kernels import kernel
from rigidmd.compile.records import NumbaStruct
from rigidmd.compile.thread_pool import call_address, run_on_all_threads

#: Acts whenever the program runs.
ALWAYS = -1


class Pass(NamedTuple):
    """A row of a program."""

    text: str  # what it does, for `rigidmd check --program`
    task: CompiledTask
    content: tuple  # its arguments
    blocks: int = 1
    when: int = ALWAYS  # bits


class Rows(NamedTuple):
    """The passes of a program as compiled code reads them. A pass that fails writes a code into
    `status`."""

    address: np.ndarray  # (rows,) intp, of the machine code
    arguments: np.ndarray  # (rows,) intp, of the arguments
    blocks: np.ndarray  # (rows,)
    when: np.ndarray  # (rows,) bits
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
        self.rows = Rows(addresses, np.zeros_like(when), np.ones_like(when), when, status)
        self._bound: dict[int, list[NumbaStruct]] = {}

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
        target[:] = [struct.address for struct in structs]
        self.rows.blocks[:] = [one.blocks for one in used]
        self._bound[id(target)] = structs

    def _used(self, passes: Sequence[Pass]) -> list[Pass]:
        return [one for one in passes if one.when & self._uses]


@kernel(from_python=True)
def run_row(rows, k):
    """Call pass k; returns its status."""
    rows.status[0] = 0
    call_row(rows, rows.arguments, k)
    return rows.status[0]


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
    """Call pass k; its status is in `rows`."""
    if rows.blocks[k] == 1:
        call_address(rows.address[k], arguments[k], 0)
    else:
        run_on_all_threads(rows.address[k], arguments[k], rows.blocks[k])


@kernel
def run_passes(rows, arguments, when):
    """Call the passes that act at `when`, bits; returns the first status that is not 0, or 0.
    arguments : their addresses, of `rows` or others"""
    rows.status[0] = 0
    for k in range(len(rows.address)):
        if rows.when[k] & when == 0:
            continue
        call_row(rows, arguments, k)
        if rows.status[0] != 0:
            break
    return rows.status[0]
