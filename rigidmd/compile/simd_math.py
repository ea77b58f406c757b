"""Mathematics for vectors: math.exp, log, pow, sin, cos, sqrt, fabs, and -x, x**y, abs(x); fast 1/x
and 1/sqrt(x).

A formula written with Python's `math` serves single numbers and vectors alike. In double precision
the results are accurate to about the last digit, in single precision to 2e-7; x**n with a constant
integer n is a product, with the rounding error of each factor.

Sums of a number and its rounding error must not be reassociated: no kernel has fast-math flags.

Of Numba's private parts this file uses a template of types, for powers with a constant exponent.

Methods: reduction of the argument by parts of ln 2 and pi/2 (Cody & Waite 1980), the logarithm with
s = f/(2 + f) as in fdlibm, powers from a logarithm in two doubles (Dekker 1971); polynomials are
truncated series.
"""

import math
import operator
from functools import partial
from math import factorial

from llvmlite import ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin

from rigidmd.compile.kernels import chosen_by_type
from rigidmd.compile.machine import IS_X86, SIMD_BITS
from rigidmd.compile.simd_types import (
    LANE_COUNTS,
    Lanes,
    call_llvm,
    define,
    emit_broadcast,
    emit_numbers,
    emitted,
    horner,
    shuffle,
    suffix,
    to_double,
    to_single,
)

#: ln 2 in two parts, by the bits of a number; the first ends in zero bits, so that whole multiples
#: of it are exact.
LN2 = {64: (0.693147180369123816490, 1.90821492927058770002e-10), 32: (0.693359375, -2.12194440e-4)}
#: pi/2 in three doubles.
HALF_PI = (1.5707963267948966, 6.123233995736766e-17, -1.4973849048591833e-33)
#: Arguments of sin and cos beyond this give NaN, because neighbouring numbers differ by a good part
#: of a period.
LONGEST_ANGLE = 1e13


class VectorOperations:
    """Operations on vectors of one type, each rounded as written."""

    def __init__(self, builder, lanes: Lanes):
        self.builder = builder
        self.add, self.sub, self.mul, self.div = (
            builder.fadd,
            builder.fsub,
            builder.fmul,
            builder.fdiv,
        )
        self.negative, self.choose, self.compare = (
            builder.fneg,
            builder.select,
            builder.fcmp_ordered,
        )
        self.bits, self.count = lanes.dtype.bitwidth, lanes.count
        self.is_double = self.bits == 64
        self.type = ir.VectorType(ir.DoubleType() if self.is_double else ir.FloatType(), self.count)
        self.whole = ir.VectorType(ir.IntType(self.bits), self.count)
        self.fraction_bits = 52 if self.is_double else 23
        self.bias = 1023 if self.is_double else 127
        # added to a number, it leaves the nearest integer in the last bits
        self.magic = 1.5 * 2.0**self.fraction_bits

    def number(self, x: float):
        return ir.Constant(self.type, [x] * self.count)

    def integer(self, k: int):
        return ir.Constant(self.whole, [k] * self.count)

    def call(self, name: str, *arguments):
        return call_llvm(self.builder, f"llvm.{name}.{suffix(self.type)}", self.type, *arguments)

    def fma(self, a, b, c):
        """a b + c, rounded once."""
        return self.call("fma", a, b, c)

    def as_bits(self, a):
        return self.builder.bitcast(a, self.whole)

    def as_number(self, k):
        return self.builder.bitcast(k, self.type)

    def nearest(self, a):
        """The nearest integers of small numbers: as numbers, and as integers."""
        moved = self.add(a, self.number(self.magic))
        origin = self.builder.bitcast(self.number(self.magic), self.whole)
        return self.sub(moved, self.number(self.magic)), self.builder.sub(
            self.as_bits(moved), origin
        )

    def of_integer(self, k):
        """Small integers as numbers."""
        origin = self.builder.bitcast(self.number(self.magic), self.whole)
        return self.sub(self.as_number(self.builder.add(k, origin)), self.number(self.magic))

    def polynomial(self, coefficients: list[float], x):
        """Sum of coefficients[k] x^k."""
        total = self.number(coefficients[-1])
        for c in coefficients[-2::-1]:
            total = self.fma(total, x, self.number(c))
        return total


