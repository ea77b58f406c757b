"""Coulomb pairs with a reaction field."""

import pytest
from support.common import small_scene

from rigidmd.assemble.build import build


def test_the_self_energy_of_the_reaction_field():
    system = build(small_scene({"spce": 4}, 20.0, forces={"truncation": "switch"}))
    field = 0.5 / 9.0**3
    dipole2 = (system.species[0].dipole_debye / 4.803204712570263) ** 2
    assert system.constants["reaction_field_self"] == pytest.approx(
        -4 * field * dipole2 * 138935.457644, rel=1e-9
    )
