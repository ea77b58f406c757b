"""Loads of all terms: the slow oracle, finite differences, action and reaction, a changed cell."""

from functools import partial

import numpy as np
import pytest
from support.common import built, move, observe, small_scene
from support.reference import Oracle
from support.slopes import energy_of, force_on, torque_on, trace_of_virial

from rigidmd.assemble.build import build
from rigidmd.compile import Program
from rigidmd.core.integrators import SCHEMES
from rigidmd.errors import SimulationError
from rigidmd.forces.neighbors.lists import (
    BUILDS,
)
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.units import BAR, BOLTZMANN

TRUNCATIONS = ["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
MIXTURES = [
    ({"spce": 12}, 13.0),
    ({"tip4p2005": 8, "nitrogen": 5, "argon": 4}, 14.0),
    ({"argon": 20}, 12.5),
    ({"spce": 5, "nitrogen": 6}, None),
]


def truncated(name):
    """Forces that end at 6 Å in this way, from 4.5 Å on where it has a start."""
    start = {"switch_start_A": 4.5} if name in ("force_switch", "switch") else {}
    return {"cutoff_A": 6.0, "truncation": name} | start


def energies(engine, state):
    return {name: tally.energy for name, tally in engine.evaluate(state)[1].items()}


@pytest.mark.parametrize(
    ("truncation", "counts", "edge"),
    [
        pytest.param(
            truncation,
            *which,
            id=f"{truncation}-{k}",
            marks=[]
            if (k == 1 and truncation != "force_shift") or truncation == "switch"
            else pytest.mark.soak,
        )
        for truncation in TRUNCATIONS
        for k, which in enumerate(MIXTURES)
    ],
)
def test_energies_are_those_of_the_oracle(counts, edge, truncation):
    forces = truncated(truncation) | {"reaction_field_permittivity": 78.5}
    for seed, mixing in enumerate(["lorentz-berthelot", "geometric"]):
        system, engine, state = built(counts, edge, seed, forces=forces | {"mixing": mixing})
        lj, coulomb = Oracle(system).energy(state.position, state.rotation)
        found = energies(engine, state)
        assert found["lennard_jones"] == pytest.approx(lj, rel=1e-11)
        assert found.get("coulomb", 0.0) == pytest.approx(coulomb, rel=1e-10)


def test_energies_without_box_and_cutoff():
    system, engine, state = built({"tip4p2005": 3, "argon": 2}, None)
    lj, coulomb = Oracle(system).energy(state.position, state.rotation)
    assert energies(engine, state) == pytest.approx(
        {"lennard_jones": lj, "coulomb": coulomb}, rel=1e-11
    )
    assert not system.constants


def test_a_box_with_unequal_edges_and_many_cells():
    # 30 Å against a cutoff of 4: cells whose neighbourhood does not meet itself; far outside the
    # box as well
    scene = small_scene(
        {"nitrogen": 60, "argon": 40},
        None,
        box={"lengths_A": [30.0, 10.0, 17.0]},
        forces={"cutoff_A": 4.0},
    )
    system = build(scene)
    engine, state = system.engine(), system.state.copy()
    rng = np.random.default_rng(5)
    state.position[:] += rng.normal(size=state.position.shape)
    expected = Oracle(system).energy(state.position, state.rotation)[0]
    assert energies(engine, state)["lennard_jones"] == pytest.approx(expected, rel=1e-11)
    state.position[:] += rng.integers(-3, 4, state.position.shape) * np.array(system.space)
    assert energies(engine, state)["lennard_jones"] == pytest.approx(expected, rel=1e-9)


BEYOND_HALF = [
    80.0,
    np.degrees(np.arccos(0.50008 * 20 / 24)),
    np.degrees(np.arccos(0.50008 * 20 / 17)),
]  # as printed
ANGLES = [
    [60.0, 60.0, 60.0],
    [70.0, 100.0, 50.0],
    [120.0, 110.0, 95.0],
    [35.0, 60.0, 80.0],
    BEYOND_HALF,
]


@pytest.mark.parametrize("skin", [0.3, 3.0])
@pytest.mark.parametrize("angles", ANGLES)
def test_triclinic_boxes(angles, skin):
    """Energies are the oracle's, forces the slope of its energy, and molecules may be whole cells
    away."""
    box = {"lengths_A": [20.0, 17.0, 24.0], "angles_deg": angles}
    forces = truncated("force_switch") | {"cutoff_A": 5.2, "skin_A": skin}
    system = build(small_scene({"spce": 20, "nitrogen": 15}, None, box=box, forces=forces))
    engine, state, oracle = system.engine(), system.state.copy(), Oracle(system)
    assert (cell_of(system.space)[1, 0] > 10.0) == (angles is BEYOND_HALF)
    rng = np.random.default_rng(3)
    state.position[:] += rng.normal(size=state.position.shape)
    state.position[:] += rng.integers(-3, 4, state.position.shape) @ cell_of(system.space)
    lj, coulomb = oracle.energy(state.position, state.rotation)
    assert energies(engine, state) == pytest.approx(
        {"lennard_jones": lj, "coulomb": coulomb}, rel=1e-10
    )
    load, h = engine.evaluate(state)[0], 1e-4
    for m, k in ((0, 0), (7, 1), (30, 2)):
        up, down = state.position.copy(), state.position.copy()
        up[m, k] += h
        down[m, k] -= h
        slope = (
            sum(oracle.energy(up, state.rotation)) - sum(oracle.energy(down, state.rotation))
        ) / (2 * h)
        assert load.force[m, k] == pytest.approx(
            -slope, rel=1e-5, abs=1e-7 * np.abs(load.force).max()
        )


@pytest.mark.parametrize("angles", [[90.0, 90.0, 90.0], [70.0, 100.0, 50.0]])
def test_molecules_millions_of_cells_away(angles):
    """The energy to the digits that positions there have; and where boxes can no longer be counted,
    a clear refusal."""
    box = {"lengths_A": [20.0, 17.0, 24.0], "angles_deg": angles}
    system = build(small_scene({"spce": 20}, None, box=box, forces=truncated("force_switch")))
    engine, state = system.engine(), system.state.copy()
    expected = sum(energies(engine, state).values())
    away = np.random.default_rng(7).integers(-1, 2, state.position.shape) @ cell_of(system.space)
    for cells, digits in ((1e3, 1e-9), (1e6, 1e-6), (1e8, 1e-4)):
        moved = state.copy()
        moved.position[:] += cells * away
        assert sum(energies(engine, moved).values()) == pytest.approx(expected, rel=digits)
    moved.position[3, 1] = -1e12
    with pytest.raises(
        SimulationError, match=r"molecule 4 is lost: it is 1e\+12 Å from the origin"
    ):
        engine.evaluate(moved)


def test_a_cell_and_the_same_lattice_by_another_have_the_same_energy():
    """A cell that tilts by more than half an edge is reduced."""
    counts, forces = {"spce": 20}, {"cutoff_A": 6.0, "truncation": "shift"}
    triclinic = {
        "lengths_A": [13.0, (13.0**2 + 13.0**2) ** 0.5, 13.0],
        "angles_deg": [90.0, 90.0, 45.0],
    }
    cube = build(small_scene(counts, 13.0, forces=forces))
    other = build(small_scene(counts, None, box=triclinic, forces=forces))
    assert cell_of(other.space) == pytest.approx(13.0 * np.eye(3))
    found = [energies(s.engine(), cube.state) for s in (cube, other)]
    assert found[1] == pytest.approx(found[0], rel=1e-9)


@pytest.mark.parametrize("truncation", TRUNCATIONS)
def test_forces_and_torques_are_the_slope_of_the_energy(truncation):
    forces = truncated(truncation)
    _, engine, state = built({"tip4p2005": 6, "nitrogen": 4, "argon": 3}, 13.0, 1, forces=forces)
    load, _ = engine.evaluate(state)

    energy, h = partial(energy_of, engine), 1e-4
    scale = np.abs(load.force).max()
    for m in range(len(state.position)):
        # `plain` jumps where a pair crosses the cutoff; these starts have none within 2 h of it
        force, torque = force_on(m, energy, state, h), torque_on(m, energy, state, h)
        assert load.force[m] == pytest.approx(force, abs=1e-6 * scale)
        assert load.torque_body[m] == pytest.approx(torque, abs=1e-6 * scale)


@pytest.mark.parametrize("angles", [None, [70.0, 100.0, 80.0]])
def test_virial_is_the_slope_of_the_energy_with_the_box(angles):
    forces = {"cutoff_A": 6.0, "truncation": "force_switch", "switch_start_A": 4.0}
    box = {"lengths_A": 14.0, "angles_deg": angles} if angles else {"lengths_A": 13.0}
    system = build(small_scene({"spce": 14}, None, box=box, forces=forces))
    engine, state = system.engine(), system.state
    virial = sum(tally.virial for tally in engine.evaluate(state)[1].values())

    slope = trace_of_virial(partial(energy_of, engine), state, 1e-5)
    assert virial.trace() == pytest.approx(slope, rel=1e-6)


TRICLINIC = {"lengths_A": [21.0, 22.0, 23.0], "angles_deg": [70.0, 100.0, 80.0]}


@pytest.mark.parametrize(
    ("box", "precision", "digits"),
    [
        pytest.param({"lengths_A": 21.0, "periodic": False}, "double", 1e-9, id="none-double"),
        pytest.param({"lengths_A": 21.0}, "double", 1e-9, id="cubic-double"),
        pytest.param({"lengths_A": 21.0}, "mixed", 2e-6, id="cubic-mixed", marks=pytest.mark.soak),
        pytest.param(TRICLINIC, "double", 1e-9, id="triclinic-double"),
        pytest.param(TRICLINIC, "mixed", 2e-6, id="triclinic-mixed", marks=pytest.mark.soak),
    ],
)
def test_virials_are_sums_over_pairs(box, precision, digits):
    """For a list that has served for some steps, of sites far from the origin; by all pairs of
    images."""
    forces = {"cutoff_A": 6.0, "truncation": "shift"}
    system, engine, state = built(
        {"nitrogen": 300}, None, 3, 0.1, box=box, forces=forces, precision=precision
    )
    state.position[:] += [3e5, -2e5, 1e5]
    move(engine, state, SCHEMES["velocity_verlet"], 0.0002, 20)
    virial = engine.evaluate(state)[1]["lennard_jones"].virial
    pairs = engine.workspaces["lennard_jones"].pairs
    assert pairs.counters[BUILDS] == 1 and pairs.clusters.largest_displacement.max() > 0.02
    site, owner = system.site_positions(state), system.sites.molecule
    centre = state.position[owner]
    well, size = system.species[0].epsilon[0], system.species[0].sigma[0]
    periodic = box.get("periodic", True)
    images = np.array(list(np.ndindex(3, 3, 3))) - 1 if periodic else np.zeros((1, 3))
    expected = np.zeros((3, 3))
    for i in range(len(site)):
        origin_vector = site[i] - site[owner != owner[i]]
        centres = centre[i] - centre[owner != owner[i]]
        if periodic:
            edges = np.round(origin_vector @ np.linalg.inv(state.cell))
            origin_vector, centres = (
                origin_vector - edges @ state.cell,
                centres - edges @ state.cell,
            )
        for image in images:
            shift = image @ state.cell if periodic else 0.0
            d, between = origin_vector + shift, centres + shift
            r = np.sqrt((d**2).sum(axis=1))
            near = r < 6.0
            force = _force(well, size, r[near])
            expected += 0.5 * (d[near] * (force / r[near])[:, None]).T @ between[near]
    assert virial == pytest.approx(expected, abs=digits * np.abs(expected).max())


def _force(well, size, r):
    return 24 * well / r * (2 * (size / r) ** 12 - (size / r) ** 6)


def test_newton_and_no_net_torque_in_free_space():
    _, engine, state = built({"spce": 10, "nitrogen": 5, "argon": 5}, None, 3)
    load, _ = engine.evaluate(state)
    scale = np.abs(load.force).sum()
    assert np.abs(load.force.sum(axis=0)).max() < 1e-14 * scale
    torque = np.einsum("nij,nj->ni", state.rotation, load.torque_body).sum(axis=0)
    torque += np.cross(state.position, load.force).sum(axis=0)
    assert np.abs(torque).max() < 1e-14 * scale * np.abs(state.position).max()


CHANGED = {
    "squeezed": np.diag([0.99] * 3),
    "sheared": np.array([[1, 0, 0], [0.01, 1, 0], [-0.02, 0.01, 1]]),
}


@pytest.mark.parametrize("change", CHANGED)
@pytest.mark.parametrize("electrostatics", ["reaction_field", "ewald", "pme"])
def test_everything_follows_a_cell_that_changes(electrostatics, change):
    """Between two calls of `advance` the cell changes by a percent: all is as with an engine made
    for the new one."""
    forces = {
        "cutoff_A": 6.0,
        "electrostatics": electrostatics,
        "tail_correction": True,
        "skin_A": 4.0,
    }
    system, engine, state = built({"spce": 60}, 14.0, 7, spread=0.1, forces=forces)
    move(engine, state, SCHEMES["velocity_verlet"], 0.0005, 5)
    state.position[:] = state.position @ CHANGED[change]
    state.cell[:] = state.cell @ CHANGED[change]
    engine.forget()
    kept, fresh = observe(system, engine, state), observe(system, system.engine(), state)
    assert kept.load.force == pytest.approx(
        fresh.load.force, abs=1e-11 * np.abs(fresh.load.force).max()
    )
    assert kept.virial == pytest.approx(fresh.virial, abs=1e-11 * np.abs(fresh.virial).max())
    assert kept.components == pytest.approx(fresh.components, rel=1e-11)
    assert kept.pressure == pytest.approx(fresh.pressure, rel=1e-9)
    other = state.copy()
    move(engine, state, SCHEMES["velocity_verlet"], 0.0005, 5)
    move(system.engine(), other, SCHEMES["velocity_verlet"], 0.0005, 5)
    assert state.position == pytest.approx(other.position, abs=1e-9)


WAVY = {
    "name": "wavy",
    "energy": "A*exp(-B*r) - C/r**6 + 0.1*sin(r)*log(r)",
    "truncation": "force_switch",
    "parameters": {"Ar": {"A": 4e5, "B": 3.7, "C": 5e3}, "Kr": {"A": 6e5, "B": 3.6, "C": 6e3}},
}
ALIKE = {
    "one kind": ({"argon": 60}, 20.0, {"truncation": "smooth_switch"}),
    "no box": ({"spce": 20, "argon": 6}, None, {}),
    "charges": ({"spce": 30, "nitrogen": 15}, 16.0, {"truncation": "switch"}),
    "damped": ({"spce": 30}, 16.0, {"electrostatics": "damped_shifted_force"}),
    "a text": ({"argon": 30, "krypton": 30}, 20.0, {"lennard_jones": False, "custom": [WAVY]}),
    "defaults": ({"spce": 30}, 16.0, {"truncation": "shift", "electrostatics": "pme"}),
}


#: The others have types of kernels that no other test has.
SHARED = [
    ("no box", "double"),
    ("defaults", "mixed"),
    ("charges", "double"),
    ("damped", "double"),
    ("a text", "double"),
]


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=[] if (name, precision) in SHARED else pytest.mark.soak)
        for name in ALIKE
        for precision in ("mixed", "double")
    ],
)
def test_forces_have_the_same_bits_with_their_energies_and_without(name, precision):
    """A run must not depend on who observations at it, and observations take the energies of its own steps."""
    counts, edge, forces = ALIKE[name]
    forces = forces | ({"cutoff_A": 7.0} if edge else {})
    _, engine, state = built(counts, edge, 3, spread=0.05, forces=forces, precision=precision)
    for _ in range(3):
        move(engine, state, SCHEMES["velocity_verlet"], 1e-3, 4)
        load, _ = engine.evaluate(state)
        assert np.array_equal(load.force, engine.load.force)
        assert np.array_equal(load.torque_body, engine.load.torque_body)


