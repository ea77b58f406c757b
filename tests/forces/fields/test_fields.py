"""What acts on molecules from outside: electric fields, gravity, walls, restraints; and what then
keeps its momentum."""

import json
import re
from math import inf, pi, sqrt

import numpy as np
import pytest
from support.changed_package import edited, run_with_files
from support.common import move, observe, small_scene

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import REMOVED
from rigidmd.dynamics.model import draw_momenta, remove_momentum
from rigidmd.engines.cpu.engine import BehindWallError
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.errors import SceneError, SimulationError
from rigidmd.forces.fields import distances
from rigidmd.mechanics.rotation import from_vector, random_rotations
from rigidmd.run import Simulation
from rigidmd.run.trial_systems import molecular_trial_system
from rigidmd.studies.other_engines import export
from rigidmd.units import AVOGADRO, BOLTZMANN, DEBYE, ELEMENTARY_CHARGE

VERLET = SCHEMES["velocity_verlet"]


def site(name, mass, position, charge, sigma=None):
    well = {} if sigma is None else {"sigma_A": sigma, "epsilon_kJ_mol": 0.5}
    return {"name": name, "mass_u": mass, "position_A": position, "charge_e": charge} | well


#: An asymmetric body with a net charge and a dipole, its mirror image of the opposite charge, a
#: neutral dipole, a point.
KITE = [
    site("A", 10.0, [0, 0, 0], 1.0),
    site("B", 12.0, [1.2, 0.3, 0], -0.4),
    site("C", 5.0, [0, 1, 0.8], 0.1),
]
ETIK = [entry | {"charge_e": -entry["charge_e"]} for entry in KITE]
ROD = [site("P", 8.0, [0, 0, 0.5], 0.5), site("N", 9.0, [0, 0, -0.6], -0.5)]
#: One with Lennard-Jones sites away from its centre, for walls.
DUMBBELL = [
    site("L", 14.0, [0, 0, 0.5], 0.5, 3.0),
    site("M", 6.0, [0, 0.2, -0.9], -0.5, 2.5),
    site("H", 1.0, [1, 0, 0], 0.0),
]


def alone(counts, fields, box=None, **sections):
    """The system, engine, and start, rotated again, of molecules of these sites that only fields act
    on."""
    kinds = {
        "kite": KITE,
        "etik": ETIK,
        "rod": ROD,
        "dumbbell": DUMBBELL,
        "bead": [site("Z", 20.0, [0, 0, 0], 1.0)],
    }
    molecules = [
        {"name": name, "count": count, "sites": kinds[name]} for name, count in counts.items()
    ]
    box = box or {"lengths_A": 20.0, "periodic": False}
    system = build(
        small_scene(
            {},
            None,
            molecules=molecules,
            fields=fields,
            box=box,
            forces={"electrostatics": "none"} | sections.pop("forces", {}),
            **sections,
        )
    )
    terms = {name: term for name, term in system.terms.items() if name in system.external}
    state = system.state.copy()
    if len(state.rotation):
        state.rotation[:] = random_rotations(np.random.default_rng(4), len(state.rotation))
    return system, Engine(system.model, terms), state


STEADY = {"electric_V_per_nm": [0.3, -0.2, 0.6]}
OSCILLATING = STEADY | {"electric_frequency_per_ps": 2.5, "electric_phase_deg": 40.0}
GRAVITY = {"gravity_m_s2": [0.0, 3e13, -5e13]}
LJ_WALLS = {
    "walls": [
        {
            "axis": "y",
            "kind": "lj93",
            "positions_A": [1.0, 13.0],
            "sigma_A": 2.8,
            "epsilon_kJ_mol": 1.3,
            "cutoff_A": 7.0,
        }
    ]
}
SOFT_WALLS = {
    "walls": [
        {"axis": "z", "kind": "harmonic", "positions_A": [7.0, 9.0], "stiffness_kJ_mol_A2": 4.0}
    ]
}
SPRINGS = {
    "restraints": [
        {"species": "dumbbell", "molecules": "2-3", "stiffness_kJ_mol_A2": [3.0, 0.0, 5.0]}
    ]
}
ALL = {
    "steady": STEADY,
    "oscillating": OSCILLATING,
    "gravity": GRAVITY,
    "lj93": LJ_WALLS,
    "harmonic": SOFT_WALLS,
    "restraints": SPRINGS,
}


def energy_of(engine, state):
    return sum(tally.energy for tally in engine.evaluate(state)[1].values())


@pytest.mark.parametrize("kind", ALL)
def test_forces_and_torques_are_the_slopes_of_the_energy(kind):
    counts = (
        {"dumbbell": 4, "kite": 2}
        if kind in ("steady", "oscillating", "gravity")
        else {"dumbbell": 6}
    )
    _, engine, state = alone(counts, ALL[kind])
    state.time[0] = 0.37
    rng = np.random.default_rng(1)
    # the lattice stands between the walls: some have to go into the soft ones
    state.position[:] += (2.0 if kind == "harmonic" else 0.3) * rng.standard_normal(
        state.position.shape
    )
    load, tallies = engine.evaluate(state)
    assert all((tally.virial == 0).all() for tally in tallies.values())
    h, turns = 1e-5, kind not in ("gravity", "restraints")
    scale = np.abs(load.force).max() + np.abs(load.torque_body).max()
    assert scale > 1
    assert bool(load.torque_body.any()) == turns
    for m in range(len(state.position)):
        for k in range(3):
            ends = []
            for step in (h, -h):
                moved = state.copy()
                moved.position[m, k] += step
                ends.append(energy_of(engine, moved))
            assert load.force[m, k] == pytest.approx(
                -(ends[0] - ends[1]) / (2 * h), abs=1e-7 * scale
            )
            ends = []
            for step in (h, -h):
                moved = state.copy()
                moved.rotation[m] = moved.rotation[m] @ from_vector(np.eye(3)[None, k] * step)[0]
                ends.append(energy_of(engine, moved))
            assert load.torque_body[m, k] == pytest.approx(
                -(ends[0] - ends[1]) / (2 * h), abs=1e-7 * scale
            )


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


