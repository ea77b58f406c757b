"""Pointers in LLVM IR: opaque where llvmlite has them, with types where it needs them.

LLVM has only opaque pointers, and llvmlite is removing typed ones. The pointers of Numba are still typed, and llvmlite
0.44, the oldest one supported, has an LLVM that needs typed pointers.
"""

import llvmlite
from llvmlite import ir

#: Whether LLVM accepts opaque pointers. llvmlite has this attribute up to version 0.44, where the default is False.
OPAQUE: bool = getattr(llvmlite, "opaque_pointers_enabled", True)


def pointer_to(kind: ir.Type) -> ir.PointerType:
    """The type of pointers to a type."""
    return ir.PointerType() if OPAQUE else ir.PointerType(kind)


def cast_pointer(builder, pointer, kind: ir.Type):
    """A pointer for loads and stores of a type. Numba's pointers may have another type; opaque ones need no cast."""
    return pointer if getattr(pointer.type, "is_opaque", True) else builder.bitcast(pointer, ir.PointerType(kind))


class _FunctionPointer(ir.instructions.CastInstr):
    """An opaque pointer to a function: llvmlite asks the pointer for the type of the function that it calls."""

    def __init__(self, block, address, function_type: ir.FunctionType):
        super().__init__(block, "inttoptr", address, ir.PointerType())
        self._function_type = function_type

    @property
    def function_type(self) -> ir.FunctionType:
        return self._function_type


def function_at(builder, address, function_type: ir.FunctionType):
    """The function at an address, an integer."""
    if not OPAQUE:
        return builder.inttoptr(address, ir.PointerType(function_type))
    pointer = _FunctionPointer(builder.block, address, function_type)
    builder._insert(pointer)
    return pointer


def element_pointer(context, builder, array_type, array, index):
    """Pointer to number `index` of a contiguous array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index], source_etype=context.get_data_type(array_type.dtype))