def test_states_of_one_size_are_evaluated_without_binding_arrays_again(monkeypatch):
    system, engine, state = built({"spce": 8, "argon": 4}, 18.5, 1)
    other = state.copy()
    other.position[:] += 0.3 * np.random.default_rng(2).standard_normal(other.position.shape)
    before = state.copy()
    expected = [system.engine().evaluate(each)[0] for each in (state, other)]
    engine.evaluate(state)
    monkeypatch.setattr(Program, "bind", None)
    for each, exact in ((other, expected[1]), (state.copy(), expected[0])):
        load, _ = engine.evaluate(each)
        scale = np.abs(exact.force).max()
        assert load.force == pytest.approx(exact.force, abs=1e-12 * scale)
        assert load.torque_body == pytest.approx(exact.torque_body, abs=1e-12 * scale)
    assert all(np.array_equal(one, kept) for one, kept in zip(state, before, strict=True))


def test_the_pressure_of_an_ideal_gas():
    """Molecules beyond each other's reach: P V = N k T_trans, whatever rotates, also where the total
    momentum is zero."""
    system, engine, state = built(
        {"nitrogen": 12}, 200.0, forces={"cutoff_A": 8.0, "truncation": "shift"}
    )
    seen = observe(system, engine, state)
    assert seen.potential == 0.0 and seen.kinetic_rotation > 0.0
    expected = 12 * BOLTZMANN * seen.temperature_translation / state.volume / BAR
    assert seen.pressure == pytest.approx(expected, rel=1e-12)


