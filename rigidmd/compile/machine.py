"""The target processor of Numba, the width of its vectors, its threads, the number of blocks of
work, and pointers.

LLVM has only opaque pointers, and llvmlite is removing typed ones. The pointers of Numba are still
typed.
"""

import os

import numba
from llvmlite import binding, ir
from numba.core.registry import cpu_target

from rigidmd.errors import SettingError

#: The type of pointers.
POINTER = ir.PointerType()


def cast_pointer(builder, pointer, kind: ir.Type):
    """A pointer for loads and stores of a type. Numba's pointers may have another type; opaque ones
    need no cast."""
    return (
        pointer
        if getattr(pointer.type, "is_opaque", True)
        else builder.bitcast(pointer, ir.PointerType(kind))
    )


def field_address(builder, pointer, struct: ir.Type, index: int):
    """The address of a field of a struct in memory."""
    pointer = cast_pointer(builder, pointer, struct)
    places = [ir.IntType(32)(0), ir.IntType(32)(index)]
    return builder.gep(pointer, places, source_etype=struct)


class _FunctionPointer(ir.instructions.CastInstr):
    """An opaque pointer to a function: llvmlite asks the pointer for the type of the function that
    it calls."""

    function_type = None


def function_at(builder, address, function_type: ir.FunctionType):
    """The function at an address, an integer."""
    pointer = builder.inttoptr(address, POINTER)
    pointer.__class__, pointer.function_type = _FunctionPointer, function_type
    return pointer


#: LLVM names of the target: this machine, or the one set by NUMBA_CPU_NAME and NUMBA_CPU_FEATURES.
TRIPLE, PROCESSOR, _FEATURES = cpu_target.target_context.codegen().magic_tuple()
PROCESSOR_FEATURES = tuple(
    sorted(name[1:] for name in _FEATURES.split(",") if name.startswith("+"))
)
IS_X86 = TRIPLE.startswith("x86_64")
#: Other settings of Numba that change its code: environment variable -> value.
CODE_SETTINGS = {
    f"NUMBA_{name}": repr(
        getattr(numba.config, "DEBUGINFO_DEFAULT" if name == "DEBUGINFO" else name, None)
    )
    for name in (
        "OPT",
        "LOOP_VECTORIZE",
        "SLP_VECTORIZE",
        "BOUNDSCHECK",
        "DEBUGINFO",
        "DISABLE_INTEL_SVML",
        "LLVM_REFPRUNE_PASS",
        "LLVM_REFPRUNE_FLAGS",
        "EXTEND_VARIABLE_LIFETIMES",
        "ENABLE_PROFILING",
        "DEBUG_NRT",
    )
}
BLOCKS = 16  # least number of blocks of work, each run by any thread: enough for 16 threads
MOST_BLOCKS = 128
WIDTHS = ("128", "256", "512")  # possible widths of vectors, bits


def _widest() -> int:
    """Bits of the widest vectors of the target processor: those that LLVM uses for 16 integers.

    Features that a processor name implies are not listed, so the width is read from code that LLVM
    makes; wider intrinsics would abort the process.
    """
    module = ir.Module()
    vector = ir.VectorType(ir.IntType(32), 16)
    add = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), "add")
    builder = ir.IRBuilder(add.append_basic_block())
    value = builder.load(add.args[0], typ=vector)
    builder.store(builder.add(value, value), add.args[0])
    builder.ret_void()
    target = binding.Target.from_triple(TRIPLE).create_target_machine(
        cpu=PROCESSOR, features=_FEATURES
    )
    code = target.emit_assembly(binding.parse_assembly(str(module)))
    return 512 if "%zmm" in code else 256 if "%ymm" in code else 128


def _simd_bits() -> int:
    """Bits of the vectors in pair loops: the widest, or the value of `RIGIDMD_SIMD_BITS`."""
    widest, named = _widest(), os.environ.get("RIGIDMD_SIMD_BITS")
    if not named:
        return widest
    if named not in WIDTHS:
        raise SettingError(
            f"RIGIDMD_SIMD_BITS is {named[:40]!r}, must be one of {', '.join(WIDTHS)}"
        )
    if int(named) > widest:
        raise SettingError(
            f"RIGIDMD_SIMD_BITS is {named}, but vectors have at most {widest} bits on {PROCESSOR}"
        )
    return int(named)


SIMD_BITS = _simd_bits()

#: Largest number of threads: the cores of this process, or the value of `NUMBA_NUM_THREADS`.
MOST_THREADS: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]


def usable_threads(requested: int | None) -> int:
    """Number of threads that compute for a requested number; None: all."""
    return min(requested or MOST_THREADS, MOST_THREADS)
