"""Vectors: what they compute, that pair loops are made of them, and what float32 in their position
costs."""

import os
import platform
import re
import subprocess
import sys

import numba
import numpy as np
import pytest
from numba import types
from support.common import ROOT, built, move, small_scene

from rigidmd.assemble.build import build
from rigidmd.compile import SIMD_BITS, TaskArguments, kernel, simd
from rigidmd.compile.simd_memory import load_matrices, load_vectors, store_matrices, store_vectors
from rigidmd.core.integrators import SCHEMES
from rigidmd.forces.neighbors import pair_loop as pairs
from rigidmd.forces.neighbors.lists import BUILDS
from rigidmd.units import KJ_PER_MOL

PRECISIONS = {"double": np.float64, "mixed": np.float32}
W1 = {"truncation": "shift", "reaction_field_permittivity": 78.5}


@kernel(inline=True)
def cube(x):
    _, one, two = simd.inverse_root_and_cube(x)
    return one * two


@kernel(from_python=True)
def every_operation(a, b, out, sums):
    width = simd.lanes_of(a)
    x, y = simd.load(a, 0), simd.load(b, 0)
    results = (
        x + y,
        x - y,
        x * y,
        x / y,
        2.0 - x,
        x * 3,
        max(x, y),
        min(x, 1.5),
        simd.inverse_square_root(x),
        simd.select(x < y, x, 0.0),
        simd.select(simd.mask_from_bits(5, x), y, x),
        cube(x),
    )
    for k in range(12):
        simd.store(out, k * width, results[k])
    sums[0] = simd.sum_lanes(x)
    sums[1] = simd.largest_lane(x)
    sums[2] = simd.mask_bits((x > 1.0) & (y <= 2.0))
    sums[3] = simd.lowest_bit(40)
    sums[4] = simd.extract_lane(simd.convert_to(simd.load_four(sums, 0), a), 1)


@pytest.mark.parametrize("dtype", PRECISIONS.values())
def test_vectors_compute_as_arrays_do(dtype):
    width = simd.lane_count(dtype)
    assert width * np.dtype(dtype).itemsize * 8 == SIMD_BITS
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0.1, 3, (2, width)).astype(dtype)
    out, sums = np.zeros(12 * width, dtype), np.zeros(5)
    every_operation(x, y, out, sums)
    fives = np.array([k in (0, 2) for k in range(width)])
    expected = [
        x + y,
        x - y,
        x * y,
        x / y,
        2 - x,
        x * 3,
        np.maximum(x, y),
        np.minimum(x, 1.5),
        1 / np.sqrt(x.astype(float)),
        np.where(x < y, x, 0),
        np.where(fives, y, x),
        x.astype(float) ** -1.5,
    ]
    assert out.reshape(12, width) == pytest.approx(
        np.array(expected), rel=4 * float(np.finfo(dtype).eps)
    )
    assert sums[0] == pytest.approx(x.sum(dtype=float), rel=1e-14)
    assert sums[1] == sums[4] == x.max()
    assert sums[2] == sum(1 << k for k in range(width) if x[k] > 1 and y[k] <= 2)
    assert sums[3] == 3


@kernel(from_python=True)
def sums_of_six(x, out):
    width = simd.lanes_of(x)
    one = simd.load(x, 0), simd.load(x, width), simd.load(x, 2 * width)
    two = simd.load(x, 3 * width), simd.load(x, 4 * width), simd.load(x, 5 * width)
    simd.add_lane_sums(out, 1, 3, one, two)


@pytest.mark.parametrize("dtype", PRECISIONS.values())
def test_six_sums_over_lanes_are_added_in_pairs(dtype):
    x = np.random.default_rng(2).uniform(-1, 1, (6, simd.lane_count(dtype))).astype(dtype)
    out = np.arange(10).astype(dtype)
    sums_of_six(x.ravel(), out)
    expected = np.arange(10.0)
    expected[[1, 4, 7]] += x[:3].sum(axis=1, dtype=float)
    expected[[2, 5, 8]] += x[3:].sum(axis=1, dtype=float)
    assert out == pytest.approx(expected, rel=0, abs=16 * float(np.finfo(dtype).eps))