def exponential(v: VectorOperations, x, low=None):
    """exp(x + low) with a small correction `low`."""
    least, most = (-746.0, 710.0) if v.is_double else (-104.0, 89.0)
    x = v.choose(v.compare("<", x, v.number(least)), v.number(least), x)
    x = v.choose(v.compare(">", x, v.number(most)), v.number(most), x)
    n, k = v.nearest(v.mul(x, v.number(1 / math.log(2))))
    high, rest = LN2[v.bits]
    r = v.fma(v.negative(n), v.number(high), x)
    r = v.fma(v.negative(n), v.number(rest), r)
    if low is not None:
        r = v.add(r, low)
    series = v.polynomial([1 / factorial(j) for j in range(2, 14 if v.is_double else 9)], r)
    result = v.add(v.number(1.0), v.fma(v.mul(r, r), series, r))
    half = v.builder.ashr(k, v.integer(1))  # in two factors, for results near the ends of the range
    for power in (half, v.builder.sub(k, half)):
        biased = v.builder.add(power, v.integer(v.bias))
        result = v.mul(result, v.as_number(v.builder.shl(biased, v.integer(v.fraction_bits))))
    return result


def _mantissa(v: VectorOperations, x):
    """(e, f) with x = 2^e (1 + f), 1 + f from sqrt(1/2) to sqrt(2); for x > 0."""
    b = v.builder
    least = 2.0 ** (1 - v.bias)
    tiny = v.compare("<", x, v.number(least))
    x = v.choose(tiny, v.mul(x, v.number(2.0**54)), x)
    origin = v.as_bits(v.number(math.sqrt(0.5)))
    e = b.ashr(b.sub(v.as_bits(x), origin), v.integer(v.fraction_bits))
    m = v.as_number(b.sub(v.as_bits(x), b.shl(e, v.integer(v.fraction_bits))))
    e = v.choose(tiny, b.sub(e, v.integer(54)), e)
    return v.of_integer(e), v.sub(m, v.number(1.0))


def _odd_series(v: VectorOperations, s2):
    """(log((1 + s)/(1 - s)) - 2 s)/s³ from s²."""
    return v.polynomial([2 / (2 * j + 3) for j in range(11 if v.is_double else 5)], s2)


def _logarithm_limits(v: VectorOperations, x, result):
    """The logarithm at infinity, at zero and of negative numbers."""
    result = v.choose(v.compare("==", x, v.number(math.inf)), v.number(math.inf), result)
    below = v.choose(v.compare("==", x, v.number(0.0)), v.number(-math.inf), v.number(math.nan))
    return v.choose(v.compare(">", x, v.number(0.0)), result, below)


def logarithm(v: VectorOperations, x):
    """log(x)."""
    e, f = _mantissa(v, x)
    s = v.div(f, v.add(v.number(2.0), f))
    s2 = v.mul(s, s)
    half = v.mul(v.number(0.5), v.mul(f, f))
    high, low = LN2[v.bits]
    inner = v.fma(e, v.number(low), v.mul(s, v.fma(s2, _odd_series(v, s2), half)))
    return _logarithm_limits(v, x, v.fma(e, v.number(high), v.sub(f, v.sub(half, inner))))


def real_power(v: VectorOperations, x, y):
    """x^y in double precision, for x >= 0; NaN for x < 0."""
    e, f = _mantissa(v, x)
    g = v.add(v.number(2.0), f)
    lost = v.sub(f, v.sub(g, v.number(2.0)))
    s = v.div(f, g)
    rest = v.fma(v.negative(s), lost, v.fma(v.negative(s), g, f))
    s2, twice = v.mul(s, s), v.mul(v.number(2.0), s)
    ln2_high, ln2_low = LN2[64]
    high = v.mul(e, v.number(ln2_high))  # exact
    log_high = v.add(high, twice)
    log_low = v.sub(twice, v.sub(log_high, high))
    log_low = v.fma(e, v.number(ln2_low), log_low)
    log_low = v.fma(v.number(2.0), v.div(rest, g), log_low)
    log_low = v.fma(v.mul(s, s2), _odd_series(v, s2), log_low)
    log_high = _logarithm_limits(v, x, log_high)
    product = v.mul(y, log_high)
    low = v.fma(y, log_low, v.fma(y, log_high, v.negative(product)))
    low = v.choose(v.compare("<", v.call("fabs", product), v.number(750.0)), low, v.number(0.0))
    result = exponential(v, product, low)
    return v.choose(v.compare("==", y, v.number(0.0)), v.number(1.0), result)


