"""Barostats: the driving force is the slope of enthalpy, moves are in balance, ideal gases have
their volume."""

import numba
import numpy as np
import pytest
from scipy import stats
from support.common import built, move, observe, same_bits, small_scene

from rigidmd.assemble.build import barostat_of, build
from rigidmd.core.integrators import SCHEMES, WITH_THERMOSTAT
from rigidmd.core.state import NOW, WORK
from rigidmd.dynamics import barostats
from rigidmd.dynamics.barostats import (
    COMPONENTS,
    COUPLINGS,
    Pressure,
    barostat_workspace,
    cell_rescaling,
)
from rigidmd.dynamics.barostats.cell_rescaling import CellRescaling
from rigidmd.dynamics.barostats.monte_carlo import VolumeMoves
from rigidmd.dynamics.noise import BAROSTAT, THERMOSTAT, key_of
from rigidmd.dynamics.thermostats import constant_ramp
from rigidmd.dynamics.thermostats.langevin import Langevin
from rigidmd.dynamics.thermostats.velocity_rescaling import VelocityRescaling
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run import Simulation
from rigidmd.run.minimise import remove_overlaps
from rigidmd.scene import Scene
from rigidmd.units import BAR, BOLTZMANN

VERLET = SCHEMES["velocity_verlet"]
THERMAL = 300 * BOLTZMANN
NPT = {"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0, "duration_ps": 0.1}
QUIET = {"trajectory": False, "figures": False}


@numba.njit
def driving(box, model, state, room, k, volume, thermal):
    return cell_rescaling.strain_force(box, model, state, room, k, volume, thermal)


@numba.njit
def log_acceptance(box, model, state, room, h):
    return barostats.log_acceptance(box, model, state, room, h)


@numba.njit
def set_matrices(room):
    barostats.set_matrices(room)


@numba.njit
def strain_state(box, state, room):
    barostats.apply_strain(box, state, room)


@pytest.fixture(
    scope="module", params=["reaction_field", pytest.param("pme", marks=pytest.mark.soak)]
)
def liquid(request):
    """20 waters and 12 nitrogens in a slanted box under a stress, with a tail: system, engine,
    state."""
    forces = {
        "cutoff_A": 5.5,
        "truncation": "smooth_switch",
        "electrostatics": request.param,
        "tail_correction": True,
    }
    if request.param == "pme":
        forces |= {"ewald_accuracy": 1e-8}
    stress = [100.0, -200.0, 400.0, 250.0, -150.0, 350.0]
    stage = NPT | {"pressure_bar": stress, "pressure_coupling": "flexible"}
    box = {"lengths_A": [12.0, 12.5, 13.0], "angles_deg": [80.0, 85.0, 95.0]}
    system, engine, state = built(
        {"spce": 20, "nitrogen": 12}, 12.0, 3, spread=0.1, forces=forces, stages=[stage], box=box
    )
    remove_overlaps(system, engine, state, THERMAL, 0.002)
    return system, engine, state


def tallied(system, engine, state, room):
    """Fill the workspace with the present energies and virial, as `advance` does."""
    _, tallies = engine.evaluate(state)
    room.tally[0, 0] = sum(tally.energy for tally in tallies.values())
    room.tally[0, 1:] = sum(tally.virial for tally in tallies.values()).ravel()


def strained(system, engine, box, start, strain):
    """The state after a strain (6,), and a workspace that remembers how it was before."""
    state, room = start.copy(), barostat_workspace(start)
    tallied(system, engine, start, room)
    room.tally[1] = room.tally[0]
    room.strain[0] = strain
    set_matrices(room)
    strain_state(box, state, room)
    engine.forget()
    tallied(system, engine, state, room)
    return state, room


def enthalpy(system, engine, state, pressure):
    """Potential energy with the tail, kinetic energy and P V of the isotropic part (u Å²/ps²)."""
    return observe(system, engine, state).energy + np.mean(pressure[:3]) * state.volume


@pytest.mark.parametrize("k", range(6))
def test_what_drives_a_strain_is_minus_the_slope_of_the_enthalpy(liquid, k):
    system, engine, state = liquid
    box = barostat_of(system, 0)._replace(at_rest=(0.0, 0.0, 0.0))
    room = barostat_workspace(state)
    tallied(system, engine, state, room)
    found = driving(box, system.model, state, room, k, state.volume, THERMAL)
    pressure, step = np.array(box.pressure.first), 1e-4
    ends = []
    for sign in (1, -1):
        moved, _ = strained(system, engine, box, state, sign * step * np.eye(6)[k])
        ends.append(enthalpy(system, engine, moved, pressure))
    deviation = pressure[k] - (pressure[:3].mean() if k < 3 else 0.0)
    slope = (ends[0] - ends[1]) / (2 * step) + deviation * state.volume
    # the grid of PME changes with the cell: its own error of 1e-8 is what is left
    assert found == pytest.approx(-slope, rel=1e-5, abs=1e-5 * THERMAL * len(state.position))


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_move_and_its_reverse_are_in_balance(liquid, coupling):
    """The chance of a move times that of its reverse is 1: log ratios of opposite moves are
    opposite."""
    system, engine, state = liquid
    box = barostat_of(system, 0)._replace(coordinate=COUPLINGS[coupling])
    if coupling not in ("anisotropic", "flexible"):
        box = box._replace(pressure=Pressure((9.0,) * 3 + (0.0,) * 3, (9.0,) * 3 + (0.0,) * 3, 1.0))
    rng = np.random.default_rng(4)
    values = (0.03 if coupling == "lateral" else 0.01) * rng.standard_normal(6)
    strain = np.array([values[c] if c >= 0 else 0.0 for c in COUPLINGS[coupling]])
    after, room = strained(system, engine, box, state, strain)
    h = 0.05
    there = prepared(system, engine, box, state, after, room, h)
    inverse = room.matrices[1]
    back = np.array([inverse[i, j] for i, j in COMPONENTS])
    back[:3] = -strain[:3]
    again, other = strained(system, engine, box, after, back)
    assert again.position == pytest.approx(state.position, abs=1e-10)
    assert again.velocity == pytest.approx(state.velocity, abs=1e-10)
    assert again.cell == pytest.approx(state.cell, abs=1e-12)
    returned = prepared(system, engine, box, after, again, other, h)
    assert abs(there) > 0.1
    assert there == pytest.approx(-returned, abs=1e-6 * max(1, abs(there)))


def test_a_flexible_move_has_the_chance_of_its_density_of_states(liquid):
    """The formula of the theory page: energy, work of the mean pressure and of the stress, volume,
    momentum at rest, densities of the move and its reverse, measure of lower triangular matrices."""
    system, engine, state = liquid
    pressure = np.array([900.0, -300.0, 600.0, 250.0, -400.0, 150.0]) * BAR  # by COMPONENTS
    target = Pressure(tuple(pressure), tuple(pressure), 1.0)
    box = barostat_of(system, 0)._replace(
        coordinate=COUPLINGS["flexible"], pressure=target, at_rest=(1.0, 0.0, 1.0)
    )
    h, strain = 0.05, 0.01 * np.random.default_rng(7).standard_normal(6)
    after, room = strained(system, engine, box, state, strain)
    found = prepared(system, engine, box, state, after, room, h)
    back = np.array([room.matrices[1][i, j] for i, j in COMPONENTS])
    back[:3] = -strain[:3]
    mean, thermal = pressure[:3].mean(), box.thermal_energy[0]
    volume, new_volume = state.volume, after.volume
    stress = pressure - mean * np.array([1, 1, 1, 0, 0, 0])
    work = 0.5 * (volume + new_volume) * stress @ (0.5 * (strain - back))
    expected = -(mean * (new_volume - volume) + work) / thermal
    energies = [observe(system, engine, at).energy for at in (state, after)]
    expected -= (energies[1] - energies[0]) / thermal
    expected += np.log(new_volume / volume) + strain[0] + strain[2]
    expected -= 2 * (strain[1] + 2 * strain[2])
    for at, values, sign in ((after, back, 1), (state, strain, -1)):
        own, means, variances = barostat_workspace(at), np.zeros(6), np.zeros(6)
        engine.forget()
        tallied(system, engine, at, own)
        drift(box, system.model, at, own, h, means, variances)
        expected += sign * stats.norm.logpdf(values, means, np.sqrt(variances)).sum()
    assert abs(work) > 0.1 * thermal
    assert found == pytest.approx(expected, abs=1e-6 * max(1, abs(expected)))


@numba.njit
def drift(box, model, state, room, h, mean, variance):
    cell_rescaling.drift(box, model, state, room, h, mean, variance)


def prepared(system, engine, box, before, after, room, h):
    """Log of the chance of a move whose drift is the value of the state before."""
    own = barostat_workspace(before)
    engine.forget()
    tallied(system, engine, before, own)
    drift(box, system.model, before, own, h, room.strain[1], room.strain[2])
    room.velocity[:] = before.velocity
    room.cell[:] = before.cell
    return log_acceptance(box, system.model, after, room, h)


def gas(count, thermostat, box_for, samples=800, steps=30):
    """Volumes of an ideal gas in units of kT/p, every `steps` steps."""
    site = {
        "name": "A",
        "element": "Ar",
        "sigma_A": 0.005,
        "epsilon_kJ_mol": 1e-6,
        "mass_u": 40.0,
        "position_A": [0.0, 0.0, 0.0],
    }
    scene = Scene.from_dict(
        {
            "box": {"lengths_A": 10.0},
            "molecules": [{"name": "point", "sites": [site], "count": count}],
            "start": {"temperature_K": 300.0},
            "stages": [{"duration_ps": 0.01}],
            "forces": {"cutoff_A": 0.02, "skin_A": 0.01, "electrostatics": "none"},
        }
    )
    system = build(scene)
    pressure = (count + 1) * THERMAL / system.state.volume
    asked = Pressure((pressure,) * 3 + (0.0,) * 3, (pressure,) * 3 + (0.0,) * 3, 1.0)
    bath = VelocityRescaling(constant_ramp(THERMAL), 0.05, *system.freedom, key_of(1, THERMOSTAT))
    if thermostat == "langevin":
        bath = Langevin(constant_ramp(THERMAL), 20.0, 20.0, key_of(1, THERMOSTAT))
    row = VERLET.with_thermostat(bath).with_barostat(box_for(asked, pressure), 2)
    engine = system.engine()
    state = engine.begin(system.state, row)
    found = []
    for _ in range(samples):
        move(engine, state, row, 0.005, steps)
        found.append(state.volume * pressure / THERMAL)
    return np.array(found), engine.moves


@pytest.mark.parametrize(
    ("barostat", "thermostat"),
    [
        ("cell_rescaling", "velocity_rescaling"),
        pytest.param("cell_rescaling", "langevin", marks=pytest.mark.soak),
        ("monte_carlo", "langevin"),
    ],
)
def test_an_ideal_gas_has_its_volumes(barostat, thermostat):
    """p(V) ~ V^N exp(-p V/kT): a Gamma distribution, whatever the thermostat does to the total
    momentum."""
    n, key = 8, key_of(3, BAROSTAT)

    def box_for(asked, pressure):
        if barostat == "monte_carlo":
            return VolumeMoves(constant_ramp(THERMAL), asked, 600.0, float(n), (0.0, 0.0), key)
        at_rest = (1.0,) * 3 if thermostat == "velocity_rescaling" else (0.0,) * 3
        return CellRescaling(
            constant_ramp(THERMAL),
            asked,
            10.0 / pressure,
            COUPLINGS["isotropic"],
            at_rest,
            (0.0, 0.0),
            key,
        )

    volumes, moves = gas(n, thermostat, box_for, samples=6000)
    assert 0.2 < moves[1] / moves[0] < 0.99  # what is rejected matters
    blocks = volumes.reshape(20, -1).mean(axis=1)
    error = blocks.std(ddof=1) / np.sqrt(len(blocks))
    assert error < 0.13
    assert abs(volumes.mean() - (n + 1)) < 4 * error
    assert volumes.var() == pytest.approx(n + 1, rel=0.13)
    apart = volumes[
        :: max(1, round(len(volumes) * error**2 / volumes.var()))
    ]  # about as far as the correlation reaches
    assert stats.kstest(apart, "gamma", args=(n + 1,)).pvalue > 1e-3


@pytest.mark.parametrize(
    ("n", "samples"),
    [
        (1, 300),
        (2, 300),
        pytest.param(1, 20000, marks=pytest.mark.soak),
        pytest.param(2, 20000, marks=pytest.mark.soak),
    ],
)
def test_a_box_with_one_or_two_molecules_has_its_volumes(n, samples):
    """Moves of the volume by up to 1.8 volumes of one molecule: those to no volume are rejected. A
    proposal that is changed to a possible one would have no reverse."""

    def box_for(asked, pressure):
        width = 2 * np.sqrt(n + 1) * THERMAL / pressure
        return VolumeMoves(
            constant_ramp(THERMAL), asked, width, float(n), (0.0, 0.0), key_of(3, BAROSTAT)
        )

    volumes, moves = gas(n, "langevin", box_for, samples, 2)
    assert moves[1] < moves[0]
    ratio = volumes[1:] / volumes[:-1]
    assert ((ratio > 0.1) & (ratio < 10.0)).all()
    assert not np.isclose(ratio, 0.1, rtol=1e-9).any()
    assert ratio.min() < 0.3  # close to the limit
    if samples > 1000:
        assert stats.kstest(volumes[::40], "gamma", args=(n + 1,)).pvalue > 1e-3
        blocks = volumes.reshape(40, -1).mean(axis=1)
        assert abs(volumes.mean() - (n + 1)) < 4 * blocks.std(ddof=1) / np.sqrt(len(blocks))


def test_a_rejected_move_leaves_no_trace(liquid):
    system, _, state = liquid
    dear = CellRescaling(
        constant_ramp(THERMAL),
        Pressure((0.0,) * 6, (0.0,) * 6, 1.0),
        1e4 * barostat_of(system, 0).rate,
        COUPLINGS["flexible"],
        (1.0, 1.0, 1.0),
        (0.0, 0.0),
        key_of(1, BAROSTAT),
    )
    fresh = system.engine()
    still, moved = state.copy(), state.copy()
    move(fresh, moved, VERLET.with_barostat(dear, 1), 0.0, 5)
    assert fresh.moves == (5, 0)
    for name, a, b in zip(state._fields, still, moved, strict=True):
        assert name in ("step", "time") or a.tobytes() == b.tobytes(), name


@pytest.fixture(scope="module")
def compressed():
    """32 nitrogens, dense, under a piston: system, state."""
    stage = {"ensemble": "nph", "pressure_bar": 2000.0, "duration_ps": 0.1, "barostat_time_ps": 0.3}
    forces = {"cutoff_A": 4.5, "truncation": "smooth_switch", "tail_correction": True}
    system, engine, state = built(
        {"nitrogen": 32}, 11.5, 2, spread=0.1, forces=forces, stages=[stage]
    )
    remove_overlaps(system, engine, state, THERMAL, 0.002)
    bath = Langevin(constant_ramp(THERMAL), 20.0, 20.0, key_of(1, THERMOSTAT))
    move(engine, state, WITH_THERMOSTAT["baoab"].with_thermostat(bath), 0.002, 300)
    state.velocity[:] -= state.velocity.mean(axis=0)
    state.begin_segment()
    return system, state._replace(energy_ledger=np.zeros(3))


@pytest.mark.parametrize(("integrator", "order"), [("velocity_verlet", 2), ("suzuki_4", 4)])
def test_a_piston_conserves_the_enthalpy_to_its_order(compressed, integrator, order):
    system, start = compressed
    row = SCHEMES[integrator].with_piston(barostat_of(system, 0))
    spreads = []
    for dt in (0.004, 0.002):
        engine = system.engine()
        state, found = engine.begin(start, row), []
        for _ in range(30):
            move(engine, state, row, dt, round(0.008 / dt))
            found.append(observe(system, engine, state).energy - state.energy_ledger.sum())
        spreads.append(np.std(found))
        assert abs(state.volume / start.volume - 1) > 1e-3 and state.energy_ledger[WORK] != 0
    assert np.log2(spreads[0] / spreads[1]) == pytest.approx(order, abs=0.35)


def test_a_piston_can_be_run_backwards(compressed):
    system, start = compressed
    row, engine = VERLET.with_piston(barostat_of(system, 0)), system.engine()
    state = engine.begin(start, row)
    move(engine, state, row, 0.002, 40)
    assert abs(state.volume / start.volume - 1) > 1e-3
    for array in (state.velocity, state.angular_momentum_body, state.extra_variables):
        array *= -1
    engine.forget()
    move(engine, state, row, 0.002, 40)
    assert state.volume == pytest.approx(start.volume, rel=1e-11)
    assert state.position == pytest.approx(start.position, abs=1e-9)


@pytest.mark.parametrize(
    "stage",
    [
        {"pressure_coupling": "flexible"},
        pytest.param({"barostat": "monte_carlo"}, marks=pytest.mark.soak),
        pytest.param({"ensemble": "nph", "temperature_K": None}, marks=pytest.mark.soak),
    ],
    ids=str,
)
def test_every_barostat_has_the_same_bits_for_any_number_of_threads(stage):
    own = {
        key: value
        for key, value in (NPT | {"duration_ps": 0.02} | stage).items()
        if value is not None
    }
    own |= {} if own["ensemble"] == "nph" else {"barostat_interval_ps": 0.006}
    scene = small_scene({"spce": 800}, 30.0, stages=[own], output=QUIET)
    found = [Simulation(scene.model_copy(update={"threads": k})).run().state for k in (1, None)]
    assert same_bits(*found)
    assert found[0].volume != pytest.approx(27000, rel=1e-9) and found[0].step[NOW] == 10


def test_forces_follow_the_cell_through_a_run():
    """After a run at a pressure, forces, energies and virial are those of a new engine."""
    scene = small_scene(
        {"spce": 60},
        13.0,
        stages=[NPT | {"barostat_interval_ps": 0.004, "barostat_time_ps": 0.05}],
        forces={"cutoff_A": 5.5},
        output=QUIET,
    )
    simulation = Simulation(scene)
    results = simulation.run()
    assert abs(results.state.volume / 13.0**3 - 1) > 1e-3
    load, tallies = simulation.engine.evaluate(results.state)
    again, others = simulation.system.engine().evaluate(results.state)
    assert load.force == pytest.approx(again.force, rel=1e-10, abs=1e-8)
    for name in tallies:
        assert tallies[name].energy == pytest.approx(others[name].energy, rel=1e-11)


def test_the_log_has_the_box_and_the_energy_ledger(tmp_path):
    stages = [NPT | {"pressure_coupling": "flexible", "barostat_interval_ps": 0.004}]
    output = {
        "trajectory": "t.xtc",
        "trajectory_interval_ps": 0.02,
        "log_interval_ps": 0.02,
        "pressure_tensor": True,
    }
    scene = small_scene({"spce": 60}, 13.0, stages=stages, forces={"cutoff_A": 5.0}, output=output)
    results = Simulation(scene, tmp_path / "out").run()
    assert "Pressure xy (bar)" in (tmp_path / "out" / "log.csv").read_text().splitlines()[0]
    trace = sum(results[f"pressure_{k}{k}"] for k in "xyz")
    assert trace / 3 == pytest.approx(results["pressure"], rel=1e-9)
    assert results["volume"][-1] == pytest.approx(results.state.volume * 1e-3)
    assert results["gamma"][-1] != 90 and results["work"][-1] != 0
    frames = (
        results.trajectory()
        if callable(getattr(results, "trajectory", None))
        else results.universe().trajectory
    )
    assert (
        len({tuple(np.round(ts.dimensions, 4)) for ts in frames}) > 2
    )  # each frame has its own cell


@pytest.mark.parametrize(
    "coupled", [NPT, {"ensemble": "nph", "pressure_bar": 1.0, "duration_ps": 0.1}], ids=str
)
def test_a_barostat_does_not_go_with_a_field_on_net_charges(coupled):
    ion = {
        "name": "A",
        "element": "Na",
        "sigma_A": 2.0,
        "epsilon_kJ_mol": 0.4,
        "mass_u": 23.0,
        "charge_e": 1.0,
        "position_A": [0.0, 0.0, 0.0],
    }
    scene = small_scene(
        {"argon": 5},
        30.0,
        stages=[coupled],
        fields={"electric_V_per_nm": [0.0, 0.0, 0.1]},
        molecules=[{"name": "ion", "sites": [ion], "count": 8}],
    )
    with pytest.raises(SceneError, match="electric field depend on absolute positions"):
        build(scene)


def test_a_box_that_becomes_too_small_or_boils_stops_with_a_message():
    small = small_scene(
        {"argon": 40},
        20.0,
        stages=[
            NPT
            | {
                "pressure_bar": 20000.0,
                "barostat_interval_ps": 0.002,
                "duration_ps": 20.0,
                "barostat_time_ps": 0.05,
            }
        ],
        forces={"cutoff_A": 9.0},
        output=QUIET,
    )
    with pytest.raises(SimulationError, match="too small for the cutoff"):
        Simulation(small).run()
    boils = small_scene(
        {"argon": 40},
        14.0,
        stages=[
            NPT
            | {
                "barostat_interval_ps": 0.002,
                "duration_ps": 200.0,
                "barostat_time_ps": 0.02,
                "compressibility_per_bar": 1e-3,
            }
        ],
        forces={"cutoff_A": 6.0},
        output=QUIET,
    )
    with pytest.raises(SimulationError, match="boils"):
        Simulation(boils).run()
