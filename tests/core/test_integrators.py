"""Rows of users: kicks with gradient first, last, in the middle and side by side, for molecules and
for a top."""

import tomllib

import numpy as np
import pytest
from support.common import built, move, same_bits, small_scene
from support.scenes import NPT, NVT, PINNED, forty_waters
from support.stops import same_after_stops

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core.integrators import (
    DRIFT,
    KICK,
    SCHEMES,
    WITH_THERMOSTAT,
    Flow,
    Scheme,
    composed,
    split,
)
from rigidmd.errors import SceneError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.studies.accuracy.accuracy import measure_accuracy
from rigidmd.run import Simulation
from rigidmd.scene import Scene, integrators

CHIN_B = (1 - 3**-0.5) / 2, 3**-0.5, (2 - 3**0.5) / 12  # Chin 1997, scheme B: drifts, gradient
#: Name -> order, kicks, drifts and gradients. The sums over a row of fraction times gradient are those
#: of `takahashi_imada`, 1/12, of `chin_4a`, 1/36, and of Chin's scheme B.
ROWS = {
    "outer": (2, (0.5, 0.5), (1.0,), (1 / 12, 1 / 12)),
    "middle": (2, (0.0, 1.0, 0.0), (0.5, 0.5), (0.0, 1 / 12, 0.0)),
    "outer_of_three": (4, (1 / 6, 2 / 3, 1 / 6), (0.5, 0.5), (1 / 12, 0.0, 1 / 12)),
    "all_of_three": (4, (1 / 6, 2 / 3, 1 / 6), (0.5, 0.5), (1 / 30, 1 / 40, 1 / 30)),
    "two_within": (
        4,
        (0.0, 0.5, 0.5, 0.0),
        (CHIN_B[0], CHIN_B[1], CHIN_B[0]),
        (0.0, CHIN_B[2], CHIN_B[2], 0.0),
    ),
    "side_by_side": (
        2,
        (0.0, 0.25, 0.5, 0.25, 0.0),
        (0.5, 0.0, 0.0, 0.5),
        (0.0, 0.1, 1 / 15, 0.1, 0.0),
    ),
    "plain_beside": (2, (0.25, 0.25, 0.25, 0.25), (0.0, 1.0, 0.0), (1 / 6, 0.0, 0.0, 1 / 6)),
    "without": (2, (0.2, 0.6, 0.2), (0.5, 0.5), None),
}
#: Force evaluations of each row in a step.
EVALUATIONS = (2, 2, 3, 4, 4, 4, 2, 2)


def row(name: str) -> Scheme:
    order, kicks, drifts, gradients = ROWS[name]
    return split(name, kicks, drifts, order, "", gradients)


def table(name: str) -> dict:
    """The row for [[integrators]]."""
    keys = ("order", "kicks", "drifts", "gradients")
    values = zip(keys, ROWS[name], strict=True)
    return {"name": name} | {key: value for key, value in values if value is not None}


def difference(a, b) -> float:
    parts = zip(a[:4], b[:4], strict=True)
    return max(np.abs(x - y).max(initial=0.0) for x, y in parts)


def reversed_motion(state):
    state.velocity[:] *= -1
    state.angular_momentum_body[:] *= -1


@pytest.fixture(scope="module")
def waters():
    """Two waters in each other's field: an engine, their state, a time in ps."""
    _, engine, state = built({"spce": 2}, None, 8, start={"temperature_K": 50.0})
    state.position[1] = state.position[0] + [3.0, 0.4, 0.1]
    return engine, state, 0.064


@pytest.fixture(scope="module")
def top():
    """An asymmetric top on a pivot: an engine, its state, a time in s."""
    system = build_body(Scene.from_dict(PINNED))
    return system.engine(), system.state, 0.64


@pytest.fixture(params=["waters", "top"])
def moving(request):
    return request.getfixturevalue(request.param)


def moved(moving, scheme, steps, calls=None):
    """The state after steps, in calls of these counts."""
    engine, start, time = moving
    state = start.copy()
    engine.forget()
    for count in calls or [steps]:
        move(engine, state, scheme, time / steps, count)
    return state


@pytest.mark.parametrize("name", ROWS)
def test_steps_in_any_calls_have_the_same_bits(moving, name):
    whole = moved(moving, row(name), 32)
    parts = moved(moving, row(name), 32, [1, 1, 10, 20])
    assert same_bits(whole, parts)


