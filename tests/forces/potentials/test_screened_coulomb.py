"""Screened Coulomb pairs: polynomials and tables of erfc, vectors of pairs, damped shifted force."""

import numpy as np
import pytest
from scipy.special import erfc, hyp1f1
from support.common import built, observe
from support.ewald import charged_sites
from support.reference import KE, nearest

from rigidmd.compile import kernel, simd
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.potentials.screened_coulomb import (
    INTERVALS,
    TABLE_ERROR,
    TabledScreening,
    force_table,
    screened,
    screening,
    screening_of_lanes,
)


@pytest.mark.parametrize(("alpha", "cutoff"), [(0.25, 9.0), (0.35, 9.0), (0.28, 10.0), (0.9, 6.0)])
@pytest.mark.parametrize(("dtype", "error"), [(np.float64, 1e-14), (np.float32, 4e-7)])
def test_polynomials_are_erfc(alpha, cutoff, dtype, error):
    """Relative to the functions at r = 0, in the precision of the lanes; 1.5e-7 and 5e-15 where
    alpha is usual."""
    found = screening(alpha, cutoff, dtype)
    r = np.linspace(0.5, cutoff, 500)
    t = (found.scale * (r**2).astype(dtype) - dtype(1)).astype(dtype)
    x2 = (alpha * r) ** 2
    for coefficients, at_zero, exact in (
        (found.energy, 2 * alpha / np.sqrt(np.pi), hyp1f1(0.5, 1.5, -x2)),  # erf(x)/x
        (
            found.force,
            4 * alpha**3 / (3 * np.sqrt(np.pi)),
            hyp1f1(1.5, 2.5, -x2),
        ),  # erf(x)/x³ - 2 exp(-x²)/(sqrt(pi) x²)
    ):
        value = np.polyval(coefficients[::-1], t)
        assert value.dtype == dtype
        assert np.abs(value / at_zero - exact).max() < error


@pytest.mark.parametrize("error", [1e-5, 1e-6])
def test_fewer_terms_where_single_precision_may_leave_an_error(error):
    alpha, cutoff = 0.31, 9.0
    whole, cut = screening(alpha, cutoff, np.float32), screening(alpha, cutoff, np.float32, error)
    assert len(cut.force) <= len(whole.force) - 4
    assert cut.energy == whole.energy
    r = np.linspace(0.5, cutoff, 500)
    t = cut.scale * r**2 - 1
    off = (r * np.abs(np.polyval(cut.force[::-1], t) - np.polyval(whole.force[::-1], t))).max()
    assert 3e-5 * error < off < error  # the number of terms is a multiple of 4


def screened_force(alpha, r):
    """Force of erf(alpha r)/r over r, 1/Å³."""
    return 4 * alpha**3 / (3 * np.sqrt(np.pi)) * hyp1f1(1.5, 2.5, -((alpha * r) ** 2))


@pytest.mark.parametrize("x", [1.0, 2.0, 2.77, 3.1, 4.0, 5.0])
@pytest.mark.parametrize("cutoff", [6.0, 9.0, 12.3])
def test_a_table_is_as_accurate_as_it_states(x, cutoff):
    """Every interval in single precision, up to the largest r² below the cutoff."""
    alpha = x / cutoff
    density, table, off = force_table(alpha, cutoff)
    last = np.nextafter(np.float32(cutoff**2), np.float32(0))
    r2 = np.append(np.linspace(0, last, 5001)[:-1], last).astype(np.float32)
    s = density * r2
    k = s.astype(np.int32)
    assert s.dtype == table.dtype == np.float32
    assert set(k) == set(range(INTERVALS))
    value = np.polyval(list(table[::-1, k]), s - k.astype(np.float32))
    assert value.dtype == np.float32
    r = np.sqrt(r2.astype(float))
    error = r * np.abs(value - screened_force(alpha, r))
    rounding = 4e-7 * r * screened_force(alpha, r)
    assert (error < 1.02 * off + rounding).all()
    assert error.max() > 0.3 * off
    jumps = table.astype(float).sum(0)[:-1] - table[0, 1:]
    assert np.abs(jumps * np.sqrt(np.arange(1, INTERVALS) / density)).max() < 2.1 * off


