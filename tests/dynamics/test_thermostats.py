"""Thermostats: exact distributions of free bodies, heat to the last digit, chains that conserve,
the same bits."""

import numpy as np
import pytest
from scipy import stats
from support.common import built, move, observe, same_bits, small_scene

from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.compile import kernel
from rigidmd.core.integrators import DRIFT, KICK, SCHEMES, WITH_THERMOSTAT, Flow, Scheme
from rigidmd.core.integrators import THERMOSTAT as THERMOSTAT_FLOW
from rigidmd.core.state import HEAT
from rigidmd.dynamics.noise import BATCH, THERMOSTAT, key_of
from rigidmd.dynamics.thermostats import Ramp, constant_ramp
from rigidmd.dynamics.thermostats.andersen import Andersen
from rigidmd.dynamics.thermostats.langevin import Langevin
from rigidmd.dynamics.thermostats.nose_hoover import NoseHoover
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.mechanics.batches import apply_langevin_group
from rigidmd.run import Simulation
from rigidmd.run.minimise import remove_overlaps
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

VERLET, BAOAB = SCHEMES["velocity_verlet"], WITH_THERMOSTAT["baoab"]
THERMAL = 300 * BOLTZMANN
MIXTURE = {
    "argon": 300,
    "nitrogen": 300,
    "benzene_opls": 300,
    "spce": 300,
}  # point, linear, symmetric, asymmetric


def kinetic(system, state):
    """Kinetic energy, and each square of a momentum over m or I (n, 3): NaN of axes without
    inertia."""
    model = system.model
    mass, inertia = model.mass[model.species], model.inertia[model.species][: len(state.rotation)]
    moving = mass[:, None] * state.velocity**2
    with np.errstate(invalid="ignore", divide="ignore"):
        turning = np.where(inertia > 0, state.angular_momentum_body**2 / inertia, np.nan)
    return 0.5 * moving.sum() + 0.5 * np.nansum(turning), moving, turning


@pytest.mark.parametrize(
    "bath",
    [
        Langevin(constant_ramp(THERMAL), 3.0, 7.0, key_of(2, THERMOSTAT)),
        Andersen(constant_ramp(THERMAL), 0.3, key_of(2, THERMOSTAT)),
    ],
)
def test_free_bodies_of_every_kind_come_to_their_distribution(bath):
    system = build(small_scene(MIXTURE, 150.0, start={"temperature_K": 30.0}))
    state, engine = system.state.copy(), Engine(system.model, {})
    before, *_ = kinetic(system, state)
    move(
        engine, state, BAOAB.with_rotor("exact").with_thermostat(bath), 0.05, 60
    )  # the split rotor has an error of its own
    after, moving, turning = kinetic(system, state)
    assert after - before == pytest.approx(state.energy_ledger[HEAT], rel=1e-11)
    kind = np.array([m.name for m in system.species])[system.model.species]
    for name in MIXTURE:
        for squares in (moving, turning):
            for k in range(3):
                own = squares[kind == name][:, k] / THERMAL
                if np.isfinite(own).all():
                    assert stats.kstest(own, "chi2", args=(1,)).pvalue > 1e-4, (name, k)
    assert (
        np.isnan(turning[kind == "argon"]).all()
        and not state.angular_momentum_body[kind == "argon"].any()
    )
    assert (np.isnan(turning[kind == "nitrogen"]).sum(axis=1) == 1).all()


@kernel(from_python=True)
def stir(model, state, keep, keep_turning, new, numbers, first, end):
    return apply_langevin_group(model, state, keep, keep_turning, new, numbers, first, end)


@pytest.mark.parametrize("first", [0, 3])
def test_friction_and_noise_of_many_molecules_are_those_of_each(first):
    """Groups of several species, and those left over, against NumPy; the rest is left alone."""
    system = build(small_scene({"spce": 21, "argon": 5, "nitrogen": 6, "benzene_opls": 7}, 80.0))
    model, state, end = system.model, system.state.copy(), 38
    rng, keep = np.random.default_rng(1), np.array([0.8, 0.8, 0.8, 0.6, 0.6, 0.6])
    new, numbers = rng.random((len(system.species), 4)), rng.normal(size=(6, BATCH))
    heat = stir(model, state, 0.8, 0.6, new, numbers.ravel(), first, end)
    size = new[model.species][:, [3, 3, 3, 0, 1, 2]]
    before = np.hstack([system.state.velocity, system.state.angular_momentum_body])
    after = np.hstack([state.velocity, state.angular_momentum_body])
    expected = before.copy()
    expected[first:end] = keep * before[first:end] + size[first:end] * numbers.T[: end - first]
    assert after == pytest.approx(expected, rel=1e-14, abs=1e-14)
    weight = np.hstack([np.repeat(model.mass[:, None], 3, axis=1), model.inverse_inertia])[
        model.species
    ]
    assert heat == pytest.approx(0.5 * (weight * (expected**2 - before**2)).sum(), rel=1e-12)