@pytest.mark.parametrize("name", ROWS)
def test_rows_run_backwards(moving, name):
    engine, start, time = moving
    state = moved(moving, row(name), 64, [3, 61])
    reversed_motion(state)
    engine.forget()
    move(engine, state, row(name), time / 64, 64)
    reversed_motion(state)
    assert difference(state, start) < 1e-11 * max(np.abs(part).max(initial=0) for part in start[:4])


@pytest.mark.parametrize("name", ROWS)
def test_rows_have_their_orders(moving, name):
    exact = moved(moving, SCHEMES["srkn_6"], 800)
    errors = [
        difference(moved(moving, row(name), steps, [1, steps - 1]), exact) for steps in (64, 128)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ROWS[name][0], abs=0.1)


@pytest.mark.parametrize("pair", [("side_by_side", "middle"), ("plain_beside", "outer")])
def test_kicks_side_by_side_are_one_kick(moving, pair):
    """With the sum of their fractions and the mean of their gradients, but for the differences that
    stand for derivatives: a small part of the error of the row."""
    one, other = (moved(moving, row(name), 64) for name in pair)
    exact = moved(moving, SCHEMES["srkn_6"], 800)
    assert difference(one, other) < 3e-3 * difference(one, exact)


class Springs(rigidmd.Force):
    """Springs of each site to its position at the start."""

    absolute_positions = True

    def on_sites(self, x, state):
        self.calls = getattr(self, "calls", 0) + 1
        self.start = getattr(self, "start", x.copy())
        return 150 * ((x - self.start) ** 2).sum(), -300 * (x - self.start)


