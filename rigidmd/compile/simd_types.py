"""The Numba types of SIMD vectors and masks, and their operators; `simd` has the functions.

Their values are LLVM vectors. All code is portable LLVM IR and is compiled to AVX-512, AVX2, SSE or
NEON. Of Numba's private parts these files use `cgutils` and the models of arrays and tuples, of
llvmlite the builder of LLVM IR.
"""

import operator
from functools import partial

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

from rigidmd.compile.machine import SIMD_BITS

#: Number of lanes of a vector on this machine, by the type of its numbers.
LANE_COUNTS = {
    types.float32: SIMD_BITS // 32,
    types.float64: SIMD_BITS // 64,
    types.int32: SIMD_BITS // 32,
}


class Lanes(types.Type):
    """Numba type of a vector of `count` numbers."""

    def __init__(self, dtype, count):
        self.dtype, self.count = dtype, count
        super().__init__(f"lanes({count} x {dtype})")


def lanes_like(array: types.Array) -> Lanes:
    """The type of the vectors of an array."""
    return Lanes(array.dtype, LANE_COUNTS[array.dtype])


class Mask(types.Type):
    """Numba type of a truth value for each of `count` lanes."""

    dtype = types.boolean

    def __init__(self, count):
        self.count = count
        super().__init__(f"mask({count})")


@register_model(Lanes)
@register_model(Mask)
class VectorModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(
            manager, kind, ir.VectorType(manager[kind.dtype].get_value_type(), kind.count)
        )


# --- LLVM -----------------------------------------------------------------------------------------


def suffix(kind: ir.Type) -> str:
    """A type of floats or of vectors of them as the suffix of an LLVM intrinsic."""
    name = {ir.FloatType(): "f32", ir.DoubleType(): "f64"}[getattr(kind, "element", kind)]
    return f"v{kind.count}{name}" if isinstance(kind, ir.VectorType) else name


def call_llvm(builder, name: str, result: ir.Type, *arguments, flags=()):
    """Call an LLVM intrinsic."""
    kind = ir.FunctionType(result, [a.type for a in arguments])
    return builder.call(
        cgutils.get_or_insert_function(builder.module, kind, name), arguments, fastmath=flags
    )


def shuffle(builder, a, b, lanes):
    """A vector of these lanes of a and b; lanes of b are numbered after those of a."""
    return builder.shuffle_vector(
        a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes))
    )


def emitted(signature, emit):
    """An intrinsic whose code is emit(builder, ...) of its arguments."""
    return signature, lambda context, builder, _, arguments: emit(builder, *arguments)


def _conversion(dtype):
    def converted(typing, x):
        lanes = Lanes(dtype, x.count)
        change = ir.IRBuilder.fptrunc if dtype.bitwidth < x.dtype.bitwidth else ir.IRBuilder.fpext
        return lanes(x), lambda context, builder, _, given: change(
            builder, *given, context.get_value_type(lanes)
        )

    return intrinsic(converted)


#: A vector in single or double precision.
to_single, to_double = _conversion(types.float32), _conversion(types.float64)


# --- operators ------------------------------------------------------------------------------------


def _common(a, b) -> Lanes | None:
    """The vector type of two operands: a vector, and the same type or a scalar; else None."""
    if isinstance(b, Lanes):
        a, b = b, a
    return a if isinstance(a, Lanes) and (a == b or isinstance(b, types.Number)) else None


def emit_broadcast(context, builder, value, kind, lanes):
    """A value as a vector, or as a number if `lanes` is a type of numbers; a scalar is copied to
    every lane."""
    if kind == lanes or not isinstance(lanes, Lanes):
        return context.cast(builder, value, kind, lanes)
    number = context.cast(builder, value, kind, lanes.dtype)
    vector = ir.VectorType(number.type, lanes.count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, ir.IntType(32)(0))
    return shuffle(builder, first, first, [0] * lanes.count)


def emit_numbers(context, builder, values, kind, lanes) -> list:
    """The numbers of a tuple as vectors."""
    return [
        emit_broadcast(context, builder, builder.extract_value(values, k), one, lanes)
        for k, one in enumerate(kind.types)
    ]


def define(function, typer, emit, *kinds) -> None:
    """Define a function of Python for Numba types: its result by `typer`, its code by emit(context,
    builder, ...)."""
    type_callable(function)(lambda context: typer)
    for kind in kinds:
        lower_builtin(function, *kind)(emit)


def _define_operators(functions, emit, result=lambda lanes: lanes) -> None:
    """Define binary operators by emit(builder, left, right) of two vectors."""

    def typer(a, b):
        lanes = _common(a, b)
        return None if lanes is None else result(lanes)

    def lower(context, builder, signature, arguments):
        lanes, pairs = _common(*signature.args), zip(arguments, signature.args, strict=True)
        return emit(
            builder,
            *(emit_broadcast(context, builder, value, kind, lanes) for value, kind in pairs),
        )

    for function in functions:
        define(function, typer, lower, (Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes))


# A product and a sum in one expression are a multiply-add, rounded once. This is chosen here and
# not by LLVM, so that the results of a kernel follow from its source alone.


def _is_product(value) -> bool:
    return isinstance(value, ir.Instruction) and value.opname == "fmul"


def multiply_add(builder, a, b, c):
    """a b + c; rounded once on machines that do so as fast as they multiply."""
    return call_llvm(builder, f"llvm.fmuladd.{suffix(c.type)}", c.type, a, b, c)


def horner(builder, coefficients: list, x):
    """Sum of coefficients[k] x^k by Horner's rule, with the fewest operations."""
    total = coefficients[-1]
    for number in coefficients[-2::-1]:
        total = multiply_add(builder, total, x, number)
    return total


def add(builder, a, b):
    """a + b, where either may be a product."""
    if _is_product(b):
        return multiply_add(builder, *b.operands, a)
    if _is_product(a):
        return multiply_add(builder, *a.operands, b)
    return builder.fadd(a, b)


def subtract(builder, a, b):
    """a - b, where either may be a product."""
    if _is_product(b):
        return multiply_add(builder, builder.fneg(b.operands[0]), b.operands[1], a)
    if _is_product(a):
        return multiply_add(builder, *a.operands, builder.fneg(b))
    return builder.fsub(a, b)


_define_operators([operator.add, operator.iadd], add)
_define_operators([operator.sub, operator.isub], subtract)
_define_operators([operator.mul, operator.imul], ir.IRBuilder.fmul)
_define_operators([operator.truediv, operator.itruediv], ir.IRBuilder.fdiv)


_define_operators(
    [max], lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b)
)
_define_operators(
    [min], lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b)
)


def _compare(sign, builder, a, b):
    compare = (
        builder.icmp_signed if isinstance(a.type.element, ir.IntType) else builder.fcmp_ordered
    )
    return compare(sign, a, b)


for _function, _sign in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.eq, "=="),
):
    _define_operators([_function], partial(_compare, _sign), lambda lanes: Mask(lanes.count))


def _logic(emit, context, builder, signature, arguments):
    return emit(builder, *arguments)


for _function, _emit in ((operator.and_, ir.IRBuilder.and_), (operator.or_, ir.IRBuilder.or_)):
    define(
        _function,
        lambda a, b: a if isinstance(a, Mask) and a == b else None,
        partial(_logic, _emit),
        (Mask, Mask),
    )
