"""Electric fields: units, dipoles, charges that travel through images."""

from math import pi

import numpy as np
import pytest
from support.common import move, observe, small_scene
from support.fields import STEADY, VERLET, alone
from support.slopes import energy_of

from rigidmd.assemble.build import build
from rigidmd.mechanics.rotation import from_vector
from rigidmd.units import AVOGADRO, DEBYE, ELEMENTARY_CHARGE


def test_units_are_those_of_the_keys():
    """1 V/nm pulls at a charge e with 1.602e-10 N, 96.49 kJ/mol/nm; 1 m/s² at 1 u with 1.66e-27
    N."""
    _, engine, state = alone({"bead": 1}, {"electric_V_per_nm": [0.0, 0.0, 1.0]})
    newton = AVOGADRO * 1e-10 * 1e-3 * 100  # J/m is kJ/mol/Å, is u Å/ps²
    assert engine.evaluate(state)[0].force[0].tolist() == pytest.approx(
        [0, 0, ELEMENTARY_CHARGE * 1e9 * newton]
    )
    _, engine, state = alone({"bead": 1}, {"gravity_m_s2": [0.0, 2e12, 0.0]})
    assert engine.evaluate(state)[0].force[0].tolist() == pytest.approx(
        [0, 20e-3 / AVOGADRO * 2e12 * newton, 0]
    )


def test_a_field_sees_every_charge_where_it_is():
    system, engine, state = alone({"kite": 3, "rod": 2, "dumbbell": 2}, STEADY)
    charge = system.of_sites(lambda m: m.charges)
    field = np.array(STEADY["electric_V_per_nm"]) * ELEMENTARY_CHARGE * AVOGADRO * 1e-2
    x = system.site_positions(state)
    assert energy_of(engine, state) == pytest.approx(-(charge @ x) @ field, rel=1e-12)
    each = charge[:, None] * field
    lab = np.cross(x - state.position[system.sites.molecule], each)
    torque = np.array([lab[system.sites.molecule == m].sum(axis=0) for m in range(7)])
    found = np.einsum("nij,nj->ni", state.rotation, engine.evaluate(state)[0].torque_body)
    assert found == pytest.approx(torque, abs=1e-12 * np.abs(torque).max())


def test_a_dipole_rotates_towards_the_field():
    """Torque mu E sin(theta), energy -mu E cos(theta); 2.351 D in 1 V/nm."""
    system = build(small_scene({"spce": 1}, None, fields={"electric_V_per_nm": [0.0, 0.0, 1.0]}))
    engine, state = system.engine(), system.state.copy()
    water = system.species[0]
    mu = water.charges @ water.positions_body
    size = np.linalg.norm(mu) * ELEMENTARY_CHARGE * AVOGADRO * 1e-2  # e Å times 1 V/nm
    assert np.linalg.norm(mu) / DEBYE == pytest.approx(2.351, abs=1e-3)
    for theta in (0.0, 0.4, pi / 2, pi):
        # a rotation that carries mu into the xz plane, theta from z
        axis = np.cross(mu, [0, 0, 1.0])
        upright = from_vector(
            (axis / np.linalg.norm(axis) * np.arccos(mu[2] / np.linalg.norm(mu)))[None]
        )[0]
        state.rotation[0] = from_vector(np.array([[0, theta, 0]]))[0] @ upright
        load, tallies = engine.evaluate(state)
        torque = state.rotation[0] @ load.torque_body[0]
        assert torque.tolist() == pytest.approx([0, -size * np.sin(theta), 0], abs=1e-12 * size)
        assert tallies["electric_field"].energy == pytest.approx(
            -size * np.cos(theta), abs=1e-12 * size
        )
        assert not load.force.any()


def test_a_charge_that_travels_through_images_keeps_its_energy():
    system, engine, state = alone(
        {"bead": 1}, {"electric_V_per_nm": [1.0, 0.0, 0.0]}, {"lengths_A": 20.0}
    )
    before, start = observe(system, engine, state).energy, state.position.copy()
    move(engine, state, VERLET, 0.01, 500)
    assert (state.position - start)[0, 0] > 25 * 20
    seen = observe(system, engine, state)
    assert seen.energy == pytest.approx(before, abs=1e-11 * seen.kinetic)
