"""Truncated pair potentials: switched forces and corrections."""

import numpy as np
import pytest

from rigidmd.compile import kernel
from rigidmd.forces.potentials.coulomb import radial, reaction_field
from rigidmd.forces.potentials.lennard_jones import energy_and_force, lennard_jones
from rigidmd.forces.potentials.truncation import (
    SWITCH_FUNCTIONS,
    TRUNCATIONS,
    SwitchCorrection,
    SwitchTerm,
    Unmodified,
)


@kernel(from_python=True)
def pair_forces_at(argon, charges, r2, found):
    for k in range(len(r2)):
        found[k, 0] = energy_and_force(argon, 2e9, 3e6, r2[k])[1]
        found[k, 1] = radial(charges, r2[k])[1]


def switched_potentials(name, start):
    """Lennard-Jones of one and of two kinds, and charges, between the same sites."""
    potentials = [
        lennard_jones(
            np.zeros(1, np.int32), np.full(kinds, 3.4), np.full(kinds, 100.0), 9.0, name, start
        )
        for kinds in (1, 2)
    ]
    potentials = [
        potential._replace(c12=np.full_like(potential.c12, 2e9), c6=np.full_like(potential.c6, 3e6))
        for potential in potentials
    ]
    return *potentials, reaction_field(np.zeros(1), 9.0, 78.5, name, start)


def forces_of_products(argon, charges, r):
    """force/r of energies that a switch multiplies, in NumPy."""
    s, slope = np.array(
        [SWITCH_FUNCTIONS[type(argon.truncation)](argon.truncation, x) for x in r]
    ).T
    of_argon = 2e9 * r**-12 - 3e6 * r**-6, 24e9 * r**-14 - 18e6 * r**-8
    of_charges = 1 / r + charges.field * r**2 + charges.terms[0], r**-3 - 2 * charges.field
    return np.stack([s * w - slope * u / r for u, w in (of_argon, of_charges)], axis=1)


@pytest.mark.parametrize("start", [8.1, 5.0, 0.0])
@pytest.mark.parametrize("name", ["switch", "smooth_switch"])
def test_a_switched_force_is_that_of_the_product(name, start):
    """The potentials add a polynomial in r to the coefficients of their forces; it is exact."""
    one, two, charges = switched_potentials(name, start)
    r = np.linspace(max(start - 1, 3.0), 9.0, 2001)
    expected = forces_of_products(one, charges, r)
    for potential in (one, two):
        found = np.empty((len(r), 2))
        pair_forces_at(
            potential.for_slots(1, np.float64), charges.for_slots(1, np.float64), r**2, found
        )
        limit = (
            1e-13 if name == "switch" else 2e-12
        )  # terms of the smooth one are up to 1e4 times their sum
        assert (np.abs(found - expected) / np.abs(expected).max(axis=0)).max() < limit


@pytest.mark.parametrize("start", [8.1, 7.2, 6.8])
def test_the_correction_of_a_switch_gives_the_force_of_its_product(start):
    """The polynomial in r² that mixed precision adds to the force: here in double precision, and
    how far its terms cancel, which single precision would show."""
    one, _, charges = switched_potentials("switch", start)
    potentials = one.for_slots(1, np.float32), charges.for_slots(1, np.float32)
    corrections = potentials[0].correction, potentials[1].switched
    assert all(isinstance(correction, SwitchCorrection) for correction in corrections)
    shape = Unmodified(9.0)
    plain = (
        one._replace(truncation=shape).for_slots(1, np.float32),
        charges._replace(truncation=shape).for_slots(1, np.float32),
    )
    r = np.linspace(start - 1, 9.0, 2001)
    found, without = np.empty((2, len(r), 2))
    pair_forces_at(*potentials, r**2, found)
    pair_forces_at(*plain, r**2, without)
    expected = forces_of_products(one, charges, r)
    before = r < start
    for k, correction in enumerate(corrections):
        largest = np.abs(found[:, k] - without[:, k]).max()
        assert 4 * np.abs(correction.coefficients).sum() < 200 * largest
        assert (
            np.abs(found[:, k] - expected[:, k]).max() < 3e-7 * np.abs(expected[~before, k]).max()
        )
        assert found[before, k] == pytest.approx(expected[before, k], rel=1e-14)


@pytest.mark.parametrize("name", TRUNCATIONS)
def test_what_a_potential_does_for_its_truncation_is_decided_by_the_truncation(name):
    """A wide switch has an addend in mixed precision too; a smooth one multiplies the energy there;
    what is not a switch has nothing to add."""
    for start, dtype in ((0.0, np.float32), (8.0, np.float64)):
        one, two, charges = switched_potentials(name, start)
        one, two, charges = (
            one.for_slots(1, dtype),
            two.for_slots(1, dtype),
            charges.for_slots(1, dtype),
        )
        kind = (
            SwitchTerm
            if name == "switch" or (name == "smooth_switch" and dtype == np.float64)
            else tuple
        )
        assert one.correction == ()
        assert {
            type(x)
            for x in (one.addend12, one.addend6, two.addend12, two.addend6, charges.switched)
        } == {kind}