@kernel(from_python=True)
def records_in_lanes(vectors, matrices, out):
    width = simd.lanes_of(out)
    x, y, z = load_vectors(vectors, 1)
    nine = load_matrices(matrices, 1)
    simd.store(out, 0, x)
    simd.store(out, width, y)
    simd.store(out, 2 * width, z)
    for k in range(9):
        simd.store(out, (3 + k) * width, nine[k])
    store_vectors(vectors, 0, (z, x, y))
    store_matrices(matrices, 0, nine)


@pytest.mark.parametrize("dtype", PRECISIONS.values())
def test_records_are_loaded_into_lanes_and_stored(dtype):
    """From the second record on; they are written one record earlier, and what lies next to them
    stays."""
    rng, width = np.random.default_rng(3), simd.lane_count(dtype)
    vectors, matrices = (
        rng.random((width + 2, 3)).astype(dtype),
        rng.random((width + 2, 3, 3)).astype(dtype),
    )
    moved, turned, out = vectors.copy(), matrices.copy(), np.zeros(12 * width, dtype)
    records_in_lanes(moved, turned, out)
    here = slice(1, width + 1)
    columns = np.concatenate([vectors[here], matrices[here].reshape(width, 9)], axis=1).T
    assert np.array_equal(out.reshape(12, width), columns)
    assert np.array_equal(moved, np.concatenate([vectors[here][:, [2, 0, 1]], vectors[width:]]))
    assert np.array_equal(turned, np.concatenate([matrices[here], matrices[width:]]))


@kernel(inline=True)
def root(x):
    found, _, _ = simd.inverse_root_and_cube(x)
    return found


@kernel(from_python=True)
def inverses(x, out):
    width = simd.lanes_of(x)
    for i in range(0, len(x), width):
        at = simd.load(x, i)
        simd.store(out[0], i, simd.inverse(at))
        simd.store(out[1], i, simd.inverse_square_root(at))
        simd.store(out[2], i, cube(at))
        simd.store(out[3], i, root(at))


@pytest.mark.parametrize("dtype", PRECISIONS.values())
def test_inverses_are_accurate_to_the_last_digits(dtype):
    """Over all fractions that an estimate of the machine can have, and sizes as of squared
    distances."""
    x = np.concatenate([np.linspace(1, 4, 1 << 16), np.geomspace(1e-3, 1e6, 1 << 12)]).astype(dtype)
    out = np.zeros((4, len(x)), dtype)
    inverses(x, out)
    exact = x.astype(np.longdouble)
    for found, power in zip(out, (-1, -0.5, -1.5, -0.5), strict=True):
        assert np.abs(found * exact ** np.longdouble(-power) - 1).max() < 3 * np.finfo(dtype).eps


@pytest.mark.skipif(
    SIMD_BITS == 128 or platform.machine() != "x86_64",
    reason="vectors are not wider than the stack",
)
def test_the_stack_is_aligned_to_vectors():
    @numba.njit
    def aligned(x):
        simd.align_stack()
        return x + 1

    assert aligned(1) == 2
    (code,) = aligned.inspect_asm().values()
    assert f"andq\t$-{SIMD_BITS // 8}, %rsp" in code


@kernel(from_python=True)
def part(x, out):
    width = simd.lanes_of(x)
    whole, rest = simd.split_integer_part(simd.load(x, 0))
    simd.store(out, 0, rest)
    simd.store(out, width, simd.select(whole < fives(x), simd.load(x, 0), 0.0))


@kernel(inline=True)
def fives(x):
    five, _ = simd.split_integer_part(simd.broadcast(5.0, x))
    return five


def test_numbers_are_parted_into_whole_and_rest():
    width = simd.lane_count(np.float32)
    x = np.random.default_rng(1).uniform(-10, 10, width).astype(np.float32)
    x[:3] = 5.0, np.nextafter(np.float32(5), np.float32(0)), -7.0
    out = np.zeros(2 * width, np.float32)
    part(x, out)
    assert np.array_equal(out[:width], x - np.trunc(x))
    assert np.array_equal(out[width:], np.where(np.trunc(x) < 5, x, 0))


