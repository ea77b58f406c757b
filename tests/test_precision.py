"""`rigidmd precision`: what it measures, what it says, what it writes."""

import csv
import itertools
import tomllib

import numpy as np
import pytest
from conftest import ROOT, small_scene

from rigidmd.cli import main
from rigidmd.errors import SceneError
from rigidmd.output.precision_report import advice, table_text, write_precision
from rigidmd.scene import Scene
from rigidmd.study.precision import precision

TOP = ROOT / "systems" / "heavy_top_3.toml"


@pytest.fixture(scope="module")
def top():
    return precision(Scene.read(TOP), ["velocity_verlet", "srkn_4", "srkn_6"], span=0.4, repeats=3)


def trials(found, name):
    return [trial for trial in found.trials if trial.integrator == name]


def test_errors_fall_with_the_order_at_equal_cost(top):
    costs = [[trial.forces for trial in trials(top, name)] for name in ("velocity_verlet", "srkn_4", "srkn_6")]
    assert np.allclose(costs[0], costs[1], rtol=0.15)
    assert np.allclose(costs[0], costs[2], rtol=0.15)
    for name, order in (("velocity_verlet", 2), ("srkn_4", 4)):
        own = trials(top, name)[-2:]
        for error in ("rotation_error", "energy_rms"):
            a, b = (getattr(trial, error) for trial in own)
            assert np.log(a / b) / np.log(own[1].steps / own[0].steps) == pytest.approx(order, abs=0.25)
    assert top.reference_error < 1e-11
    assert min(trial.rotation_error for trial in trials(top, "srkn_6")) < 100 * top.reference_error


def test_every_trial_is_timed_as_often_as_asked(top):
    for trial in top.trials:
        assert len(trial.seconds) == 3
        assert trial.time == sorted(trial.seconds)[1]
        assert trial.timestep * trial.steps == pytest.approx(0.4)


def test_the_front_and_the_advice_follow_from_the_numbers(top):
    front = top.front("energy_rms")
    for trial in top.trials:
        assert any(better.time <= trial.time and better.energy_rms <= trial.energy_rms for better in front)
    own = trials(top, "velocity_verlet")
    target = np.sqrt(own[0].energy_rms * own[1].energy_rms)
    seconds, step = top.time_for("velocity_verlet", "energy_rms", target)
    assert own[1].timestep < step < own[0].timestep
    assert min(own[0].time, own[1].time) <= seconds <= max(own[0].time, own[1].time)
    assert top.time_for("velocity_verlet", "energy_rms", 1e-30) is None
    said = "\n".join(advice(top))
    assert "for an error of Q of 1e-06 the cheapest is srkn_" in said
    assert "times faster than velocity_verlet" in said
    assert table_text(top).count("srkn_4") == 6


def test_a_step_that_is_too_long_diverges_and_is_stopped():
    scene = Scene.read(ROOT / "systems" / "water_dimer.toml")
    found = precision(scene, ["velocity_verlet"], [1.0, 80.0], span=2.4, repeats=1)
    good, bad = found.trials
    assert not good.diverged
    assert bad.diverged
    assert bad.seconds == []
    assert found.stable_step("velocity_verlet") == pytest.approx(1.0)
    assert "velocity_verlet diverges beyond 1 fs" in "\n".join(advice(found))
    assert "fails" in table_text(found)


def test_molecules_start_where_the_last_stage_does():
    stages = [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 0.2}, {"duration_ps": 1.0}]
    scene = small_scene({"nitrogen": 8}, 18.5, stages=stages)
    found = precision(scene, ["velocity_verlet", "srkn_6"], [8.0, 4.0], repeats=1)
    assert "kT per degree of freedom, at the" in advice(found)[0]
    verlet = trials(found, "velocity_verlet")
    assert verlet[0].energy_rms / verlet[1].energy_rms == pytest.approx(4, rel=0.5)
    assert all(trial.position_error < 1 for trial in found.trials)


