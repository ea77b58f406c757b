"""Transposed loads and stores: lane n of a vector has a number of the n-th of successive records of an array (n, 3).

A square block of the records is loaded as one vector per record and transposed in registers. The remaining numbers of a
record are loaded one by one.
"""

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rigidmd.compile.pointers import cast_pointer
from rigidmd.compile.simd_types import LANE_COUNTS, Lanes


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
                    order = ir.Constant(ir.VectorType(ir.IntType(32), count), lanes)
                    done[at] = builder.shuffle_vector(rows[k], rows[k + size], order)
        rows, size = done, 2 * size
    return rows


def _pointers(context, builder, array, value, first, size: int, count: int):
    """Pointers to the numbers of records first ... first + count - 1, [record][number]."""
    data, kind = context.make_array(array)(context, builder, value).data, context.get_data_type(array.dtype)
    start = builder.mul(first, first.type(size))
    return [
        [builder.gep(data, [builder.add(start, first.type(size * n + k))], source_etype=kind) for k in range(size)]
        for n in range(count)
    ]


def _loader(size: int):
    def load(typing, array, first):
        if not isinstance(array, types.Array) or array.layout != "C":
            return None
        lanes = Lanes(array.dtype, LANE_COUNTS[array.dtype])
        found = types.UniTuple(lanes, size)
        count, align = lanes.count, array.dtype.bitwidth // 8

        def emit(context, builder, signature, arguments):
            kind = context.get_value_type(lanes)
            pointers = _pointers(context, builder, array, *arguments, size, count)
            columns, whole = [], size - size % count
            for k in range(0, whole, count):
                rows = [builder.load(cast_pointer(builder, p[k], kind), align=align, typ=kind) for p in pointers]
                columns += _transpose(builder, rows)
            for k in range(whole, size):
                column = ir.Constant(kind, ir.Undefined)
                for n in range(count):
                    number = builder.load(pointers[n][k], typ=kind.element)
                    column = builder.insert_element(column, number, ir.IntType(32)(n))
                columns.append(column)
            return context.make_tuple(builder, found, columns)

        return found(array, types.intp), emit

    return load


def _storer(size: int):
    def store(typing, array, first, columns):
        if not isinstance(array, types.Array) or array.layout != "C":
            return None
        lanes = Lanes(array.dtype, LANE_COUNTS[array.dtype])
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
                    builder.store(builder.extract_element(vectors[k], ir.IntType(32)(n)), pointers[n][k])
            return context.get_dummy_value()

        return types.void(array, types.intp, types.UniTuple(lanes, size)), emit

    return store


@intrinsic
def load_vectors(typing, array, first):
    """(x, y, z) of records first, first + 1, ... of a contiguous array (n, 3), one record in each lane."""
    return _loader(3)(typing, array, first)


@intrinsic
def load_matrices(typing, array, first):
    """The nine numbers, row by row, of records first, first + 1, ... of a contiguous array (n, 3, 3)."""
    return _loader(9)(typing, array, first)


@intrinsic
def store_vectors(typing, array, first, columns):
    """Write (x, y, z) to records first, first + 1, ... of a contiguous array (n, 3), one record from each lane."""
    return _storer(3)(typing, array, first, columns)


@intrinsic
def store_matrices(typing, array, first, columns):
    """Write nine numbers, row by row, to records first, first + 1, ... of a contiguous array (n, 3, 3)."""
    return _storer(9)(typing, array, first, columns)
