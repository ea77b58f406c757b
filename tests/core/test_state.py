"""The state: on disk and back, what damaged files are given, and that nothing of a run is anywhere
else."""

import numpy as np
import pytest
from support.common import ROOT, built, move, same_bits, small_scene

from rigidmd.core.integrators import SCHEMES, Solver
from rigidmd.core.state import HEAT, NOW, ORIGIN, state_of
from rigidmd.core.state_file import read_state, write_state
from rigidmd.dynamics.noise import THERMOSTAT, key_of
from rigidmd.dynamics.thermostats import constant_ramp
from rigidmd.dynamics.thermostats.velocity_rescaling import VelocityRescaling
from rigidmd.errors import StructureError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.units import BOLTZMANN

VERLET = SCHEMES["velocity_verlet"]


def test_a_state_comes_back_from_disk_to_the_bit(tmp_path):
    system, engine, state = built({"spce": 5, "argon": 2}, 20.0, 1)
    row = VERLET.with_thermostat(
        VelocityRescaling(
            constant_ramp(BOLTZMANN * 300), 0.1, *system.freedom, key_of(1, THERMOSTAT)
        )
    )
    move(engine, state, row, 0.001, 7)
    assert state.energy_ledger[HEAT] != 0
    write_state(tmp_path / "s.npz", system.saved(state))
    saved = read_state(tmp_path / "s.npz")
    assert same_bits(saved.state, state)
    assert saved.names == ["spce", "argon"] and np.array_equal(saved.species, system.model.species)
    assert np.array_equal(saved.residue_number, system.residue_number)


@pytest.mark.parametrize("steps", [(10, 7, 3), (20,)])
def test_another_engine_continues_where_the_state_is(tmp_path, steps):
    """Time, heat and random numbers continue from the state alone; points, whose sums have one order,
    to the bit."""
    system, _, start = built({"argon": 2}, 30.0, 2)
    row = VERLET.with_thermostat(
        VelocityRescaling(
            constant_ramp(BOLTZMANN * 100), 0.05, *system.freedom, key_of(1, THERMOSTAT)
        )
    )
    whole = start.copy()
    move(system.engine(), whole, row, 0.003, 20)
    state = start
    for n in steps:
        move(system.engine(), state, row, 0.003, n)
        write_state(tmp_path / "s.npz", system.saved(state))
        state = read_state(tmp_path / "s.npz").state
    assert same_bits(whole, state)
    assert state.time[NOW] == 0.06 and state.step[NOW] == 20


def test_time_is_counted_from_where_steps_changed():
    _, engine, state = built({"argon": 2}, 30.0, 2)
    for _ in range(3):
        move(engine, state, VERLET, 0.1, 1)
    assert state.time[NOW] == 3 * 0.1 and state.time[ORIGIN] == 0
    move(engine, state, VERLET, 0.01, 5)
    assert state.time[ORIGIN] == 3 * 0.1 and state.step[ORIGIN] == 3
    assert state.time[NOW] == 3 * 0.1 + 5 * 0.01


@pytest.mark.parametrize("solver", ["rk4", "dop853"])
@pytest.mark.parametrize("form", ["matrix", "quaternion", "euler_angles"])
def test_a_solver_of_the_textbooks_equations_continues_from_its_state(solver, form):
    """What it evolves, the present step of DOP853 included, is in the state: a new engine gives the
    same bits."""
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.integrator": solver, "run.formulation": form}
    )
    system = build_body(scene)
    method = system.method
    assert isinstance(method, Solver)
    engine = system.engine()
    whole = engine.begin(system.state, method)
    parts = whole.copy()
    for until in (7, 20, 33):
        engine.advance(whole, method, 1e-3, until)
        system.engine().advance(parts, method, 1e-3, until)
    assert same_bits(whole, parts)


def test_a_run_changes_neither_its_system_nor_its_start():
    simulation = Simulation(
        small_scene(
            {"spce": 8},
            20.0,
            stages=[{"duration_ps": 0.01, "integrator": "auto", "energy_error_kT": 1e-2}],
        )
    )
    system, before = simulation.system, simulation.system.state.copy()
    asked = system.scene
    simulation.run()
    assert system.scene is asked and same_bits(before, system.state)


DAMAGES = {
    "no state": (lambda s: s.pop("velocity"), "it holds no velocity"),
    "later": (
        lambda s: s.update(schema=99),
        r"written by a later rigidmd \(version 99 of the format",
    ),
    "shape": (lambda s: s.update(position=s["position"][:3]), "position: damaged"),
    "nan": (lambda s: s.update(energy_ledger=np.full(3, np.nan)), "energy_ledger: damaged"),
    "species": (lambda s: s.update(species=s["species"] + 5), "species: damaged"),
    "rotation": (lambda s: s.update(rotation=1.1 * s["rotation"]), "rotation: damaged"),
    "mirror": (lambda s: s.update(rotation=-s["rotation"]), "rotation: damaged"),
    "models": (lambda s: s.update(models=s["models"][:, :3]), "models: damaged"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_state_is_refused_with_a_message(tmp_path, damage):
    system, _, state = built({"spce": 5}, 20.0, 1)
    write_state(tmp_path / "s.npz", system.saved(state))
    with np.load(tmp_path / "s.npz") as saved:
        arrays = dict(saved)
    spoil, words = DAMAGES[damage]
    spoil(arrays)
    np.savez(tmp_path / "s.npz", **arrays)
    with pytest.raises(StructureError, match=words):
        read_state(tmp_path / "s.npz")


def test_a_state_of_the_first_version_is_read(tmp_path):
    """It had neither a version nor an energy ledger; time and work were of one number each."""
    state = state_of(np.ones((2, 3)), cell=10 * np.eye(3))
    old = {
        key: getattr(state, key)
        for key in ("position", "velocity", "rotation", "angular_momentum_body", "cell")
    }
    np.savez(
        tmp_path / "s.npz",
        species_names=["argon"],
        species=[0, 0],
        time=np.ones(1),
        work=np.zeros(1),
        **old,
    )
    saved = read_state(tmp_path / "s.npz")
    assert same_bits(saved.state[:5], state[:5]) and saved.state.time[NOW] == 0


def test_a_state_of_the_second_version_has_other_names(tmp_path):
    system, _, state = built({"spce": 3}, 20.0, 1)
    state.energy_ledger[:] = 1.5, -2.0, 0.25
    write_state(tmp_path / "s.npz", system.saved(state._replace(extra_variables=np.arange(4.0))))
    with np.load(tmp_path / "s.npz") as data:
        arrays = {name: data[name] for name in data.files} | {"schema": 2}
    arrays["books"], arrays["bath"] = arrays.pop("energy_ledger"), arrays.pop("extra_variables")
    np.savez(tmp_path / "old.npz", **arrays)
    read = read_state(tmp_path / "old.npz").state
    assert read.energy_ledger.tolist() == [1.5, -2.0, 0.25]
    assert read.extra_variables.tolist() == [0.0, 1.0, 2.0, 3.0]