def test_mixed_precision_says_what_its_forces_lose():
    scene = small_scene({"spce": 60}, 18.5, precision="mixed")
    found = precision(scene, ["velocity_verlet"], [2.0], span=0.01, repeats=1)
    force, torque = found.subject.rounding
    assert 1e-8 < force < 1e-5 and 1e-8 < torque < 1e-5
    assert f"forces differ from double ones by {force:.1e} of their rms" in "\n".join(advice(found))
    assert precision(small_scene({"argon": 8}, 18.5), ["velocity_verlet"], [2.0], repeats=1).subject.rounding is None


def test_only_what_keeps_its_order_is_tried():
    wheel = Scene.read(ROOT / "systems" / "satellite_wheel.toml")
    found = precision(wheel, span=5.0, repeats=1)
    names = {trial.integrator for trial in found.trials}
    assert "suzuki_4" in names
    assert "srkn_6" not in names
    with pytest.raises(SceneError, match="srkn_6 would not have its order on this scene"):
        precision(wheel, ["srkn_6"])
    with pytest.raises(SceneError, match="there is no rk5"):
        precision(wheel, ["rk5"])


def test_steps_suit_what_is_fast_in_a_body():
    compass = precision(Scene.read(ROOT / "systems" / "gyrocompass.toml"), ["kahan_li_6"], span=60.0, repeats=1)
    # the wheel's nutation, 20 rad/s, sets the steps, not the Earth's turning
    assert not any(trial.diverged for trial in compass.trials[-3:])
    assert compass.trials[-1].rotation_error < 1e-6


def test_the_command_writes_a_table_a_figure_and_a_page(tmp_path, capsys):
    folder = tmp_path / "p"
    command = ["precision", str(TOP), "--integrators", "velocity_verlet,srkn_6", "--timesteps", "0.002,0.001",
               "--span", "0.1", "--repeats", "1", "-o", str(folder)]  # fmt: skip
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "velocity_verlet" in said
    assert "precision.html" in said
    with (folder / "precision.csv").open() as file:
        rows = list(csv.reader(file))
    assert len(rows) == 5
    assert float(rows[1][1]) == pytest.approx(0.002)
    assert (folder / "precision.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "precision.html").read_text()
    assert "data:image/png;base64," in page
    assert "<script" not in page
    assert page.count("<tr>") == 5
    assert main(command) == 2  # nothing is overwritten
    assert main([*command, "--force"]) == 0
    assert main(["precision", str(TOP), "--timesteps", "a"]) == 2


@pytest.fixture(scope="module")
def water():
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.5},
        {"duration_ps": 1.0, "timestep_fs": 1.0},
    ]
    forces = {"cutoff_A": 6.0, "truncation": "smooth_switch"}
    return small_scene({"spce": 64}, 12.42, forces=forces, stages=stages)


def test_averages_show_what_a_step_takes_from_temperatures(water, tmp_path):
    found = precision(water, ["velocity_verlet", "srkn_4"], [4.0, 1.0], span=0.02, repeats=1, averages=3.0)
    coarse, fine = trials(found, "velocity_verlet")
    loss = {}
    for trial in (coarse, fine):
        on, half, unbiased = (trial.averages[f"T_rot{kind}"][0] for kind in ("", " half-step", " unbiased"))
        loss[trial.timestep] = unbiased - on
        assert half - on == pytest.approx(1.5 * (unbiased - on))
    # of the order of (omega dt)²/6 with the 100 rad/ps of librations, and quadratic in the step
    assert 3 < loss[4.0] < 20
    assert loss[4.0] / loss[1.0] == pytest.approx(16, rel=0.2)
    gap, error = coarse.averages["T_rot - T_trans unbiased"]
    assert abs(gap) < 4 * error
    assert "T_rot unbiased" not in trials(found, "srkn_4")[0].averages
    assert found.most_exact.integrator == "srkn_4"
    assert found.most_exact.timestep == pytest.approx(1.0)
    said = table_text(found)
    assert "T_rot - T_trans (K): on the steps" in said
    assert "(held against)" in said
    assert "velocity_verlet at 4 fs: T_rot - T_trans is" in "\n".join(advice(found))
    written = write_precision(tmp_path, found, "a command")
    rows = list(csv.DictReader((tmp_path / "precision_averages.csv").open()))
    assert [path.name for path in written][-1] == "precision_averages.csv"
    assert float(rows[0]["T_rot unbiased (K)"]) == pytest.approx(coarse.averages["T_rot unbiased"][0])
    assert "Averages over 3 ps" in (tmp_path / "precision.html").read_text()