def test_friction_is_that_of_each_motion():
    """Without noise, at 0 K, momenta fall by exactly exp(-friction t)."""
    system = build(small_scene({"spce": 5}, 40.0))
    row = BAOAB.with_thermostat(Langevin(constant_ramp(0.0), 2.0, 5.0, key_of(1, THERMOSTAT)))
    state = system.state.copy()
    move(Engine(system.model, {}), state, row, 0.01, 10)
    assert state.velocity == pytest.approx(system.state.velocity * np.exp(-0.2), rel=1e-13)
    size = np.linalg.norm(system.state.angular_momentum_body, axis=1)
    assert np.linalg.norm(state.angular_momentum_body, axis=1) == pytest.approx(
        size * np.exp(-0.5), rel=1e-12
    )


def test_collisions_come_after_their_mean_time():
    system = build(small_scene({"argon": 4000}, 200.0))
    row = VERLET.with_thermostat(
        Andersen(constant_ramp(THERMAL), 0.5, key_of(4, THERMOSTAT)), halved=True
    )
    state = system.state.copy()
    move(Engine(system.model, {}), state, row, 0.1, 3)
    kept = (state.velocity == system.state.velocity).all(axis=1).mean()
    assert kept == pytest.approx(np.exp(-0.6), abs=4 * np.sqrt(0.25 / 4000))


@pytest.fixture(scope="module")
def liquid():
    """27 waters and 5 nitrogens without overlaps, with momenta: system, state."""
    system, engine, state = built(
        {"spce": 27, "nitrogen": 5},
        12.0,
        spread=0.1,
        forces={"cutoff_A": 5.0, "truncation": "smooth_switch", "switch_start_A": 3.0},
    )
    remove_overlaps(system, engine, state, THERMAL, 0.002)
    move(
        engine,
        state,
        BAOAB.with_thermostat(Langevin(constant_ramp(THERMAL), 20.0, 20.0, key_of(1, THERMOSTAT))),
        0.001,
        500,
    )
    return system, state._replace(energy_ledger=np.zeros(3))


def test_chains_conserve_the_energy_of_molecules_and_chains_to_order_two(liquid):
    system, start = liquid
    bath = NoseHoover(
        constant_ramp(THERMAL), 0.05, 3, system.freedom.translation, system.freedom.rotation
    )
    row, spreads = VERLET.with_thermostat(bath, halved=True), []
    for dt in (0.002, 0.001, 0.0005):
        engine = system.engine()
        state, found = engine.begin(start, row), []
        for _ in range(50):
            move(engine, state, row, dt, round(0.004 / dt))
            found.append(observe(system, engine, state).energy - state.energy_ledger.sum())
        spreads.append(np.std(found))
        assert state.extra_variables.any() and abs(state.energy_ledger[HEAT]) > 20 * spreads[-1]
    assert np.log2(np.array(spreads[:-1]) / spreads[1:]) == pytest.approx([2, 2], abs=0.25)


def test_chains_can_be_run_backwards(liquid):
    system, start = liquid
    bath = NoseHoover(
        constant_ramp(THERMAL), 0.05, 4, system.freedom.translation, system.freedom.rotation
    )
    row, engine = VERLET.with_thermostat(bath, halved=True), system.engine()
    state = engine.begin(start, row)
    move(engine, state, row, 0.001, 50)
    there = state.position.copy()
    for array in (state.velocity, state.angular_momentum_body):
        array *= -1
    rates = state.extra_variables.reshape(2, 2, 4)[:, 1]
    rates *= -1
    engine.forget()
    move(engine, state, row, 0.001, 50)
    assert np.abs(there - start.position).max() > 0.01
    assert state.position == pytest.approx(start.position, abs=1e-9)
    assert state.extra_variables.reshape(2, 2, 4)[:, 0] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    "thermostat",
    [
        "langevin",
        *(
            pytest.param(name, marks=pytest.mark.soak)
            for name in ("velocity_rescaling", "nose_hoover", "andersen")
        ),
    ],
)
def test_every_thermostat_draws_the_same_bits_for_any_number_of_threads(thermostat):
    stage = {
        "ensemble": "nvt",
        "temperature_K": [300.0, 310.0],
        "thermostat": thermostat,
        "duration_ps": 0.02,
    }
    scene = small_scene({"spce": 1000}, 32.0, stages=[stage], output={"trajectory": False})
    found = [Simulation(scene.model_copy(update={"threads": k})).run().state for k in (1, None)]
    assert same_bits(*found)
    assert found[0].energy_ledger[HEAT] != 0


