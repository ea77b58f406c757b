"""Values in memory: how compiled code reads them."""

import ctypes
from struct import calcsize
from typing import NamedTuple

import numba
import numpy as np
import pytest
from numba import types
from numba.core.errors import TypingError
from numba.core.registry import cpu_target
from support.thread_kernels import add

from rigidmd.compile import (
    BoundTask,
    Code,
    NumbaStruct,
    load_arguments,
    task,
)
from rigidmd.compile.records import (
    ARRAY_FIELDS,
    array_format,
    by_reference,
    referenced_type,
    structure_of,
)


class Mixed(NamedTuple):
    """Values of every kind that a term may have."""

    small: np.int8
    flags: tuple
    plane: np.ndarray
    nothing: None
    single: np.float32
    flag: bool
    inner: tuple
    number: float
    count: int
    turned: np.ndarray
    code: Code | None


@task()
def _tell(task_arguments, block):
    mixed, found = load_arguments(task_arguments)
    found[0], found[1], found[2] = mixed.small, mixed.flags[0], mixed.flags[1]
    found[3], found[4], found[5] = mixed.plane[1, 2], mixed.single, mixed.flag
    found[6], found[7] = mixed.inner[0], mixed.inner[1][0][1]
    found[8], found[9], found[10] = mixed.number, mixed.count, mixed.turned[2, 1]
    found[11] = mixed.plane.shape[0] + len(mixed.inner[1][0])
    mixed.plane[0, 0] = -1.0


def test_arrays_are_stored_as_assumed():
    kind, context = types.Array(types.float64, 2, "C"), cpu_target.target_context
    model = context.data_model_manager[kind]
    sizes = [
        context.get_abi_sizeof(context.get_value_type(model.get_member_fe_type(name)))
        for name in model._fields
    ]
    size = context.get_abi_sizeof(context.get_value_type(kind))
    stored = list(zip(model._fields, sizes, strict=True))
    assumed = list(zip(ARRAY_FIELDS, [8, 8, 8, 8, 8, 16, 16], strict=True))
    assert (stored, size) == (assumed, calcsize(array_format(2))), (
        f"Numba {numba.__version__} stores an array as {stored} (name, bytes), {size} bytes in all;"
        f" rigidmd/compile/records.py assumes {assumed}: change `ARRAY_FIELDS` there"
    )


def test_values_are_stored_as_in_compiled_code():
    plane, found = np.arange(6.0).reshape(2, 3), np.zeros(12)
    inner = (np.uint16(65000), (np.array([7, 8, 9], np.int32),))
    turned, code = (
        np.arange(6, dtype=np.float32).reshape(2, 3).T,
        Code(add=(add, (np.zeros(3), 0.0))),
    )
    mixed = Mixed(
        np.int8(-3),
        (True, False),
        plane,
        None,
        np.float32(0.5),
        True,
        inner,
        2.5,
        -(2**40),
        turned,
        code,
    )
    BoundTask(_tell, (mixed, found))()
    assert found.tolist() == [-3, 1, 0, 5, 0.5, 1, 65000, 8, 2.5, -(2**40), 5, 5]
    assert plane[0, 0] == -1.0
    context, struct = cpu_target.target_context, NumbaStruct(mixed)
    for memory, kind in (struct._memory, struct.kind), (*struct._records, struct.kind.content):
        expected = context.get_abi_sizeof(context.get_value_type(kind))
        assert ctypes.sizeof(memory) - 1 == expected  # a buffer of text ends with a zero


class OtherMixed(NamedTuple):
    x: object


@pytest.mark.parametrize(
    "values",
    [
        [np.zeros(3), np.zeros(3, np.float32), np.zeros((3, 1)), np.zeros(6)[::2], 0.0, None],
        [np.zeros((2, 3)), np.zeros((2, 3)).T, np.zeros((4, 3))[::2], np.zeros((2, 3), "<i4")],
        [1, 1.0, True, np.int8(1), np.int16(1), np.float32(1), np.bool_(True), 2**63, -(2**62)],
        [(1, 2), (1, 2.0), (1,), (), ((1,),), ((1, 2),), Mixed(*range(11)), OtherMixed(1)],
        [OtherMixed(np.zeros(2)), OtherMixed(np.zeros((2, 2))), OtherMixed(1), (np.zeros(2),)],
    ],
)
def test_remembered_types_are_those_of_numba(values):
    """Also of values that were seen before."""
    read_only = np.zeros(3)
    read_only.flags.writeable = False
    for value in 2 * [*values, read_only]:
        assert referenced_type(value) == by_reference(numba.typeof(value))
    assert len({*map(structure_of, values)}) >= len({*map(referenced_type, values)})


def test_what_cannot_be_stored_or_has_another_type_is_named():
    with pytest.raises(TypeError, match="unicode_type cannot be an argument of a task"):
        NumbaStruct((1.0, "text"))
    code = Code(add=(add, (np.zeros(3), 0.0)))
    assert code.to_struct((np.zeros(2), 1.0)).kind == numba.typeof((np.zeros(3), 0.0))
    with pytest.raises(
        TypingError, match=r"add was compiled for .*float64, 1d.*, not for .*float32, 1d"
    ):
        code.to_struct((np.zeros(3, np.float32), 0.0))