def _sine(v: VectorOperations, x, quarter: int):
    """sin(x + quarter pi/2)."""
    b = v.builder
    n, k = v.nearest(v.mul(x, v.number(2 / math.pi)))
    r = x
    for part in HALF_PI:
        r = v.fma(v.negative(n), v.number(part), r)
    r2 = v.mul(r, r)
    sine = v.polynomial([(-1) ** (j + 1) / factorial(2 * j + 3) for j in range(8)], r2)
    sine = v.fma(v.mul(r, r2), sine, r)
    cosine = v.polynomial([(-1) ** j / factorial(2 * j + 4) for j in range(8)], r2)
    half = v.mul(v.number(0.5), r2)
    one = v.sub(v.number(1.0), half)
    cosine = v.add(one, v.fma(v.mul(r2, r2), cosine, v.sub(v.sub(v.number(1.0), one), half)))
    k = b.add(k, v.integer(quarter))
    is_odd = b.icmp_signed("!=", b.and_(k, v.integer(1)), v.integer(0))
    is_negative = b.icmp_signed("!=", b.and_(k, v.integer(2)), v.integer(0))
    result = v.choose(is_odd, cosine, sine)
    result = v.choose(is_negative, v.negative(result), result)
    near = v.compare("<", v.call("fabs", x), v.number(LONGEST_ANGLE))
    return v.choose(near, result, v.number(math.nan))


def _in_double(v: VectorOperations, emit, *values):
    """A function of vectors, computed in double precision for every type."""
    if v.is_double:
        return emit(v, *values)
    wide = VectorOperations(v.builder, Lanes(types.float64, v.count))
    return v.builder.fptrunc(
        emit(wide, *(v.builder.fpext(value, wide.type) for value in values)), v.type
    )


#: Vector versions of Python's functions: emit(operations, value).
FUNCTIONS = {
    math.exp: exponential,
    math.log: logarithm,
    math.sin: lambda v, x: _in_double(v, lambda v, x: _sine(v, x, 0), x),
    math.cos: lambda v, x: _in_double(v, lambda v, x: _sine(v, x, 1), x),
    math.sqrt: lambda v, x: v.call("sqrt", x),
    math.fabs: lambda v, x: v.call("fabs", x),
    abs: lambda v, x: v.call("fabs", x),
    operator.neg: lambda v, x: v.negative(x),
    operator.pos: lambda v, x: x,
}


def _lower(emit, context, builder, signature, arguments):
    return emit(VectorOperations(builder, signature.return_type), *arguments)


for _function, _emit in FUNCTIONS.items():
    define(
        _function, lambda x: x if isinstance(x, Lanes) else None, partial(_lower, _emit), (Lanes,)
    )


def _integer_power(v: VectorOperations, x, n: int):
    """x^n by squaring, for a constant integer n."""
    if n == 0:
        return v.number(1.0)
    size, square, result = abs(n), x, None
    while size:
        if size & 1:
            result = square if result is None else v.mul(result, square)
        size >>= 1
        if size:
            square = v.mul(square, square)
    return v.div(v.number(1.0), result) if n < 0 else result


class _PowerType(AbstractTemplate):
    """Types of powers. A constant exponent n has its value in its type, so that integer powers are
    products."""

    def generic(self, args, kws):
        x, y = args
        if isinstance(x, Lanes) and (x == y or isinstance(y, types.Number | types.IntegerLiteral)):
            return signature(x, x, y)
        if isinstance(y, Lanes) and isinstance(x, types.Number):
            return signature(y, x, y)
        return None


def _power(context, builder, signature, arguments):
    lanes, (of_x, of_y) = signature.return_type, signature.args
    v, x = (
        VectorOperations(builder, lanes),
        emit_broadcast(context, builder, arguments[0], of_x, lanes),
    )
    if isinstance(of_y, types.IntegerLiteral):
        return _integer_power(v, x, of_y.literal_value)
    return _in_double(v, real_power, x, emit_broadcast(context, builder, arguments[1], of_y, lanes))


for _function in (operator.pow, operator.ipow, math.pow):
    _kind = {"key": _function, "prefer_literal": _function is not math.pow}
    infer_global(_function)(type(f"{_function.__name__}_of_lanes", (_PowerType,), _kind))
    for _kinds in (
        (Lanes, Lanes),
        (Lanes, types.Number),
        (types.Number, Lanes),
        (Lanes, types.IntegerLiteral),
    ):
        lower_builtin(_function, *_kinds)(_power)


# --- inverses and roots ---------------------------------------------------------------------------

#: Whether this machine has the instruction of `simd.permute_two`, and estimates of 14 bits.
HAS_AVX512 = SIMD_BITS == 512
#: Flags with which LLVM may replace a division or a root by the hardware's estimate and a Newton
#: step.
ESTIMATE_FLAGS = ("afn", "arcp", "contract", "nsz", "reassoc")


def _square_root(builder, value):
    return call_llvm(
        builder, f"llvm.sqrt.{suffix(value.type)}", value.type, value, flags=ESTIMATE_FLAGS
    )


