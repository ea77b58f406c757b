"""Forces of a state: from the last step where they are known; two engines compared."""

import numpy as np
import pytest
from support.common import built, shaken, small_scene

import rigidmd
from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.core.integrators import SCHEMES
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.features.external.engines import compare_at


@pytest.mark.parametrize("density", [1.4, 1.95, 2.6])
@pytest.mark.parametrize(("gap", "agrees"), [(1e-7, True), (3e-4, False)])
def test_two_engines_agree_by_the_size_of_each_quantity(density, gap, agrees):
    """Also where the virial is many times the energies, or these cancel: dense, on a lattice,
    cold."""
    box, forces = {"density_g_cm3": density}, {"cutoff_A": 4.6, "truncation": "plain"}
    system = build(
        small_scene({"argon": 32}, None, box=box, forces=forces, start={"temperature_K": 1.0})
    )
    term = system.terms["lennard_jones"]
    other = term._replace(
        potential=term.potential._replace(
            c12=term.potential.c12 * (1 + gap), c6=term.potential.c6 * (1 - gap)
        )
    )
    here, there = (system.engine_of({"lennard_jones": each}, "double") for each in (term, other))
    state = shaken(system, 1, 0.05)[2]
    lines = compare_at(system, state, here, there)
    assert {line.name for line in lines if not line.agrees} == (
        set()
        if agrees
        else {"lennard jones", "potential energy", "rms force on a molecule", "virial"}
    )


NPT = {"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0}
ROWS = {
    "nve": {},
    "langevin": {"ensemble": "nvt", "temperature_K": 300.0, "thermostat": "langevin"},
    "nose_hoover": {"ensemble": "nvt", "temperature_K": 300.0, "thermostat": "nose_hoover"},
    "srkn_6": {"integrator": "srkn_6"},
    "pefrl": {"integrator": "pefrl"},  # it ends with a drift
    "chin_4a": {"integrator": "chin_4a"},
    "stochastic_cell": NPT,
    "monte_carlo": NPT | {"barostat": "monte_carlo"},
    "piston": {"ensemble": "nph", "pressure_bar": 1.0},
}


@pytest.mark.parametrize(
    ("name", "precision"),
    [(name, "double") for name in ROWS]
    + [pytest.param(name, "mixed", marks=pytest.mark.soak) for name in ROWS],
)
def test_an_observation_takes_the_energies_of_the_last_step(name, precision, monkeypatch):
    """They are those of an evaluation, to the bit, and the run continues as if nobody had observed."""
    electrostatics = "pme" if precision == "double" else "reaction_field"
    forces = {"cutoff_A": 5.5, "electrostatics": electrostatics, "tail_correction": True}
    stage = {"duration_ps": 1.0} | ROWS[name]
    system, engine, start = built(
        {"spce": 20, "nitrogen": 12},
        12.0,
        3,
        spread=0.05,
        forces=forces,
        stages=[stage],
        precision=precision,
        fields={"electric_V_per_nm": [0.0, 0.0, 1.0], "electric_frequency_per_ps": 3.0},
    )
    row, other, evaluated = integrator_of_stage(system, 0), system.engine(), []
    looked, alone = engine.begin(start, row), other.begin(start, row)
    evaluate = Engine.evaluate
    monkeypatch.setattr(
        Engine, "evaluate", lambda self, state: evaluated.append(self) or evaluate(self, state)
    )
    for until in (7, 20, 21, 30):
        engine.advance(looked, row, 1e-3, until, observed=True)
        other.advance(alone, row, 1e-3, until)
        load, tallies = engine.evaluate_current(looked)
        assert all(np.array_equal(a, b) for a, b in zip(looked, alone, strict=True))
        expected, expected_tallies = other.evaluate_current(alone)
        assert all(np.array_equal(a, b) for a, b in zip(load, expected, strict=True))
        for term, tally in expected_tallies.items():
            assert tallies[term].energy == tally.energy
            assert np.array_equal(tallies[term].virial, tally.virial)
    if name not in ("pefrl", "chin_4a", "monte_carlo", "stochastic_cell"):
        assert engine not in evaluated
    assert other in evaluated


class Spring(rigidmd.Force):
    """A spring to the origin, which counts how often it is requested."""

    asked = 0

    def on_molecules(self, state):
        self.asked += 1
        return 0.5 * (state.position**2).sum(), -state.position


def test_an_observation_calls_a_force_in_python_once():
    system = build(small_scene({"argon": 10}, 25.0).with_user_code([spring := Spring()]))
    engine, row = system.engine(), SCHEMES["velocity_verlet"]
    state = engine.begin(system.state, row)
    engine.advance(state, row, 1e-3, 5, observed=True)
    asked = spring.asked
    found = engine.evaluate_current(state)[1]["spring"].energy
    assert spring.asked == asked
    assert found == engine.evaluate(state)[1]["spring"].energy
    assert spring.asked == asked + 1


def test_an_observation_of_another_state_is_an_evaluation():
    system, engine, start = built({"argon": 20}, 20.0, 3)
    row = SCHEMES["velocity_verlet"]
    moved, other = engine.begin(start, row), engine.begin(start, row)
    engine.advance(moved, row, 1e-3, 5, observed=True)
    other.position[:] += 0.1 * np.arange(20)[:, None]
    engine.advance(other, row, 1e-3, 0, observed=True)  # no step
    expected = system.engine().evaluate(other)[1]
    assert engine.evaluate_current(other)[1]["lennard_jones"].energy == pytest.approx(
        expected["lennard_jones"].energy, rel=1e-12
    )


def test_an_observation_of_a_state_that_was_changed_from_outside_is_new():
    _, engine, state = built({"argon": 20}, 25.0)
    row = SCHEMES["velocity_verlet"]
    engine.advance(state, row, 1e-3, 5, observed=True)
    known = engine.evaluate_current(state)[1]["lennard_jones"].energy
    assert engine.evaluate_current(state.copy())[1]["lennard_jones"].energy == known
    state.position[0, 0] += 0.5
    engine.forget()
    assert engine.evaluate_current(state)[1]["lennard_jones"].energy != known
