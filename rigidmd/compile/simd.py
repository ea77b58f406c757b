"""SIMD vectors for compiled code: a Numba type whose values are LLVM vectors.

Lanes of float32 or float64 support `+ - * /`, mix with scalars (which fill all lanes), compare to masks, and are loaded
from and stored to contiguous arrays. The number of lanes follows from the machine (machine.SIMD_BITS): 16 float32 with
AVX-512, 8 with AVX2, otherwise 4; half as many float64. `simd_types` has the types and operators, this file the
functions.

Functions that appear in formulas also accept scalars, so that one formula serves pair loops and single numbers, like
those of Python's `math`, see `simd_math`.
"""

from math import prod, sqrt

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from rigidmd.compile import (
    SIMD_BITS,
    implements,
    simd_math,  # noqa: F401  (registers exp, log, ... of vectors)
)
from rigidmd.compile.machine import IS_X86
from rigidmd.compile.pointers import cast_pointer, element_pointer
from rigidmd.compile.simd_types import LANE_COUNTS, Lanes, Mask, emit_broadcast, multiply_add

#: Whether this machine has the instruction of `permute_two`, and estimates of 14 bits.
HAS_AVX512 = SIMD_BITS == 512


def lane_count(dtype) -> int:
    """Number of lanes in a vector of a NumPy dtype on this machine."""
    return SIMD_BITS // (8 * np.dtype(dtype).itemsize)


def zeros(shape: int | tuple[int, ...], dtype) -> np.ndarray:
    """Like np.zeros, aligned to vectors. NumPy aligns to 16 bytes, so that vectors of 64 bytes would cross cache lines,
    which costs the pair loop 3 to 4 %."""
    shape = (shape,) if isinstance(shape, int) else shape
    size = prod(shape) * np.dtype(dtype).itemsize
    vector = SIMD_BITS // 8
    memory = np.zeros(size + vector, np.uint8)
    start = -memory.ctypes.data % vector
    return memory[start : start + size].view(dtype).reshape(shape)


# --- memory ----------------------------------------------------------------------------------------------------------


def _address(context, builder, array_type, array, index, lanes):
    """Pointer to the vector that starts at array[index]."""
    address = element_pointer(context, builder, array_type, array, index)
    return cast_pointer(builder, address, context.get_value_type(lanes))


def _emitted(signature, emit):
    """An intrinsic whose code is emit(builder, ...) of its arguments."""
    return signature, lambda context, builder, _, arguments: emit(builder, *arguments)


def _is_contiguous(array) -> bool:
    return isinstance(array, types.Array) and array.layout == "C"


def _is_contiguous_1d(array) -> bool:
    return _is_contiguous(array) and array.ndim == 1