@kernel(from_python=True)
def pick(table, x, out):
    k, _ = simd.split_integer_part(simd.load(x, 0))
    simd.store(out, 0, simd.permute_two(simd.load(table, 0), simd.load(table, 16), k))


@pytest.mark.skipif(not simd.HAS_AVX512, reason="an instruction of AVX-512")
def test_numbers_are_picked_from_two_vectors():
    rng = np.random.default_rng(2)
    table = rng.normal(size=32).astype(np.float32)
    for x in (np.arange(16), np.arange(16, 32), rng.integers(0, 1000, 16), np.arange(-16, 0)):
        out = np.zeros(16, np.float32)
        pick(table, x.astype(np.float32), out)
        assert np.array_equal(out, table[x % 32])


@pytest.mark.soak
@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_pair_loops_of_water_are_vectorised(precision):
    _, engine, state = built({"spce": 30}, 20.0, forces=W1, precision=precision)
    engine.evaluate(state)
    kind = {"double": "double", "mixed": "float"}[precision]
    for own in engine.workspaces.values():
        task_arguments = TaskArguments(
            numba.typeof((own.slot_potential, own.pairs, own.sums, None, None))
        )
        task = pairs._sum_forces
        fresh = numba.cfunc(types.void(task_arguments, types.intp), **task.options)(task.function)
        vector = f"<{SIMD_BITS // (64 if kind == 'double' else 32)} x {kind}>"
        code = fresh.inspect_llvm()
        assert "NRT" not in code  # nothing in it counts references
        assert not re.search(
            r" f(add|sub|mul) (?!<|double|float)", code
        )  # rounded as written, see `kernel`
        for operation in ("fmul", "fadd", "fsub", r"fcmp \w*", "select"):
            assert re.search(
                rf"{operation}[ \w]* {re.escape(vector)}|select <\d+ x i1> %\S+, {re.escape(vector)}",
                code,
            )
        if platform.machine() in ("x86_64", "AMD64"):
            register = {512: "zmm", 256: "ymm", 128: "xmm"}[SIMD_BITS]
            suffix = "pd" if kind == "double" else "ps"
            assembly = fresh._library.get_asm_str()
            assert len(re.findall(rf"v?mul{suffix}\s.*%{register}", assembly)) > 10
            assert not re.search(r"v?sqrts[sd]|v?divs[sd]", assembly)  # no pair by itself
            assert SIMD_BITS == 128 or f"andq\t$-{SIMD_BITS // 8}, %rsp" in assembly


MIXED, DROPLET = ({"tip4p2005": 60, "nitrogen": 30, "argon": 20}, 18.0), ({"spce": 60}, None)


@pytest.mark.parametrize(
    ("ending", "counts", "edge"),
    [
        ("switch", *MIXED),
        *(
            pytest.param(ending, *which, marks=pytest.mark.soak)
            for ending in ("plain", "shift", "force_shift", "force_switch", "switch")
            for which in (MIXED, DROPLET)
            if (ending, which) != ("switch", MIXED)
        ),
    ],
)
def test_mixed_precision_costs_less_than_a_hundred_thousandth(counts, edge, ending):
    start = {"switch_start_A": 5.0} if ending in ("force_switch", "switch") else {}
    forces = {"cutoff_A": 7.0, "truncation": ending} | start
    off = []
    for seed in range(1, 9):
        loads = []
        for precision in PRECISIONS:
            _, engine, state = built(counts, edge, seed, 0.1, forces=forces, precision=precision)
            load, tallies = engine.evaluate(state)
            loads.append(
                (
                    load,
                    sum(t.energy for t in tallies.values()),
                    sum(t.virial for t in tallies.values()),
                )
            )
        (double, energy, virial), (mixed, energy_mixed, virial_mixed) = loads
        for a, b in zip(double, mixed, strict=True):
            assert np.sqrt(np.mean((a - b) ** 2)) < 1e-5 * np.sqrt(np.mean(a**2))
        assert virial_mixed == pytest.approx(virial, abs=1e-5 * np.abs(virial).max())
        off.append((energy_mixed - energy) / (KJ_PER_MOL * sum(counts.values())))
    # not relative to the sum, in which pairs of both signs cancel: 1e-5 kJ/mol for each molecule
    assert np.sqrt(np.mean(np.square(off))) < 1e-5


