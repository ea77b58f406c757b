"""Values of Python as compiled code has them in memory, written there without compiling anything.

Numba's own way, a call from Python, compiles code that takes apart every array of every argument, a second of compiling
for the forty arrays of a term; and each call runs through all of it.
"""

import ctypes
from functools import cache
from typing import Any

import numba
from numba import types

#: C types of the numbers of compiled code.
C_TYPES = {types.boolean: ctypes.c_bool, types.float64: ctypes.c_double, types.float32: ctypes.c_float} | {
    kind: getattr(ctypes, f"c_{kind.name}") for kind in sorted(types.integer_domain, key=str) if kind.bitwidth <= 64
}


class NumbaStruct:
    """A value in memory, for a task to open at `address`. References to arrays are not counted there, but kept here.

    Raises TypeError if there is something in it besides numbers, arrays, None, codes, and tuples of these
    """

    def __init__(self, value: Any):
        self.value, self.kind = value, numba.typeof(value)
        self._memory = _struct((("whole", self.kind),))()
        _fill(self._memory, (("whole", self.kind),), (value,))
        self.address = ctypes.addressof(self._memory)


class AddressType(types.Type):
    """Base of types whose values are whole numbers of 64 bits: what `word` of the value says."""


@cache
def _struct(fields: tuple[tuple[str, types.Type], ...]) -> type[ctypes.Structure]:
    """The C struct of named values, each aligned to its own size, as LLVM has it."""
    return type("Laid", (ctypes.Structure,), {"_fields_": [(name, _c_type(kind)) for name, kind in fields]})


def _c_type(kind: types.Type) -> Any:
    if isinstance(kind, types.Array):
        return _array(kind.ndim)
    if isinstance(kind, types.BaseTuple):
        return _struct(_fields(kind))
    if isinstance(kind, AddressType):
        return ctypes.c_int64
    if kind is types.none:
        return ctypes.c_void_p
    if kind not in C_TYPES:
        raise TypeError(f"a value of type {kind} cannot be laid down for compiled code")
    return C_TYPES[kind]


@cache
def _array(dimensions: int) -> type[ctypes.Structure]:
    numbers = ctypes.c_ssize_t * dimensions
    owners = [("meminfo", ctypes.c_void_p), ("parent", ctypes.c_void_p)]
    content = [("size", ctypes.c_ssize_t), ("itemsize", ctypes.c_ssize_t), ("data", ctypes.c_void_p)]
    fields = [*owners, *content, ("shape", numbers), ("strides", numbers)]
    return type("LaidArray", (ctypes.Structure,), {"_fields_": fields})


def _fields(kind: types.BaseTuple) -> tuple[tuple[str, types.Type], ...]:
    return tuple((f"of_{k}", inner) for k, inner in enumerate(kind.types))


def _fill(struct: ctypes.Structure, fields: tuple[tuple[str, types.Type], ...], values: tuple) -> None:
    """Write values into the fields of a struct."""
    for (name, kind), value in zip(fields, values, strict=True):
        if isinstance(kind, types.Array):
            there = getattr(struct, name)
            there.size, there.itemsize, there.data = value.size, value.itemsize, value.ctypes.data
            there.shape[:], there.strides[:] = value.shape, value.strides
        elif isinstance(kind, types.BaseTuple):
            _fill(getattr(struct, name), _fields(kind), value)
        elif isinstance(kind, AddressType):
            setattr(struct, name, value.word)
        elif kind is not types.none:
            setattr(struct, name, value)