def test_comparators_stand_beside_the_schemes_and_fail_in_words():
    upright = tomllib.loads(TOP.read_text()) | {"start": {"angular_velocity_body_rad_s": [3.0, 0.0, 60.0]}}
    names = ["velocity_verlet", "rk4", "rk4_quaternion", "rk4_euler_angles", "dop853"]
    found = precision(Scene.from_dict(upright), names, [1e-3, 5e-4], span=0.2, repeats=1)
    assert {trial.integrator for trial in found.trials if trial.diverged} == {"rk4_euler_angles"}
    assert "rk4_euler_angles: the Euler angles became singular" in "\n".join(advice(found))
    drift = {trial.integrator: trial.orthogonality for trial in found.trials if not trial.diverged}
    assert drift["velocity_verlet"] < 1e-13
    assert drift["rk4"] > 1e-11  # nothing keeps Q a rotation there
    adaptive = trials(found, "dop853")
    assert [trial.tolerance for trial in adaptive] == sorted((t.tolerance for t in adaptive), reverse=True)
    assert all(b.forces > a.forces and b.timestep < a.timestep for a, b in itertools.pairwise(adaptive))
    assert adaptive[-1].rotation_error < 1e-8


def test_what_else_is_kept_is_shown(top):
    verlet = trials(top, "velocity_verlet")[0]
    assert set(verlet.kept) == {"L_z", "L_3"}
    assert max(verlet.kept.values()) < 1e-12
    assert "L_z" in table_text(top).splitlines()[1]
    dimer = precision(Scene.read(ROOT / "systems" / "water_dimer.toml"), ["velocity_verlet"], [1.0], repeats=1)
    assert set(dimer.trials[0].kept) == {"momentum", "L"}
    assert max(dimer.trials[0].kept.values()) < 1e-11


@pytest.mark.slow
def test_orders_cost_and_temperatures_of_512_waters():
    """Slopes over a decade, the best scheme at 1e-5 kJ/mol, and both temperatures at 2 and 4 fs."""
    changes = {
        "molecules.0.count": 512, "forces.truncation": "smooth_switch", "forces.switch_start_A": 5.0,
        "stages.0.duration_ps": 10.0,
    }  # fmt: skip
    scene = Scene.read(ROOT / "systems" / "water.toml", changes)
    found = precision(scene, ["velocity_verlet", "two_stage", "chin_4a", "srkn_4", "srkn_6"], repeats=1)
    for name, order, margin, most in (
        ("velocity_verlet", 2, 0.1, 0.1), ("chin_4a", 4, 0.2, 1e-3), ("srkn_4", 4, 0.2, 1e-3)
    ):  # fmt: skip
        own = [trial for trial in trials(found, name) if trial.rotation_error < most]
        a, b = own[0], own[-1]
        slope = np.log(a.rotation_error / b.rotation_error) / np.log(a.timestep / b.timestep)
        assert a.rotation_error / b.rotation_error > 10
        assert slope == pytest.approx(order, abs=margin)
    unit = found.subject.energy_size / 100 / 512  # of the energy error, in kJ/mol per molecule
    for trial in found.trials:
        trial.seconds = [float(trial.forces)]  # in forces, which no noise can touch
    target = 1e-5 / unit
    verlet, _ = found.time_for("velocity_verlet", "energy_rms", target)
    best = min(at[0] for name in ("two_stage", "chin_4a", "srkn_4", "srkn_6")
               if (at := found.time_for(name, "energy_rms", target)))  # fmt: skip
    assert verlet / best > 2
    found = precision(scene, ["velocity_verlet"], [4.0, 2.0], span=0.02, repeats=1, averages=40.0)
    for trial in found.trials:
        on, on_error = trial.averages["T_rot - T_trans"]
        unbiased, error = trial.averages["T_rot - T_trans unbiased"]
        assert abs(unbiased) < 2.5 * error
        if trial.timestep == pytest.approx(4.0):
            assert on < -3 * on_error
