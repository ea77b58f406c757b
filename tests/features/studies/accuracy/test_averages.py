"""Averages at finite steps: biases of oscillators and of water, errors, what needs a thermostat."""

import csv
import json

import numpy as np
import pytest
from support.accuracy import TOP, trials
from support.common import ROOT, SPRING, small_scene, springs

from rigidmd.commands.cli import main
from rigidmd.core.statistics import mean_and_error
from rigidmd.errors import SceneError
from rigidmd.features.studies.accuracy import averages, averages_report
from rigidmd.features.studies.accuracy.accuracy import measure_accuracy
from rigidmd.features.studies.accuracy.averages import measure_averages
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.units import BOLTZMANN, KJ_PER_MOL


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
def test_averages_of_oscillators_are_off_by_what_theory_states(oscillators):
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
def test_what_is_reported_of_averages_follows_from_them(oscillators):
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


def test_averages_are_written_and_what_fails_is_reported(tmp_path, capsys, monkeypatch):
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