def test_a_dipole_turns_towards_the_field():
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


def walls(kind, **more):
    own = (
        {"sigma_A": 3.0, "epsilon_kJ_mol": 2.0} if kind == "lj93" else {"stiffness_kJ_mol_A2": 5.0}
    )
    return {
        "walls": [
            {"axis": "z", "kind": kind, "positions_A": [-4.0, inf], "acts_on": "centres"}
            | own
            | more
        ]
    }


def test_walls_are_what_their_formulas_say():
    def energy(z, **more):
        _, engine, state = alone({"bead": 1}, walls("lj93", **more))
        state.position[:] = [[1e3, -50.0, z]]
        return energy_of(engine, state) / 100

    well = (2 / 5) ** (1 / 6) * 3.0
    assert energy(-4 + well) == pytest.approx(-sqrt(10) / 3 * 2.0, rel=1e-13)
    assert energy(-4 + well + 1e-4) > energy(-4 + well) < energy(-4 + well - 1e-4)
    cut = 2.0 * (2 / 15 * (3 / 8) ** 9 - (3 / 8) ** 3)
    for z in (-2.5, 0.0, 3.9):
        plain = 2.0 * (2 / 15 * (3 / (z + 4)) ** 9 - (3 / (z + 4)) ** 3)
        assert energy(z) == pytest.approx(plain, rel=1e-13)
        assert energy(z, cutoff_A=8.0) == pytest.approx(plain - cut, rel=1e-13)
    assert energy(4.1, cutoff_A=8.0) == 0
    assert energy(2.0, positions_A=[-4.0, 5.0]) == pytest.approx(
        energy(2.0) + energy(-1.0), rel=1e-13
    )
    _, engine, state = alone({"bead": 3}, walls("harmonic", positions_A=[-4.0, 2.0]))
    state.position[:, 2] = [-4.5, 0.0, 4.0]
    load, tallies = engine.evaluate(state)
    assert tallies["walls_0"].energy == pytest.approx(100 * 2.5 * (0.25 + 4), rel=1e-13)
    assert load.force[:, 2].tolist() == pytest.approx([250, 0, -1000])


def test_a_site_behind_a_wall_is_an_error_that_says_where():
    _, engine, state = alone({"bead": 3}, walls("lj93"))
    for z in (-4.0, -4.2):
        state.position[1, 2] = z
        with pytest.raises(
            BehindWallError,
            match=rf"molecule 2 has a site at z = {z:g} Å, behind the wall at z = -4 Å",
        ):
            engine.evaluate(state)
    state.position[1, 2] = np.nan
    with pytest.raises(SimulationError, match="molecule 2 is lost"):
        engine.evaluate(state)
    # one that shoots through the wall in a run is named, with a cause and advice
    scene = small_scene(
        {"argon": 2},
        None,
        stages=[{"duration_ps": 1.0, "timestep_fs": 10}],
        watch={"move": False},
        fields=walls("lj93", positions_A=[0.0, inf], cutoff_A=0.5),
    )
    simulation = Simulation(scene)
    state = simulation.system.state.copy()
    state.position[0, 2], state.velocity[0, 2] = 5.0, -1000.0
    simulation.start_from(state)
    with pytest.raises(
        SimulationError,
        match=r"molecule 1 \(argon\) has a site at z = -.* behind .*a shorter timestep",
    ):
        simulation.run()


#: For runs: what acts, on what, for how long (ps), at which step of velocity Verlet (ps).
TALL = [LJ_WALLS["walls"][0] | {"positions_A": [4.0, 12.5], "cutoff_A": 50.0}]
FALL = {"gravity_m_s2": [0.0, 0.0, -4e13]} | walls("lj93", positions_A=[0.0, inf])
RUNS = {
    "steady": ({"rod": 3, "kite": 2, "bead": 1}, STEADY, 0.4, 0.008),
    "oscillating": ({"rod": 3, "kite": 2, "bead": 1}, OSCILLATING, 0.4, 0.004),
    "lj93": ({"dumbbell": 6}, {"walls": TALL}, 0.6, 0.004),
    "gravity": ({"bead": 4}, FALL, 1.2, 0.01),
    "restraints": ({"dumbbell": 4}, SPRINGS, 2.0, 0.01),
}


def conserved_along(kind, scheme, dt):
    """Energy less ledger after every step (u Å²/ps²), and how far the kinetic energy ranges."""
    counts, fields, span, _ = RUNS[kind]
    system, engine, state = alone(counts, fields)
    draw_momenta(system.model, state, 300.0, np.random.default_rng(3))
    found, kinetic = [], []
    for _ in range(round(span / dt) + 1):
        seen = observe(system, engine, state)
        found.append(seen.energy - state.energy_ledger.sum())
        kinetic.append(seen.kinetic)
        move(engine, state, scheme, dt, 1)
    return np.array(found), np.ptp(kinetic)


