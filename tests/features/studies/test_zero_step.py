"""The analysis `zero_step`: means and g(r) at a step of zero from one run."""

import numpy as np
import pytest
from support.common import small_scene

import rigidmd
from rigidmd import Simulation
from rigidmd.commands.cli import main
from rigidmd.errors import OutputError
from rigidmd.features.studies import step_bias
from rigidmd.run.report import short_summary

STEP = 25.0  # fs


@pytest.fixture(scope="module")
def nitrogen(tmp_path_factory):
    """Liquid nitrogen with a thermostat at the ends of long steps."""
    stage = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 60.0, "timestep_fs": STEP}
    scene = small_scene(
        {"nitrogen": 32},
        None,
        box={"density_g_cm3": 0.75},
        forces={"cutoff_A": 6.0, "truncation": "smooth_switch"},
        start={"temperature_K": 90.0},
        stages=[{"ensemble": "minimise"}, stage | {"integrator": "velocity_verlet"}],
        output={"log_interval_ps": 0.1, "trajectory_interval_ps": 0.2, "figures": False},
    )
    folder = tmp_path_factory.mktemp("nitrogen") / "run"
    Simulation(scene, folder).run(progress=False)
    return folder


def test_all_means_and_g_of_a_run(nitrogen, capsys):
    results = rigidmd.read_run(nitrogen)
    found = rigidmd.analysis.zero_step(results)
    names = [value.name for value in found.values]
    assert names == ["Potential Energy per molecule", "Total Energy", "Pressure"]
    stage = results.summary["stages"][-1]
    energy = found.values[0]
    assert energy.note.startswith("the step added +")
    bias = stage["potential_step_kJ_mol_per_molecule"]
    assert energy.value == pytest.approx(stage["potential_kJ_mol_per_molecule"] - bias)
    # (ω dt)²/8 kT per degree of freedom, if motions were harmonic
    freedom = 3 * 32 - 3 + 2 * 32
    squares = (results["force_squares"] + results["torque_squares"])[-300:].mean()
    harmonic = (1e-3 * STEP) ** 2 * squares / 8 / 32
    assert 0.3 * harmonic < bias < 2.5 * harmonic
    assert stage["potential_step_error_kJ_mol_per_molecule"] < harmonic
    assert squares * (1e-3 * STEP) ** 2 / (freedom * 8.314e-3 * 90) < 0.3
    g, of_step = found["g N-N"], found["g N-N, of the step"]
    assert np.all(np.abs(g[:20]) < 1e-9)
    assert g.max() > 1.5
    raw = rigidmd.analysis.rdf(results)["g N-N"]
    assert g + of_step == pytest.approx(raw, abs=1e-9)  # of the same frames
    uncertain = found.curves[0].errors["g N-N"]
    assert 0 < np.abs(of_step).max() < 0.1
    assert (uncertain[raw > 0] > 0).all()
    assert main(["analyse", str(nitrogen), "zero_step", "curves=false"]) == 0
    text = capsys.readouterr().out
    assert "Potential Energy per molecule" in text
    assert "the step added" in text


def test_the_summary_prints_the_step_where_it_matters(nitrogen):
    """From a third of the statistical error on, if it is twice its own error."""
    summary = rigidmd.read_run(nitrogen).summary
    keys = [f"potential_{key}_kJ_mol_per_molecule" for key in ("error", "step", "step_error")]
    stage = summary["stages"][-1]
    for error, bias, uncertain, shown in [
        (0.01, 0.004, 0.001, True),
        (0.01, -0.004, 0.001, True),
        (0.01, 0.003, 0.001, False),
        (0.01, 0.004, 0.003, False),
    ]:
        stage |= dict(zip(keys, (error, bias, uncertain), strict=True))
        line = next(x for x in short_summary(summary).splitlines() if "potential energy" in x)
        assert (f"± 0.010, step {bias:+g}" in line) is shown, (bias, uncertain)
        assert ("step" in line) is shown


def test_a_density_profile_is_corrected_too(nitrogen):
    found = rigidmd.analysis.zero_step(rigidmd.read_run(nitrogen), axis="z")
    assert [curve.file for curve in found.curves] == ["zero_step_rdf", "zero_step_density_profile"]
    density, of_step = (
        found.curves[1].columns[f"density nitrogen (g/cm3){end}"] for end in ("", ", of the step")
    )
    # the mass is the same at any step
    assert density.mean() == pytest.approx(0.75, rel=1e-4)
    assert of_step.mean() == pytest.approx(0.0, abs=1e-9)


