"""The machine: the width of vectors and what distinguishes caches."""

import platform
import subprocess
import sys

import pytest
from support.processes import with_settings

MACHINE = (
    "from rigidmd.compile import cache, machine; print(machine.SIMD_BITS, cache.compiler_digest())"
)


def machine_with(**settings):
    """Bits of vectors, and the name of the cache, where the environment has these settings."""
    command = [sys.executable, "-c", MACHINE]
    done = subprocess.run(command, env=with_settings(**settings), capture_output=True, text=True)
    return done.stdout.split()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="the processors are those of x86")
@pytest.mark.parametrize(
    ("name", "bits"),
    [("generic", "128"), ("nehalem", "128"), ("haswell", "256"), ("skylake-avx512", "512")],
)
def test_vectors_are_as_wide_as_those_of_the_processor_that_is_named(name, bits):
    assert machine_with(NUMBA_CPU_NAME=name, NUMBA_CPU_FEATURES="")[0] == bits


def test_settings_that_change_code_have_a_cache_of_their_own():
    usual = machine_with()
    assert machine_with(NUMBA_OPT="3", NUMBA_NUM_THREADS="1", NUMBA_DEBUG_CACHE="0") == usual
    changed = [
        machine_with(**{name: value})
        for name, value in (
            ("NUMBA_OPT", "0"),
            ("NUMBA_BOUNDSCHECK", "1"),
            ("NUMBA_SLP_VECTORIZE", "1"),
        )
    ]
    assert len({digest for _, digest in [usual, *changed]}) == 4
