"""Averages at finite steps: the sweep that measures their biases, what needs a thermostat."""

import csv
import json
import shlex

import numpy as np
import pytest
from support.accuracy import TOP, trials
from support.common import ROOT, SPRING, springs

from rigidmd.commands.cli import main
from rigidmd.core.statistics import mean_and_error
from rigidmd.errors import SceneError
from rigidmd.features.studies.accuracy import averages
from rigidmd.features.studies.accuracy.accuracy import measure_accuracy
from rigidmd.features.studies.accuracy.averages import plan_averages
from rigidmd.features.studies.extrapolation import MeanAtStep, extrapolate
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


@pytest.mark.soak
def test_averages_of_oscillators_are_off_by_what_theory_states():
    """Springs at w dt = 1 and less. Velocity Verlet conserves p²/2m + m w² (1 - x/4) q²/2 with x =
    (w dt)², which gives its U."""
    unit = 1e3 * np.sqrt(39.948 / SPRING)  # fs of a radian
    thermal = 1.5 * 0.0083144626 * 300
    means = []
    for integrator in ("velocity_verlet", "baoab"):
        for x in (0.16, 0.49, 1.0):
            step = unit * np.sqrt(x)
            scene = springs(integrator=integrator, timestep_fs=step, duration_ps=72.0)
            output = scene.output.model_copy(update={"log_interval_ps": 0.02})
            results = Simulation(scene.model_copy(update={"output": output})).run()
            late = results["time"] > 12
            swing = 1 / (1 - x / 4) if integrator == "velocity_verlet" else 1
            for series, exact in (
                (results["potential"] / 64, thermal * swing),
                (results["temperature_translation"], 300),  # where the thermostat acts
            ):
                mean, error = mean_and_error(series[late])
                assert error < 0.01 * exact
                assert abs(mean - exact) < 4 * error
                if exact != 300:
                    means.append(MeanAtStep(integrator, step, mean, error))
    fit = extrapolate([point for point in means if point.timestep < 0.9 * unit])
    assert abs(fit.limit - thermal) < 4 * fit.limit_error
    # 1 % of kT per degree of freedom is x/8
    step = np.sqrt(0.02 * thermal / fit.slopes["velocity_verlet"][0])
    assert step == pytest.approx(unit * np.sqrt(0.08), rel=0.15)
    assert abs(fit.slopes["baoab"][0]) < 4 * fit.slopes["baoab"][1]


GAS = """
seed = 7

[box]
lengths_A = 20.0

[[molecules]]
model = "argon"
count = 20

[forces]
cutoff_A = 8.0

[start]
temperature_K = 90.0

[[stages]]
name = "sampling"
ensemble = "nvt"
temperature_K = 90.0
duration_ps = 1
timestep_fs = 5
thermostat = "langevin"
friction_translation_per_ps = 5.0
"""


@pytest.fixture(scope="module")
def gas(tmp_path_factory):
    path = tmp_path_factory.mktemp("gas") / "gas.toml"
    path.write_text(GAS)
    return path


METHODS = "velocity_verlet,baoab+velocity_rescaling"
SWEPT = ("stages.0.integrator", "stages.0.thermostat", "stages.0.timestep_fs")