SAME_BITS = """
import hashlib, sys
sys.path.insert(0, "tests")
from support.common import small_scene
from rigidmd.scene import Scene
from rigidmd.run import Simulation
stage = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.1}
scene = small_scene({"spce": 700, "nitrogen": 500}, 40.0, stages=[stage], precision=sys.argv[1])
state = Simulation(scene).run().state
print(hashlib.sha256(b"".join(a.tobytes() for a in state)).hexdigest())
"""


@pytest.mark.parametrize("precision", ["mixed", pytest.param("double", marks=pytest.mark.soak)])
def test_the_same_bits_for_any_number_of_threads(precision):
    ends = set()
    for threads in ("1", "16"):  # two: test_dynamics.py
        environment = os.environ | {"NUMBA_NUM_THREADS": threads}
        done = subprocess.run(
            [sys.executable, "-c", SAME_BITS, precision],
            cwd=ROOT,
            env=environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        ends.add(done.stdout)
    assert len(ends) == 1


def all_pairs(system, state):
    """Energy of SPC/E water with shifted truncations by all pairs, NumPy, no list."""
    x = system.site_positions(state)
    owner = system.sites.molecule
    charge = np.tile(system.species[0].charges, len(state.position))
    edges, cutoff = np.array(system.space), system.cutoff
    field = (78.5 - 1) / (2 * 78.5 + 1) / cutoff**3
    energy = 0.0
    for i in range(len(x)):
        d = x[i] - x[i + 1 :]
        d -= edges * np.round(d / edges)
        r2 = (d**2).sum(axis=1)
        near = (r2 < cutoff**2) & (owner[i + 1 :] != owner[i])
        r = np.sqrt(r2[near])
        u = 1 / r + field * r**2 - 1 / cutoff - field * cutoff**2
        energy += 138935.457644 * charge[i] * (charge[i + 1 :][near] * u).sum()
        if i % 3 == 0:
            r = r[np.arange(i + 1, len(x))[near] % 3 == 0]
            sigma = system.species[0].sigma[0]
            s6, c6 = (sigma / r) ** 6, (sigma / cutoff) ** 6
            energy += 4 * system.species[0].epsilon[0] * ((s6**2 - s6) - (c6**2 - c6)).sum()
    return energy


def test_no_pair_is_missed_in_a_long_run():
    """Wherever the list stands in its life: forces are those of a list built then and there,
    energies of all pairs."""
    system = build(small_scene({"spce": 400}, 23.0, forces=W1, start={"temperature_K": 600.0}))
    engine, state = system.engine(), system.state.copy()
    for round in range(30):
        move(engine, state, SCHEMES["velocity_verlet"], 0.001, 14)
        load, tallies = engine.evaluate(state)
        fresh, _ = system.engine().evaluate(state)
        assert load.force == pytest.approx(fresh.force, abs=1e-11 * np.abs(fresh.force).max())
        if round % 15 == 14:
            assert sum(t.energy for t in tallies.values()) == pytest.approx(
                all_pairs(system, state), rel=1e-11
            )
    assert min(own.pairs.counters[BUILDS] for own in engine.workspaces.values()) > 5


@pytest.mark.skipif(SIMD_BITS == 128, reason="this is what all tests run with here")
@pytest.mark.parametrize(
    ("chosen", "least"),
    [
        ("compute_as_arrays", 2),
        pytest.param("compute_as_arrays or no_pair_is_missed", 3, marks=pytest.mark.soak),
    ],
)
def test_the_narrowest_vectors(chosen, least):
    """Two lanes of float64, as on machines without AVX2: every operation, and lists of very many
    clusters."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        __file__,
        "-k",
        chosen,
    ]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=environment | {"RIGIDMD_SIMD_BITS": "128"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert int(re.search(r"\b(\d+) passed", done.stdout)[1]) >= least