@pytest.mark.parametrize("kind", RUNS)
@pytest.mark.parametrize(
    "name", ["velocity_verlet", pytest.param("srkn_4", marks=pytest.mark.soak)]
)
def test_energy_less_work_is_conserved_to_the_order_of_the_scheme(kind, name):
    scheme, dt = SCHEMES[name], RUNS[kind][3] * (2 if name == "srkn_4" else 1)
    errors = []
    for step in (dt, dt / 2):
        energy, moved = conserved_along(kind, scheme, step)
        errors.append(np.sqrt(np.mean((energy - energy[0]) ** 2)) / moved)
    assert errors[0] < 0.02
    assert np.log2(errors[0] / errors[1]) == pytest.approx(scheme.order, abs=0.1)


def test_a_field_that_oscillates_does_work_that_is_booked():
    """Without the ledger the energy is not conserved at all; and a charge at rest gains what E0²/2 m
    w² states."""
    counts, fields, span, dt = RUNS["oscillating"]
    system, engine, state = alone(counts, fields)
    before = observe(system, engine, state).energy
    move(engine, state, VERLET, dt, round(span / dt))
    change = observe(system, engine, state).energy - before
    assert abs(change) > 100 * abs(change - state.energy_ledger.sum())
    f, field = 2.0, 0.7  # 1/ps, V/nm
    fields = {"electric_V_per_nm": [field, 0.0, 0.0], "electric_frequency_per_ps": f}
    system, engine, state = alone({"bead": 1}, fields)
    state.velocity[:] = 0.0
    move(
        engine, state, SCHEMES["srkn_4"], 1 / f / 160, 40
    )  # a quarter of a period: all is kinetic energy
    speed = field * ELEMENTARY_CHARGE * AVOGADRO * 1e-2 / 20.0 / (2 * pi * f)
    assert state.velocity[0].tolist() == pytest.approx([speed, 0, 0], rel=1e-7)
    assert engine.evaluate(state)[1]["electric_field"].energy == pytest.approx(
        0, abs=1e-7 * 10 * speed**2
    )


def test_a_charge_that_travels_through_images_keeps_its_energy():
    system, engine, state = alone(
        {"bead": 1}, {"electric_V_per_nm": [1.0, 0.0, 0.0]}, {"lengths_A": 20.0}
    )
    before, start = observe(system, engine, state).energy, state.position.copy()
    move(engine, state, VERLET, 0.01, 500)
    assert (state.position - start)[0, 0] > 25 * 20
    seen = observe(system, engine, state)
    assert seen.energy == pytest.approx(before, abs=1e-11 * seen.kinetic)


def slit(fields, **sections):
    """Waters between walls in a box, with a field."""
    both = {
        "axis": "z",
        "kind": "lj93",
        "positions_A": [0.0, 16.0],
        "sigma_A": 2.5,
        "epsilon_kJ_mol": 1.5,
    }
    data = {
        "box": {"lengths_A": [14.0, 14.0, 28.0]},
        "forces": {"cutoff_A": 6.9, "truncation": "smooth_switch"},
        "fields": {"walls": [both]} | fields,
        "output": {"trajectory": False},
    }
    return small_scene({"spce": 60}, 1.0, **data | sections)


def test_a_run_of_waters_between_walls_keeps_its_energy_and_the_momentum_along_them():
    stages = [{"duration_ps": 1.0, "timestep_fs": 1.0}, {"duration_ps": 2.0, "timestep_fs": 1.0}]
    oscillating = {"electric_V_per_nm": [0.2, 0.0, 1.0], "electric_frequency_per_ps": 3.0}
    results = Simulation(slit(oscillating, stages=stages)).run()
    stage = results.summary["stages"][1]
    assert (
        abs(stage["drift_kJ_mol_ns_per_molecule"]) < 4 * stage["drift_error_kJ_mol_ns_per_molecule"]
    )
    nve = results["stage"] == 1
    noise = stage["energy_rms_kJ_mol_per_molecule"] * 60
    assert (
        np.ptp(results["energy"][nve]) > 20 * noise
    )  # without the work of the field it would not be so
    assert noise < 2e-3 * results["kinetic"][nve].mean()
    assert results.summary["degrees_of_freedom"] == 60 * 6 - 2
    assert results.summary["momentum_conserved"] == ["x", "y"]
    state = results.state
    each = 18.0154 * np.abs(state.velocity).sum(axis=0)
    momentum = np.abs(18.0154 * state.velocity.sum(axis=0)) / each
    assert momentum[:2].max() < 1e-12
    assert momentum[2] > 1e-3
    z = state.position[:, 2]
    assert 1.0 < z.min() < z.max() < 15.0