def test_several_runs_have_smaller_errors(nitrogen):
    results = rigidmd.read_run(nitrogen)
    one, both = (rigidmd.analysis.zero_step(of) for of in (results, [results, results]))
    for alone, together in zip(one.values, both.values, strict=True):
        assert together.value == pytest.approx(alone.value)
        assert together.error == pytest.approx(alone.error / np.sqrt(2))


def test_a_run_without_an_estimate_has_a_reason(nitrogen, monkeypatch):
    results = rigidmd.read_run(nitrogen)
    with pytest.raises(OutputError, match="zero_step: the run has fewer than 20 independent"):
        rigidmd.analysis.zero_step(results, start=58.0)
    with monkeypatch.context() as patched:
        patched.setattr(step_bias, "LARGEST_SQUARE", 0.01)
        with pytest.raises(OutputError, match=r"the step is too long: the mean of \(ω dt\)² is"):
            rigidmd.analysis.zero_step(results)
    bath = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 20.0, "thermostat": "langevin"}
    for stage, reason in [
        ({"duration_ps": 1.0}, "it is for nvt and npt, and the stage is nve"),
        (
            bath | {"friction_rotation_per_ps": 100.0},
            "relaxes kinetic energy at 200/ps, too strong",
        ),
    ]:
        scene = small_scene(
            {"nitrogen": 32},
            None,
            box={"density_g_cm3": 0.75},
            forces={"cutoff_A": 6.0},
            start={"temperature_K": 90.0},
            stages=[{"timestep_fs": 10.0} | stage],
            output={"trajectory": False, "log_interval_ps": 0.2},
        )
        with pytest.raises(OutputError, match=reason):
            rigidmd.analysis.zero_step(Simulation(scene).run(progress=False))


@pytest.mark.soak
@pytest.mark.parametrize(
    ("model", "count", "forces", "lengths", "steps"),
    [
        ("nitrogen", 64, 6.5, (20.0, 400.0), {10.0: {}, 20.0: {}, 30.0: {}}),
        ("nitrogen", 64, 6.5, (20.0, 400.0), {30.0: {"integrator": "velocity_verlet"}}),
        ("spce", 64, 6.0, (10.0, 100.0), {2.0: {}, 4.0: {}, 6.0: {}}),
        ("spce", 64, 6.0, (10.0, 100.0), {4.0: {"integrator": "velocity_verlet"}}),
    ],
)
def test_corrected_means_of_repeated_runs_agree(model, count, forces, lengths, steps):
    """Twenty runs at each step: (mean at zero - truth)/error, with the truth from all corrected means
    at the shortest step of the default."""
    heat = 90.0 if model == "nitrogen" else 300.0
    density = 0.75 if model == "nitrogen" else 0.997
    stage = {"ensemble": "nvt", "temperature_K": heat}
    short = (min(steps) if len(steps) > 1 else (10.0 if model == "nitrogen" else 2.0)), {}
    found = {}
    for step, keys in [short, *((step, keys) for step, keys in steps.items() if step != short[0])]:
        for seed in range(20):
            scene = {
                "seed": seed,
                "box": {"density_g_cm3": density},
                "molecules": [{"model": model, "count": count}],
                "forces": {"cutoff_A": forces, "truncation": "smooth_switch"},
                "stages": [
                    {"ensemble": "minimise"},
                    stage | {"duration_ps": lengths[0], "timestep_fs": short[0]},
                    stage | {"duration_ps": lengths[1], "timestep_fs": step} | keys,
                ],
                "output": {"trajectory": False, "log_interval_ps": 0.05, "figures": False},
            }
            results = Simulation(rigidmd.Scene.from_dict(scene)).run(progress=False)
            for name in ("potential_energy", "pressure"):
                pair = results.mean(name), results.mean(name, zero_step=True)
                found.setdefault((name, step), []).append([*pair[0][:2], *pair[1][:2]])
    for (name, step), values in found.items():
        raw, _, at_zero, error = np.array(values).T
        truth = np.array(found[name, short[0]])[:, 2]
        pulls = (at_zero - truth.mean()) / np.hypot(error, truth.std(ddof=1) / np.sqrt(20))
        print(
            f"{model} {name} {step:g} fs: raw {raw.mean():.5g}, at zero {at_zero.mean():.5g} ±"
            f" {at_zero.std(ddof=1) / np.sqrt(20):.2g}, truth {truth.mean():.5g}; pulls"
            f" {pulls.mean():.2f} ± {pulls.std(ddof=1):.2f}"
        )
        assert abs(pulls.mean()) < 0.9, (name, step)
        assert 0.4 < pulls.std(ddof=1) < 1.4, (name, step)
