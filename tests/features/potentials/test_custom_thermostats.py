"""Thermostats of users."""

import linecache
import math
from typing import NamedTuple

import pytest
from support.common import small_scene
from support.potentials import POINTS, SCRIPTS, points

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.dynamics.noise import THERMOSTAT, Key, key_of, normals
from rigidmd.errors import SceneError
from rigidmd.features.potentials.user_code.compiled import check_compiled_code
from rigidmd.run.checks import explain
from rigidmd.run.failed_check import FailedCheck


class Halving(NamedTuple):
    """Halves the kinetic energy in a time."""

    time: float
    halved = False


@rigidmd.compiled_thermostat(Halving)
def halve(bath, model, state, h, draw):
    factor = 0.5 ** (h / bath.time)
    before = 0.0
    for m in range(len(state.velocity)):
        for k in range(3):
            before += 0.5 * model.mass[model.species[m]] * state.velocity[m, k] ** 2
            state.velocity[m, k] *= math.sqrt(factor)
    state.energy_ledger[0] += (factor - 1) * before


def test_a_thermostat_of_a_user_replaces_that_of_the_stage():
    output = {"log_interval_ps": 0.02}
    scene = small_scene({"argon": 20}, 40.0, stages=POINTS["stages"], output=output)
    results = rigidmd.Simulation(scene, thermostat=Halving(0.01)).run()
    assert results["kinetic"][-1] == pytest.approx(results["kinetic"][0] / 16, rel=0.02)
    assert results["heat"][-1] == pytest.approx(
        results["energy"][-1] - results["energy"][0], rel=0.02
    )
    assert any("thermostat: halving, from Python" in note for note in results.system.notes)
    assert results.system.scene.from_python == ("thermostat halving",)


def with_error(line: str, name: str = "kick"):
    """A thermostat of one line of code, for each molecule m, from a file of its own so that
    messages can quote it."""

    class Shaky(NamedTuple):
        rate: float
        key: Key

    source = f"def {name}(thermostat, model, state, h, draw):\n    for m in range(len(state.velocity)):\n        {line}\n"
    lines = source.splitlines(keepends=True)
    linecache.cache["shaky.py"] = (len(source), None, lines, "shaky.py")
    names = {"normals": normals, "SCRIPTS": SCRIPTS[0]}
    exec(compile(source, "shaky.py", "exec"), names)
    rigidmd.compiled_thermostat(Shaky)(names[name])
    return Shaky(0.5, key_of(1, THERMOSTAT))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "normals(draw, 0, m)",
            "line 3 of shaky.py: `normals(draw, 0, m)`): normals(key, draw, molecule, step) is called with",
        ),
        (
            "state.velocity[m] *= model.mass[m]",
            "kick (line 3 of shaky.py: `state.velocity[m] *= model.mass[m]`) has an index",
        ),
        (
            "state.velocity[m, 3] = 0.0",
            "kick (line 3 of shaky.py: `state.velocity[m, 3] = 0.0`) has an index beyond an array",
        ),
        (
            "state.velocities[m, 0] = 0.0",
            "line 3 of shaky.py: `state.velocities[m, 0] = 0.0`): Numba knows no attribute 'velocities'",
        ),
        ("state.velocity[m, 0] = thermostat.time", "Numba knows no attribute 'time' of Shaky"),
        (
            "state.velocity[m, 0] = ramp(h)",
            "kick (line 1 of shaky.py) cannot be compiled: NameError: name 'ramp' is not defined",
        ),
        ("state.velocity[m, 0] = SCRIPTS", "it uses SCRIPTS, which is not compiled"),
        (
            "state.velocity[m, 0] = 0.0 / (h - h)",
            "kick (line 1 of shaky.py) makes momenta that are not finite",
        ),
    ],
)
def test_an_error_in_a_thermostat_names_its_line_and_the_cause(line, message):
    with pytest.raises(SceneError) as error:
        rigidmd.Simulation(points(), thermostat=with_error(line)).run()
    assert message in str(error.value)
    assert "halving" not in str(error.value)


@pytest.mark.parametrize(
    ("line", "note"),
    [
        ("state.velocity[m, 1] *= -1.0", None),
        (
            "state.velocity[m, 1] *= 0.9; "
            + (heat := "state.energy_ledger[0] -= 20.0 * 0.19 / 0.81 * state.velocity[m, 1]**2"),
            None,
        ),
        ("state.velocity[m, 1] *= 0.9", "of it and adds 0 to state.energy_ledger[0]"),
        (f"state.velocity[m, 1] *= 0.9; {heat.replace('-=', '+=')}", "of it and adds 0."),
    ],
)
def test_heat_that_is_not_in_the_ledger_has_a_note(line, note):
    system = build(points().with_user_code([], with_error(line)))
    notes = check_compiled_code(system, system.state)
    assert len(notes) == (note is not None)
    assert note is None or note in notes[0]


def test_a_stop_names_the_code_of_the_user_that_acts_in_each_step():
    rows = [{"name": "two_halves", "order": 2, "steps": [0.5, 0.5], "source": "this test"}]
    stages = [{"duration_ps": 0.04, "timestep_fs": 4, "integrator": "two_halves"}]
    system = build(points(integrators=rows, stages=stages).with_user_code([], Halving(0.01)))
    told = explain(system, FailedCheck("molecule 2 (dot) is lost", 1), [], 0.004, None)
    assert (
        "Likely cause: the thermostat halving, from Python or the integrator two_halves, from the scene"
        in told
    )
