"""Values of Python in memory as compiled code stores them, without compiling anything.

A call from Python would compile code that unpacks every array of every argument, a second of compiling for the forty
arrays of a term, and every call would run all of it.
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
    """A value in memory as compiled code stores it, at `address`. Its arrays are kept here, and not reference-counted.

    Raises TypeError if the value contains anything but numbers, arrays, None, codes, and tuples of these.
    """

    def __init__(self, value: Any):
        self.value, self.kind = value, numba.typeof(value)
        self._memory = _struct((("whole", self.kind),))()
        _fill(self._memory, (("whole", self.kind),), (value,))
        self.address = ctypes.addressof(self._memory)


class AddressType(types.Type):
    """Base of types whose values are 64-bit integers in compiled code: the `address_value` of the Python object."""


@cache
def _struct(fields: tuple[tuple[str, types.Type], ...]) -> type[ctypes.Structure]:
    """The C struct of named values, each aligned to its own size, like a struct of LLVM."""
    return type("NumbaTuple", (ctypes.Structure,), {"_fields_": [(name, _c_type(kind)) for name, kind in fields]})


def _c_type(kind: types.Type) -> Any:
    if isinstance(kind, types.Array):
        return array_struct(kind.ndim)
    if isinstance(kind, types.BaseTuple):
        return _struct(_fields(kind))
    if isinstance(kind, AddressType):
        return ctypes.c_int64
    if kind is types.none:
        return ctypes.c_void_p
    if kind not in C_TYPES:
        raise TypeError(f"a value of type {kind} cannot be an argument of a task")
    return C_TYPES[kind]


@cache
def array_struct(dimensions: int) -> type[ctypes.Structure]:
    """The C struct of an array, with the fields of Numba's `ArrayModel` in the same order."""
    numbers = ctypes.c_ssize_t * dimensions
    owners = [("meminfo", ctypes.c_void_p), ("parent", ctypes.c_void_p)]
    content = [("nitems", ctypes.c_ssize_t), ("itemsize", ctypes.c_ssize_t), ("data", ctypes.c_void_p)]
    return type(
        "NumbaArray", (ctypes.Structure,), {"_fields_": [*owners, *content, ("shape", numbers), ("strides", numbers)]}
    )


def _fields(kind: types.BaseTuple) -> tuple[tuple[str, types.Type], ...]:
    return tuple((f"item_{k}", inner) for k, inner in enumerate(kind.types))


def _fill(struct: ctypes.Structure, fields: tuple[tuple[str, types.Type], ...], values: tuple) -> None:
    """Write values into the fields of a struct."""
    for (name, kind), value in zip(fields, values, strict=True):
        if isinstance(kind, types.Array):
            array = getattr(struct, name)
            array.nitems, array.itemsize, array.data = value.size, value.itemsize, value.ctypes.data
            array.shape[:], array.strides[:] = value.shape, value.strides
        elif isinstance(kind, types.BaseTuple):
            _fill(getattr(struct, name), _fields(kind), value)
        elif isinstance(kind, AddressType):
            setattr(struct, name, value.address_value)
        elif kind is not types.none:
            setattr(struct, name, value)
