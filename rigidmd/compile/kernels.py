"""Kernels: functions that are compiled, with the options that this engine wants."""

from numba import types
from numba.extending import overload

from rigidmd.compile.numba_private import dispatcher, uncounted

# Reassociation and contraction let LLVM keep sums in registers and use FMA. The flags that assume away NaN and
# infinity are left out: a bad number must stay visible.
PAIR_FLAGS = {"reassoc", "contract", "nsz", "arcp"}


def kernel(function=None, *, parallel=False, fastmath=False, inline=False, counted=True, outer=False):
    """`numba.njit`, cached on disk.

    inline: make LLVM inline it wherever it is called, for what runs in an inner loop. Terms are passed as their fields,
    forty arguments and more, and a call costs more than a pair of sites. And for whatever has fastmath: a function that
    is called by its name may be there twice, by itself and compiled into its caller, with sums in another order, and
    which of them is taken depends on what else the process has compiled; seen, a run had other last bits when it came
    from the cache.
    counted: False for a loop that takes views of arrays in passing but neither allocates nor returns any, and all it
    calls: the references are then not counted. Counting, atomic, made 47 ns of the 7 that a vector of pairs takes.
    Such a loop takes elements by their index: iterating over a view ended in a crash. Its caller never assigns anew, in
    a loop of its own, arrays that it passes: the new ones were freed while they were in use.
    outer: whether Python calls it.
    """
    if function is None:
        return lambda f: kernel(f, parallel=parallel, fastmath=fastmath, inline=inline, counted=counted, outer=outer)
    options = options_of(fastmath, inline) | ({"parallel": True, "_nrt": True} if parallel else uncounted(counted))
    return dispatcher(function, options, outer)


def implements(stub, fastmath=False, inline=False, counted=True):
    """`numba.extending.overload` with the options of `kernel`, which an overload does not inherit from its caller."""
    return overload(stub, jit_options=options_of(fastmath, inline) | uncounted(counted))


def options_of(fastmath, inline: bool) -> dict:
    """Options that every kernel has."""
    return {"error_model": "numpy", "fastmath": fastmath} | ({"forceinline": True} if inline else {})


def is_a(numba_type, named_tuple) -> bool:
    """Whether a Numba type is that of the given NamedTuple class; what overloads choose by."""
    return isinstance(numba_type, types.BaseNamedTuple) and numba_type.instance_class is named_tuple
