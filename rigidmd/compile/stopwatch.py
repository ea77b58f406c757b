"""The time that the blocks of passes take, on whichever thread they run."""

import time

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rigidmd.compile.code import load_arguments, task
from rigidmd.compile.machine import POINTER, field_address
from rigidmd.compile.thread_pool import call_address

INT32, INT64 = ir.IntType(32), ir.IntType(64)


@intrinsic
def _now(typing):
    """Nanoseconds of a clock."""

    def emit(context, builder, signature, arguments):
        kind = ir.FunctionType(INT32, [INT32, POINTER])
        name, module = "clock_gettime", builder.module
        clock = module.globals.get(name) or ir.Function(module, kind, name)
        struct = ir.LiteralStructType([INT64, INT64])
        moment = cgutils.alloca_once(builder, struct)
        address = builder.inttoptr(builder.ptrtoint(moment, INT64), POINTER)
        builder.call(clock, [INT32(time.CLOCK_MONOTONIC), address])
        seconds, rest = (
            builder.load(field_address(builder, address, struct, k), typ=INT64) for k in range(2)
        )
        return builder.add(builder.mul(seconds, INT64(1_000_000_000)), rest)

    return types.int64(), emit


@task(count_references=False)
def measure_block(arguments, block):
    """Call a block of another task, and add the time that it takes, ns, to its row of `spent`."""
    address, task_arguments, spent = load_arguments(arguments)
    began = _now()
    call_address(address, task_arguments, block)
    spent[block, 0] += _now() - began
