"""`rigidmd accuracy`: trials, recommendations, formulations, files."""

import csv
import dataclasses
import itertools
import re
import tomllib

import numpy as np
import pytest
from support.accuracy import TOP, changed, made, trials
from support.common import ROOT, small_scene

from rigidmd.commands.cli import main
from rigidmd.core.integrators import FORMULATIONS
from rigidmd.errors import SceneError
from rigidmd.features.bodies.trials import body_trial_system
from rigidmd.features.studies.accuracy import accuracy
from rigidmd.features.studies.accuracy.accuracy import (
    measure_accuracy,
    recommendations,
    trial_table,
    write_accuracy,
)
from rigidmd.features.studies.accuracy.measurement import IntegratorAccuracy
from rigidmd.features.studies.accuracy.orders import convergence, order_table
from rigidmd.run.trials import Trial
from rigidmd.scene import Scene


@pytest.fixture(scope="module")
def top(short_timings):
    return measure_accuracy(
        Scene.read(TOP), ["velocity_verlet", "srkn_4", "srkn_6"], span=0.4, repeats=3
    )


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


def test_every_trial_is_timed_as_often_as_requested(top):
    for trial in top.trials:
        assert len(trial.seconds) == 3
        assert trial.time == sorted(trial.seconds)[1]
        assert trial.timestep * trial.steps == pytest.approx(0.4)


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
    assert "±" not in trial_table(found).text().splitlines()[0].replace("drift        ±", "drift")
    write_accuracy(tmp_path, found, "a command")
    with (tmp_path / "accuracy.csv").open() as file:
        assert [line["spread (%)"] for line in csv.DictReader(file)] == ["", ""]


def test_the_front_and_the_advice_follow_from_the_numbers(top):
    front = top.front("energy_rms")
    for trial in top.trials:
        assert any(
            top.cost(better) <= top.cost(trial) and better.energy_rms <= trial.energy_rms
            for better in front
        )
    own = trials(top, "velocity_verlet")
    target = np.sqrt(own[0].energy_rms * own[1].energy_rms)
    at = top.time_for("velocity_verlet", "energy_rms", target)
    assert own[1].timestep < at.step < own[0].timestep
    assert min(own[0].time, own[1].time) <= at.time <= max(own[0].time, own[1].time)
    assert top.time_for("velocity_verlet", "energy_rms", 1e-30) is None
    timed = [dataclasses.replace(trial, seconds=[float(trial.forces)] * 3) for trial in top.trials]
    said = "\n".join(recommendations(dataclasses.replace(top, trials=timed)))
    assert re.search(
        "for an error of Q of (1e-0[024] to )?1e-0[46] over 0.4 s the fastest is srkn_", said
    )
    assert "times faster than velocity_verlet" in said
    assert "timing noise" not in said
    assert trial_table(top).text().count("srkn_4") == len(trials(top, "srkn_4")) > 6


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


def test_energy_without_a_rotation_is_not_an_accuracy():
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
    assert at.time == pytest.approx(5e-3 / step, rel=1e-6)
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


@pytest.mark.parametrize("quiet", [True, False])
def test_force_evaluations_rank_where_timings_scatter(quiet):
    """The slower integrator has fewer force evaluations, and an empty column is not printed."""
    spread = 0.01 if quiet else 0.5
    found = made(
        ("velocity_verlet", 1e-3, (1.0 - spread, 1.0, 1.0 + spread), 1e-5),
        ("srkn_4", 5e-3, (2.0 - spread, 2.0, 2.0 + spread), 1e-5),
        ("pefrl", 2e-3, (3.0, 3.0, 3.0), 1e-1),
    )
    assert found.is_timed == quiet
    lines = accuracy.describe_accuracy(found)
    if quiet:
        assert lines[2].splitlines()[0].split("  ")[-1].strip() == "fastest integrator"
        assert "velocity_verlet at 0.001 s" in lines[2] and "srkn_4" not in lines[2]
    else:
        assert "fewest force evaluations" in lines[2]
        assert "srkn_4 at 0.005 s" in lines[2] and "5.0 times fewer" in lines[2]
        assert "Force evaluations rank the integrators" in lines[-1]
    at = [accuracy.cheapest(found)[0][1].split()[0], found.front("energy_rms")[0].integrator]
    assert at == ["velocity_verlet" if quiet else "srkn_4"] * 2


def test_mixed_precision_states_what_its_forces_lose():
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


def test_comparators_stand_next_to_the_schemes_and_fail_with_a_message():
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


def test_what_cannot_be_measured_is_left_out_with_a_message(planned):
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
    assert "L_z" in trial_table(top).text().splitlines()[0]
    dimer = measure_accuracy(
        Scene.read(ROOT / "systems" / "water_dimer.toml", {"precision": "double"}),
        ["velocity_verlet"],
        [1.0],
        repeats=1,
    )
    assert set(dimer.trials[0].conserved_errors) == {"momentum", "L"}
    assert max(dimer.trials[0].conserved_errors.values()) < 1e-11


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
