"""Loads and stores of SIMD vectors: of neighbouring numbers, and of records, one in each lane.

A transposed load of records, rows of an array (n, 3) or (n, 3, 3), loads a square block as one
vector per record and transposes it in registers. The remaining numbers of a record are loaded one
by one.
"""

from math import prod

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rigidmd.compile.kernels import kernel
from rigidmd.compile.machine import SIMD_BITS, cast_pointer
from rigidmd.compile.simd_types import LANE_COUNTS, Lanes, emit_broadcast, lanes_like, shuffle


def lane_count(dtype) -> int:
    """Number of lanes in a vector of a NumPy dtype on this machine."""
    return SIMD_BITS // (8 * np.dtype(dtype).itemsize)


def zeros(shape: int | tuple[int, ...], dtype) -> np.ndarray:
    """Like np.zeros, aligned to vectors. NumPy aligns to 16 bytes, so that vectors of 64 bytes
    would cross cache lines, which costs the pair loop 3 to 4 %."""
    shape = (shape,) if isinstance(shape, int) else shape
    size = prod(shape) * np.dtype(dtype).itemsize
    vector = SIMD_BITS // 8
    memory = np.zeros(size + vector, np.uint8)
    start = -memory.ctypes.data % vector
    return memory[start : start + size].view(dtype).reshape(shape)


# --- vectors --------------------------------------------------------------------------------------


def is_contiguous(array, dimensions: int | None = None) -> bool:
    """Whether a Numba type is a contiguous array, of this number of dimensions."""
    return (
        isinstance(array, types.Array)
        and array.layout == "C"
        and array.ndim == (dimensions or array.ndim)
    )