def test_a_ramp_goes_from_its_begin_to_its_end():
    system = build(small_scene({"argon": 3000}, 150.0))
    row = BAOAB.with_thermostat(
        Langevin(Ramp(THERMAL, 2 * THERMAL, 100.0), 50.0, 50.0, key_of(1, THERMOSTAT))
    )
    state, engine = system.state.copy(), Engine(system.model, {})
    for part in (0.5, 1.0):
        move(engine, state, row, 0.02, 50)
        _, moving, _ = kinetic(system, state)
        assert moving.mean() / THERMAL == pytest.approx(1 + part, abs=0.05)


MIDDLE = Scheme(
    "two kicks on either side of the thermostat",
    (
        Flow(KICK, 0.2),
        Flow(DRIFT, 0.4),
        Flow(KICK, 0.3),
        Flow(DRIFT, 0.1),
        Flow(THERMOSTAT_FLOW, 1.0),
        Flow(DRIFT, 0.1),
        Flow(KICK, 0.3),
        Flow(DRIFT, 0.4),
        Flow(KICK, 0.2),
    ),
    order=2,
    exact_rotor=False,
    source="made for this test",
)


def oscillation(flows, h):
    """Matrix of flows of an oscillator of mass 1 and force -x for (x, v)."""
    matrix = np.eye(2)
    for flow in flows:
        if flow.kind == DRIFT:
            matrix = np.array([[1, flow.fraction * h], [0, 1]]) @ matrix
        elif flow.kind == KICK:
            strength = flow.fraction * h * (1 - flow.gradient * h * h)
            matrix = np.array([[1, 0], [-strength, 1]]) @ matrix
    return matrix


@pytest.mark.parametrize("scheme", [*SCHEMES.values(), BAOAB, MIDDLE], ids=lambda row: row.name)
def test_kinetic_energies_are_corrected_by_the_scheme(scheme):
    """Twice the corrected kinetic energy of an oscillator is the mean of v² where the thermostat acts,
    and without a thermostat the temperature of the shadow Hamiltonian w' J, with J the area of its
    ellipse over 2 pi; both with an error of order h⁴."""
    for h in (0.2, 0.1):
        step = oscillation(scheme.flows, h)
        ratio = np.sqrt(-step[1, 0] / step[0, 1])  # of the ellipse v² + ratio² x² = 2
        squares = np.diag([1 / ratio**2, 1.0])
        kinds = [flow.kind for flow in scheme.flows]
        if THERMOSTAT_FLOW in kinds:
            to = oscillation(scheme.flows[: kinds.index(THERMOSTAT_FLOW)], h)
            exact = (to @ squares @ to.T)[1, 1]
        else:
            exact = np.arccos(step.trace() / 2) / h / ratio
        corrected = squares[1, 1] + 2 * scheme.kinetic_correction * h**2 * squares[0, 0]
        assert abs(corrected - exact) < h**4


@pytest.mark.parametrize("halved", [True, False])
def test_kinetic_energies_at_the_ends_are_those_of_a_thermostat_there(halved):
    scheme = VERLET.with_thermostat((), halved=halved)
    assert scheme.kinetic_correction == 0
    assert BAOAB.with_thermostat(()).kinetic_correction == 1 / 8
    assert scheme.shadow_correction == pytest.approx(1 / 12)
    assert VERLET.with_groups((), 5).kinetic_correction == 0


def test_degrees_of_freedom_follow_the_thermostat():
    heat = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.004}
    stirred = heat | {"thermostat": "langevin", "friction_translation_per_ps": 200.0}
    stages = [stirred, heat, {"duration_ps": 0.004}]
    scene = small_scene(
        {"spce": 20}, 20.0, stages=stages, output={"trajectory": False, "log_interval_ps": 0.002}
    )
    simulation = Simulation(scene)
    system = simulation.system
    assert [system.freedom_in(k).total for k in range(3)] == [120, 117, 117]
    thermostat = integrator_of_stage(system, 1).thermostat
    assert (thermostat.freedom_translation, thermostat.freedom_rotation) == (57, 60)
    results = simulation.run()
    own = results["stage"] == 0
    mass = system.model.mass[system.model.species].sum()
    assert results["momentum"][own][-1] ** 2 / (2 * mass) > KJ_PER_MOL
    assert (
        results["momentum"][~own].max() < 1e-9
    )  # taken out before the stage that conserves it, and accounted for
    assert np.abs(np.diff(results["conserved"])).max() < 0.05  # kJ/mol