@pytest.mark.parametrize(
    ("counts", "fields", "kept"),
    [
        ({"rod": 4}, STEADY, "xyz"),
        ({"kite": 2, "etik": 2}, STEADY, "xyz"),
        ({"kite": 2, "etik": 1}, {"electric_V_per_nm": [0.0, 0.1, 0.0]}, "xz"),
        ({"kite": 2}, OSCILLATING, ""),
        ({"rod": 4}, GRAVITY, "x"),
        ({"dumbbell": 4}, LJ_WALLS, "xz"),
        ({"dumbbell": 4}, LJ_WALLS | {"walls": [*LJ_WALLS["walls"], *SOFT_WALLS["walls"]]}, "x"),
        ({"dumbbell": 4}, SPRINGS, "y"),
    ],
)
def test_conserved_components_of_momentum_are_known_and_not_counted(counts, fields, kept):
    system, engine, state = alone(counts, fields)
    keeps = np.array([axis in kept for axis in "xyz"])
    assert (system.model.keeps_momentum == keeps).all()
    n = sum(counts.values())
    assert system.freedom.translation == 3 * n - len(kept)
    mass = system.model.mass[system.model.species]
    draw_momenta(system.model, state, 200.0, np.random.default_rng(2))
    size = (mass[:, None] * np.abs(state.velocity)).sum()
    assert (np.abs(mass @ state.velocity) < 1e-14 * size).tolist() == keeps.tolist()
    kinetic = 0.5 * mass @ (state.velocity**2).sum(axis=1)
    assert kinetic == pytest.approx(0.5 * system.freedom.translation * BOLTZMANN * 200.0, rel=1e-12)
    move(engine, state, VERLET, 0.002, 200)
    assert (np.abs(mass @ state.velocity) < 1e-12 * size).tolist() == keeps.tolist()
    # what is taken out, by the flow of a step and outside of one
    state.velocity[:] += 1.0
    other = state.copy()
    momentum = mass @ state.velocity
    taken = remove_momentum(system.model, other.velocity)
    engine.forget()
    move(engine, state, VERLET.with_momentum_removal(1), 0.0, 1)
    for velocity in (state.velocity, other.velocity):
        assert mass @ velocity == pytest.approx(np.where(keeps, 0.0, momentum), abs=1e-12 * size)
    assert taken == pytest.approx((momentum[keeps] ** 2).sum() / (2 * mass.sum()), abs=1e-12 * size)
    assert state.energy_ledger[REMOVED] == pytest.approx(-taken, rel=1e-10)


def test_the_errors_of_precision_are_those_of_what_is_conserved():
    for fields, names in (
        ({}, {"momentum", "L"}),
        (STEADY, {"momentum"}),
        (GRAVITY, {"momentum"}),
        (SPRINGS | {"restraints": [{"stiffness_kJ_mol_A2": 1.0}]}, set()),
    ):
        system, _, state = alone({"dumbbell": 3}, fields)
        trial_system = molecular_trial_system(system, state, None, 0.1)
        assert set(trial_system.conserved_errors(state)) == names


def test_threads_change_no_bit():
    fields = (
        OSCILLATING
        | walls("lj93", acts_on="sites", positions_A=[-1.0, 31.0])
        | {"gravity_m_s2": [0.0, 0.0, 3e12]}
    )
    fields["restraints"] = [{"molecules": "1-100", "stiffness_kJ_mol_A2": 2.0}]
    scene = small_scene(
        {"spce": 700},
        None,
        fields=fields,
        box={"lengths_A": [30.0, 30.0, 44.0]},
        forces={"cutoff_A": 9.0},
    )
    found = []
    for threads in (1, 2):
        system = build(scene.model_copy(update={"threads": threads}))
        engine, state = system.engine(), system.state.copy()
        move(engine, state, VERLET, 0.0005, 5)
        found.append((*state, observe(system, engine, state).potential))
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))
    assert found[0][7].any()  # the ledger


def test_a_start_from_nothing_stands_between_walls():
    system = build(slit({}))
    z = system.site_positions(system.state)[:, 2]
    assert 0.0 < z.min() < 4.0
    assert 12.0 < z.max() < 16.0
    x = system.state.position[:, 0]
    assert x.max() - x.min() > 9.0
    floor = build(small_scene({"argon": 30}, None, fields=walls("lj93", positions_A=[3.0, inf])))
    z = floor.state.position[:, 2]
    assert 3.0 + 2.5 < z.min() < z.max() < 3.0 + 15.0 + 2.6


def test_molecules_of_a_file_are_taken_to_the_images_between_the_walls(tmp_path):
    rows = [(3.0, 3.0, 7.0), (8.0, 3.0, 37.0), (3.0, 8.0, -24.0)]
    lines = [
        f"    1AR      Ar{k:5d}" + "".join(f"{c / 10:8.3f}" for c in x)
        for k, x in enumerate(rows, 1)
    ]
    (tmp_path / "a.gro").write_text("\n".join(["t", "3", *lines, "2.0 2.0 3.0"]) + "\n")

    def found(positions):
        fields = walls("lj93", positions_A=positions)
        scene = small_scene(
            {},
            None,
            tmp_path,
            molecules=[{"model": "argon"}],
            box={},
            structure={"file": "a.gro"},
            fields=fields,
            forces={"cutoff_A": 9.0},
        )
        return build(scene).state.position

    assert found([0.0, 14.0])[:, 2].tolist() == pytest.approx([7, 7, 6])
    assert found([-30.0, -16.0])[:, 2].tolist() == pytest.approx([-23, -23, -24])
    with pytest.raises(
        SceneError,
        match=r"fields.walls.0: at the start, molecule 3 \(argon\) has a site at z = 6 Å, behind",
    ):
        found([6.5, 20.0])


def test_restraints_hold_the_molecules_that_are_named():
    molecules = [{"model": "argon", "count": 5, "frozen": [5]}, {"model": "krypton", "count": 3}]
    restraints = [
        {"species": "krypton", "stiffness_kJ_mol_A2": 2.0, "position_A": [1.0, 2.0, 3.0]},
        {"species": "argon", "molecules": [2, 4], "stiffness_kJ_mol_A2": [0.0, 0.0, 3.0]},
        {"species": "argon", "stiffness_kJ_mol_A2": 1.0},
    ]
    system = build(small_scene({}, 30.0, molecules=molecules, fields={"restraints": restraints}))
    found = [system.terms[f"restraints_{k}"] for k in range(3)]
    assert [term.molecule.tolist() for term in found] == [[5, 6, 7], [1, 3], [0, 1, 2, 3]]
    assert (found[0].reference == [1.0, 2.0, 3.0]).all()
    assert (found[1].reference == system.state.position[[1, 3]]).all()
    assert found[1].stiffness.tolist() == [0, 0, 300]


