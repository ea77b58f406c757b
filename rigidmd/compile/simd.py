"""SIMD vectors for compiled code: a Numba type whose values are LLVM vectors.

Lanes of float32 or float64 support `+ - * /`, `max` and `min` (of x and y: y where x is NaN), mix
with scalars (which fill all lanes), compare to masks, and are loaded from and stored to contiguous
arrays. The number of lanes follows from the machine (machine.SIMD_BITS): 16 float32 with AVX-512, 8
with AVX2, otherwise 4; half as many float64. `simd_types` has the types and operators,
`simd_memory` loads and stores, `simd_math` functions of mathematics, and this file, from which
kernels import all, the other functions.

Functions that appear in formulas also accept scalars, so that one formula serves pair loops and
single numbers.
"""

# ruff: noqa: F401  (kernels import these names from here)
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from rigidmd.compile.kernels import chosen_by_type
from rigidmd.compile.simd_math import (
    HAS_AVX512,
    inverse,
    inverse_root_and_cube,
    inverse_square_root,
    square_root,
)
from rigidmd.compile.simd_memory import (
    align_stack,
    broadcast,
    emit_load,
    emit_store,
    is_contiguous,
    lane_count,
    load,
    load_broadcast,
    load_eight,
    load_four,
    load_scalar,
    load_with_lanes_of,
    store,
    store_even_lanes,
    zeros,
)
from rigidmd.compile.simd_types import (
    LANE_COUNTS,
    Lanes,
    Mask,
    call_llvm,
    emit_broadcast,
    emit_numbers,
    emitted,
    horner,
    lanes_like,
    multiply_add,
    shuffle,
    suffix,
    to_double,
    to_single,
)


@intrinsic
def pairwise_minimum(typing, x):
    """The smaller of lanes 2 k and 2 k + 1, in both lanes."""

    def emit(builder, value):
        neighbor = shuffle(builder, value, value, [k ^ 1 for k in range(x.count)])
        return builder.select(builder.fcmp_ordered("<", value, neighbor), value, neighbor)

    return emitted(x(x), emit)


@intrinsic
def select(typing, mask, x, y):
    """x where the mask is set, y elsewhere; y may be a scalar."""

    def emit(context, builder, signature, arguments):
        return builder.select(
            arguments[0],
            arguments[1],
            emit_broadcast(context, builder, arguments[2], signature.args[2], x),
        )

    return x(mask, x, y), emit


@intrinsic
def mask_bits(typing, mask):
    """The mask as an integer, bit k for lane k."""

    def emit(builder, value):
        return builder.zext(builder.bitcast(value, ir.IntType(mask.count)), ir.IntType(64))

    return emitted(types.int64(mask), emit)


@intrinsic
def lowest_bit(typing, word):
    """Index of the lowest set bit of a word that is not 0."""
    return emitted(types.int64(types.int64), lambda b, word: b.cttz(word, ir.IntType(1)(1)))


@intrinsic
def mask_from_bits(typing, word, lanes):
    """The mask for lanes of this type, with lane k from bit k of an integer."""
    mask = Mask(lanes.count)

    def emit(context, builder, signature, arguments):
        return builder.bitcast(
            builder.trunc(arguments[0], ir.IntType(mask.count)), context.get_value_type(mask)
        )

    return mask(types.int64, lanes), emit


@intrinsic
def sum_lanes(typing, x):
    """The sum of all lanes as a float64, added pairwise in a fixed order."""

    def emit(builder, value):
        value = builder.fpext(value, ir.VectorType(ir.DoubleType(), x.count))
        return builder.extract_element(_add_halves(builder, value, 1), ir.IntType(32)(0))

    return emitted(types.float64(x), emit)


def _add_halves(builder, value, count):
    """The halves of a vector added repeatedly until `count` lanes are left."""
    while value.type.count > count:
        half = value.type.count // 2
        value = builder.fadd(
            *(shuffle(builder, value, value, range(k, k + half)) for k in (0, half))
        )
    return value


