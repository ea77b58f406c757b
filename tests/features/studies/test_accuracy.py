"""`rigidmd accuracy`: measurements, recommendations, files."""

import csv
import dataclasses
import itertools
import json
import re
import tomllib

import numpy as np
import pytest
from support.common import ROOT, SPRING, small_scene, springs

from rigidmd.commands.cli import main
from rigidmd.core.integrators import FORMULATIONS, SCHEMES
from rigidmd.core.statistics import mean_and_error
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run import Simulation
from rigidmd.run.trial_systems import body_trial_system
from rigidmd.run.trials import Method, Trial
from rigidmd.scene import Scene
from rigidmd.studies.accuracy import accuracy, averages, averages_report, measurement
from rigidmd.studies.accuracy.accuracy import (
    measure_accuracy,
    recommendations,
    table_text,
    trial_table,
    write_accuracy,
)
from rigidmd.studies.accuracy.averages import (
    UNSEEN,
    AveragedQuantity,
    AverageRun,
    Averages,
    measure_averages,
)
from rigidmd.studies.accuracy.measurement import IntegratorAccuracy, measure, time_span
from rigidmd.studies.accuracy.orders import convergence, fitted_order, order_table
from rigidmd.studies.extrapolation import MeanAtStep, Together, extrapolate, means_of_runs
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

TOP = ROOT / "systems" / "heavy_top_3.toml"


