"""Values in memory, and records: named tuples that compiled code reads where they are.

A record is the address of a named tuple. An attribute is one load, and a nested named tuple is an
address again, so that a function costs what it uses of its arguments: passed by value, each of the
forty arrays of a term would become seven numbers in every function between the task and the loop.
No kernel changes a field of a record, so its loads are marked invariant, and a store through an
array does not force a loop to load the array's address again.

Private parts of Numba, tested by tests/test_compile.py: the values of tuples and of `ArrayModel`
are C structs, which `NumbaStruct` fills. A call from Python would instead compile code that unpacks
every array of every argument, a second of compiling for the forty arrays of a term, and every call
would run all of it.
"""

import ctypes
from collections.abc import Callable, Hashable
from functools import cache, wraps
from typing import Any, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import models, register_model

from rigidmd.compile.machine import field_address

#: C types of the numbers of compiled code.
C_TYPES = {
    types.boolean: ctypes.c_bool,
    types.float64: ctypes.c_double,
    types.float32: ctypes.c_float,
} | {
    kind: getattr(ctypes, f"c_{kind.name}")
    for kind in sorted(types.integer_domain, key=str)
    if kind.bitwidth <= 64
}


class Record(types.Type):
    """Numba type of the address of a named tuple, whose type is `content`."""

    def __init__(self, content: types.BaseNamedTuple):
        self.content = content
        super().__init__(f"record({content})")

    @property
    def key(self):
        """The type of the named tuple. The name does not identify it: classes of the same name have
        the same."""
        return self.content

    def __len__(self) -> int:
        return len(self.fields)

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields."""
        return self.content.fields

    @property
    def types(self) -> tuple[types.Type, ...]:
        """Types of the fields in memory."""
        return self.content.types

    @property
    def instance_class(self) -> type:
        """The class of the named tuple."""
        return self.content.instance_class


register_model(Record)(models.OpaqueModel)  # the pointers that Numba keeps in variables


def by_reference(kind: types.Type) -> types.Type:
    """The type of task arguments whose named tuples are records."""
    if isinstance(kind, types.BaseNamedTuple):
        return Record(kind)
    if isinstance(kind, types.BaseTuple):
        return types.BaseTuple.from_types([by_reference(one) for one in kind.types])
    return kind


T = TypeVar("T")


def remember_by_structure(function: Callable[[Any], T]) -> Callable[[Any], T]:
    """Call a function of a value, whose result depends on the Numba type alone, once for each
    structure of values.

    Numba would build and hash the types of the forty arrays of a term anew for each pass.
    """
    results: dict[Hashable, T] = {}

    @wraps(function)
    def remembered(value: Any) -> T:
        structure = structure_of(value)
        if structure not in results:
            results[structure] = function(value)
        return results[structure]

    return remembered


def structure_of(value: Any) -> Hashable:
    """What decides on the Numba type of a value: the classes of its parts, and the layout of its
    arrays."""
    kind = type(value)
    if kind is np.ndarray:
        flags = value.flags
        layout = flags.c_contiguous, flags.f_contiguous, flags.aligned, flags.writeable
        return value.dtype, value.ndim, *layout
    if isinstance(value, tuple):
        return kind, *map(structure_of, value)
    if value is None or kind in (bool, float) or issubclass(kind, np.number | np.bool_):
        return kind
    if kind is int and value.bit_length() < 64:
        return kind
    return numba.typeof(value)


@remember_by_structure
def referenced_type(value: Any) -> types.Type:
    """The type of task arguments whose named tuples are records."""
    return by_reference(numba.typeof(value))


@infer_getattr
class _RecordAttributes(AttributeTemplate):
    key = Record

    def generic_resolve(self, record, name):
        if name in record.fields:
            field = record.types[record.fields.index(name)]
            return Record(field) if isinstance(field, types.BaseNamedTuple) else field
        return None


@lower_getattr_generic(Record)
def _load_attribute(context, builder, record, value, name):
    index = record.fields.index(name)
    struct, field = context.get_value_type(record.content), record.types[index]
    address = field_address(builder, value, struct, index)
    if isinstance(field, types.BaseNamedTuple):
        return builder.bitcast(address, cgutils.voidptr_t)
    loaded = load_invariant(builder, address, context.get_value_type(field))
    return impl_ret_borrowed(context, builder, field, loaded)


def load_invariant(builder, pointer, kind: ir.Type):
    """A value in memory that does not change while the function runs."""
    loaded = builder.load(pointer, typ=kind)
    loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
    return loaded


def stored_by_reference(context, builder, kind: types.Type, value):
    """A value as one of the type `by_reference(kind)`; its named tuples are stored on the stack."""
    if isinstance(kind, types.BaseNamedTuple):
        return builder.bitcast(cgutils.alloca_once_value(builder, value), cgutils.voidptr_t)
    if isinstance(kind, types.BaseTuple):
        parts = [
            stored_by_reference(context, builder, part, builder.extract_value(value, n))
            for n, part in enumerate(kind.types)
        ]
        return context.make_tuple(builder, by_reference(kind), parts)
    return value


class NumbaStruct:
    """Task arguments in memory as compiled code reads them, at `address`, with records for named
    tuples.

    Its arrays are kept here, and not reference-counted. Raises TypeError if the value contains
    anything but numbers, arrays, None, codes, and tuples of these.
    """

    def __init__(self, value: Any):
        self.value, self.kind = value, referenced_type(value)
        self._records: list[Any] = []
        self._memory = self._reference(self.kind, value)
        self.address = ctypes.addressof(self._memory)

    def _reference(self, kind: types.Type, value: Any) -> Any:
        """An object of ctypes for a value with records."""
        if isinstance(kind, Record):
            record = c_value(kind.content, value)
            self._records.append(record)
            return ctypes.c_void_p(ctypes.addressof(record))
        if isinstance(kind, types.BaseTuple):
            return _tuple_struct(
                self._reference(part, one) for part, one in zip(kind.types, value, strict=True)
            )
        return c_value(kind, value)


def c_value(kind: types.Type, value: Any) -> Any:
    """A value as an object of ctypes with its own memory."""
    if isinstance(kind, types.Array):
        struct, numbers = array_struct(kind.ndim), ctypes.c_ssize_t * kind.ndim
        sizes = value.size, value.itemsize, value.ctypes.data
        return struct(None, None, *sizes, numbers(*value.shape), numbers(*value.strides))
    if isinstance(kind, types.BaseTuple):
        return _tuple_struct(
            c_value(part, one) for part, one in zip(kind.types, value, strict=True)
        )
    if hasattr(value, "address_value"):
        return ctypes.c_int64(value.address_value)
    if kind is types.none:
        return ctypes.c_void_p()
    if kind not in C_TYPES:
        raise TypeError(f"a value of type {kind} cannot be an argument of a task")
    return C_TYPES[kind](value)


def _tuple_struct(parts: Any) -> ctypes.Structure:
    items = tuple(parts)
    return _struct(tuple((f"item_{k}", type(part)) for k, part in enumerate(items)))(*items)


@cache
def _struct(fields: tuple[tuple[str, Any], ...]) -> type[ctypes.Structure]:
    """The C struct of named values, each aligned to its own size, like a struct of LLVM."""
    return type("NumbaTuple", (ctypes.Structure,), {"_fields_": fields})


@cache
def array_struct(dimensions: int) -> type[ctypes.Structure]:
    """The C struct of an array, with the fields of Numba's `ArrayModel` in the same order."""
    numbers = ctypes.c_ssize_t * dimensions
    owners = ("meminfo", ctypes.c_void_p), ("parent", ctypes.c_void_p)
    content = (
        ("nitems", ctypes.c_ssize_t),
        ("itemsize", ctypes.c_ssize_t),
        ("data", ctypes.c_void_p),
    )
    return _struct((*owners, *content, ("shape", numbers), ("strides", numbers)))