@intrinsic
def add_lane_sums(typing, array, index, step, x, y):
    """Add the sums of all lanes of vectors x[k] and y[k] to array[index + k step] and array[index +
    k step + 1].

    x, y : tuples of three vectors. All six are summed together, in the precision of the array, with
    fewer instructions than six calls of `sum_lanes`.
    """
    if not is_contiguous(array, 1):
        return None
    lanes = lanes_like(array)
    three = types.UniTuple(lanes, 3)
    # part: number of lanes within which shuffling is fastest
    width, part = (
        lanes.count,
        128 // array.dtype.bitwidth,
    )

    def merged(builder, a, b, first, second):
        """The sum of two selections of lanes of a and b, the same in each part."""
        both = [
            [start + k for start in range(0, width, part) for k in lanes]
            for lanes in (first, second)
        ]
        return builder.fadd(*(shuffle(builder, a, b, lanes) for lanes in both))

    def emit(context, builder, signature, arguments):
        into, index, step, *both = arguments
        found = [[builder.extract_value(of, k) for of in both] for k in range(3)]
        if part == 2:
            sums = [
                _add_halves(builder, merged(builder, *of, (0, width), (1, width + 1)), 2)
                for of in found
            ]
        else:
            halves = (0, width, 1, width + 1), (2, width + 2, 3, width + 3)
            on_x, on_y, on_z = (merged(builder, *of, *halves) for of in found)
            halves = (0, 1, width, width + 1), (2, 3, width + 2, width + 3)
            fours = [
                _add_halves(builder, merged(builder, *of, *halves), 4)
                for of in ((on_x, on_y), (on_z, on_z))
            ]
            sums = [
                shuffle(builder, four, four, lanes) for four in fours for lanes in ((0, 1), (2, 3))
            ][:3]
        for pair in sums:
            before = emit_load(context, builder, array, into, index, pair.type)
            emit_store(context, builder, array, into, index, builder.fadd(before, pair))
            index = builder.add(index, step)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, three, three), emit


@intrinsic
def largest_lane(typing, x):
    """The largest of all lanes; undefined if a lane is NaN."""

    def emit(builder, value):
        kind = value.type
        return call_llvm(
            builder, f"llvm.vector.reduce.fmax.{suffix(kind)}", kind.element, value, flags=("nnan",)
        )

    return emitted(x.dtype(x), emit)


@intrinsic
def extract_lane(typing, x, k):
    """The number in lane k."""
    return emitted(x.dtype(x, types.intp), lambda b, vector, k: b.extract_element(vector, k))


@intrinsic
def polynomial(typing, coefficients, x):
    """Sum of coefficients[k] x^k for a tuple of floats in ascending order; x is a scalar or a
    vector.

    Even and odd powers are summed separately: two independent chains of multiply-adds, each half as
    long, overlap.
    """
    if not isinstance(coefficients, types.BaseTuple) or not isinstance(x, Lanes | types.Float):
        return None

    def emit(context, builder, signature, arguments):
        numbers, value = emit_numbers(context, builder, arguments[0], coefficients, x), arguments[1]
        square = builder.fmul(value, value)
        even = horner(builder, numbers[::2], square)
        return (
            multiply_add(builder, horner(builder, numbers[1::2], square), value, even)
            if numbers[1:]
            else even
        )

    return x(coefficients, x), emit


