"""The processor that Numba compiles for, the width of its vectors, its threads, and how finely work is divided."""

import os

import numba
from llvmlite import binding, ir
from numba.core.registry import cpu_target

from rigidmd.errors import SettingError

#: What Numba compiles for: this machine, or what NUMBA_CPU_NAME and NUMBA_CPU_FEATURES name; as LLVM names it.
TRIPLE, PROCESSOR, _FEATURES = cpu_target.target_context.codegen().magic_tuple()
PROCESSOR_FEATURES = tuple(sorted(name[1:] for name in _FEATURES.split(",") if name.startswith("+")))
IS_X86 = TRIPLE.startswith("x86_64")
#: Settings of Numba that change the code it makes, besides those of the processor: environment variable -> value.
CODE_SETTINGS = {
    f"NUMBA_{name}": repr(getattr(numba.config, "DEBUGINFO_DEFAULT" if name == "DEBUGINFO" else name, None))
    for name in (
        "OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO", "DISABLE_INTEL_SVML",
        "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS", "EXTEND_VARIABLE_LIFETIMES", "ENABLE_PROFILING", "DEBUG_NRT",
    )
}  # fmt: skip
BLOCKS = 16  # of work, at least, which any thread may take: enough for 16 threads
MOST_BLOCKS = 128
WIDTHS = ("128", "256", "512")  # of vectors, in bits


def _widest() -> int:
    """Bits of the widest vectors of the processor that Numba compiles for: those into which LLVM puts 16 integers.

    The features that a name implies are not listed, so that LLVM is asked for code: wider intrinsics would abort.
    """
    module = ir.Module()
    vector = ir.VectorType(ir.IntType(32), 16)
    add = ir.Function(module, ir.FunctionType(ir.VoidType(), [vector.as_pointer()]), "add")
    builder = ir.IRBuilder(add.append_basic_block())
    value = builder.load(add.args[0])
    builder.store(builder.add(value, value), add.args[0])
    builder.ret_void()
    target = binding.Target.from_triple(TRIPLE).create_target_machine(cpu=PROCESSOR, features=_FEATURES)
    code = target.emit_assembly(binding.parse_assembly(str(module)))
    return 512 if "%zmm" in code else 256 if "%ymm" in code else 128


def _simd_bits() -> int:
    """Bits of the vectors in pair loops: the widest, or what `RIGIDMD_SIMD_BITS` says."""
    widest, named = _widest(), os.environ.get("RIGIDMD_SIMD_BITS")
    if not named:
        return widest
    if named not in WIDTHS:
        raise SettingError(f"RIGIDMD_SIMD_BITS is {named[:40]!r}, must be one of {', '.join(WIDTHS)}")
    if int(named) > widest:
        raise SettingError(f"RIGIDMD_SIMD_BITS is {named}, but vectors have at most {widest} bits on {PROCESSOR}")
    return int(named)


SIMD_BITS = _simd_bits()

#: Threads that there may be: the cores of this process, or what `NUMBA_NUM_THREADS` says.
MOST_THREADS: int = numba.config.NUMBA_NUM_THREADS  # pyright: ignore[reportPrivateImportUsage, reportAttributeAccessIssue]


def usable_threads(asked: int | None) -> int:
    """Number of threads that compute when so many are asked for; None: all."""
    return min(asked or MOST_THREADS, MOST_THREADS)