def _load(lanes, array):
    def emit(context, builder, signature, arguments):
        address = _address(context, builder, array, *arguments, lanes)
        return builder.load(address, align=array.dtype.bitwidth // 8, typ=context.get_value_type(lanes))

    return lanes(array, types.intp), emit


@intrinsic
def load(typing, array, index):
    """The vector array[index], array[index + 1], ... of a contiguous array, indexed in C order."""
    return _load(Lanes(array.dtype, LANE_COUNTS[array.dtype]), array) if _is_contiguous(array) else None


@intrinsic
def load_scalar(typing, array, index):
    """array[index] for an index >= 0, without Numba's test for negative ones at each access in the pair loop."""
    if not _is_contiguous_1d(array):
        return None

    def emit(context, builder, signature, arguments):
        address = element_pointer(context, builder, array, *arguments)
        return builder.load(address, typ=context.get_data_type(array.dtype))

    return array.dtype(array, types.intp), emit


@intrinsic
def load_with_lanes_of(typing, array, index, other):
    """`load` with the number of lanes of vectors of another array."""
    signature, emit = _load(Lanes(array.dtype, LANE_COUNTS[other.dtype]), array)
    return signature.return_type(array, types.intp, other), lambda c, b, s, a: emit(c, b, s, a[:2])


@intrinsic
def load_four(typing, array, index):
    """The vector of four numbers from array[index] on."""
    return _load(Lanes(array.dtype, 4), array) if _is_contiguous_1d(array) else None


@intrinsic
def load_eight(typing, array, index):
    """The vector of eight numbers from array[index] on."""
    return _load(Lanes(array.dtype, 8), array) if _is_contiguous_1d(array) else None


@intrinsic
def load_broadcast(typing, array, index):
    """A vector with array[index] in every lane."""
    if not _is_contiguous_1d(array):
        return None
    lanes = Lanes(array.dtype, LANE_COUNTS[array.dtype])

    def emit(context, builder, signature, arguments):
        address = element_pointer(context, builder, array, *arguments)
        number = builder.load(address, typ=context.get_data_type(array.dtype))
        return emit_broadcast(context, builder, number, array.dtype, lanes)

    return lanes(array, types.intp), emit


@intrinsic
def store(typing, array, index, lanes):
    """Write a vector to array[index], array[index + 1], ..."""

    def emit(context, builder, signature, arguments):
        target, index, value = arguments
        address = _address(context, builder, array, target, index, lanes)
        builder.store(value, address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), emit


@intrinsic
def align_stack(typing):
    """Align the stack of the calling function, so that vectors spilled from registers do not cross cache lines.

    LLVM decides whether to align it before it knows which vectors it spills. Without this, the alignment differed
    between processes: forces of PME in double precision took between 1.3 and 2.2 ns per lane.
    """

    def emit(context, builder, signature, arguments):
        slot = cgutils.alloca_once(builder, ir.VectorType(ir.IntType(8), SIMD_BITS // 8))
        slot.align = SIMD_BITS // 8
        kind = ir.FunctionType(ir.VoidType(), [slot.type])
        builder.asm(kind, "", "r", [slot], side_effect=True)
        return context.get_dummy_value()

    return types.void(), emit


# --- functions of lanes ----------------------------------------------------------------------------------------------


#: Flags with which LLVM may replace a division or a root by the hardware's estimate and a Newton step.
ESTIMATE_FLAGS = ("afn", "arcp", "contract", "nsz", "reassoc")


def _call(builder, name, result, *arguments, flags=()):
    """Call an LLVM intrinsic."""
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), arguments, fastmath=flags)


def _suffix(kind) -> str:
    """A vector type as the suffix of an LLVM intrinsic."""
    element = {ir.FloatType(): "f32", ir.DoubleType(): "f64"}.get(kind.element) or f"i{kind.element.width}"
    return f"v{kind.count}{element}"


def _square_root(builder, value):
    return _call(builder, f"llvm.sqrt.{_suffix(value.type)}", value.type, value, flags=ESTIMATE_FLAGS)


def _inverse_value(builder, value):
    return builder.fdiv(ir.Constant(value.type, [1.0] * value.type.count), value, flags=ESTIMATE_FLAGS)


@intrinsic
def square_root(typing, x):
    """Square roots of a vector, accurate to about the last digit."""
    return _emitted(x(x), _square_root)


@intrinsic
def _approximate_inverse_root(typing, x):
    """1/sqrt(x) in float32; LLVM may use the hardware estimate and a Newton step, with an error of 2e-7."""
    return _emitted(x(x), lambda b, value: _inverse_value(b, _square_root(b, value)))


@intrinsic
def _approximate_inverse(typing, x):
    """1/x in float32, likewise."""
    return _emitted(x(x), _inverse_value)


def _conversion(dtype):
    def converted(typing, x):
        lanes = Lanes(dtype, x.count)

        def emit(context, builder, signature, arguments):
            target = context.get_value_type(lanes)
            if x.dtype == dtype:
                return arguments[0]
            change = builder.fptrunc if dtype.bitwidth < x.dtype.bitwidth else builder.fpext
            return change(arguments[0], target)

        return lanes(x), emit

    return converted


to_single = intrinsic(_conversion(types.float32))
to_double = intrinsic(_conversion(types.float64))


#: Coefficients of e, e², ... in (1 - e)^-p - 1, for 1/x (p = 1), 1/sqrt(x) (p = 1/2) and 1/sqrt(x)³ (p = 3/2).
INVERSE_SERIES, ROOT_SERIES = (1.0, 1.0, 1.0), (1 / 2, 3 / 8, 5 / 16, 35 / 128)
CUBE_SERIES = (3 / 2, 15 / 8, 35 / 16, 315 / 128)


def _series_terms(x) -> int:
    """Number of terms of a series that correct the estimates of a type; 0 if it has no estimates.

    The next term is below half the last digit: e is at most 1.2e-4 with AVX-512, 7.4e-4 with older instructions.
    """
    if not IS_X86 or x.count not in (2, 4, 8, 16):
        return 0
    return (1 if x.dtype == types.float32 else 3) + (not _fills_avx512(x))


def _fills_avx512(x) -> bool:
    """Whether a vector type fills the registers of AVX-512."""
    return HAS_AVX512 and x.count == LANE_COUNTS.get(x.dtype)


def _estimate(name):
    def estimated(typing, x):
        def emit(context, builder, signature, arguments):
            value = arguments[0]
            if _fills_avx512(x):
                everywhere = ir.Constant(ir.IntType(max(8, x.count)), -1)
                kind = {types.float32: "ps", types.float64: "pd"}[x.dtype]
                return _call(builder, f"llvm.x86.avx512.{name}14.{kind}.512", value.type, value, value, everywhere)
            if x.dtype == types.float64:
                value = builder.fptrunc(value, ir.VectorType(ir.FloatType(), x.count))
            if x.count == 2:
                value = _shuffle(builder, value, value, (0, 1, 0, 1))
            kind = "avx.{}.ps.256" if x.count == 8 else "sse.{}.ps"
            value = _call(builder, f"llvm.x86.{kind.format(name)}", value.type, value)
            if x.count == 2:
                value = _shuffle(builder, value, value, (0, 1))
            return value if x.dtype == types.float32 else builder.fpext(value, context.get_value_type(x))

        return x(x), emit

    return estimated


#: 1/sqrt(x) and 1/x of a vector by the estimates of the hardware, with relative errors up to 2^-14 with AVX-512, else
#: 1.5 2^-12. The second is used with AVX-512 only.
_estimate_inverse_root = intrinsic(_estimate("rsqrt"))
_estimate_inverse = intrinsic(_estimate("rcp"))


@intrinsic
def _horner(typing, coefficients, x):
    """Sum of coefficients[k] x^k by Horner's rule, with the fewest operations."""

    def emit(context, builder, signature, arguments):
        kinds = signature.args[0].types
        found = None
        for k in reversed(range(len(kinds))):
            number = emit_broadcast(context, builder, builder.extract_value(arguments[0], k), kinds[k], x)
            found = number if found is None else multiply_add(builder, found, arguments[1], number)
        return found

    return x(coefficients, x), emit


def inverse_square_root(x):
    """1/sqrt(x), accurate to about the last digit."""
    raise TypeError("compiled code only")


# The series are explicit, because LLVM's choice depends on the processor: for some it computes a root and divides, for
# others it corrects an estimate of float32 by one step, with errors of the cube up to 5.8e-7 instead of 1.9e-7.
@implements(inverse_square_root, inline=True)
def _inverse_square_root(x):
    if not isinstance(x, Lanes):
        return lambda x: 1 / sqrt(x)
    if terms := _series_terms(x):
        series = ROOT_SERIES[:terms]

        def from_estimate(x):
            y = _estimate_inverse_root(x)
            e = 1.0 - x * y * y
            return y + y * (e * _horner(series, e))

        return from_estimate

    if x.dtype == types.float32:
        return lambda x: _approximate_inverse_root(x)

    def refined(x):
        # One step of third order takes the float32 result from 24 bits to 53; a float64 root and division are slower.
        y = to_double(_approximate_inverse_root(to_single(x)))
        e = 1.0 - x * y * y
        return y + y * e * (0.5 + 0.375 * e)

    return refined


def inverse_root_and_cube(x):
    """1/sqrt(x), and two numbers whose product is 1/sqrt(x)³, each accurate to about the last digit.

    The caller multiplies the two in a multiply-add. An unused root costs nothing.
    """
    raise TypeError("compiled code only")


@implements(inverse_root_and_cube, inline=True)
def _inverse_root_and_cube(x):
    if isinstance(x, Lanes) and _series_terms(x):
        series, root_series = (1.0, *CUBE_SERIES[: _series_terms(x)]), ROOT_SERIES[: _series_terms(x)]

        def from_estimate(x):
            # The cube of a corrected root would take one multiplication more; pairs with a reaction field then take 5 %
            # longer (AVX-512). The root from the cube would have two more rounding errors, visible in energies.
            y = _estimate_inverse_root(x)
            y2 = y * y
            e = 1.0 - x * y2
            return y + y * (e * _horner(root_series, e)), y * y2, _horner(series, e)

        return from_estimate

    def cubed(x):
        y = inverse_square_root(x)
        return y, y, y * y

    return cubed


@intrinsic
def pairwise_minimum(typing, x):
    """The smaller of lanes 2 k and 2 k + 1, in both lanes."""

    def emit(builder, value):
        neighbor = _shuffle(builder, value, value, [k ^ 1 for k in range(x.count)])
        return builder.select(builder.fcmp_ordered("<", value, neighbor), value, neighbor)

    return _emitted(x(x), emit)


@intrinsic
def store_even_lanes(typing, array, index, x):
    """Write the integer parts, 0 to 127, of lanes 0, 2, 4, ... of a vector to an array of bytes from an index on.

    Lane 1 must equal lane 0, lane 3 lane 2, and so on.
    """
    if not _is_contiguous_1d(array) or array.dtype != types.uint8:
        return None
    count = x.count // 2

    def emit(context, builder, signature, arguments):
        target, index, value = arguments
        whole = builder.fptosi(value, ir.VectorType(ir.IntType(32), x.count))
        # two equal lanes are one number of 64 bits, whose lowest byte is stored: no lanes are moved
        half = builder.trunc(
            builder.bitcast(whole, ir.VectorType(ir.IntType(64), count)), ir.VectorType(ir.IntType(8), count)
        )
        address = element_pointer(context, builder, array, target, index)
        builder.store(half, cast_pointer(builder, address, half.type), align=1)
        return context.get_dummy_value()

    return types.void(array, types.intp, x), emit


def inverse(x):
    """1/x, accurate to about the last digit."""
    raise TypeError("compiled code only")


@implements(inverse, inline=True)
def _inverse(x):
    if not isinstance(x, Lanes):
        return lambda x: 1 / x
    if _fills_avx512(x):  # without AVX-512 a division in single precision is faster
        series = INVERSE_SERIES[: _series_terms(x)]

        def from_estimate(x):
            y = _estimate_inverse(x)
            e = 1.0 - x * y
            return y + y * (e * _horner(series, e))

        return from_estimate

    if x.dtype == types.float32:
        return lambda x: _approximate_inverse(x)

    def refined(x):
        y = to_double(_approximate_inverse(to_single(x)))
        e = 1.0 - x * y
        return y + y * e * (1.0 + e)

    return refined


def _selection(sign):
    def chosen(typing, x, y):
        def emit(context, builder, signature, arguments):
            a, b = (emit_broadcast(context, builder, v, k, x) for v, k in zip(arguments, signature.args, strict=True))
            return builder.select(builder.fcmp_ordered(sign, a, b), a, b)

        return x(x, y), emit

    return chosen


_vector_maximum = intrinsic(_selection(">"))
_vector_minimum = intrinsic(_selection("<"))


def maximum(x, y):
    """The larger of x and y in each lane, y if x is NaN; y may be a scalar."""
    raise TypeError("compiled code only")


@implements(maximum, inline=True)
def _maximum(x, y):
    if isinstance(x, Lanes):
        return lambda x, y: _vector_maximum(x, y)
    return lambda x, y: max(x, y)


def minimum(x, y):
    """The smaller of x and y in each lane, y if x is NaN; y may be a scalar."""
    raise TypeError("compiled code only")


@implements(minimum, inline=True)
def _minimum(x, y):
    if isinstance(x, Lanes):
        return lambda x, y: _vector_minimum(x, y)
    return lambda x, y: min(x, y)


@intrinsic
def select(typing, mask, x, y):
    """x where the mask is set, y elsewhere; y may be a scalar."""

    def emit(context, builder, signature, arguments):
        return builder.select(
            arguments[0], arguments[1], emit_broadcast(context, builder, arguments[2], signature.args[2], x)
        )

    return x(mask, x, y), emit


@intrinsic
def mask_bits(typing, mask):
    """The mask as an integer, bit k for lane k."""

    def emit(builder, value):
        word = builder.bitcast(value, ir.IntType(mask.count))
        return builder.zext(word, ir.IntType(64)) if mask.count < 64 else word

    return _emitted(types.int64(mask), emit)


@intrinsic
def lowest_bit(typing, word):
    """Index of the lowest set bit of a word that is not 0."""
    return _emitted(types.int64(types.int64), lambda b, word: b.cttz(word, ir.IntType(1)(1)))


@intrinsic
def mask_from_bits(typing, word, lanes):
    """The mask for lanes of this type, with lane k from bit k of an integer."""
    mask = Mask(lanes.count)

    def emit(context, builder, signature, arguments):
        return builder.bitcast(builder.trunc(arguments[0], ir.IntType(mask.count)), context.get_value_type(mask))

    return mask(types.int64, lanes), emit


@intrinsic
def sum_lanes(typing, x):
    """The sum of all lanes as a float64, added pairwise in a fixed order."""

    def emit(builder, value):
        if x.dtype == types.float32:
            value = builder.fpext(value, ir.VectorType(ir.DoubleType(), x.count))
        return builder.extract_element(_add_halves(builder, value, 1), ir.IntType(32)(0))

    return _emitted(types.float64(x), emit)


def _shuffle(builder, a, b, lanes):
    """A vector of these lanes of a and b; lanes of b are numbered after those of a."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


def _add_halves(builder, value, count):
    """The halves of a vector added repeatedly until `count` lanes are left."""
    while value.type.count > count:
        half = value.type.count // 2
        value = builder.fadd(*(_shuffle(builder, value, value, range(k, k + half)) for k in (0, half)))
    return value


@intrinsic
def add_lane_sums(typing, array, index, step, x, y):
    """Add the sums of all lanes of vectors x[k] and y[k] to array[index + k step] and array[index + k step + 1].

    x, y : tuples of three vectors. All six are summed together, in the precision of the array, with fewer instructions
    than six calls of `sum_lanes`.
    """
    if not _is_contiguous_1d(array):
        return None
    lanes = Lanes(array.dtype, LANE_COUNTS[array.dtype])
    three = types.UniTuple(lanes, 3)
    width, part = lanes.count, 128 // array.dtype.bitwidth  # part: number of lanes within which shuffling is fastest

    def merged(builder, a, b, first, second):
        """The sum of two selections of lanes of a and b, the same in each part."""
        both = [[start + k for start in range(0, width, part) for k in lanes] for lanes in (first, second)]
        return builder.fadd(*(_shuffle(builder, a, b, lanes) for lanes in both))

    def emit(context, builder, signature, arguments):
        into, index, step, *both = arguments
        found = [[builder.extract_value(of, k) for of in both] for k in range(3)]
        if part == 2:
            sums = [_add_halves(builder, merged(builder, *of, (0, width), (1, width + 1)), 2) for of in found]
        else:
            halves = (0, width, 1, width + 1), (2, width + 2, 3, width + 3)
            on_x, on_y, on_z = (merged(builder, *of, *halves) for of in found)
            halves = (0, 1, width, width + 1), (2, 3, width + 2, width + 3)
            fours = [_add_halves(builder, merged(builder, *of, *halves), 4) for of in ((on_x, on_y), (on_z, on_z))]
            sums = [_shuffle(builder, four, four, lanes) for four in fours for lanes in ((0, 1), (2, 3))][:3]
        data = context.make_array(array)(context, builder, into).data
        for pair in sums:
            element = builder.gep(data, [index], source_etype=context.get_data_type(array.dtype))
            address, align = cast_pointer(builder, element, pair.type), array.dtype.bitwidth // 8
            total = builder.fadd(builder.load(address, align=align, typ=pair.type), pair)
            builder.store(total, address, align=align)
            index = builder.add(index, step)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, three, three), emit


@intrinsic
def largest_lane(typing, x):
    """The largest of all lanes; undefined if a lane is NaN."""

    def emit(builder, value):
        kind = value.type
        return _call(builder, f"llvm.vector.reduce.fmax.{_suffix(kind)}", kind.element, value, flags=("nnan",))

    return _emitted(x.dtype(x), emit)


@intrinsic
def extract_lane(typing, x, k):
    """The number in lane k."""
    return _emitted(x.dtype(x, types.intp), lambda b, vector, k: b.extract_element(vector, k))


@intrinsic
def polynomial(typing, coefficients, x):
    """Sum of coefficients[k] x^k for a tuple of floats in ascending order; x is a scalar or a vector.

    Even and odd powers are summed separately: two independent chains of multiply-adds, each half as long, overlap.
    """
    if not isinstance(coefficients, types.BaseTuple) or not isinstance(x, Lanes | types.Float):
        return None

    def emit(context, builder, signature, arguments):
        values, x_value = arguments
        kinds = signature.args[0].types

        def constant(k):
            number = builder.extract_value(values, k)
            if isinstance(x, Lanes):
                return emit_broadcast(context, builder, number, kinds[k], x)
            return context.cast(builder, number, kinds[k], x)

        def chain(powers, y):
            total = constant(powers[-1])
            for k in powers[-2::-1]:
                total = multiply_add(builder, total, y, constant(k))
            return total

        square = builder.fmul(x_value, x_value)
        even, odd = range(0, len(kinds), 2), range(1, len(kinds), 2)
        found = chain(even, square)
        if len(odd):
            found = multiply_add(builder, chain(odd, square), x_value, found)
        return found

    return x(coefficients, x), emit


@intrinsic
def evaluate_cubic(typing, coefficients, t):
    """(value, derivative) at t of cubic polynomials, of which number k is valid from t = k to k + 1.

    coefficients (4 n,) : four for each polynomial in x = t - k, in ascending order. The first one is extended
    below 0 by a straight line, the last one beyond the end. t is a float64 or a vector
    """
    lanes = t if isinstance(t, Lanes) else Lanes(types.float64, 1)
    pair = types.UniTuple(t, 2)

    def emit(context, builder, signature, arguments):
        table = context.make_array(coefficients)(context, builder, arguments[0])
        kind = context.get_data_type(coefficients.dtype)
        vector, whole = context.get_value_type(lanes), ir.VectorType(ir.IntType(64), lanes.count)
        value = arguments[1] if isinstance(t, Lanes) else builder.bitcast(arguments[1], vector)
        last = builder.sub(builder.sdiv(builder.extract_value(table.shape, 0), ir.IntType(64)(4)), ir.IntType(64)(1))
        zero = ir.Constant(vector, [0.0] * lanes.count)
        begins = builder.fcmp_ordered("<", value, zero)
        step = builder.fptosi(builder.select(begins, zero, value), whole)
        parts = [ir.Constant(vector, ir.Undefined)] * 4
        starts = zero
        for k in range(lanes.count):
            lane = ir.IntType(32)(k)
            index = builder.extract_element(step, lane)
            index = builder.select(builder.icmp_signed("<", index, last), index, last)
            index = builder.select(builder.icmp_signed(">", index, ir.IntType(64)(0)), index, ir.IntType(64)(0))
            starts = builder.insert_element(starts, builder.sitofp(index, vector.element), lane)
            address = builder.gep(table.data, [builder.mul(index, ir.IntType(64)(4))], source_etype=kind)
            for c in range(4):
                number = builder.load(builder.gep(address, [ir.IntType(64)(c)], source_etype=kind), typ=kind)
                if number.type != vector.element:
                    number = builder.fptrunc(number, vector.element)
                parts[c] = builder.insert_element(parts[c], number, lane)
        x = builder.fsub(value, starts)
        curved = [builder.select(begins, zero, part) for part in parts[2:]]

        def sum_of(*terms):
            total = terms[-1]
            for term in terms[-2::-1]:
                total = multiply_add(builder, total, x, term)
            return total

        def times(k, part):
            return builder.fmul(ir.Constant(vector, [float(k)] * lanes.count), part)

        found = sum_of(*parts[:2], *curved), sum_of(parts[1], times(2, curved[0]), times(3, curved[1]))
        if not isinstance(t, Lanes):
            found = [builder.extract_element(one, ir.IntType(32)(0)) for one in found]
        return context.make_tuple(builder, pair, found)

    return pair(coefficients, t), emit


@intrinsic
def broadcast(typing, number, array):
    """A vector of the type of an array with the same number in every lane."""
    lanes = Lanes(array.dtype, LANE_COUNTS[array.dtype])

    return lanes(number, array), lambda context, b, _, arguments: emit_broadcast(
        context, b, arguments[0], number, lanes
    )


def lanes_of(array):
    """Number of lanes in the vectors of an array, a constant at compile time."""
    raise TypeError("compiled code only")


@implements(lanes_of, inline=True)
def _lanes_of(array):
    count = LANE_COUNTS[array.dtype]
    return lambda array: count


def convert_to(x, array):
    """A vector in the precision of an array."""
    raise TypeError("compiled code only")


@implements(convert_to, inline=True)
def _convert_to(x, array):
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
    """In each lane, one of 32 float32 numbers: 0 to 15 are the lanes of `low`, 16 to 31 the lanes of `high`.

    Only the last five bits of an index count. One instruction of AVX-512, see HAS_AVX512: a table in registers.
    """
    if (low, high, index) != (Lanes(types.float32, 16), Lanes(types.float32, 16), Lanes(types.int32, 16)):
        return None

    name = "llvm.x86.avx512.vpermi2var.ps.512"
    return _emitted(low(low, high, index), lambda b, low, high, k: _call(b, name, low.type, low, k, high))
