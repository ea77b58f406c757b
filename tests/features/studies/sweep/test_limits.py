"""Averages at a time step of zero."""

import csv
import json
import re

import numpy as np
import pytest
from support.sweeps import ARGON, run_here, table

from rigidmd.commands import cli
from rigidmd.features.studies.extrapolation import extrapolate
from rigidmd.features.studies.sweep import limits, sweeping
from rigidmd.features.studies.sweep.plan import parse_axis
from rigidmd.features.studies.sweep.table import POTENTIAL

STEP = "stages.0.timestep_fs"


@pytest.mark.usefixtures("draws")
def test_averages_at_a_step_of_zero(argon, tmp_path, printed, monkeypatch):
    monkeypatch.setattr(limits, "MOST_PANELS", 2)  # drawing takes most of the time
    folder = tmp_path / "steps"
    swept = ["--set", f"{STEP}=5,10,20", "--set", "start.temperature_K=90,120"]
    fixed = [
        "--set",
        "stages.0.duration_ps=2",
        "--set",
        "output.log_interval_ps=0.02",
        "-o",
        str(folder),
    ]
    axes = [parse_axis(text) for text in (*swept[1::2][:2], fixed[1], fixed[3])]
    run_here(argon, axes, folder, step=STEP)
    assert re.search(
        r"first peak \(Å\) .*\d ± \d",
        printed("analyse", folder, "--only", "rdf", "--extrapolate", STEP).out,
    )
    said = printed("sweep", argon, *swept, *fixed, "--extrapolate", STEP).out
    assert (
        "averages at a step of 0, from errors of order dt² (velocity_verlet) in stages.0.timestep_fs"
        in said
    )
    assert re.search(r"no joint fit: temperature_K = 90: it is for nvt and npt, .* is nve", said)
    assert "no limit" not in said  # the edges of the box are the same at all steps, to rounding
    assert "sweep.png, extrapolation.csv, extrapolation.png, extrapolation.html" in said
    with (folder / "extrapolation.csv").open(encoding="utf-8") as file:
        rows = {(row["start.temperature_K"], row["average"]): row for row in csv.DictReader(file)}
    means = {
        (row["start.temperature_K"], row[STEP]): float(row["Temperature (K)"])
        for row in table(folder)
    }
    for temperature in ("90", "120"):
        assert any(at == temperature and "first peak (Å)" in name for at, name in rows)
        row = rows[temperature, "Temperature (K)"]
        assert (row["order"], row["degrees of freedom"]) == ("2", "1")
        bias = float(row["bias at 5 fs"])
        assert float(row["limit"]) + bias == pytest.approx(means[temperature, "5"], rel=1e-6)
        assert float(row["limit error"]) > 0
    assert "<svg" in (folder / "extrapolation.html").read_text("utf-8")
    assert (folder / "extrapolation.png").stat().st_size > 10_000


def test_energy_at_a_step_of_zero_has_a_joint_fit(argon, tmp_path, printed):
    """Next to the independent one, with a smaller error, and with the heat capacity."""
    folder = tmp_path / "steps"
    stage = {"ensemble": "nvt", "temperature_K": 150.0, "duration_ps": 120.0}
    fixed = {f"stages.0.{key}": value for key, value in stage.items()}
    fixed["box.lengths_A"] = 17.0
    axes = sweeping.axes_of({STEP: [10, 20], "seed": [1, 2]} | fixed)
    run_here(argon, axes, folder, step=STEP)
    said = printed("sweep", argon, "-o", folder, "--collect", "--extrapolate", STEP).out
    for kind in ("independent", "joint"):
        assert re.search(rf"U per molecule \(kJ/mol\) +{kind} ", said)
    assert re.search(r"c_v \(J/\(mol K\)\) +fluctuations +\d", said)
    with (folder / "extrapolation.csv").open(encoding="utf-8") as file:
        rows = {(row["average"], row["fit"]): row for row in csv.DictReader(file)}
    joint, alone = (rows[POTENTIAL, kind] for kind in ("joint", "independent"))
    assert 0 < float(joint["limit error"]) < 0.8 * float(alone["limit error"])
    apart = float(joint["limit"]) - float(alone["limit"])
    assert abs(apart) < 3 * float(alone["limit error"])
    assert float(joint["bias at 20 fs"]) == pytest.approx(4 * float(joint["bias at 10 fs"]))
    assert 12 < float(rows["c_v (J/(mol K))", "fluctuations"]["limit"]) < 30