@pytest.mark.parametrize(("name", "evaluations"), [*zip(ROWS, EVALUATIONS, strict=True)])
def test_forces_of_python_are_evaluated_as_often_as_needed(name, evaluations):
    """Also where they are displaced for a gradient: with the order of the row."""
    scheme = row(name)
    assert scheme.force_evaluations == evaluations
    forces = Springs()
    scene = small_scene({"argon": 4}, None, precision="double").with_user_code((forces,))
    system = build(scene)
    moving = system.engine(), system.state, 0.32
    exact = moved(moving, SCHEMES["srkn_6"], 800)
    errors, calls = [], []
    for steps in (64, 128):
        before = forces.calls
        errors.append(difference(moved(moving, scheme, steps, [steps // 4] * 4), exact))
        calls.append(forces.calls - before)
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ROWS[name][0], abs=0.1)
    assert calls[1] - calls[0] == 64 * evaluations


@pytest.mark.parametrize("barostat", ["monte_carlo", "cell_rescaling"])
@pytest.mark.parametrize("name", ["outer", "all_of_three", "chin_4a"])
def test_energy_less_heat_and_work_is_conserved(name, barostat):
    """A move of the box has the energy of the current positions."""
    stage = {
        "ensemble": "npt",
        "thermostat": "langevin",
        "temperature_K": 94.0,
        "pressure_bar": 50.0,
        "barostat": barostat,
        "barostat_interval_ps": 0.02,
        "integrator": name,
    }
    scene = small_scene(
        {"argon": 100},
        17.0,
        forces={"cutoff_A": 6.0, "truncation": "smooth_switch", "electrostatics": "none"},
        start={"temperature_K": 94.0},
        integrators=[table(name)] if name in ROWS else [],
        stages=[stage | {"duration_ps": 1.0, "timestep_fs": 2.0}],
        output={"trajectory": False, "log_interval_ps": 0.02},
    )
    results = Simulation(scene).run()
    assert np.ptp(results["volume"]) > 0
    assert np.ptp(results["conserved"]) < 1e-3 * np.ptp(results["energy"])


@pytest.mark.parametrize("name", ["outer", "side_by_side", "all_of_three"])
def test_trajectories_of_hybrid_monte_carlo_have_weights_of_mean_one(name):
    """<exp(-dH/kT)> = 1, and a rejected trajectory leaves the energy as it was."""
    stage = {
        "ensemble": "nvt",
        "thermostat": "hybrid_monte_carlo",
        "temperature_K": 120.0,
        "trajectory_steps": 6,
        "timestep_fs": 60.0,
        "duration_ps": 0.36 * 400,
        "integrator": name,
    }
    scene = small_scene(
        {"nitrogen_trappe": 12, "argon": 4},
        13.0,
        forces={"cutoff_A": 5.0, "electrostatics": "none"},
        integrators=[table(name)],
        stages=[stage],
        output={"trajectory": False, "log_interval_ps": 0.36},
    )
    results = Simulation(scene).run()
    weights = results["exp_minus_dH"][40:]
    assert 0.2 < results["acceptance"][1:].mean() < 0.999
    assert abs(weights.mean() - 1) < 4.5 * weights.std() / np.sqrt(len(weights))
    assert np.abs(results["drift"]).max() < 1e-8 * np.abs(results["energy"]).max()


def test_a_run_with_gradients_in_its_last_kick_is_resumed_to_the_same_bits(tmp_path):
    tables = [table(name) for name in ("outer", "all_of_three")]
    stages = [
        NPT | {"integrator": "outer", "barostat": "monte_carlo"},
        NVT | {"integrator": "all_of_three"},
    ]
    same_after_stops(forty_waters(*stages, integrators=tables), [17, 60, 111, 140], tmp_path)


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: split("mine", (0.4, 0.5), (1.0,), 2, ""), "mine: its kicks sum to 0.9, not to 1"),
        (lambda: split("mine", (0.5, 0.5), (1.1,), 2, ""), "mine: its drifts sum to 1.1, not to 1"),
        (lambda: split("mine", (0.5, 0.5), (float("nan"),), 2, ""), "mine: its drifts sum to nan"),
        (
            lambda: split("mine", (0.4, 0.6), (1.0,), 2, ""),
            "flows 1 and 3 of 3 differ .kick 0.4 and kick 0.6.",
        ),
        (
            lambda: split("mine", (1.0, 0.0), (1.0,), 1, ""),
            "flows 1 and 2 of 2 differ .kick 1 and drift 1.",
        ),
        (lambda: split("mine", (0.2, 0.6, 0.2), (0.4, 0.6), 2, ""), "flows 2 and 4 of 5 differ"),
        (
            lambda: split("mine", (0.5, 0.5), (1.0,), 2, "", (0.1, 0.2)),
            "differ .kick 0.5, gradient 0.1 and kick 0.5, ",
        ),
        (
            lambda: split("mine", (0.5, 0.5), (0.5, 0.5), 2, ""),
            "2 kicks, 2 drifts: kicks must be one more than drifts",
        ),
        (
            lambda: split("mine", (0.5, 0.5), (1.0,), 2, "", (0.1,)),
            "1 gradients: .* gradients as many as kicks",
        ),
        (lambda: composed("mine", (0.6, -0.3, 0.6), 4, ""), "mine: its drifts sum to 0.9"),
        (lambda: composed("mine", (0.3, 0.7), 2, ""), "not time-reversible"),
        (lambda: composed("mine", (), 2, ""), "mine: its drifts sum to 0, not to 1"),
        (
            lambda: Scheme("mine", (Flow(KICK, 0.5), Flow(DRIFT, 1.0)), 2, True, ""),
            "mine: its kicks sum to 0.5",
        ),
    ],
)
def test_a_row_that_is_inconsistent_or_not_reversible_is_refused_when_it_is_made(make, error):
    with pytest.raises(ValueError, match=f"integrator .*{error}"):
        make()


def test_rows_in_print_have_rounded_coefficients_and_shipped_ones_are_made_again():
    rounded = split("mine", (0.1931833275, 0.613633345, 0.1931833275), (0.5, 0.5), 2, "in print")
    assert rounded.force_evaluations == 2
    for scheme in (SCHEMES | WITH_THERMOSTAT).values():
        assert Scheme(*scheme) == scheme  # the checks of a new row


MINE = """
[[integrators]]
name = "mine"
order = 4
kicks = {kicks}
drifts = {drifts}
[[integrators]]
name = "other"
order = 2
steps = [0.5, 0.5]
[box]
lengths_A = 20.0
[[molecules]]
model = "argon"
count = 20
[forces]
truncation = "smooth_switch"
[start]
temperature_K = 90
[[stages]]
duration_ps = 0.04
integrator = "{name}"
[output]
trajectory = false
figures = false
"""


