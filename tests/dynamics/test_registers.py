"""Registers of the step: sums over molecules and extents, compared with NumPy."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.common import built, same_bits

from rigidmd.assemble.build import integrator_of_stage
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import no_load
from rigidmd.dynamics.observables import largest_values, sums_of_state
from rigidmd.mechanics.rotation import orthogonality_error


@pytest.mark.parametrize(
    "molecules", [{"spce": 5, "argon": 4}, {"argon": 6}, {"nitrogen": 4, "tip4p": 3}]
)
def test_sums_are_those_of_numpy(molecules):
    system, _, state = built(molecules, 30.0, 3)
    model, load = system.model, no_load(state)
    rng = np.random.default_rng(1)
    for array in load:
        array[:] = rng.normal(size=array.shape)
    found, mass = sums_of_state(model, state, load), model.mass[model.species][:, None]
    inverse = model.inverse_inertia[model.species][: len(state.rotation)]
    assert found.momentum == pytest.approx((mass * state.velocity).sum(axis=0), rel=1e-12, abs=1e-9)
    assert found.momentum_flux == pytest.approx(
        (mass * state.velocity).T @ state.velocity, rel=1e-12, abs=1e-9
    )
    assert found.translation == pytest.approx(found.momentum_flux.trace())
    assert found.rotation == pytest.approx(
        (inverse * state.angular_momentum_body**2).sum(), rel=1e-12
    )
    squares = (load.force / mass).T @ load.force
    assert found.force_squares == pytest.approx(squares, rel=1e-12, abs=1e-9)
    assert found.force == pytest.approx((load.force**2 / mass).sum(), rel=1e-12)
    assert found.torque == pytest.approx((inverse * load.torque_body**2).sum(), rel=1e-12)
    if len(state.rotation):
        state.rotation[1] += 1e-6
    assert sums_of_state(model, state).orthogonality_error == pytest.approx(
        orthogonality_error(state.rotation), abs=1e-15
    )
    unloaded = sums_of_state(model, state)
    assert (unloaded.force, unloaded.torque) == (0, 0)
    if len(state.rotation):
        state.rotation[0, 1, 1] = np.nan
        assert np.isnan(sums_of_state(model, state).orthogonality_error)


@pytest.mark.parametrize("molecules", [{"spce": 5, "argon": 4}, {"argon": 6}])
def test_an_extent_has_the_largest_of_every_array(molecules):
    _, _, state = built(molecules, 30.0, 3)
    load = no_load(state)
    load.force[:] = np.random.default_rng(2).normal(size=load.force.shape)
    arrays = [*state[:4], *load]
    assert largest_values(state, load) == tuple(np.abs(array).max(initial=0.0) for array in arrays)
    for k, array in enumerate(arrays):
        if len(array):
            for worst in (
                -1e300,
                np.inf,
                -np.inf,
                np.nan,
                -np.nan,
            ):  # each is larger than the one before
                array.flat[7] = worst
                np.testing.assert_equal(largest_values(state, load)[k], abs(worst))
    assert largest_values(state)[4:] == (0.0, 0.0)


@pytest.mark.parametrize("molecules", [{"spce": 40}, {"argon": 40}])
def test_what_is_measured_at_the_end_of_a_move_is_that_of_the_state(molecules):
    system, engine, state = built(molecules, 25.0, 3)
    verlet = SCHEMES["velocity_verlet"]
    state = engine.begin(state, verlet)

    def same(known=True, with_sums=False):
        assert engine.extent(state) == (largest_values(state, engine.load) if known else None)
        load, _ = engine.evaluate_current(state)
        sums = engine.sums(state, load)
        assert (sums is not None) == with_sums
        if sums is not None:
            of_state = sums_of_state(system.model, state, load)
            for found, expected in zip(sums[:-1], of_state, strict=False):  # without curvature
                np.testing.assert_array_equal(found, expected)

    assert engine.extent(state) is None
    for until, looked in ((3, True), (5, False), (7, True), (7, False), (7, True)):
        engine.advance(state, verlet, 0.001, until, looked)
        same(with_sums=looked)
    state.position[1] += 0.3
    state.velocity[1] *= 100.0
    engine.forget()
    same(known=False)
    engine.advance(
        state, SCHEMES["pefrl"], 0.001, 8, True
    )  # ends with a drift: its forces are those before
    same(known=False)
    other = engine.begin(system.state, verlet)
    assert engine.extent(other) is None


def power_of(system, engine, state):
    """sum F V + sum n . I^-1 L"""
    load, _ = engine.evaluate(state)
    inverse = system.model.inverse_inertia[system.model.species][: len(state.rotation)]
    turning = (inverse * load.torque_body * state.angular_momentum_body).sum()
    return (load.force * state.velocity).sum() + turning


def flown(system, state, time):
    """The state after a time of free flight and free rotation, to first order."""
    other = state.copy()
    other.position[:] += time * state.velocity
    inverse = system.model.inverse_inertia[system.model.species][: len(state.rotation)]
    if len(inverse):
        turn = Rotation.from_rotvec(time * inverse * state.angular_momentum_body)
        other.rotation[:] = state.rotation @ turn.as_matrix()
        other.angular_momentum_body[:] = turn.inv().apply(state.angular_momentum_body)
    return other


def with_weak_thermostat(molecules, integrator):
    """A system, its engine, its state, and an integrator whose thermostat barely acts."""
    stage = {"ensemble": "nvt", "temperature_K": 300.0, "thermostat_time_ps": 1e15}
    stage |= {"duration_ps": 1.0, "integrator": integrator}
    run = {"remove_momentum_interval_ps": False}
    system, engine, state = built(molecules, 18.0, 3, stages=[stage], run=run)
    return system, engine, state, integrator_of_stage(system, 0)


@pytest.mark.parametrize("integrator", ["velocity_verlet", "baoab", "srkn_4"])
@pytest.mark.parametrize("molecules", [{"spce": 6, "argon": 4, "nitrogen": 3}, {"argon": 9}])
def test_the_curvature_is_the_second_derivative_along_free_motion(integrator, molecules):
    """Of the potential energy, in the middle of the last step, from two forces: compared with powers
    after free flights. The steps of a call do not depend on whether it is observed."""
    system, engine, state, scheme = with_weak_thermostat(molecules, integrator)
    plain, whole, dt, steps = state.copy(), state.copy(), 1e-4, 7
    engine.advance(state, scheme, dt, steps - 1)
    before = state.copy()
    engine.forget()
    engine.advance(state, scheme, dt, steps, observed=True)
    found = engine.sums(state, engine.evaluate_current(state)[0]).curvature
    system.engine().advance(plain, scheme, dt, steps)
    assert same_bits(plain, state)
    expected, h = [], 1e-5
    for one in (before, state):
        powers = [power_of(system, system.engine(), flown(system, one, t)) for t in (-h, h)]
        expected.append(-(powers[1] - powers[0]) / (2 * h))
    size = max(map(abs, expected))
    assert found == pytest.approx(np.mean(expected), rel=1e-3, abs=1e-3 * size)
    # of one call the same
    engine = system.engine()
    engine.advance(whole, scheme, dt, steps, observed=True)
    load = engine.evaluate_current(whole)[0]
    assert same_bits(whole, state)
    assert engine.sums(whole, load).curvature == found


def test_the_curvature_is_unknown_without_a_thermostat_or_where_a_step_begins_with_a_drift():
    system, engine, state, scheme = with_weak_thermostat({"spce": 6}, "position_verlet")
    engine.advance(state, scheme, 1e-3, 5, observed=True)
    assert engine.sums(state, engine.evaluate_current(state)[0]) is None
    engine.advance(state, SCHEMES["velocity_verlet"], 1e-3, 10, observed=True)
    assert np.isnan(engine.sums(state, engine.evaluate_current(state)[0]).curvature)
    assert np.isnan(sums_of_state(system.model, state).curvature)