def _inverse_value(builder, value):
    return builder.fdiv(
        ir.Constant(value.type, [1.0] * value.type.count), value, flags=ESTIMATE_FLAGS
    )


@intrinsic
def square_root(typing, x):
    """Square roots of a vector, accurate to about the last digit."""
    return emitted(x(x), _square_root)


@intrinsic
def _approximate_inverse_root(typing, x):
    """1/sqrt(x) in float32; LLVM may use the hardware estimate and a Newton step, with an error of
    2e-7."""
    return emitted(x(x), lambda b, value: _inverse_value(b, _square_root(b, value)))


@intrinsic
def _approximate_inverse(typing, x):
    """1/x in float32, likewise."""
    return emitted(x(x), _inverse_value)


#: Coefficients of e, e², ... in (1 - e)^-p - 1, for 1/x (p = 1), 1/sqrt(x) (p = 1/2) and 1/sqrt(x)³
#: (p = 3/2).
INVERSE_SERIES, ROOT_SERIES = (1.0, 1.0, 1.0), (1 / 2, 3 / 8, 5 / 16, 35 / 128)
CUBE_SERIES = (3 / 2, 15 / 8, 35 / 16, 315 / 128)


def _series_terms(x) -> int:
    """Number of terms of a series that correct the estimates of a type; 0 if it has no estimates.

    The next term is below half the last digit: e is at most 1.2e-4 with AVX-512, 7.4e-4 with older
    instructions.
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
                return call_llvm(
                    builder,
                    f"llvm.x86.avx512.{name}14.{kind}.512",
                    value.type,
                    value,
                    value,
                    everywhere,
                )
            value = builder.fptrunc(value, ir.VectorType(ir.FloatType(), x.count))
            if x.count == 2:
                value = shuffle(builder, value, value, (0, 1, 0, 1))
            kind = "avx.{}.ps.256" if x.count == 8 else "sse.{}.ps"
            value = call_llvm(builder, f"llvm.x86.{kind.format(name)}", value.type, value)
            if x.count == 2:
                value = shuffle(builder, value, value, (0, 1))
            return builder.fpext(value, context.get_value_type(x))

        return x(x), emit

    return estimated


#: 1/sqrt(x) and 1/x of a vector by the estimates of the hardware, with relative errors up to 2^-14
#: with AVX-512, else 1.5 2^-12. The second is used with AVX-512 only.
_estimate_inverse_root = intrinsic(_estimate("rsqrt"))
_estimate_inverse = intrinsic(_estimate("rcp"))


@intrinsic
def _horner(typing, coefficients, x):
    """Sum of coefficients[k] x^k."""

    def emit(context, builder, signature, arguments):
        return horner(
            builder, emit_numbers(context, builder, arguments[0], coefficients, x), arguments[1]
        )

    return x(coefficients, x), emit


# The series are explicit, because LLVM's choice depends on the processor: for some it computes a
# root and divides, for others it corrects an estimate of float32 by one step, with errors of the
# cube up to 5.8e-7 instead of 1.9e-7.
@chosen_by_type(inline=True)
def inverse_square_root(x):
    """1/sqrt(x), accurate to about the last digit."""
    if not isinstance(x, Lanes):
        return lambda x: 1 / math.sqrt(x)
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
        # One step of third order takes the float32 result from 24 bits to 53; a float64 root and
        # division are slower.
        y = to_double(_approximate_inverse_root(to_single(x)))
        e = 1.0 - x * y * y
        return y + y * e * (0.5 + 0.375 * e)

    return refined


@chosen_by_type(inline=True)
def inverse_root_and_cube(x):
    """1/sqrt(x), and two numbers whose product is 1/sqrt(x)³, each accurate to about the last
    digit.

    The caller multiplies the two in a multiply-add. An unused root costs nothing.
    """
    if isinstance(x, Lanes) and _series_terms(x):
        series, root_series = (
            (1.0, *CUBE_SERIES[: _series_terms(x)]),
            ROOT_SERIES[: _series_terms(x)],
        )

        def from_estimate(x):
            # The cube of a corrected root would take one multiplication more; pairs with a reaction
            # field then take 5 % longer (AVX-512). The root from the cube would have two more
            # rounding errors, visible in energies.
            y = _estimate_inverse_root(x)
            y2 = y * y
            e = 1.0 - x * y2
            return y + y * (e * _horner(root_series, e)), y * y2, _horner(series, e)

        return from_estimate

    def cubed(x):
        y = inverse_square_root(x)
        return y, y, y * y

    return cubed


@chosen_by_type(inline=True)
def inverse(x):
    """1/x, accurate to about the last digit."""
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