def test_what_is_frozen_is_left_alone():
    molecules = [
        {"model": "spce", "count": 4, "frozen": [1]},
        {"model": "argon", "count": 2, "frozen": True},
    ]
    fields = STEADY | GRAVITY | walls("lj93", acts_on="sites", positions_A=[-3.0, 20.0])
    system = build(small_scene({}, 36.0, molecules=molecules, fields=fields))
    state = system.state.copy()
    held = system.model.inverse_mass[system.model.species] == 0
    state.position[held, 2] = 21.0  # behind a wall
    own = {name: term for name, term in system.terms.items() if name in system.external}
    load, tallies = Engine(system.model, own).evaluate(state)
    assert set(own) == {"electric_field", "gravity", "walls_0"}
    assert held.sum() == 3
    assert not load.force[held].any()
    assert not load.torque_body[held].any()
    assert (load.force[~held].any(axis=1) & load.torque_body[~held].any(axis=1)).all()
    assert tallies["gravity"].energy != 0


def test_check_tells_of_fields_and_of_what_is_left_out():
    text = describe(slit(OSCILLATING | {"gravity_m_s2": [0.0, 0.0, -9.81]}))
    assert (
        "electric field: (0.3, -0.2, 0.6) V/nm cos(2 pi f t + 40°), f = 2.5/ps. Its work is in the energy ledger"
        in text
    )
    assert "gravity: (0, 0, -9.81) m/s²" in text
    assert (
        "walls 0: at z = 0 Å and z = 16 Å, on 60 sites: Lennard-Jones 9-3, sigma 2.5 Å, epsilon 1.5 kJ/mol, no"
        in text
    )
    assert "total momentum: conserved along x and y" in text
    assert "  restraints: not in [fields]" in text
    held = describe(
        small_scene({"spce": 4}, 20.0, fields={"restraints": [{"stiffness_kJ_mol_A2": 2.0}]})
    )
    assert "restraints 0: 4 molecules restrained to their starting positions, 2 kJ/mol/Å²" in held
    assert "total momentum: conserved nowhere" in held
    assert "electric field, gravity, walls: not in [fields]" in held
    pme = describe(slit({}, forces={"cutoff_A": 6.9, "electrostatics": "pme"}))
    assert "total momentum: removed along x and y every 1 ps" in pme
    assert "fields.walls: pme includes the periodic images beyond the walls" in pme


LJ = {
    "axis": "z",
    "kind": "lj93",
    "positions_A": [0.0, 20.0],
    "sigma_A": 3.0,
    "epsilon_kJ_mol": 1.0,
}
SOFT = {"axis": "z", "kind": "harmonic", "positions_A": [0.0, 20.0], "stiffness_kJ_mol_A2": 5.0}
HELD = {"stiffness_kJ_mol_A2": 5.0}
NO_BOX = {"box": {"lengths_A": 30.0, "periodic": False}}