@intrinsic
def evaluate_cubic(typing, coefficients, t):
    """(value, derivative) at t of cubic polynomials, of which number k is valid from t = k to k +
    1.

    coefficients (4 n,) : four for each polynomial in x = t - k, in ascending order. The first one
    is extended below 0 by a straight line, the last one beyond the end. t is a float64 or a vector
    """
    lanes = t if isinstance(t, Lanes) else Lanes(types.float64, 1)
    pair = types.UniTuple(t, 2)

    def emit(context, builder, signature, arguments):
        table = context.make_array(coefficients)(context, builder, arguments[0])
        kind = context.get_data_type(coefficients.dtype)
        vector, whole = context.get_value_type(lanes), ir.VectorType(ir.IntType(64), lanes.count)
        value = arguments[1] if isinstance(t, Lanes) else builder.bitcast(arguments[1], vector)
        last = builder.sub(
            builder.sdiv(builder.extract_value(table.shape, 0), ir.IntType(64)(4)),
            ir.IntType(64)(1),
        )
        zero = ir.Constant(vector, [0.0] * lanes.count)
        begins = builder.fcmp_ordered("<", value, zero)
        step = builder.fptosi(builder.select(begins, zero, value), whole)
        parts = [ir.Constant(vector, ir.Undefined)] * 4
        starts = zero
        for k in range(lanes.count):
            lane = ir.IntType(32)(k)
            index = builder.extract_element(step, lane)
            index = builder.select(builder.icmp_signed("<", index, last), index, last)
            index = builder.select(
                builder.icmp_signed(">", index, ir.IntType(64)(0)), index, ir.IntType(64)(0)
            )
            starts = builder.insert_element(starts, builder.sitofp(index, vector.element), lane)
            address = builder.gep(
                table.data, [builder.mul(index, ir.IntType(64)(4))], source_etype=kind
            )
            for c in range(4):
                number = builder.load(
                    builder.gep(address, [ir.IntType(64)(c)], source_etype=kind), typ=kind
                )
                parts[c] = builder.insert_element(
                    parts[c], builder.fptrunc(number, vector.element), lane
                )
        x = builder.fsub(value, starts)
        curved = [builder.select(begins, zero, part) for part in parts[2:]]

        def times(k, part):
            return builder.fmul(ir.Constant(vector, [float(k)] * lanes.count), part)

        slopes = [parts[1], times(2, curved[0]), times(3, curved[1])]
        found = horner(builder, parts[:2] + curved, x), horner(builder, slopes, x)
        if not isinstance(t, Lanes):
            found = [builder.extract_element(one, ir.IntType(32)(0)) for one in found]
        return context.make_tuple(builder, pair, found)

    return pair(coefficients, t), emit


@chosen_by_type(inline=True)
def lanes_of(array):
    """Number of lanes in the vectors of an array, a constant at compile time."""
    count = LANE_COUNTS[array.dtype]
    return lambda array: count


@chosen_by_type(inline=True)
def convert_to(x, array):
    """A vector in the precision of an array."""
    if array.dtype == types.float32:
        return lambda x, array: to_single(x)
    return lambda x, array: x


@intrinsic
def split_integer_part(typing, x):
    """(integer part, remainder) of float32 lanes, rounded towards 0; undefined from 2^31 on."""
    if not isinstance(x, Lanes) or x.dtype != types.float32:
        return None
    whole = Lanes(types.int32, x.count)
    pair = types.Tuple((whole, x))

    def emit(context, builder, signature, arguments):
        step = builder.fptosi(arguments[0], context.get_value_type(whole))
        rest = builder.fsub(arguments[0], builder.sitofp(step, arguments[0].type))
        return context.make_tuple(builder, pair, (step, rest))

    return pair(x), emit


@intrinsic
def permute_two(typing, low, high, index):
    """In each lane, one of 32 float32 numbers: 0 to 15 are the lanes of `low`, 16 to 31 the lanes
    of `high`.

    Only the last five bits of an index count. One instruction of AVX-512, see HAS_AVX512: a table
    in registers.
    """
    if (low, high, index) != (
        Lanes(types.float32, 16),
        Lanes(types.float32, 16),
        Lanes(types.int32, 16),
    ):
        return None

    name = "llvm.x86.avx512.vpermi2var.ps.512"
    return emitted(
        low(low, high, index), lambda b, low, high, k: call_llvm(b, name, low.type, low, k, high)
    )
