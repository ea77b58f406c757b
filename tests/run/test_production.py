"""`Results.mean`: `run/production.py`."""

from math import isnan

import pytest
from support.common import ROOT, small_scene

import rigidmd
from rigidmd import Simulation
from rigidmd.errors import OutputError
from rigidmd.run.production import Estimate


def results_of(ensemble, duration=4.0, **keys):
    stage = {"ensemble": ensemble, "duration_ps": duration, "timestep_fs": 10.0} | keys
    scene = small_scene(
        {"argon": 32},
        11.7,
        forces={"cutoff_A": 5.5},
        stages=[{"ensemble": "minimise"}, stage],
        start={"temperature_K": 120.0},
        output={"log_interval_ps": 0.05},
    )
    return Simulation(scene).run(progress=False)


def test_a_mean_is_the_mean_of_the_summary():
    results = results_of("nvt", 60.0, temperature_K=120.0)
    stage = results.summary["stages"][-1]
    found = results.mean("potential_energy")
    value, error = (stage[f"potential{key}_kJ_mol_per_molecule"] for key in ("", "_error"))
    assert found == Estimate(value, pytest.approx(error), "kJ/mol per molecule")
    assert results.mean("potential") == found
    assert str(found).endswith("kJ/mol per molecule")
    assert results.mean("pressure").value == stage["pressure_bar"]
    bias = stage["potential_step_kJ_mol_per_molecule"]
    at_zero = results.mean("potential_energy", zero_step=True)
    assert at_zero.value == pytest.approx(value - bias)
    assert at_zero.error > found.error
    with pytest.raises(
        KeyError, match=r"no mean of 'drift'; there are potential, potential_energy"
    ):
        results.mean("drift")
    with pytest.raises(OutputError, match="Temperatures follow the thermostat"):
        results.mean("temperature", zero_step=True)


def test_a_mean_of_a_stored_run_and_of_a_body(tmp_path):
    scene = small_scene({"argon": 8}, 20.0, stages=[{"duration_ps": 2.0, "timestep_fs": 10.0}])
    results = Simulation(scene, tmp_path / "run").run()
    for name in ("temperature", "potential_energy"):
        found = rigidmd.read_run(tmp_path / "run").mean(name)
        assert found == results.mean(name) and found.error > 0
    with pytest.warns(DeprecationWarning, match="pressure_bar is pressure now"):
        assert results.mean("pressure_bar") == results.mean("pressure")
    body = rigidmd.Scene.read(ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.1})
    with pytest.raises(OutputError, match=r"one of a single body: results\[column\] has all"):
        Simulation(body).run().mean("energy")


def test_a_mean_that_is_not_known_has_a_reason():
    results = results_of("nve")
    assert results.mean("temperature").unit == "K"
    with pytest.raises(
        OutputError, match="potential at a step of zero is not known: it is for nvt"
    ):
        results.mean("potential", zero_step=True)
    short = results_of("nvt", 0.2, temperature_K=120.0)
    assert isnan(short.mean("potential").error)
    assert str(short.mean("temperature")).endswith("K (too short for an error)")
    values = short["potential"][short["stage"] == 1]
    assert short.mean("potential").value == pytest.approx(values.mean() / 32)