@pytest.mark.parametrize(
    ("fields", "more", "message"),
    [
        (
            {"electric_frequency_per_ps": 1.0},
            {},
            "electric_frequency_per_ps would have no effect without electric_V_per_nm",
        ),
        (
            {"electric_V_per_nm": [0.0, 0.0, 1.0], "electric_phase_deg": 90.0},
            {},
            "electric_phase_deg would have no effect without electric_frequency_per_ps",
        ),
        (
            {"electric_V_per_nm": [0.0, 0.0, 1.0], "electric_frequency_per_ps": 300.0},
            {},
            "a period of 3.33 fs is less than two steps of stages.0 (2 fs)",
        ),
        (
            {"electric_V_per_nm": [0.0, 0.0, 1.0]},
            {"molecules": [{"model": "argon", "count": 3}]},
            "fields.electric_V_per_nm would have no effect: no molecule that moves has a charge",
        ),
        (
            {"electric_V_per_nm": [0.0, 1.0]},
            {},
            "fields.electric_V_per_nm: has 2 entries, needs more",
        ),
        (
            {"electric_V_nm": [0.0, 0.0, 1.0]},
            {},
            "fields.electric_V_nm: unknown key; did you mean electric_V_per_nm",
        ),
        (
            {"gravity_m_s2": [0.0, 0.0, -9.81]},
            {},
            "nothing stops the fall along z, which is periodic",
        ),
        (
            {"gravity_m_s2": [0.0, 1.0, -9.81], "walls": [LJ]},
            {},
            "nothing stops the fall along y, which is periodic",
        ),
        (
            {"walls": [LJ | {"stiffness_kJ_mol_A2": 1.0}]},
            {},
            "fields.walls.0: stiffness_kJ_mol_A2 would have no effect with kind = 'lj93'",
        ),
        (
            {"walls": [{key: LJ[key] for key in ("axis", "kind", "positions_A")}]},
            {},
            "kind = 'lj93' needs sigma_A and epsilon_kJ_mol",
        ),
        (
            {"walls": [LJ | {"axis": "c"}]},
            {},
            "fields.walls.0.axis: is 'c', must be 'x', 'y' or 'z'",
        ),
        (
            {"walls": [LJ | {"positions_A": [5.0, 5.0]}]},
            {},
            "positions_A = [5, 5]: the first must be below the second",
        ),
        (
            {"walls": [LJ | {"positions_A": [-inf, inf]}]},
            NO_BOX,
            "positions_A = [-inf, inf] defines no wall",
        ),
        ({"walls": [LJ | {"positions_A": [0.0, inf]}]}, {}, "a periodic box needs both walls"),
        (
            {"walls": [LJ, SOFT | {"positions_A": [21.0, 30.0]}]},
            NO_BOX,
            "the walls across z leave no space between them",
        ),
        (
            {"walls": [LJ | {"positions_A": [0.0, 22.0]}]},
            {},
            "along z the box is 30 Å, and must be 33 Å at least: 22 Å between the walls, 2 Å by which sites may protrude, "
            "and the cutoff of 9 Å",
        ),
        (
            {"walls": [LJ]},
            {"box": {"lengths_A": 40.0, "angles_deg": [90.0, 80.0, 90.0]}},
            "need a box with right angles",
        ),
        (
            {"walls": [LJ | {"positions_A": [0.0, 5.0]}]},
            {},
            "the walls across z leave no space for molecules",
        ),
        (
            {"walls": [LJ]},
            {
                "molecules": [
                    {"name": "bare", "count": 2, "sites": [site("Q", 5.0, [0, 0, 0], 1.0)]}
                ]
            },
            "bare has no site with Lennard-Jones parameters, and would pass the walls. Use acts_on = 'centres'",
        ),
        ({"walls": [LJ]}, {"forces": {"tail_correction": True}}, "omit it between walls"),
        ({"restraints": [{}]}, {}, "fields.restraints.0.stiffness_kJ_mol_A2: is missing"),
        (
            {"restraints": [{"stiffness_kJ_mol_A2": [0.0, 0.0, 0.0]}]},
            {},
            "stiffness_kJ_mol_A2: is 0: it would have no effect",
        ),
        (
            {"restraints": [HELD | {"molecules": "3-1"}]},
            {},
            "fields.restraints.0.molecules: is '3-1': 3-1 ends before",
        ),
        (
            {"restraints": [HELD | {"molecules": "2-9"}]},
            {},
            "fields.restraints.0.molecules: no spce has the number 2-9; they have 1 to 5",
        ),
        (
            {"restraints": [HELD | {"species": "ice"}]},
            {},
            "fields.restraints.0.species: there is no 'ice'; there are spce",
        ),
        (
            {"restraints": [HELD]},
            {"molecules": [{"model": "spce", "count": 2}, {"model": "argon", "count": 2}]},
            "fields.restraints.0.species is required: there are spce, argon",
        ),
        (
            {"restraints": [HELD | {"molecules": "1-2"}]},
            {"molecules": [{"model": "spce", "count": 5, "frozen": [2]}]},
            "fields.restraints.0.molecules: 1-2 includes frozen molecules",
        ),
        (
            {"restraints": [HELD]},
            {"run": {"remove_momentum_interval_ps": 1.0}},
            "run.remove_momentum_interval_ps: fields or frozen molecules change all components",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_words(fields, more, message):
    with pytest.raises(SceneError) as refused:
        build(small_scene({"spce": 5}, 30.0, fields=fields, **more))
    assert message in str(refused.value)


def test_gravity_may_fall_where_something_stops_it():
    down = {"gravity_m_s2": [0.0, 0.0, -1e10]}
    frozen = [{"model": "argon", "count": 3}, {"model": "krypton", "count": 2, "frozen": True}]
    for fields, more in (
        (down | {"walls": [LJ]}, {}),
        (down | {"restraints": [HELD | {"molecules": [1]}]}, {}),
        (down, {"molecules": frozen}),
        (down, NO_BOX),
    ):
        assert "gravity" in build(small_scene({"argon": 4}, 30.0, fields=fields, **more)).terms


def test_fields_that_are_tied_to_places_say_so():
    def scene(fields):
        return small_scene({"spce": 4}, 36.0, fields=fields)

    assert build(scene(OSCILLATING)).position_dependent == []
    assert alone({"kite": 1, "etik": 1}, STEADY)[0].position_dependent == ["electric_field"]
    assert build(scene({"walls": [LJ], "restraints": [HELD]} | STEADY)).position_dependent == [
        "walls_0",
        "restraints_0",
    ]
    assert not build(
        scene({"electric_V_per_nm": [0.0, 0.0, 0.0]})
    ).external  # a sweep may pass through nothing


@pytest.mark.soak
def test_a_resolved_scene_with_fields_runs_again_to_the_same_bits(tmp_path):
    scene = slit(OSCILLATING | {"restraints": [{"molecules": "1-3", "stiffness_kJ_mol_A2": 4.0}]})
    first = Simulation(scene, tmp_path / "a").run()
    again = Simulation(type(scene).read(tmp_path / "a" / "scene.toml")).run()
    assert all(np.array_equal(a, b) for a, b in zip(first.state, again.state, strict=True))


# --- a new field takes two files ------------------------------------------------------------------

TRAP = """
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import OK
from rigidmd.forces.terms import add_forces
from rigidmd.units import KJ_PER_MOL


class Trap(NamedTuple):
    stiffness: float  # u/ps²

    tied_to_places = True
    changes_momentum = np.ones(3, bool)


def term(parts, trap, where, faults):
    if not parts.moves.all():
        faults.append(f"{where}: it has no frozen molecules")
    return Trap(trap.stiffness_kJ_mol_A2 * KJ_PER_MOL)


@implements(add_forces, Trap)
def _add_trap(term, state, load, tally):
    for m in range(len(state.position)):
        for k in range(3):
            load.force[m, k] -= term.stiffness * state.position[m, k]
            if tally is not None:
                tally[0] += 0.5 * term.stiffness * state.position[m, k] ** 2
    return OK
"""
TRAP_KEYS = """class Trap(Section):
    \"\"\"A harmonic trap of all molecules.\"\"\"

    stiffness_kJ_mol_A2: Positive
    \"\"\"Stiffness\"\"\"


class Fields(Section):
    \"\"\"External fields that act on molecules.\"\"\"

    trap: Trap | None = None
    \"\"\"A harmonic trap\"\"\"
"""
TRAP_ENTRY = """FIELDS = {
    "trap": FieldKind("trap", "trap", "trap", lambda trap, term: f"{trap.stiffness_kJ_mol_A2:g} kJ/mol/Å²"),
"""
TRAP_SCRIPT = """
import json
import numpy as np
from support.common import shaken
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.errors import SceneError
from rigidmd.scene import schema

def scene(fields, **more):
    return Scene.from_dict({
        "box": {"lengths_A": 20, "periodic": False}, "molecules": [{"model": "nitrogen", "count": 4} | more],
        "start": {"temperature_K": 100}, "stages": [{"duration_ps": 0.01}], "fields": fields,
    })

def messages(*given, **more):
    try:
        build(scene(*given, **more))
    except SceneError as error:
        return error.errors

trapped = scene({"trap": {"stiffness_kJ_mol_A2": 0.5}})
system, engine, state = shaken(build(trapped), 3)
with_trap, tallies = engine.evaluate(state)
energy, total = tallies["trap"].energy, with_trap.force.sum(axis=0)
print(json.dumps({
    "energy": energy, "expected": 25 * float((state.position**2).sum()),
    "force": total.tolist(), "sum": (-50 * state.position.sum(axis=0)).tolist(),
    "check": describe(trapped), "without": describe(scene({})), "schema": schema()["$defs"]["Trap"]["description"],
    "errors": [messages({"trap": {"stiffness_kJ_mol_A2": -1.0}}), messages({"trap": {"stiffness": 1.0}}),
               messages({"trap": {"stiffness_kJ_mol_A2": 1.0}}, frozen="1")],
}))
"""


def test_adding_a_field_takes_two_files(tmp_path):
    files = {
        "scene/fields.py": edited(
            "scene/fields.py",
            (
                'class Fields(Section):\n    """External fields that act on molecules."""\n',
                TRAP_KEYS,
            ),
            ("FIELDS = {\n", TRAP_ENTRY),
        ),
        "forces/fields/trap.py": TRAP,
    }
    assert len(files) == 2
    found = json.loads(run_with_files(tmp_path, files, TRAP_SCRIPT).splitlines()[-1])
    assert found["energy"] == pytest.approx(found["expected"])
    assert found["force"] == pytest.approx(found["sum"])
    assert "  trap: 0.5 kJ/mol/Å²\n" in found["check"]
    assert (
        "\n  trap, electric field, gravity, walls, restraints: not in [fields]" in found["without"]
    )
    assert found["schema"] == "A harmonic trap of all molecules."
    (negative,), (unknown, missing), (frozen,) = found["errors"]
    assert negative == "fields.trap.stiffness_kJ_mol_A2: is -1.0, must be greater than 0"
    assert "did you mean stiffness_kJ_mol_A2?" in unknown + missing
    assert frozen == "fields.trap: it has no frozen molecules"


TILTED = {"lengths_A": [18.0, 20.0, 22.0], "angles_deg": [80.0, 100.0, 75.0]}
PAIR = {"between": [1, 4], "distance_A": 4.0, "stiffness_kJ_mol_A2": 7.0}
GROUPS = {"between": [[1, 3], "4-6"], "distance_A": 3.0, "stiffness_kJ_mol_A2": 11.0}


def held_apart(entry, box):
    """A term alone, with molecules of two masses anywhere, also in other images of the box."""
    molecules = [{"model": "argon", "count": 3}, {"model": "krypton", "count": 3}]
    fields = {"restraints": [entry]}
    stages = [{"ensemble": "minimise"}]
    box = box or {"lengths_A": 20.0, "periodic": False}
    scene = small_scene({}, None, molecules=molecules, fields=fields, box=box, stages=stages)
    start = np.array(
        [[2, 3, 1], [9, 9, 9], [3, 4, 2.5], [5, 2, 3], [6, 4, 3], [5.5, 2.5, 5]], float
    )
    return scene, start


def centres(state, groups, mass):
    """Centres of groups by the nearest images to their first members, over 27 images each."""
    images = np.zeros((1, 3))
    if np.isfinite(state.cell).all():
        images = np.array(list(np.ndindex(7, 7, 7))) - 3.0
        images = images @ state.cell

    def nearest(vector):
        return (vector + images)[np.linalg.norm(vector + images, axis=1).argmin()]

    found = []
    for group in groups:
        origin = state.position[group[0]]
        arms = np.array([nearest(state.position[m] - origin) for m in group])
        found.append(origin + np.average(arms, axis=0, weights=mass[group]))
    return nearest(found[1] - found[0])


@pytest.mark.parametrize("box", [None, TILTED], ids=["open", "tilted"])
@pytest.mark.parametrize("entry", [PAIR, GROUPS], ids=["pair", "groups"])
def test_a_restrained_distance(entry, box, monkeypatch):
    """Energy by the nearest images, forces and virial by differences of the energy, no force on the
    whole."""
    scene, start = held_apart(entry, box)
    monkeypatch.setattr(
        distances, "_faults_in_box", lambda *_: []
    )  # the lattice of the start is elsewhere
    system = build(scene)
    term = system.terms["restraints_0"]
    engine, state = Engine(system.model, {"restraints_0": term}), system.state.copy()
    state.position[:] = start
    mass = system.model.mass[system.model.species]
    groups = (
        [np.atleast_1d(np.array(group) - 1) for group in ([1], [4])]
        if entry is PAIR
        else [[0, 2], [3, 4, 5]]
    )
    groups = [np.array(group) for group in groups]
    if box is not None:  # molecules that have crossed faces of the box
        state.position[:] += (
            np.array([[0, 0, 0], [1, 0, 0], [0, 1, -1], [1, -2, 0], [0, 1, 0], [1, 1, 1]])
            @ state.cell
        )
    load, tallies = engine.evaluate(state)
    arm = centres(state, groups, mass)
    stiffness = 100 * entry["stiffness_kJ_mol_A2"]
    away = np.linalg.norm(arm) - entry["distance_A"]
    tally = tallies["restraints_0"]
    assert tally.energy == pytest.approx(0.5 * stiffness * away**2, rel=1e-12)
    assert term.distance_in(state) == pytest.approx(np.linalg.norm(arm), rel=1e-13)
    assert not load.torque_body.any()
    assert np.abs(load.force.sum(axis=0)).max() < 1e-12 * np.abs(load.force).max()
    h, scale = 1e-5, np.abs(load.force).max()
    for m in range(6):
        for k in range(3):
            ends = []
            for step in (h, -h):
                moved = state.copy()
                moved.position[m, k] += step
                ends.append(energy_of(engine, moved))
            assert load.force[m, k] == pytest.approx(
                -(ends[0] - ends[1]) / (2 * h), abs=1e-7 * scale
            )
    for i in range(3):
        for j in range(i + 1):  # strains that leave the cell lower triangular
            ends = []
            for step in (h, -h):
                moved, strain = state.copy(), np.eye(3)
                strain[i, j] += step
                moved.position[:] = state.position @ strain
                moved.cell[:] = state.cell @ strain if box else state.cell
                ends.append(energy_of(engine, moved))
            slope = (ends[0] - ends[1]) / (2 * h)
            assert slope == pytest.approx(
                -tally.virial[j, i], abs=1e-6 * max(1.0, np.abs(tally.virial).max())
            )


def test_a_restrained_distance_in_a_run():
    """Columns of the log have it; the conserved energy and the momentum are conserved; a barostat
    is possible."""
    entry = {"between": [1, 2], "distance_A": 8.5, "stiffness_kJ_mol_A2": 5.0}
    other = entry | {"between": [3, 6], "distance_A": 9.5}
    stages = [
        {"duration_ps": 0.4},
        {"ensemble": "npt", "temperature_K": 90, "pressure_bar": 1, "duration_ps": 0.02},
    ]
    scene = small_scene(
        {"argon": 27},
        27.0,
        stages=stages,
        fields={"restraints": [other, entry]},
        output={"log_interval_ps": 0.01},
    )
    results = Simulation(scene).run()
    assert results.units["distance_1"] == "Å"
    state, mass = results.state, np.ones(27)
    for name, groups in (("distance_0", ([2], [5])), ("distance_1", ([0], [1]))):
        expected = np.linalg.norm(centres(state, [np.array(group) for group in groups], mass))
        assert results[name][-1] == pytest.approx(expected, abs=1e-9)
        assert np.ptp(results[name]) > 0.01
    nve = results["stage"] == 0
    assert np.abs(results["drift"][nve]).max() < 0.02 * results["kinetic"].mean()
    assert results["momentum"].max() < 1e-9


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (PAIR | {"between": [1, 9]}, "between: molecule 9 does not exist; there are 1 to 6"),
        (PAIR | {"between": [2, 2]}, "between: a molecule is named twice"),
        (PAIR | {"between": [[1, 2], [2, 3]]}, "between: a molecule is named twice"),
        (PAIR | {"distance_A": None}, "between needs distance_A"),
        (PAIR | {"between": None}, "distance_A would have no effect without between"),
        (
            PAIR | {"stiffness_kJ_mol_A2": [1.0, 1.0, 2.0]},
            "stiffness_kJ_mol_A2 has one number for a distance",
        ),
        (PAIR | {"position_A": [1.0, 1.0, 2.0]}, "position_A would have no effect with between"),
        (PAIR | {"distance_A": 9.5}, "may come near half the smallest height of the box, 10 Å"),
        (
            PAIR | {"distance_A": 8.0, "stiffness_kJ_mol_A2": 0.01},
            "Use a larger box or a higher stiffness",
        ),
        (PAIR | {"between": [[1, 6], 2]}, "Å from its first one, more than a quarter"),
    ],
)
def test_distances_that_cannot_be(entry, expected):
    entry = {key: value for key, value in entry.items() if value is not None}
    with pytest.raises(SceneError, match=re.escape(expected)):
        build(small_scene({"argon": 6}, 20.0, fields={"restraints": [entry]}))


def test_other_engines_refuse_a_restrained_distance(tmp_path, capsys):
    text = describe(small_scene({"argon": 6}, 20.0, fields={"restraints": [PAIR]}))
    assert "distance of molecule 1 and molecule 4 restrained to 4 Å, 7 kJ/mol/Å²" in text
    for program in ("gromacs", "lammps"):
        with pytest.raises(SceneError, match="restraints"):
            export(
                small_scene({"argon": 6}, 20.0, fields={"restraints": [PAIR]}),
                program,
                tmp_path / program,
            )
