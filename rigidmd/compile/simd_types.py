"""The Numba types of SIMD vectors and masks, and their operators; `simd` has the functions.

Their values are LLVM vectors. All code is portable LLVM IR and is compiled to AVX-512, AVX2, SSE or NEON.
"""

import operator

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable

from rigidmd.compile.machine import SIMD_BITS

#: Number of lanes of a vector on this machine, by the type of its numbers.
LANE_COUNTS = {types.float32: SIMD_BITS // 32, types.float64: SIMD_BITS // 64, types.int32: SIMD_BITS // 32}


class Lanes(types.Type):
    """Numba type of a vector of `count` numbers."""

    def __init__(self, dtype, count):
        self.dtype, self.count = dtype, count
        super().__init__(f"lanes({count} x {dtype})")


class Mask(types.Type):
    """Numba type of a truth value for each of `count` lanes."""

    def __init__(self, count):
        self.count = count
        super().__init__(f"mask({count})")


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(manager[kind.dtype].get_value_type(), kind.count))


@register_model(Mask)
class MaskModel(models.PrimitiveModel):
    def __init__(self, manager, kind):
        super().__init__(manager, kind, ir.VectorType(ir.IntType(1), kind.count))


# --- operators -------------------------------------------------------------------------------------------------------


def _common(a, b) -> Lanes | None:
    """The vector type of two operands: a vector, and the same type or a scalar; else None."""
    if isinstance(b, Lanes):
        a, b = b, a
    return a if isinstance(a, Lanes) and (a == b or isinstance(b, types.Number)) else None


def emit_broadcast(context, builder, value, kind, lanes):
    """A value as a vector; a scalar is copied to every lane."""
    if kind == lanes:
        return value
    number = context.cast(builder, value, kind, lanes.dtype)
    vector = ir.VectorType(number.type, lanes.count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), number, ir.IntType(32)(0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), lanes.count), [0] * lanes.count)
    return builder.shuffle_vector(first, first, order)


def _operator(functions, emit, result=lambda lanes: lanes):
    """Define a binary operator for Numba by emit(builder, left, right) of two vectors."""
    for function in functions:

        @type_callable(function)
        def of_types(context):
            def typer(a, b):
                lanes = _common(a, b)
                return result(lanes) if lanes is not None else None

            return typer

        def lower(context, builder, signature, arguments):
            lanes = _common(*signature.args)
            left, right = (
                emit_broadcast(context, builder, v, kind, lanes)
                for v, kind in zip(arguments, signature.args, strict=True)
            )
            return emit(builder, left, right)

        for kinds in ((Lanes, Lanes), (Lanes, types.Number), (types.Number, Lanes)):
            lower_builtin(function, *kinds)(lower)


# A product and a sum in one expression are a multiply-add, rounded once. This is chosen here and not by LLVM, so that
# the results of a kernel follow from its source alone.


def _is_product(value) -> bool:
    return isinstance(value, ir.Instruction) and value.opname == "fmul"


def multiply_add(builder, a, b, c):
    """a b + c; rounded once on machines that do so as fast as they multiply."""
    kind = ir.FunctionType(c.type, [c.type] * 3)
    element = {ir.FloatType(): "f32", ir.DoubleType(): "f64"}[getattr(c.type, "element", c.type)]
    name = f"v{c.type.count}{element}" if isinstance(c.type, ir.VectorType) else element
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.{name}"), [a, b, c])


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


_operator([operator.add, operator.iadd], add)
_operator([operator.sub, operator.isub], subtract)
_operator([operator.mul, operator.imul], lambda builder, a, b: builder.fmul(a, b))
_operator([operator.truediv, operator.itruediv], lambda builder, a, b: builder.fdiv(a, b))


def _compare(function, sign):
    def emit(builder, a, b):
        if isinstance(a.type.element, ir.IntType):
            return builder.icmp_signed(sign, a, b)
        return builder.fcmp_ordered(sign, a, b)

    _operator([function], emit, lambda lanes: Mask(lanes.count))


for _function, _sign in ((operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.eq, "==")):
    _compare(_function, _sign)


def _logic(function, emit):
    @type_callable(function)
    def of_types(context):
        return lambda a, b: a if isinstance(a, Mask) and a == b else None

    lower_builtin(function, Mask, Mask)(lambda context, builder, signature, arguments: emit(builder, *arguments))


_logic(operator.and_, lambda builder, a, b: builder.and_(a, b))
_logic(operator.or_, lambda builder, a, b: builder.or_(a, b))