WALLS = {"axis": "z", "kind": "harmonic", "positions_A": [5.0, 50.0], "stiffness_kJ_mol_A2": 4.0}
KEPT = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0}


@pytest.mark.parametrize(
    ("counts", "stage", "sections", "axes"),
    [
        ({"nitrogen": 5}, KEPT, {}, [1, 1, 1]),
        ({"nitrogen": 5}, {"duration_ps": 1.0}, {}, [1, 1, 1]),
        ({"nitrogen": 5}, KEPT | {"thermostat": "langevin"}, {}, [0, 0, 0]),
        ({"nitrogen": 5}, KEPT | {"thermostat": "hybrid_monte_carlo"}, {}, [0, 0, 0]),
        ({"nitrogen": 1}, KEPT, {}, [1, 1, 1]),
        ({"nitrogen": 5}, KEPT, {"fields": {"walls": [WALLS]}}, [1, 1, 0]),
    ],
)
def test_the_pressure_contains_the_total_momentum_where_it_is_zero(counts, stage, sections, axes):
    """kT/V along each axis along which it is conserved."""
    forces = {"cutoff_A": 8.0, "truncation": "shift"}
    system, engine, state = built(counts, 60.0, forces=forces, stages=[stage], **sections)
    state.velocity[:] -= state.velocity.mean(axis=0)
    seen = observe(system, engine, state, stage=0)
    mass = system.model.mass[system.model.species]
    flux = np.einsum("n,ni,nj->ij", mass, state.velocity, state.velocity)
    several = sum(counts.values()) > 1
    thermal = BOLTZMANN * (seen.temperature_translation if several else seen.temperature)
    expected = (flux + thermal * np.diag(axes)) / state.volume / BAR
    assert thermal > 0
    assert seen.pressure_tensor == pytest.approx(expected, rel=1e-12, abs=1e-12)