def test_averages_are_a_sweep_over_methods_and_steps(gas, tmp_path, printed):
    """Its points are two of the four pairs of integrator and thermostat, at each step. The command
    that it prints reads it again, with the same table."""
    folder = tmp_path / "averages"
    command = ["accuracy", gas, "--averages", "--sample-ps", "10", "--integrators", METHODS]
    said = printed(*command, "--timesteps", "5,10,20", "-o", folder).out
    assert f"--averages is a sweep over {', '.join(SWEPT)}" in said
    manifest = json.loads((folder / "sweep.json").read_text())
    points = [tuple(point["values"].values()) for point in manifest["points"]]
    assert points == [
        (*method, step)
        for method in (("velocity_verlet", "langevin"), ("baoab", "velocity_rescaling"))
        for step in (5.0, 10.0, 20.0)
    ]
    assert manifest["fixed"]["stages.0.duration_ps"] == pytest.approx(12.0)
    assert manifest["fixed"]["stages.0.friction_translation_per_ps"] is None  # not of rescaling
    table = said[said.index("averages at a step of 0") : said.index("  files in")]
    (again,) = (line for line in said.splitlines() if line.startswith("  rigidmd sweep "))
    assert table in printed(*shlex.split(again)[1:]).out
    rows = [line.split() for line in table.splitlines()]
    (head,) = (row for row in rows if row[:2] == ["integrator", "thermostat"])
    assert "off by 1% at (fs)" in " ".join(head)
    with (folder / "extrapolation.csv").open(encoding="utf-8") as file:
        limits = [row for row in csv.DictReader(file) if row["average"] == "Temperature (K)"]
    assert [row["stages.0.integrator"] for row in limits] == ["velocity_verlet", "baoab"]
    assert len({row["limit"] for row in limits}) == 1  # of the ensemble, by both methods
    assert {row["degrees of freedom"] for row in limits} == {"3"}  # six means, limit, two slopes
    page = (folder / "extrapolation.html").read_text("utf-8")
    assert "off by 1% at (fs)" in page


def test_averages_need_a_thermostat_at_one_temperature(capsys):
    water = str(ROOT / "systems" / "water.toml")
    assert main(["accuracy", water, "--averages"]) == 2
    said = capsys.readouterr().err
    assert "--averages samples the last stage, and nve has no thermostat" in said
    assert len([line for line in said.splitlines() if "averages" in line]) == 1
    assert main(["accuracy", water, "--sample-ps", "3"]) == 2
    assert "it needs --averages" in capsys.readouterr().err
    with pytest.raises(SceneError, match="A single body has no thermostat"):
        plan_averages(Scene.read(TOP), {})
    with pytest.raises(SceneError, match="one temperature and one pressure"):
        plan_averages(springs(temperature_K=[300.0, 200.0]), {})
    with pytest.raises(SceneError, match="unknown thermostat langevn; did you mean langevin"):
        plan_averages(springs(), {}, ["baoab+langevn"])
    with pytest.raises(SceneError, match="unknown integrator verlet"):
        plan_averages(springs(), {}, ["verlet"])
    nvt = ["--set", "stages.2.ensemble=nvt", "--set", "stages.2.temperature_K=300"]
    options = ["--sample-ps", "0.1", "--timesteps", "200,400"]
    assert main(["accuracy", water, "--averages", *nvt, *options]) == 2
    assert "less than one step of 400 fs" in capsys.readouterr().err
    with pytest.raises(SceneError, match="must be between"):
        plan_averages(springs(), {}, sample=0.0)


def test_methods_and_steps_that_are_averaged_by_default():
    scene = springs(thermostat="nose_hoover", friction_translation_per_ps=None)
    plan = plan_averages(scene, {"seed": 5})
    assert plan.methods == [
        ("baoab", "nose_hoover"),
        ("baoab", "velocity_rescaling"),
        ("baoab", "langevin"),
        ("velocity_verlet", "velocity_rescaling"),
    ]
    axes = {axis.keys[0]: axis for axis in plan.axes}
    assert axes["seed"] == (("seed",), (5,), False)
    longest = 2e3 * np.sqrt(39.948 / SPRING)
    steps = axes[plan.step_key].values
    assert steps == pytest.approx([share * longest for share in averages.LADDER], rel=0.05)
    settings = dict(zip(SWEPT, ("velocity_verlet", "langevin", steps[0]), strict=True))
    assert not plan.includes(settings)
    assert plan.includes(settings | {SWEPT[1]: "velocity_rescaling"})


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
    verlet = found.time_for("velocity_verlet", "energy_rms", target).time
    best = min(
        at.time
        for name in ("two_stage", "chin_4a", "srkn_4", "srkn_6")
        if (at := found.time_for(name, "energy_rms", target))
    )
    assert verlet / best > 2
    for step in (4.0, 2.0):
        gap, error = mean_and_error(at_constant_energy(scene, "velocity_verlet", step, 40.0)[0])
        assert abs(gap) < 2.5 * error