@pytest.fixture(scope="module", autouse=True)
def short_timings():
    """Seconds of computing are not what most of these tests are about."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement, "TIMING_SECONDS", 0.002)
        yield


@pytest.fixture(scope="module")
def top(short_timings):
    return measure_accuracy(
        Scene.read(TOP), ["velocity_verlet", "srkn_4", "srkn_6"], span=0.4, repeats=3
    )


def trials(found, name):
    return [trial for trial in found.trials if trial.integrator == name]


def test_errors_fall_with_the_order_at_equal_cost(top):
    costs = [
        [trial.forces for trial in trials(top, name)]
        for name in ("velocity_verlet", "srkn_4", "srkn_6")
    ]
    shared = min(map(len, costs))  # besides the longer steps that are tried until one fails
    assert shared >= 6
    for other in costs[1:]:
        assert np.allclose(costs[0][-shared:], other[-shared:], rtol=0.15)
    for name, order in (("velocity_verlet", 2), ("srkn_4", 4)):
        own = trials(top, name)[-2:]
        for error in ("rotation_error", "energy_rms"):
            a, b = (getattr(trial, error) for trial in own)
            assert np.log(a / b) / np.log(own[1].steps / own[0].steps) == pytest.approx(
                order, abs=0.25
            )
    assert top.reference_error < 1e-11
    assert min(trial.rotation_error for trial in trials(top, "srkn_6")) < 100 * top.reference_error


def test_every_trial_is_timed_as_often_as_asked(top):
    for trial in top.trials:
        assert len(trial.seconds) == 3
        assert trial.time == sorted(trial.seconds)[1]
        assert trial.timestep * trial.steps == pytest.approx(0.4)


class Clockwork:
    """An engine, and the clock: steps take 1 ms, a call 5 ms, and the first three steps of a new
    engine 30 ms more."""

    now = 0.0

    def __init__(self, made, lasts=10**9):
        self.cold, self.at, self.lasts = 3, 0, lasts
        made.append(self)

    def begin(self, state, scheme):
        """As `Engine.begin`."""
        return state.copy()

    def advance(self, state, scheme, dt, until, observed=False):
        """As `Engine.advance`."""
        steps, self.at = max(0, until - self.at), until
        if self.at > self.lasts:
            raise SimulationError("no further")
        Clockwork.now += 5e-3 + 1e-3 * steps + 30e-3 * min(steps, self.cold)
        self.cold -= min(steps, self.cold)

    def forget(self):
        """As `Engine.forget`."""


@pytest.fixture
def clockwork(monkeypatch):
    """(subject, engines made) of a subject moved by clockwork, for a given lifetime in steps."""
    monkeypatch.setattr(measurement, "TIMING_SECONDS", 0.2)
    monkeypatch.setattr(measurement.clock, "perf_counter", lambda: Clockwork.now)

    def trial_system(can_continue, lasts=10**9):
        made = []
        method = Method(lambda timestep: Clockwork(made, lasts), SCHEMES["velocity_verlet"])
        own, _ = body_trial_system(Scene.read(TOP), 0.1)
        return dataclasses.replace(
            own, methods={"velocity_verlet": method}, can_continue=can_continue
        ), made

    return trial_system


@pytest.mark.parametrize("steps", [1, 25, 1000])
@pytest.mark.parametrize("can_continue", [False, True])
def test_a_timing_is_of_warm_steps_and_of_nothing_else(clockwork, steps, can_continue):
    """25 steps of 216 waters took 40 ms where a new engine began with them, and 20 ms after
    that."""
    trial_system, made = clockwork(can_continue)
    began = Clockwork.now
    seconds = time_span(trial_system, Trial("velocity_verlet", 1e-3, steps, steps))
    assert seconds == pytest.approx(1e-3 * steps)
    assert Clockwork.now - began > 0.2
    assert len(made) == 1
    spans = -(-0.2 // (5e-3 + 1e-3 * steps))
    assert made[0].at == (steps * spans if can_continue else 0)


def test_a_step_that_is_good_for_the_span_only_is_timed_on_the_span(clockwork):
    trial_system, made = clockwork(can_continue=True, lasts=60)
    assert time_span(trial_system, Trial("velocity_verlet", 1e-3, 25, 25)) == pytest.approx(0.025)
    assert made[0].at <= 60
    trial_system, _ = clockwork(can_continue=True, lasts=20)
    with pytest.raises(SimulationError):
        time_span(trial_system, Trial("velocity_verlet", 1e-3, 25, 25))


def test_timings_alternate_between_trials(monkeypatch):
    order = []
    monkeypatch.setattr(
        measurement,
        "time_span",
        lambda trial_system, trial: order.append(trial.steps) or 1e-3 * len(order),
    )
    trial_system, _ = body_trial_system(Scene.read(TOP), 0.01)
    trials = [Trial("velocity_verlet", 0.01 / n, n, n) for n in (2, 3, 4)]
    fractions = []
    measure(trial_system, trials, 2, progress=fractions.append)
    assert order == [2, 3, 4, 2, 3, 4]
    assert [trial.seconds for trial in trials] == [[1e-3, 4e-3], [2e-3, 5e-3], [3e-3, 6e-3]]
    assert fractions == pytest.approx(np.arange(1, 7) / 6)


@pytest.mark.filterwarnings(
    "ignore::RuntimeWarning:matplotlib"
)  # an axis on which all points have one value
def test_a_spread_is_shown_and_warned_of_and_none_is_claimed_of_one_timing(tmp_path):
    trial_system, _ = body_trial_system(Scene.read(TOP), 0.1)

    def told(*seconds):
        trials = [Trial("velocity_verlet", 1e-3, 100, 100, list(s), *[1e-6] * 6) for s in seconds]
        found = IntegratorAccuracy(trial_system, trials, 1000, 1e-14)
        return found, "\n".join(recommendations(found))

    found, words = told((1.0, 1.1, 1.19), (1.0, 1.0, 1.0))
    assert [trial_table(found).values(trial)[4] for trial in found.trials] == pytest.approx(
        [100 * 0.19 / 1.1, 0]
    )
    assert "warning" not in words
    found, words = told((1.0, 1.1, 1.15), (1.0, 1.1, 1.4), (1.0, 2.0, 1.5))
    assert "warning: repeated timings of 2 of 3 trials differ by more than 20%" in words
    assert "those of velocity_verlet at 0.001 s by 67%" in words
    found, words = told((1.0,), (1.5,))
    assert "timed once" in words
    assert "warning" not in words
    assert "±" not in table_text(found).splitlines()[1].replace("drift        ±", "drift")
    write_accuracy(tmp_path, found, "a command")
    with (tmp_path / "accuracy.csv").open() as file:
        assert [line["spread (%)"] for line in csv.DictReader(file)] == ["", ""]


def test_the_front_and_the_advice_follow_from_the_numbers(top):
    front = top.front("energy_rms")
    for trial in top.trials:
        assert any(
            better.time <= trial.time and better.energy_rms <= trial.energy_rms for better in front
        )
    own = trials(top, "velocity_verlet")
    target = np.sqrt(own[0].energy_rms * own[1].energy_rms)
    at = top.time_for("velocity_verlet", "energy_rms", target)
    assert own[1].timestep < at.step < own[0].timestep
    assert min(own[0].time, own[1].time) <= at.seconds <= max(own[0].time, own[1].time)
    assert top.time_for("velocity_verlet", "energy_rms", 1e-30) is None
    timed = [dataclasses.replace(trial, seconds=[float(trial.forces)] * 3) for trial in top.trials]
    said = "\n".join(recommendations(dataclasses.replace(top, trials=timed)))
    assert re.search(
        "for an error of Q of (1e-0[024] to )?1e-0[46] over 0.4 s the fastest is srkn_", said
    )
    assert "times faster than velocity_verlet" in said
    assert "timing noise" not in said
    assert table_text(top).count("srkn_4") == len(trials(top, "srkn_4")) > 6


def made(*rows, span=0.1):
    """A body's trials (integrator, step, seconds of three timings or a reason to fail, energy and Q
    error)."""
    trial_system, _ = body_trial_system(Scene.read(TOP), span)
    trials = []
    for name, step, seconds, error in rows:
        n = round(span / step)
        trial = Trial(name, step, n, n, rotation_error=error, energy_rms=error)
        if isinstance(seconds, str):
            trial.failure = seconds
        else:
            trial.seconds = list(seconds)
        trials.append(trial)
    return IntegratorAccuracy(trial_system, trials, 1000, 1e-14)


def test_advice_comes_first_names_its_span_and_is_one_line_for_all_errors_that_a_longest_step_keeps():
    found = made(
        ("velocity_verlet", 1e-3, (2.0, 2.0, 2.0), 2e-9),
        ("srkn_4", 5e-3, (1.0, 1.0, 1.0), 5e-7),
        ("srkn_4", 2.5e-3, (1.9, 1.9, 1.9), 5e-9),
        ("pefrl", 2e-3, (9.0, 9.0, 9.0), 1e-1),
    )
    said, most = (
        recommendations(found),
        "times the largest kinetic energy over 0.1 s the fastest is srkn_4 at",
    )
    assert said[0] == (
        f"for an energy error of 1e-02 to 1e-06 {most} 0.005 s (its longest step tried): 2.0 times faster than "
        "velocity_verlet at 0.001 s"
    )
    assert said[1].startswith(
        f"for an energy error of 1e-08 {most} 0.0028 s: 1.2 times faster than velocity_verlet"
    )
    assert [line.startswith("for an error of Q") for line in said[2:5]] == [True, True, False]


def test_energy_without_a_rotation_is_no_accuracy():
    """A solver that keeps the energy while Q becomes no rotation, or another invariant changes, is
    not advised for it."""
    found = made(
        ("rk4", 1e-2, (1.0, 1.0, 1.0), 1e-3),
        ("rk4", 2e-3, (5.0, 5.0, 5.0), 1e-9),
        ("velocity_verlet", 1e-3, (9.0, 9.0, 9.0), 3e-2),
        ("velocity_verlet", 1e-4, (90.0, 90.0, 90.0), 3e-4),
    )
    (advice, *_) = recommendations(found)
    assert "for an energy error of 1e-02" in advice and "rk4 at 0.01 s" in advice
    for worse in ({"orthogonality_error": 0.33}, {"conserved_errors": {"L_z": 0.04}}):
        changed = [dataclasses.replace(found.trials[0], **worse), *found.trials[1:]]
        (advice, *_) = recommendations(dataclasses.replace(found, trials=changed))
        assert "rk4 at 0.01 s" not in advice


@pytest.mark.parametrize(
    ("next_step", "step", "limit"),
    [("diverges", 4e-3, "kept from its longest stable step"), ((0.5,) * 3, 5e-3, "")],
)
def test_no_step_at_the_edge_of_stability_is_recommended(next_step, step, limit):
    found = made(
        ("kahan_li_6", 1e-2, next_step, 1.0),
        ("kahan_li_6", 5e-3, (1.0, 1.0, 1.0), 1e-6),
        ("kahan_li_6", 2.5e-3, (2.0, 2.0, 2.0), 1e-8),
    )
    at = found.time_for("kahan_li_6", "energy_rms", 1e-6)
    assert at.step == pytest.approx(step)
    assert at.seconds == pytest.approx(5e-3 / step, rel=1e-6)
    assert at.limit == limit


@pytest.mark.parametrize(("slow", "fast"), [((1.0, 1.2, 1.4), False), ((1.19, 1.2, 1.21), True)])
def test_no_advantage_is_claimed_within_the_spread_of_the_timings(slow, fast):
    found = made(
        ("velocity_verlet", 1e-3, slow, 1e-5),
        ("srkn_4", 5e-3, (0.99, 1.0, 1.01), 1e-5),
        ("pefrl", 2e-3, (1.0, 1.0, 1.0), 1e-1),
    )
    (line,) = (line for line in recommendations(found) if line.startswith("for an energy error"))
    assert ("1.2 times faster than velocity_verlet" in line) == fast
    assert ("Equally fast within timing noise: velocity_verlet at 0.001 s" in line) != fast


@pytest.mark.parametrize(
    ("longest", "steps"), [(0.05, [12, 25, 50, 100]), (1.0, [6, 12, 25, 50, 100])]
)
def test_ladders_continue_to_longer_steps_until_one_fails_or_is_too_long_for_the_span(
    longest, steps, monkeypatch
):
    def measure_errors(trial_system, trial, exact):
        trial.energy_rms = 1e-9
        trial.failure = "diverges" if trial.timestep > longest else ""

    trial_system, _ = body_trial_system(Scene.read(TOP), 1.0)
    monkeypatch.setattr(measurement, "measure_errors", measure_errors)
    monkeypatch.setattr(measurement, "final_state", lambda *_: trial_system.state)
    monkeypatch.setattr(measurement, "time_span", lambda *_: 1.0)
    for extend, expected in ((True, steps), (False, [50, 100])):
        trials = measurement.plan(trial_system, {"velocity_verlet": [0.02, 0.01]})
        found = measure(trial_system, trials, 1, extend=extend).trials
        assert [trial.steps for trial in found] == expected
        assert [trial.diverged for trial in found] == [trial.timestep > longest for trial in found]


def test_a_step_that_is_too_long_diverges_and_is_stopped():
    scene = Scene.read(ROOT / "systems" / "water_dimer.toml")
    found = measure_accuracy(scene, ["velocity_verlet"], [1.0, 80.0], span=2.4, repeats=1)
    good, bad = found.trials
    assert not good.diverged
    assert bad.diverged
    assert bad.seconds == []
    assert found.stable_step("velocity_verlet") == pytest.approx(1.0)
    assert "velocity_verlet diverges beyond 1 fs" in "\n".join(recommendations(found))
    assert "fails" in table_text(found)


def test_molecules_start_where_the_last_stage_does():
    stages = [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 0.2}, {"duration_ps": 1.0}]
    scene = small_scene({"nitrogen": 8}, 18.5, stages=stages)
    found = measure_accuracy(scene, ["velocity_verlet", "srkn_6"], [4.0, 2.0], repeats=1)
    assert "kT per degree of freedom, at the" in "\n".join(recommendations(found))
    verlet = trials(found, "velocity_verlet")
    assert verlet[0].energy_rms / verlet[1].energy_rms == pytest.approx(4, rel=0.15)
    assert all(trial.position_error < 1 for trial in found.trials)


def test_mixed_precision_says_what_its_forces_lose():
    scene = small_scene({"spce": 60}, 18.5, precision="mixed")
    found = measure_accuracy(scene, ["velocity_verlet"], [2.0], span=0.01, repeats=1)
    force, torque = found.trial_system.rounding
    assert 1e-8 < force < 1e-5 and 1e-8 < torque < 1e-5
    assert f"forces differ from double ones by {force:.1e} of their rms" in "\n".join(
        recommendations(found)
    )
    assert (
        measure_accuracy(
            small_scene({"argon": 8}, 18.5), ["velocity_verlet"], [2.0], repeats=1
        ).trial_system.rounding
        is None
    )


def test_only_what_keeps_its_order_is_tried():
    wheel = Scene.read(ROOT / "systems" / "satellite_wheel.toml")
    found = measure_accuracy(wheel, span=5.0, repeats=1)
    names = {trial.integrator for trial in found.trials}
    assert "suzuki_4" in names
    assert "srkn_6" not in names
    said = "\n".join(recommendations(found))
    assert (
        "srkn_6: the free motion of a body with wheels has no exact flow: it would be of order 2\n"
        in said
    )
    with pytest.raises(
        SceneError, match=r"srkn_6 does not suit this scene: .* wheels .*: it would be of order 2$"
    ):
        measure_accuracy(wheel, ["srkn_6"])
    with pytest.raises(SceneError, match="unknown integrator rk5"):
        measure_accuracy(wheel, ["rk5"])


def test_steps_suit_what_is_fast_in_a_body():
    compass = measure_accuracy(
        Scene.read(ROOT / "systems" / "gyrocompass.toml"), ["kahan_li_6"], span=60.0, repeats=1
    )
    # the wheel's nutation, 20 rad/s, sets the steps, not the Earth's rotating
    assert not any(trial.diverged for trial in compass.trials[-3:])
    assert compass.trials[-1].rotation_error < 1e-6


def test_the_command_writes_a_table_a_figure_and_a_page(tmp_path, capsys):
    folder = tmp_path / "p"
    command = [
        "accuracy",
        str(TOP),
        "--integrators",
        "velocity_verlet,srkn_6",
        "--timesteps",
        "0.002,0.001",
        "--span",
        "0.1",
        "--repeats",
        "1",
        "-o",
        str(folder),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "velocity_verlet" in said
    assert "accuracy.html" in said
    with (folder / "accuracy.csv").open() as file:
        rows = list(csv.reader(file))
    assert len(rows) == 5
    assert float(rows[1][1]) == pytest.approx(0.002)
    assert (folder / "accuracy.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "accuracy.html").read_text()
    assert page.count("<svg") == 1
    assert "<script" not in page
    trials = page[page.index(">All trials</h2>") :]
    assert trials.count("<tr>") == 5
    assert "least run time" in page
    assert main(command) == 2  # nothing is overwritten
    assert main([*command, "--force"]) == 0
    assert main(["accuracy", str(TOP), "--timesteps", "a"]) == 2
    capsys.readouterr()


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--integrators", "rk5"], "unknown integrator rk5"),
        (["--integrators", "rk4"], "rk4 does not suit this scene: it is for single bodies"),
        (["--span", "inf"], "must be between"),
        (["--timesteps", "nan"], "must be between"),
        (["--averages", "--integrators", "rk5"], "unknown integrator rk5"),
    ],
)
def test_arguments_are_refused_before_anything_is_compiled_or_run(
    arguments, error, capsys, tmp_path
):
    water = ["accuracy", str(ROOT / "systems" / "water.toml"), "-o", str(tmp_path / "p")]
    thermal = [
        "--set",
        "stages.production.ensemble=nvt",
        "--set",
        "stages.production.temperature_K=298.15",
    ]
    assert main([*water, *thermal, *arguments]) == 2
    said = capsys.readouterr()
    assert error in said.err
    assert "compiling" not in said.out + said.err


@pytest.fixture(scope="module")
def water():
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.5},
        {"duration_ps": 1.0, "timestep_fs": 1.0},
    ]
    forces = {"cutoff_A": 6.0, "truncation": "smooth_switch"}
    return small_scene({"spce": 64}, 12.42, forces=forces, stages=stages)


def at_constant_energy(scene: Scene, integrator: str, step: float, duration: float):
    """Temperatures of rotation less those of translation, and what the temperature would lose with
    the momenta at the ends of steps, K."""
    *before, last = scene.stages
    changed = last.model_copy(
        update={"integrator": integrator, "timestep_fs": step, "duration_ps": duration}
    )
    output = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": 0.02})
    results = Simulation(
        scene.model_copy(update={"stages": (*before, changed), "output": output})
    ).run()
    late = results["stage"] == len(before)
    rotation, translation, temperature, kinetic = (
        results[name][late]
        for name in (
            "temperature_rotation",
            "temperature_translation",
            "temperature",
            "kinetic",
        )
    )
    freedom = results.summary["degrees_of_freedom"]
    at_ends = 2 * kinetic * KJ_PER_MOL / (freedom * BOLTZMANN)
    return rotation - translation, float(np.mean(temperature - at_ends))


def test_the_step_takes_from_the_kinetic_energy_at_its_ends(water):
    loss = {step: at_constant_energy(water, "velocity_verlet", step, 3.0)[1] for step in (4.0, 1.0)}
    # of the order of (omega dt)²/6 with the 100 rad/ps of librations, and quadratic in the step
    assert 2 < loss[4.0] < 10
    assert loss[4.0] / loss[1.0] == pytest.approx(16, rel=0.2)
    assert at_constant_energy(water, "srkn_4", 4.0, 0.1)[1] == pytest.approx(0, abs=1e-6)


def test_comparators_stand_beside_the_schemes_and_fail_in_words():
    upright = tomllib.loads(TOP.read_text()) | {
        "start": {"angular_velocity_body_rad_s": [3.0, 0.0, 60.0]}
    }
    names = ["velocity_verlet", "rk4", "rk4_quaternion", "rk4_euler_angles", "dop853"]
    found = measure_accuracy(Scene.from_dict(upright), names, [1e-3, 5e-4], span=0.2, repeats=1)
    assert {trial.integrator for trial in found.trials if trial.diverged} == {"rk4_euler_angles"}
    assert "rk4_euler_angles: the Euler angles became singular" in "\n".join(recommendations(found))
    drift = {
        trial.integrator: trial.orthogonality_error for trial in found.trials if not trial.diverged
    }
    assert drift["velocity_verlet"] < 1e-13
    assert drift["rk4"] > 1e-11  # nothing keeps Q a rotation there
    adaptive = trials(found, "dop853")
    assert [trial.tolerance for trial in adaptive] == sorted(
        (t.tolerance for t in adaptive), reverse=True
    )
    assert all(
        b.forces > a.forces and b.timestep < a.timestep for a, b in itertools.pairwise(adaptive)
    )
    assert adaptive[-1].rotation_error < 1e-8


def changed(**run):
    """The heavy top with other keys of its run."""
    return Scene.read(TOP, {f"run.{key}": value for key, value in run.items()})


def test_the_formulation_of_the_scene_is_the_one_measured():
    errors = {}
    for name in ("rk4_matrix", "rk4_quaternion", "rk4_euler_angles"):
        (trial,) = measure_accuracy(Scene.read(TOP), [name], [1e-3], span=0.2, repeats=1).trials
        assert trial.integrator == name.removesuffix("_matrix")
        errors[name.removeprefix("rk4_")] = trial.rotation_error
    assert len(set(errors.values())) == 3
    for form in FORMULATIONS:
        (trial,) = measure_accuracy(
            changed(integrator="rk4", formulation=form), ["rk4"], [1e-3], span=0.2, repeats=1
        ).trials
        assert trial.rotation_error == errors[form]


@pytest.fixture
def planned(monkeypatch):
    """(names tried, what was omitted) by default on a scene; nothing is run."""
    monkeypatch.setattr(
        accuracy,
        "measure",
        lambda trial_system, trials, *_, **options: IntegratorAccuracy(
            trial_system, trials, 1, 0.0
        ),
    )

    def plan(scene):
        found = measure_accuracy(scene)
        return {trial.integrator for trial in found.trials}, found.left_out

    return plan


def test_textbook_solvers_in_all_formulations_are_measured_by_default(planned):
    textbook = {
        f"{solver}{form}"
        for solver in ("rk4", "dop853")
        for form in ("", "_quaternion", "_euler_angles")
    }
    names, left_out = planned(Scene.read(TOP))
    assert textbook | {"velocity_verlet", "srkn_6"} <= names
    assert left_out == {}
    assert "vefrl" not in names
    assert "vefrl" in planned(changed(integrator="vefrl"))[0]
    assert "rk4_quaternion" in planned(changed(integrator="rk4", formulation="quaternion"))[0]
    assert (
        "radau_euler_angles" in planned(changed(integrator="radau", formulation="euler_angles"))[0]
    )


def test_what_cannot_be_measured_is_left_out_in_words(planned):
    upright = tomllib.loads(TOP.read_text()) | {
        "start": {"angular_velocity_body_rad_s": [3.0, 0.0, 60.0]}
    }
    names, left_out = planned(Scene.from_dict(upright))
    assert set(left_out) == {"rk4_euler_angles", "dop853_euler_angles"}
    assert "theta = 0" in left_out["rk4_euler_angles"]
    assert "rk4_quaternion" in names
    names, left_out = planned(Scene.read(ROOT / "systems" / "dropped_stone.toml"))
    assert "rk4" in names
    assert "a point does not rotate" in left_out["rk4_quaternion"]
    _, left_out = planned(Scene.read(ROOT / "systems" / "gyroscope_friction.toml"))
    assert (
        left_out["rk4"]
        == "dry friction is discontinuous where a body stops, which it cannot resolve"
    )
    with pytest.raises(
        SceneError, match="rk4_quaternion does not suit this scene: it is for single bodies"
    ):
        measure_accuracy(Scene.read(ROOT / "systems" / "water_dimer.toml"), ["rk4_quaternion"])


def test_help_names_the_formulations(capsys):
    with pytest.raises(SystemExit):
        main(["accuracy", "--help"])
    said = capsys.readouterr().out
    assert "--integrators rk4,rk4_quaternion,rk4_euler_angles" in said
    assert "dop853_euler_angles" in said


def test_what_else_is_kept_is_shown(top):
    verlet = trials(top, "velocity_verlet")[0]
    assert set(verlet.conserved_errors) == {"L_z", "L_3"}
    assert max(verlet.conserved_errors.values()) < 1e-12
    assert "L_z" in table_text(top).splitlines()[1]
    dimer = measure_accuracy(
        Scene.read(ROOT / "systems" / "water_dimer.toml", {"precision": "double"}),
        ["velocity_verlet"],
        [1.0],
        repeats=1,
    )
    assert set(dimer.trials[0].conserved_errors) == {"momentum", "L"}
    assert max(dimer.trials[0].conserved_errors.values()) < 1e-11


def test_the_limit_at_a_step_of_zero_is_shared_and_long_steps_are_left_out():
    slopes, error = {"a": 0.3, "b": -0.1}, 0.01
    points = [
        MeanAtStep(name, dt, 5 + b * dt**2, error)
        for name, b in slopes.items()
        for dt in (1.0, 2.0, 3.0)
    ]
    fit = extrapolate(points)
    assert fit.limit == pytest.approx(5)
    assert fit.longest == 3
    assert {name: at[0] for name, at in fit.slopes.items()} == pytest.approx(slopes)
    wild = MeanAtStep("a", 6.0, 5 + 0.3 * 36 + 0.02 * 6**4, error)
    assert extrapolate([*points, wild]) == fit
    assert fit.bias(wild)[0] == pytest.approx(0.3 * 36 + 0.02 * 6**4)
    assert fit.bias(wild)[1] == pytest.approx(np.hypot(error, fit.limit_error))
    known = extrapolate(points, exact=4.9)
    assert (known.limit, known.limit_error) == (4.9, 0.0)
    assert known.bias(points[0]) == pytest.approx((points[0].mean - 4.9, error))
    alone = extrapolate([MeanAtStep("a", 2.0, 7.0, 0.1), MeanAtStep("b", 4.0, 8.0, 0.1)])
    assert (alone.limit, alone.limit_error, alone.slopes) == (7.0, 0.1, {})
    assert alone.bias(MeanAtStep("a", 2.0, 7.0, 0.1)) == (0.0, 0.0)


def test_errors_of_a_limit_and_of_biases_are_those_of_repeated_measurements():
    rng = np.random.default_rng(0)
    steps, errors = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.03, 0.02, 0.04, 0.02])
    limits, biases = [], []
    for _ in range(2000):
        noise = errors * rng.standard_normal((2, 4))
        points = [
            MeanAtStep(name, *point)
            for name, b, n in zip("ab", (0.02, 0.05), noise, strict=True)
            for point in zip(steps, 2 + b * steps**2 + n, errors, strict=True)
        ]
        fit = extrapolate(points)
        if fit.longest == 4:  # of what was not omitted by chance
            limits.append((fit.limit, fit.limit_error))
            biases.append([fit.bias(point) for point in points])
    assert len(limits) > 1700
    assert np.std([limit for limit, _ in limits]) == pytest.approx(limits[0][1], rel=0.08)
    found = np.array(biases)
    assert np.allclose(found[:, :, 0].std(axis=0), found[0, :, 1], rtol=0.08)
    assert np.mean([limit for limit, _ in limits]) == pytest.approx(
        2, abs=4 * limits[0][1] / np.sqrt(len(limits))
    )


def test_a_fit_has_its_chi2_and_the_order_of_the_integrator():
    points = [MeanAtStep("a", dt, 1 + 0.02 * dt**4, 0.1) for dt in (1.0, 2.0, 4.0)]
    points[1] = points[1]._replace(mean=points[1].mean + 0.1)
    fit = extrapolate(points, order=4)
    assert fit.order == 4
    assert fit.freedom == 1
    assert 0 < fit.chi2 < 1
    assert fit.limit == pytest.approx(1, abs=0.1)
    assert fit.slopes["a"][0] == pytest.approx(0.02, rel=0.02)
    assert extrapolate(points[:2]).freedom == 0


def test_points_that_no_fit_describes_make_the_error_of_the_limit_larger():
    """By the root of chi² over its degrees of freedom: two methods at three steps, and then at
    two."""
    off = {"a": (0.2, -0.2, 0.3), "b": (-0.1, 0.3, 0.1)}
    for count, freedom in ((3, 1), (2, 1)):
        points = [
            MeanAtStep(name, float(k + 1), 5 + values[k], 0.01 * (k + 1))
            for name, values in off.items()
            for k in range(count)
        ]
        fit = extrapolate(points)
        used = [point for point in points if point.timestep <= 2]
        design = np.array(
            [[1.0, *(point.timestep**2 * (point.method == name) for name in off)] for point in used]
        )
        errors = np.array([point.error for point in used])
        weighted = design / errors[:, None]
        found, (chi2,), _, _ = np.linalg.lstsq(
            weighted, np.array([point.mean for point in used]) / errors, rcond=None
        )
        assert (fit.longest, fit.freedom) == (2.0, freedom)
        assert fit.chi2 == pytest.approx(chi2) and chi2 > 10
        assert fit.limit == pytest.approx(found[0])
        plain = np.sqrt(np.linalg.inv(weighted.T @ weighted)[0, 0])
        assert fit.limit_error == pytest.approx(plain * np.sqrt(chi2 / freedom))


@pytest.mark.parametrize(
    ("slope", "error", "seen"), [(0.1, 1.0, False), (-0.1, 0.5, False), (2.0, 0.1, True)]
)
def test_the_step_of_a_bias_that_is_not_seen_allows_for_its_error(slope, error, seen):
    """Means 5 + slope dt² of two steps whose errors give the slope this error."""
    steps = np.array([1.0, 2.0])
    of_mean = error * (steps[1] ** 2 - steps[0] ** 2) / np.sqrt(2)
    runs = [
        AverageRun("baoab", "langevin", dt, 1.0, averages={"U": (5 + slope * dt**2, of_mean)})
        for dt in steps
    ]
    quantity = AveragedQuantity("U", "kJ/mol", 2.5)
    found = Averages("scene", "nvt", 300.0, 10, 60, 5.0, [quantity], runs)
    fit = found.fit(quantity)
    assert fit.slopes["baoab + langevin"] == pytest.approx((slope, error))
    steepest = abs(slope) + (0.0 if seen else UNSEEN * error)
    step, was_seen = found.step_at_limit("baoab + langevin", quantity)
    assert was_seen is seen
    assert step == pytest.approx(
        np.sqrt(found.bias_limit(quantity) * quantity.bias_size / steepest)
    )


@pytest.mark.parametrize(
    ("steps", "runs", "more", "errors", "longest"),
    [
        ((2.0, 4.0), 1, 0.0, 1.0, 4.0),  # errors of single runs
        ((1.0, 2.0, 4.0), 2, 0.0, 1.0, 4.0),
        (
            (1.0, 2.0, 4.0),
            4,
            0.0,
            0.6,
            4.0,
        ),  # errors of single runs that are too small: the scatter counts
        ((1.0, 2.0, 4.0), 8, 0.0, 1.6, 4.0),
        ((2.0, 4.0), 8, 0.0, None, 4.0),  # runs that are too short for an error
        (
            (1.0, 2.0, 3.0, 4.0, 6.0),
            8,
            6.0,
            1.0,
            4.0,
        ),  # the longest step has more than dt², and is omitted
    ],
)
def test_pulls_of_limits_have_unit_width(steps, runs, more, errors, longest):
    """(limit - truth)/error of 1000 extrapolations, of which chi² leaves out a sound step of some
    by chance."""
    rng, pulls, longests = np.random.default_rng(3), [], []
    for _ in range(1000):
        sampled = {}
        for dt in steps:
            values = 5 + 0.1 * dt**2 + more * (dt == steps[-1]) + rng.standard_normal(runs)
            within = (
                [None] * runs
                if errors is None
                else errors * np.exp(0.2 * rng.standard_normal(runs))
            )
            sampled[dt] = list(zip(values, within, strict=True))
        fit = extrapolate(means_of_runs(sampled))
        pulls.append((fit.limit - 5) / fit.limit_error)
        longests.append(fit.longest)
    assert np.mean(np.array(longests) == longest) > 0.85
    assert max(longests) == longest
    assert abs(np.mean(pulls)) < 0.15
    assert 0.9 < np.std(pulls) < 1.2
    assert 0.9 < np.quantile(np.abs(pulls), 0.683) < 1.2


def test_means_of_few_runs_without_errors_are_left_out():
    values = [(1.0, None), (1.2, None)]
    assert means_of_runs({1.0: values, 2.0: values}) == []
    known = means_of_runs({1.0: [(1.0, 0.3), (1.2, 0.4)], 2.0: [(1.5, 0.3)]})
    assert known[0][1:] == pytest.approx((1.0, 1.1, np.sqrt((0.09 + 0.16) / 2 / 2)))
    assert known[1][1:] == (2.0, 1.5, 0.3)


def test_a_value_of_runs_together_takes_the_place_of_the_mean_of_their_values():
    """Squares of means, whose values in single runs are too high, or too short for a value."""
    rng, count = np.random.default_rng(5), 6
    for has_values in (True, False):
        pulls = []
        for _ in range(1000):
            runs, together = {}, {}
            for dt in (1.0, 2.0, 4.0):
                means = 3 + 0.1 * dt**2 + rng.standard_normal(count)
                runs[dt] = [(mean**2, 6.0) for mean in means] if has_values else []
                error = 2 * means.mean() * means.std(ddof=1) / np.sqrt(count)
                together[dt] = Together(means.mean() ** 2 - means.var(ddof=1) / count, error, count)
            points = means_of_runs(runs, together)
            assert [point.mean for point in points] == [value.value for value in together.values()]
            fit = extrapolate(
                [point._replace(mean=point.mean - 0.01 * point.timestep**4) for point in points]
            )
            pulls.append((fit.limit - 9) / fit.limit_error)
        assert abs(np.mean(pulls)) < 0.15
        assert 0.85 < np.std(pulls) < 1.2


def test_two_runs_together_have_a_limit_and_a_wide_error():
    together = {dt: Together(5.0 + dt**2, 0.1, 2) for dt in (1.0, 2.0)}
    points = means_of_runs({}, together)
    assert [point.error for point in points] == pytest.approx([0.1 * 1.32] * 2, rel=0.01)
    mixed = means_of_runs({4.0: [(21.0, 0.3)]}, together)
    assert mixed == []


@pytest.fixture(scope="module")
def oscillators():
    """Springs at w dt = 1 and less, by velocity Verlet and BAOAB."""
    unit = 1e3 * np.sqrt(39.948 / SPRING)  # fs of a radian
    fractions = []
    found = measure_averages(
        springs(),
        ["velocity_verlet", "baoab"],
        [0.4 * unit, 0.7 * unit, unit],
        sample=60.0,
        progress=fractions.append,
    )
    assert fractions == sorted(fractions)
    assert fractions[-1] == pytest.approx(1)
    return found


@pytest.mark.soak
def test_averages_of_oscillators_are_off_by_what_theory_says(oscillators):
    thermal, freedom = 0.0083144626 * 300, 3
    quantities = {quantity.name: quantity for quantity in oscillators.quantities}
    for run in oscillators.runs:
        x = (run.timestep / 1e3) ** 2 * SPRING / 39.948
        verlet = run.integrator == "velocity_verlet"
        swing = 1 / (1 - x / 4)  # of the conserved energy p²/2m + m w² (1 - x/4) q²/2
        exact = {
            "U": freedom * thermal / 2 * (swing if verlet else 1),
            "T_trans": 300,  # where the thermostat acts
        }
        for name, value in exact.items():
            mean, error = run.averages[name]
            assert error < 0.01 * value
            assert abs(mean - value) < 4 * error
            assert oscillators.point(run, quantities[name]).mean == mean


@pytest.mark.soak
def test_what_is_said_of_averages_follows_from_them(oscillators):
    quantities = {quantity.name: quantity for quantity in oscillators.quantities}
    assert {quantity.name for quantity in oscillators.main} == {"U", "T_trans", "pressure"}
    assert "Kinetic Energy (kJ/mole)" in quantities
    potential = quantities["U"]
    limit = oscillators.fit(potential)
    assert abs(limit.limit - 1.5 * 0.0083144626 * 300) < 4 * limit.limit_error
    coarse = oscillators.runs[2]
    bias, error = oscillators.bias(coarse, potential)
    assert coarse.method == "velocity_verlet + langevin"
    assert abs(bias - (1 / 0.75 - 1) / 2) < 4 * error < 0.1
    # 1 % of kT is x/8
    step, seen = oscillators.step_at_limit("velocity_verlet + langevin", potential)
    assert seen
    assert step == pytest.approx(1e3 * np.sqrt(0.08 * 39.948 / SPRING), rel=0.1)
    assert not oscillators.step_at_limit("velocity_verlet + langevin", quantities["T_trans"])[1]
    said = "\n".join(averages_report.bias_conclusions(oscillators))
    assert (
        f"U is off by 1% of kT per degree of freedom at: velocity_verlet + langevin {step:.2g} fs; baoab"
        in said
    )
    assert (
        "T_trans is off by 1% of its value at: velocity_verlet + langevin none seen, more than"
        in said
    )
    assert "temperatures are compared with 300 K" in said
    assert coarse.forces_per_ps == pytest.approx(1e3 / coarse.timestep)
    assert coarse.seconds_per_ns > 0


def test_averages_leave_out_what_comes_before_equilibrium():
    """A fifth of the time sampled comes before it: the means are the values of the same run without its
    first part."""
    (run,) = measure_averages(springs(), ["baoab"], [10.0], sample=2.0).runs
    again = springs(integrator="baoab", timestep_fs=10.0, duration_ps=2.4)
    looked = again.output.model_copy(update={"log_interval_ps": 0.02})
    results = Simulation(again.model_copy(update={"output": looked})).run()
    late = results["time"] > 0.4
    assert (late.sum(), len(late)) == (100, 121)
    for name, column, share in (("U", "potential", 64), ("T_trans", "temperature_translation", 1)):
        assert run.averages[name][0] == pytest.approx(
            results[column][late].mean() / share, rel=1e-9
        )


def test_averages_are_written_and_what_fails_is_said(tmp_path, capsys, monkeypatch):
    stage = {
        "ensemble": "npt",
        "temperature_K": 90.0,
        "pressure_bar": 1.0,
        "duration_ps": 1.0,
        "timestep_fs": 5.0,
    }
    scene = small_scene(
        {"argon": 40}, 18.5, start={"temperature_K": 90.0}, stages=[{"duration_ps": 0.1}, stage]
    )
    monkeypatch.setattr(Scene, "read", lambda path, overrides: scene)
    folder = tmp_path / "p"
    command = [
        "accuracy",
        "liquid.toml",
        "--averages",
        "--sample-ps",
        "20",
        "--timesteps",
        "5,10,400",
        "--integrators",
        "velocity_verlet",
        "-o",
        str(folder),
    ]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "bias of averages over 20 ps of npt" in said
    assert "velocity_verlet + velocity_rescaling at 400 fs: stopped at step" in said
    with (folder / "accuracy.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["step (fs)"] for row in rows] == ["5.0", "10.0", "400.0"]
    assert float(rows[0]["density (g/cm³)"]) > 0
    assert rows[2]["density (g/cm³)"] == ""
    told = json.loads((folder / "accuracy.json").read_text())
    assert told["runs"][0]["averages"]["density"]["mean"] == float(rows[0]["density (g/cm³)"])
    assert told["runs"][2]["failure"].startswith("stopped at step")
    assert "pressure" not in told["quantities"]
    assert told["quantities"]["density"]["degrees_of_freedom"] == 0  # one method at two steps
    assert told["runs"][0]["averages"]["Temperature (K)"]["mean"] > 0
    assert (folder / "averages.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "averages.html").read_text("utf-8")
    assert page.count("<tr>") == 2 + 1 + 3  # heads, a method, runs
    assert "density" in page
    assert "at 400 fs: stopped at step" in page
    assert "<svg" in page
    assert main(command) == 2  # nothing is overwritten


def test_averages_need_a_thermostat_at_one_temperature(capsys):
    water = str(ROOT / "systems" / "water.toml")
    assert main(["accuracy", water, "--averages"]) == 2
    said = capsys.readouterr().err
    assert "--averages samples the last stage, and nve has no thermostat" in said
    assert len([line for line in said.splitlines() if "averages" in line]) == 1
    assert main(["accuracy", water, "--sample-ps", "3"]) == 2
    assert "it needs --averages" in capsys.readouterr().err
    with pytest.raises(SceneError, match="A single body has no thermostat"):
        measure_averages(Scene.read(TOP))
    with pytest.raises(SceneError, match="one temperature and one pressure"):
        measure_averages(springs(temperature_K=[300.0, 200.0]))
    with pytest.raises(SceneError, match="unknown thermostat langevn; did you mean langevin"):
        measure_averages(springs(), ["baoab+langevn"])
    with pytest.raises(SceneError, match="unknown integrator verlet"):
        measure_averages(springs(), ["verlet"])
    with pytest.raises(SceneError, match="must be between"):
        measure_averages(springs(), sample=0.0)


def test_methods_and_steps_that_are_averaged_by_default(monkeypatch):
    monkeypatch.setattr(averages, "_sample", lambda *_: None)
    found = measure_averages(springs(thermostat="nose_hoover", friction_translation_per_ps=None))
    assert list(dict.fromkeys((run.integrator, run.thermostat) for run in found.runs)) == [
        ("baoab", "nose_hoover"),
        ("baoab", "velocity_rescaling"),
        ("baoab", "langevin"),
        ("velocity_verlet", "velocity_rescaling"),
    ]
    longest = 2e3 * np.sqrt(39.948 / SPRING)
    steps = [run.timestep for run in found.runs if run.thermostat == "langevin"]
    assert steps == pytest.approx([share * longest for share in averages.LADDER], rel=0.05)


@pytest.mark.soak
def test_orders_cost_and_temperatures_of_512_waters():
    """Slopes over a decade, the best scheme at 1e-5 kJ/mol, and both temperatures at 2 and 4 fs."""
    changes = {
        "molecules.0.count": 512,
        "forces.truncation": "smooth_switch",
        "forces.switch_start_A": 5.0,
        "stages.equilibration.duration_ps": 10.0,
    }
    scene = Scene.read(ROOT / "systems" / "water.toml", changes)
    found = measure_accuracy(
        scene, ["velocity_verlet", "two_stage", "chin_4a", "srkn_4", "srkn_6"], repeats=1
    )
    for name, order, margin, most in (
        ("velocity_verlet", 2, 0.1, 0.1),
        ("chin_4a", 4, 0.2, 1e-3),
        ("srkn_4", 4, 0.2, 1e-3),
    ):
        own = [trial for trial in trials(found, name) if trial.rotation_error < most]
        a, b = own[0], own[-1]
        slope = np.log(a.rotation_error / b.rotation_error) / np.log(a.timestep / b.timestep)
        assert a.rotation_error / b.rotation_error > 10
        assert slope == pytest.approx(order, abs=margin)
    unit = found.trial_system.energy_size / 100 / 512  # of the energy error, in kJ/mol per molecule
    for trial in found.trials:
        trial.seconds = [float(trial.forces)]  # in forces, which no noise can touch
    target = 1e-5 / unit
    verlet = found.time_for("velocity_verlet", "energy_rms", target).seconds
    best = min(
        at.seconds
        for name in ("two_stage", "chin_4a", "srkn_4", "srkn_6")
        if (at := found.time_for(name, "energy_rms", target))
    )
    assert verlet / best > 2
    for step in (4.0, 2.0):
        gap, error = mean_and_error(at_constant_energy(scene, "velocity_verlet", step, 40.0)[0])
        assert abs(gap) < 2.5 * error


def test_the_output_of_accuracy_begins_with_the_answer_and_marks_floors():
    steps = [8e-3, 4e-3, 2e-3, 1e-3]
    second = [("velocity_verlet", h, (1.0, 1.0, 1.0), 1e3 * h**2) for h in steps]
    fourth = [("srkn_4", h, (2.0, 2.0, 2.0), max(1e6 * h**4, 1.1e-5)) for h in steps]
    found = made(*second, *fourth)
    lines = accuracy.describe_accuracy(found)
    assert lines[2].startswith("target error")
    orders = {row[0]: row[1:4] for row in order_table(found).shown()[1]}
    measured = {
        "velocity_verlet": ["2", *["2.00 ± 0.00"] * 2],
        "srkn_4": ["4", *["4.00 ± 0.00"] * 2],
    }
    assert orders == measured
    floor = convergence(found, "srkn_4", "energy_rms").floor
    assert [trial.timestep for trial in floor] == [1e-3]
    assert convergence(found, "velocity_verlet", "energy_rms").floor == []
    (marked,) = (line for line in "\n".join(lines).splitlines() if line.count("1.1e-05*") == 2)
    assert marked.startswith("srkn_4") and "0.001" in marked


#: Errors of a scheme of order 4 at steps that halve: 0.3 h^4 with h = 1, 1/2, ...
FOURTH = [0.3 * 16.0**-k for k in range(9)]


@pytest.mark.parametrize(
    ("errors", "order", "at_floor"),
    [
        (FOURTH, 4.0, 0),
        ([*FOURTH[:1], 1e-3 * FOURTH[1], *FOURTH[2:]], 4.0, 0),  # small by accident, once
        ([*FOURTH[:2], 1e-6 * FOURTH[2], *FOURTH[3:]], 4.0, 0),
        ([*FOURTH[:7], 1e-3 * FOURTH[7], *FOURTH[8:]], 4.0, 0),
        ([*FOURTH[:4], 30 * FOURTH[4], *FOURTH[5:]], 4.0, 0),  # large
        ([*FOURTH[:6], 2e-8, 3e-8, 1.5e-8], 4.0, 2),  # rounding
        ([*FOURTH[:5], 5e-6, 3e-6, 6e-6, 2e-6], 4.0, 4),
        ([*FOURTH[:2], *[FOURTH[1]] * 5], None, 5),  # two steps above the floor
        (FOURTH[:2], None, 0),
        (FOURTH[:1], None, 0),
        ([], None, 0),
        ([0.3, 0.2, 0.35, 0.25, 0.3], None, 4),  # nothing falls
        ([0.3, 3e-2, 2e-2, 2e-5, 9e-6], None, 0),  # falls without an order
    ],
)
def test_orders_are_measured_where_errors_fall_and_have_an_error(errors, order, at_floor):
    steps = [2e-3 * 0.5**k for k in range(len(errors))]
    rows = [("srkn_4", *row) for row in zip(steps, [(1.0,)] * len(steps), errors, strict=True)]
    found = convergence(made(*rows, span=2e-2), "srkn_4", "energy_rms")
    assert [trial.timestep for trial in found.floor] == steps[len(steps) - at_floor :]
    if order is None:
        assert found.order is None
    else:
        assert abs(found.order.value - order) < 0.1
        assert found.order.error < 0.5


def test_noise_of_errors_is_the_error_of_an_order():
    rng = np.random.default_rng(3)
    pulls = []
    for _ in range(300):
        points = [(-k * np.log(2), -4 * k * np.log(2) + 0.1 * rng.normal()) for k in range(5)]
        order = fitted_order(points)
        pulls.append((order.value - 4) / order.error)
    assert 0.2 < np.median(np.abs(pulls)) < 1.5


def test_an_error_of_a_trajectory_below_that_of_the_reference_is_no_order():
    found = made(
        *[("srkn_4", 2e-3 * 0.5**k, (1.0,), error) for k, error in enumerate(FOURTH)], span=2e-2
    )
    found.reference_error = 9e-8
    assert len(convergence(found, "srkn_4", "rotation_error").floor) == 3
    assert convergence(found, "srkn_4", "energy_rms").floor == []