def test_values_of_replicas_together_are_extrapolated(argon, tmp_path):
    """Not the means of the values of single runs: heights of peaks differ, and diffusion has none
    there."""
    folder = tmp_path / "steps"
    swept = {STEP: [5, 10], "seed": [1, 2], "stages.0.duration_ps": 2.0}
    points = run_here(argon, sweeping.axes_of(swept), folder, step=STEP).points
    assert cli.main(["analyse", str(folder), "--only", "rdf", "--extrapolate", STEP]) == 0
    with (folder / "analysis.csv").open(encoding="utf-8") as file:
        together = {float(row[STEP]): row for row in csv.DictReader(file)}
    name = next(name for name in together[5.0] if "height" in name and "error" not in name)
    with (folder / "extrapolation.csv").open(encoding="utf-8") as file:
        limit = next(row for row in csv.DictReader(file) if row["average"] == name)
    for step, row in together.items():
        biased = float(limit["limit"]) + float(limit[f"bias at {step:g} fs"])
        assert biased == pytest.approx(float(row[name]), rel=1e-6)
        tables = [
            json.loads((folder / point.folder / "analysis.json").read_text())["analyses"]["rdf"][
                "values"
            ]
            for point in points
            if point.values[STEP] == step
        ]
        singles = [
            next(value for value in values if "height" in value["name"])["value"]
            for values in tables
        ]
        assert abs(np.mean(singles) - float(row[name])) > 1e-4
    # analyses that are not possible fail only if they are named
    assert cli.main(["analyse", str(folder), "--extrapolate", STEP]) == 0


def test_the_order_of_an_extrapolation_is_that_of_the_integrator(argon, tmp_path):
    """By dt⁴ for srkn_4: 1, 16, 81 times the slope."""
    folder = tmp_path / "steps"
    fixed = {
        "stages.0.duration_ps": 2.0,
        "output.log_interval_ps": 0.02,
        "stages.0.integrator": "srkn_4",
    }
    axes = sweeping.axes_of({STEP: [5, 10, 20]} | fixed)
    found = limits.extrapolate_sweep(run_here(argon, axes, folder, step=STEP), STEP)
    assert "dt⁴ (srkn_4)" in found.title
    assert {limit.order for limit in found.limits} == {4}
    limit = next(limit for limit in found.limits if len(limit.points) == 3)
    of_order_2 = [point._replace(order=2) for point in limit.points]
    assert limit.fit == extrapolate(limit.points) != extrapolate(of_order_2)


@pytest.mark.parametrize(("ensemble", "slopes"), [("nve", 1), ("nvt", 2)])
def test_methods_have_one_limit_with_a_thermostat(ensemble, slopes, argon, tmp_path):
    """Each with its order. At constant energy runs by other methods have another energy."""
    stage = {"ensemble": ensemble, "duration_ps": 2.0}
    if ensemble == "nvt":
        stage["temperature_K"] = 90.0
    swept = {STEP: [5, 10], "stages.0.integrator": ["velocity_verlet", "srkn_4"]}
    fixed = {f"stages.0.{key}": value for key, value in stage.items()}
    fixed["output.log_interval_ps"] = 0.02
    axes = sweeping.axes_of(swept | fixed)
    found = limits.extrapolate_sweep(run_here(argon, axes, tmp_path / ensemble, step=STEP), STEP)
    of_both = [limit for limit in found.limits if limit.quantity == "Temperature (K)"]
    assert {limit.order: len(limit.fit.slopes) for limit in of_both} == {2: slopes, 4: slopes}
    assert len({limit.fit.limit for limit in of_both}) == 3 - slopes


def test_what_cannot_be_extrapolated(argon, finished, tmp_path, printed):
    (scene := tmp_path / "argon.toml").write_text(ARGON + "[[stages]]\nduration_ps = 1\n")
    steps = ["--set", "stages.0.timestep_fs=2,4"]
    for arguments, expected in (
        (
            [*steps, "--extrapolate", "stages.nve.timestep_fs"],
            "is not varied. This sweep varies stages.0.timestep_fs",
        ),
        (
            ["--set", "seed=1,2", "--extrapolate", "seed"],
            "seed is not the time step of a stage of molecules",
        ),
        (
            [
                *steps,
                "--extrapolate",
                "stages.0.timestep_fs",
                "--to",
                "slurm",
                "--walltime",
                "1:00:00",
            ],
            "needs results",
        ),
        (
            [*steps, "--extrapolate", "stages.0.timestep_fs"],
            "is not the step of the stage whose averages are taken",
        ),
    ):
        assert expected in printed("sweep", scene, *arguments, "-o", tmp_path / "none", code=2).err
        assert not (tmp_path / "none").exists()
    point = finished / "temperature_K=90_seed=1"
    assert (
        "needs a sweep over a time step"
        in printed(
            "analyse", point, "--extrapolate", "stages.0.timestep_fs", "--only", "rdf", code=2
        ).err
    )