def test_a_table_serves_where_it_is_accurate_enough():
    cutoff = 9.0
    for x in np.arange(0.5, 5.1, 0.2):
        alpha = x / cutoff
        *_, off = force_table(alpha, cutoff)
        allowed = TABLE_ERROR * cutoff * screened_force(alpha, 0.0)
        assert (off < allowed) == (x < 3.25)
        for error in (0.0, 0.9 * off, 1.1 * off):
            found = screening_of_lanes(alpha, cutoff, np.float32, error)
            assert isinstance(found, TabledScreening) == (
                simd.HAS_AVX512 and off < max(error, allowed)
            )
            assert found.energy == screening(alpha, cutoff, np.float32).energy
        assert screening_of_lanes(alpha, cutoff, np.float64) == screening(alpha, cutoff)


@kernel(from_python=True)
def screened_pairs(law, r2, energy, force):
    for i in range(0, len(r2), simd.lanes_of(r2)):
        at = simd.load(r2, i)
        inverse, one, two = simd.inverse_root_and_cube(at)
        u, w = screened(law, inverse, (one, two), at)
        simd.store(energy, i, u)
        simd.store(force, i, w)


@pytest.mark.parametrize("x", [1.0, 2.0, 2.77, 3.1, 4.0, 5.0])
@pytest.mark.parametrize(("dtype", "rounding"), [(np.float64, 2e-14), (np.float32, 1.5e-6)])
def test_vectors_of_pairs_have_the_forces_of_erfc(x, dtype, rounding):
    """Rounding is relative to the parts that nearly cancel at large distances: a pair of charges,
    and the screening."""
    cutoff = 9.0
    alpha = x / cutoff
    r2 = np.linspace(1.0, cutoff**2, 1600, endpoint=False).astype(dtype)
    energy, force = np.zeros_like(r2), np.zeros_like(r2)
    screened_pairs(screening_of_lanes(alpha, cutoff, dtype), r2, energy, force)
    r = np.sqrt(r2.astype(float))
    u = erfc(alpha * r) / r
    w = u / r2 + 2 * alpha / np.sqrt(np.pi) * np.exp(-((alpha * r) ** 2)) / r2
    assert (np.abs(energy - u) < rounding * (1 / r + alpha)).all()
    assert (np.abs(force - w) < rounding * (1 / r**3 + screened_force(alpha, 0.0))).all()


@pytest.mark.parametrize("alpha", [0.2, pytest.param(0.0, marks=pytest.mark.soak)])
def test_damped_shifted_force_is_fennell_and_gezelter(alpha):
    cutoff = 6.0
    forces = {"cutoff_A": cutoff, "electrostatics": "damped_shifted_force", "damping_per_A": alpha}
    system, engine, state = built({"tip4p2005": 8, "spce": 6}, 13.0, 3, forces=forces)
    x, q, owner = charged_sites(system, state)
    slope_at = (
        erfc(alpha * cutoff) / cutoff**2
        + 2 * alpha / np.sqrt(np.pi) * np.exp(-((alpha * cutoff) ** 2)) / cutoff
    )

    def law(r):
        return (
            erfc(alpha * r) / r - erfc(alpha * cutoff) / cutoff + slope_at * (r - cutoff)
            if r < cutoff
            else 0.0
        )

    pairs = own = 0.0
    for i in range(len(x)):
        own -= q[i] ** 2 * (
            alpha / np.sqrt(np.pi) + 0.5 * (erfc(alpha * cutoff) / cutoff + slope_at * cutoff)
        )
        for j in range(i):
            if owner[i] == owner[j]:
                r = np.linalg.norm(x[i] - x[j])
                own += q[i] * q[j] * (law(r) - 1 / r)
            else:
                pairs += (
                    q[i] * q[j] * law(np.linalg.norm(nearest(x[i] - x[j], cell_of(system.space))))
                )
    seen = observe(system, engine, state)
    assert seen.components["coulomb"] == pytest.approx(KE * pairs, rel=1e-10)
    assert seen.components["damped_self"] == pytest.approx(KE * own, rel=1e-10)
