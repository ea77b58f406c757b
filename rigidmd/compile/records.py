"""Values in memory, and records: named tuples that compiled code reads where they are.

A record is the address of a named tuple. An attribute is one load, and a nested named tuple is an
address again, so that a function costs what it uses of its arguments: passed by value, each of the
forty arrays of a term would become seven numbers in every function between the task and the loop.
No kernel changes a field of a record, so its loads are marked invariant, and a store through an
array does not force a loop to load the array's address again.

Private parts of Numba, tested by tests/compile/test_records.py: the values of tuples and of
`ArrayModel` are C structs, which `NumbaStruct` fills. A call from Python would instead compile code
that unpacks every array of every argument, a second of compiling for the forty arrays of a term,
and every call would run all of it.
"""

import ctypes
from collections.abc import Callable, Hashable, Iterator
from functools import wraps
from struct import Struct, calcsize
from typing import Any, NamedTuple, TypeVar

import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed, lower_getattr_generic
from numba.core.typing.templates import AttributeTemplate, infer_getattr
from numba.extending import models, register_model

from rigidmd.compile.machine import field_address

#: Formats of the module `struct` for the numbers of compiled code, and for addresses and sizes.
FORMATS = {types.boolean: "?", types.float64: "d", types.float32: "f"}
FORMATS |= {types.int8: "b", types.int16: "h", types.int32: "i", types.int64: "q"}
FORMATS |= {types.uint8: "B", types.uint16: "H", types.uint32: "I", types.uint64: "Q"}
WORD = "n"
#: Fields of Numba's `ArrayModel`, in its order.
ARRAY_FIELDS = ("meminfo", "parent", "nitems", "itemsize", "data", "shape", "strides")


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


def remember_by_structure(function: Callable[[object], T]) -> Callable[[object], T]:
    """Call a function of a value, whose result depends on the Numba type alone, once for each
    structure of values.

    Numba would build and hash the types of the forty arrays of a term anew for each pass.
    """
    results: dict[Hashable, T] = {}

    @wraps(function)
    def remembered(value: object) -> T:
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
def referenced_type(value: object) -> types.Type:
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


class Layout(NamedTuple):
    """How a value lies in memory: its own numbers, and those of each of its records in order."""

    numbers: Struct
    records: tuple[Struct, ...]


@remember_by_structure
def _layout(value: object) -> tuple[types.Type, Layout]:
    """The type of a value with records, and its layout."""
    kind = referenced_type(value)
    records: list[Struct] = []
    numbers = Struct(_format(kind, value, records))
    return kind, Layout(numbers, tuple(records))


def _format(kind: types.Type, value: Any, records: list[Struct]) -> str:
    """Format of the numbers of a value, as in a struct of LLVM: each is aligned to its own size, a
    tuple to that of its largest number."""
    if isinstance(kind, Record):
        records.append(Struct(_format(kind.content, value, [])))
        return WORD
    if isinstance(kind, types.Array):
        return array_format(kind.ndim)
    if isinstance(kind, types.BaseTuple):
        parts = zip(kind.types, value, strict=True)
        text = "".join(_format(part, one, records) for part, one in parts)
        alignment = "0" + max(filter(str.isalpha, text), key=calcsize, default="b")
        return alignment + text + alignment
    if kind is types.none or hasattr(value, "address_value"):
        return WORD
    if kind not in FORMATS:
        raise TypeError(f"a value of type {kind} cannot be an argument of a task")
    return FORMATS[kind]


def array_format(dimensions: int) -> str:
    """Format of an array: `ARRAY_FIELDS`, of which the last two have a number for each
    dimension."""
    return f"{len(ARRAY_FIELDS) - 2 + 2 * dimensions}{WORD}"


class NumbaStruct:
    """Task arguments in memory as compiled code reads them, at `address`, with records for named
    tuples.

    Its arrays are kept here, and not reference-counted. Raises TypeError if the value contains
    anything but numbers, arrays, None, codes, and tuples of these.
    """

    def __init__(self, value: object):
        self.value = value
        self.kind, layout = _layout(value)
        self._records: list[ctypes.Array] = []
        numbers: list[float] = []
        self._append(value, numbers, iter(layout.records))
        self._memory = ctypes.create_string_buffer(layout.numbers.pack(*numbers))
        self.address = ctypes.addressof(self._memory)

    def _append(
        self, value: object, numbers: list[float], records: Iterator[Struct] | None
    ) -> None:
        """Append the numbers of a value. Without `records` they contain those of named tuples."""
        if isinstance(value, np.ndarray):
            numbers += (0, 0, value.size, value.itemsize, value.ctypes.data)
            numbers += value.shape
            numbers += value.strides
        elif isinstance(value, tuple) and hasattr(value, "_fields") and records is not None:
            content: list[float] = []
            self._append(value, content, None)
            record = ctypes.create_string_buffer(next(records).pack(*content))
            self._records.append(record)
            numbers.append(ctypes.addressof(record))
        elif isinstance(value, tuple):
            for one in value:
                self._append(one, numbers, records)
        elif value is None:
            numbers.append(0)
        else:
            numbers.append(getattr(value, "address_value", value))