def test_adding_an_integrator_to_a_scene(tmp_path, capsys):
    """A table of coefficients is an integrator for runs, their folders, and accuracy."""
    known = SCHEMES["srkn_4"]
    for name in ("mine", "srkn_4"):
        text = MINE.format(name=name, kicks=list(known.kicks), drifts=list(known.drifts))
        (tmp_path / f"{name}.toml").write_text(text)
        assert main(["run", str(tmp_path / f"{name}.toml"), "-o", str(tmp_path / name)]) == 0
    logs = [(tmp_path / name / "log.csv").read_text() for name in ("mine", "srkn_4")]
    assert logs[0] == logs[1]
    assert (
        main(["resume", str(tmp_path / "mine"), "--until", "0.08ps"]) == 0
    )  # the folder has the row
    assert "mine" in capsys.readouterr().out
    found = measure_accuracy(
        Scene.read(tmp_path / "mine" / "scene.toml"), ["mine", "srkn_4", "other"], [8.0], repeats=1
    )
    errors = {trial.integrator: trial.energy_rms for trial in found.trials}
    assert errors["mine"] == errors["srkn_4"] < errors["other"]


def test_adding_an_integrator_from_python(monkeypatch):
    monkeypatch.setattr(integrators, "_REGISTERED", {})
    body = Scene.read("systems/heavy_top_3.toml")
    with pytest.raises(SceneError, match="is 'jump', must be 'velocity_verlet', "):
        Scene.read("systems/heavy_top_3.toml", {"run.integrator": "jump"})
    assert (
        rigidmd.register_integrator(
            "jump", order=4, steps=SCHEMES["yoshida_4"].drifts, source="Yoshida"
        )
        == "jump"
    )
    scene = Scene.read("systems/heavy_top_3.toml", {"run.integrator": "jump"})
    assert scene.run.scheme.flows == SCHEMES["yoshida_4"].flows
    assert [row.source for row in scene.integrators] == ["Yoshida"]
    assert not body.integrators
    names = {
        trial.integrator
        for trial in measure_accuracy(scene, timesteps=[0.01], span=0.1, repeats=1).trials
    }
    assert {"jump", "velocity_verlet", "dop853"} <= names
    rigidmd.register_integrator(
        "jump", order=2, steps=[0.5, 0.5]
    )  # the scene is a value: it keeps its row
    assert scene.run.scheme.flows == SCHEMES["yoshida_4"].flows
    again = Scene.from_dict(scene.model_dump(exclude_none=True))
    assert again.run.scheme == scene.run.scheme


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("steps = [0.5, 0.4]", "its drifts sum to 0.9, not to 1$"),
        ("steps = [0.4, 0.6]", "so that it is not time-reversible$"),
        (
            "steps = [0.5, 0.5]\norder = 4",
            "order = 4, but the error of an oscillator has order 2.0$",
        ),
        (
            "kicks = [0.082984, 0.39631, -0.039056, 0.119524, -0.039056, 0.39631, 0.082984]\ndrifts = [0.245299, 0.604873, -0.350172, -0.350172, 0.604873, 0.245299]\norder = 4",
            "has order 2.0. Give all digits of its coefficients .14 or more.",
        ),
        (
            "steps = [1.3512072, -1.7024142, 1.3512072]\norder = 4",
            "its drifts sum to 1.0000002, not to 1. Give all digits",
        ),
        ("steps = [1.0]\nkicks = [0.5, 0.5]", "contradict each other"),
        ("kicks = [0.5, 0.5]", "needs steps, or kicks and drifts"),
        ("kicks = [0.5, 0.5]\ndrifts = [0.5, 0.5]", "kicks must be one more than drifts"),
        ("kicks = [0.5, nan]\ndrifts = [1.0]", "kicks.1"),
        (
            "kicks = [0.5, 0.0, 0.5]\ndrifts = [0.5, 0.5]\ngradients = [0, 0.1, 0]",
            "fraction 0 has no gradient",
        ),
        ("steps = [1.0]\nname = 'srkn_4'", "srkn_4 is an integrator of rigidmd"),
        ("steps = [1.0]\nname = 'my row'", "name: is 'my row'"),
        ("steps = [100000.0, -100000.0, 1.0]", "steps.0: is 100000.0, must not be more than 10"),
    ],
)
def test_rows_that_cannot_be(row, message):
    row = tomllib.loads(row)
    with pytest.raises(SceneError, match=message):
        rigidmd.register_integrator(**({"name": "mine", "order": 2} | row))
    stage = {"duration_ps": 1.0, "integrator": row.get("name", "mine")}
    with pytest.raises(SceneError, match=r"integrators\.0") as caught:
        small_scene(
            {"argon": 20}, 30.0, integrators=[{"name": "mine", "order": 2} | row], stages=[stage]
        )
    assert not [error for error in caught.value.errors if error.startswith("stages")]
