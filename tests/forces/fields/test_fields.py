"""All external fields: slopes of the energy, energy ledger, conserved momenta, errors of the scene."""

import json
from functools import partial
from math import inf, pi

import numpy as np
import pytest
from support.changed_package import edited, run_with_files
from support.common import move, observe, small_scene
from support.fields import (
    HELD,
    LJ,
    NO_BOX,
    OSCILLATING,
    STEADY,
    VERLET,
    alone,
    site,
    slit,
    walls,
)
from support.slopes import energy_of, force_on, torque_on

from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import REMOVED
from rigidmd.dynamics.model import draw_momenta, remove_momentum
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.errors import SceneError
from rigidmd.run import Simulation
from rigidmd.run.kind import describe
from rigidmd.run.trial_systems import molecular_trial_system
from rigidmd.units import AVOGADRO, BOLTZMANN, ELEMENTARY_CHARGE

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
    energy = partial(energy_of, engine)
    for m in range(len(state.position)):
        force, torque = force_on(m, energy, state, h), torque_on(m, energy, state, h)
        assert load.force[m] == pytest.approx(force, abs=1e-7 * scale)
        assert load.torque_body[m] == pytest.approx(torque, abs=1e-7 * scale)


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


def test_a_field_that_oscillates_does_work_that_is_accounted_for():
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


def report(scene) -> str:
    """The whole report of `rigidmd check`, without its line breaks."""
    return " ".join(describe(scene, verbose=True).split())


def test_check_describes_fields_and_what_is_left_out():
    text = report(slit(OSCILLATING | {"gravity_m_s2": [0.0, 0.0, -9.81]}))
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
    assert "restraints: not in [fields]" in text
    held = report(
        small_scene({"spce": 4}, 20.0, fields={"restraints": [{"stiffness_kJ_mol_A2": 2.0}]})
    )
    assert "restraints 0: 4 molecules restrained to their starting positions, 2 kJ/mol/Å²" in held
    assert "total momentum: conserved nowhere" in held
    assert "electric field, gravity, walls: not in [fields]" in held
    pme = report(slit({}, forces={"cutoff_A": 6.9, "electrostatics": "pme"}))
    assert "total momentum: removed along x and y every 1 ps" in pme
    assert "fields.walls: pme includes the periodic images beyond the walls" in pme


SOFT = {"axis": "z", "kind": "harmonic", "positions_A": [0.0, 20.0], "stiffness_kJ_mol_A2": 5.0}


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
def test_what_cannot_be_is_refused_with_a_message(fields, more, message):
    with pytest.raises(SceneError) as refused:
        build(small_scene({"spce": 5}, 30.0, fields=fields, **more))
    assert message in str(refused.value)


def test_fields_that_are_tied_to_positions_are_reported():
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


TRAP = """
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import OK
from rigidmd.forces.terms import add_forces
from rigidmd.units import KJ_PER_MOL


class Trap(NamedTuple):
    stiffness: float  # u/ps²

    absolute_positions = True
    changes_momentum = np.ones(3, bool)


def term(parts, trap, where, faults):
    if not parts.moves.all():
        faults.append(f"{where}: it has no frozen molecules")
    return Trap(trap.stiffness_kJ_mol_A2 * KJ_PER_MOL)


def sentence(trap, term):
    return f"{trap.stiffness_kJ_mol_A2:g} kJ/mol/Å²"


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
    "trap": FieldKind("trap", "trap", "trap"),
"""
TRAP_SCRIPT = """
import json
import numpy as np
from support.common import shaken
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.run.kind import describe
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
    "check": describe(trapped), "without": describe(scene({}), verbose=True), "schema": schema()["$defs"]["Trap"]["description"],
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