def _element(context, builder, array_type, array, index):
    """Pointer to number `index` of a contiguous array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index], source_etype=context.get_data_type(array_type.dtype))


def emit_load(context, builder, array_type, array, index, kind):
    """The vector of an LLVM type that starts at array[index]."""
    address = cast_pointer(builder, _element(context, builder, array_type, array, index), kind)
    return builder.load(address, align=array_type.dtype.bitwidth // 8, typ=kind)


def emit_store(context, builder, array_type, array, index, value):
    """Write a vector to memory from array[index] on."""
    address = cast_pointer(
        builder, _element(context, builder, array_type, array, index), value.type
    )
    builder.store(value, address, align=array_type.dtype.bitwidth // 8)


def _load(array, count, *unused):
    lanes = Lanes(array.dtype, count)

    def emit(context, builder, signature, arguments):
        return emit_load(context, builder, array, *arguments[:2], context.get_value_type(lanes))

    return lanes(array, types.intp, *unused), emit


@intrinsic
def load(typing, array, index):
    """The vector array[index], array[index + 1], ... of a contiguous array, indexed in C order."""
    return _load(array, LANE_COUNTS[array.dtype]) if is_contiguous(array) else None


@intrinsic
def load_with_lanes_of(typing, array, index, other):
    """`load` with the number of lanes of vectors of another array."""
    return _load(array, LANE_COUNTS[other.dtype], other) if is_contiguous(array) else None


@intrinsic
def load_four(typing, array, index):
    """The vector of four numbers from array[index] on."""
    return _load(array, 4) if is_contiguous(array, 1) else None


@intrinsic
def load_eight(typing, array, index):
    """The vector of eight numbers from array[index] on."""
    return _load(array, 8) if is_contiguous(array, 1) else None


@intrinsic
def load_scalar(typing, array, index):
    """array[index] for an index >= 0, without Numba's test for negative ones at each access in the
    pair loop."""
    if not is_contiguous(array, 1):
        return None

    def emit(context, builder, signature, arguments):
        address = _element(context, builder, array, *arguments)
        return builder.load(address, typ=context.get_data_type(array.dtype))

    return array.dtype(array, types.intp), emit


@intrinsic
def broadcast(typing, number, array):
    """A vector of the type of an array with the same number in every lane."""
    lanes = lanes_like(array)
    return lanes(number, array), lambda context, b, _, given: emit_broadcast(
        context, b, given[0], number, lanes
    )


@kernel(inline=True, count_references=False)
def load_broadcast(array, index):
    """A vector with array[index] in every lane."""
    return broadcast(load_scalar(array, index), array)


@intrinsic
def store(typing, array, index, lanes):
    """Write a vector to array[index], array[index + 1], ..."""

    def emit(context, builder, signature, arguments):
        emit_store(context, builder, array, *arguments)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), emit


@intrinsic
def store_even_lanes(typing, array, index, x):
    """Write the integer parts, 0 to 127, of lanes 0, 2, 4, ... of a vector to an array of bytes
    from an index on.

    Lane 1 must equal lane 0, lane 3 lane 2, and so on.
    """
    if not is_contiguous(array, 1) or array.dtype != types.uint8:
        return None
    count = x.count // 2

    def emit(context, builder, signature, arguments):
        target, index, value = arguments
        whole = builder.fptosi(value, ir.VectorType(ir.IntType(32), x.count))
        # two equal lanes are one number of 64 bits, whose lowest byte is stored: no lanes are moved
        half = builder.trunc(
            builder.bitcast(whole, ir.VectorType(ir.IntType(64), count)),
            ir.VectorType(ir.IntType(8), count),
        )
        emit_store(context, builder, array, target, index, half)
        return context.get_dummy_value()

    return types.void(array, types.intp, x), emit


@intrinsic
def align_stack(typing):
    """Align the stack of the calling function, so that vectors spilled from registers do not cross
    cache lines.

    LLVM decides whether to align it before it knows which vectors it spills. Without this, the
    alignment differed between processes: forces of PME in double precision took between 1.3 and 2.2
    ns per lane.
    """

    def emit(context, builder, signature, arguments):
        slot = cgutils.alloca_once(builder, ir.VectorType(ir.IntType(8), SIMD_BITS // 8))
        slot.align = SIMD_BITS // 8
        kind = ir.FunctionType(ir.VoidType(), [slot.type])
        builder.asm(kind, "", "r", [slot], side_effect=True)
        return context.get_dummy_value()

    return types.void(), emit


# --- records --------------------------------------------------------------------------------------


def _transpose(builder, rows: list) -> list:
    """The columns of a square matrix, given its rows as vectors."""
    count, size = len(rows), 1
    while size < count:
        low = [k if not k & size else count + k - size for k in range(count)]
        high = [k + size if not k & size else count + k for k in range(count)]
        done = list(rows)
        for k in range(count):
            if not k & size:
                for at, lanes in ((k, low), (k + size, high)):
                    done[at] = shuffle(builder, rows[k], rows[k + size], lanes)
        rows, size = done, 2 * size
    return rows


def _pointers(context, builder, array, value, first, size: int, count: int):
    """Pointers to the numbers of records first ... first + count - 1, [record][number]."""
    data, kind = (
        context.make_array(array)(context, builder, value).data,
        context.get_data_type(array.dtype),
    )
    start = builder.mul(first, first.type(size))
    return [
        [
            builder.gep(data, [builder.add(start, first.type(size * n + k))], source_etype=kind)
            for k in range(size)
        ]
        for n in range(count)
    ]


def _loader(size: int):
    def load(typing, array, first):
        if not is_contiguous(array):
            return None
        lanes = lanes_like(array)
        found = types.UniTuple(lanes, size)
        count, align = lanes.count, array.dtype.bitwidth // 8

        def emit(context, builder, signature, arguments):
            kind = context.get_value_type(lanes)
            pointers = _pointers(context, builder, array, *arguments, size, count)
            columns, whole = [], size - size % count
            for k in range(0, whole, count):
                rows = [
                    builder.load(cast_pointer(builder, p[k], kind), align=align, typ=kind)
                    for p in pointers
                ]
                columns += _transpose(builder, rows)
            for k in range(whole, size):
                column = ir.Constant(kind, ir.Undefined)
                for n in range(count):
                    number = builder.load(pointers[n][k], typ=kind.element)
                    column = builder.insert_element(column, number, ir.IntType(32)(n))
                columns.append(column)
            return context.make_tuple(builder, found, columns)

        return found(array, types.intp), emit

    return intrinsic(load)


def _storer(size: int):
    def store(typing, array, first, columns):
        if not is_contiguous(array):
            return None
        lanes = lanes_like(array)
        count, align = lanes.count, array.dtype.bitwidth // 8

        def emit(context, builder, signature, arguments):
            value, first, given = arguments
            pointers = _pointers(context, builder, array, value, first, size, count)
            vectors = [builder.extract_value(given, k) for k in range(size)]
            whole = size - size % count
            for k in range(0, whole, count):
                for n, row in enumerate(_transpose(builder, vectors[k : k + count])):
                    builder.store(row, cast_pointer(builder, pointers[n][k], row.type), align=align)
            for k in range(whole, size):
                for n in range(count):
                    builder.store(
                        builder.extract_element(vectors[k], ir.IntType(32)(n)), pointers[n][k]
                    )
            return context.get_dummy_value()

        return types.void(array, types.intp, types.UniTuple(lanes, size)), emit

    return intrinsic(store)


#: (x, y, z) of records first, first + 1, ... of a contiguous array (n, 3), one record in each lane;
#: and the nine numbers, row by row, of records of an array (n, 3, 3). Both have the arguments
#: (array, first).
load_vectors, load_matrices = _loader(3), _loader(9)
#: Write such numbers, of one record from each lane: (array, first, numbers).
store_vectors, store_matrices = _storer(3), _storer(9)
