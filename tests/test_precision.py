"""`rigidmd precision`: what it measures, what it says, what it writes."""

import csv

import numpy as np
import pytest
from conftest import ROOT, small_scene

from rigidmd.cli import main
from rigidmd.errors import SceneError
from rigidmd.output.precision_report import advice, table_text
from rigidmd.scene import Scene
from rigidmd.simulation.precision import precision

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
