"""Sweeps: what is requested, points in processes of their own, stops of every kind, tables,
clusters, bad input."""

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT
from support.processes import WAIT, process, wait_until

import rigidmd
from rigidmd.analysis import registry
from rigidmd.commands import cli
from rigidmd.errors import OutputError, RigidMDWarning, SceneError
from rigidmd.io.folder import FolderLock
from rigidmd.io.progress import progress_of
from rigidmd.run import Simulation
from rigidmd.run.record import read_record
from rigidmd.scene import Scene, parse_override
from rigidmd.scene.base import format_override
from rigidmd.studies.extrapolation import extrapolate
from rigidmd.studies.sweep import figure, limits, sweeping
from rigidmd.studies.sweep import points as sweep_points
from rigidmd.studies.sweep.figure import axis_label
from rigidmd.studies.sweep.folder import point_name, read_manifest, short_keys, value_name
from rigidmd.studies.sweep.plan import Axis, parse_axis, settings
from rigidmd.studies.sweep.points import format_walltime, wait_for_folder
from rigidmd.studies.sweep.table import POTENTIAL, SweepRow, summarise_run
from rigidmd.studies.sweep.table import Table as SweepTable

ARGON = """
[box]
lengths_A = 22.0

[[molecules]]
model = "argon"
count = 20

[forces]
cutoff_A = 8.0

[start]
temperature_K = 90.0

[[stages]]
duration_ps = 0.5
timestep_fs = 5

[output]
trajectory = "trajectory.trr"
trajectory_interval_ps = 0.05
figures = false
"""
GRID = ["--set", "start.temperature_K=90,120", "--set", "seed=1..2"]


@pytest.fixture(scope="module")
def argon(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "argon.toml"
    path.write_text(ARGON)
    return path


@pytest.fixture(scope="module")
def finished(argon, tmp_path_factory):
    """A sweep that has finished: 2 temperatures, 2 seeds."""
    folder = tmp_path_factory.mktemp("runs") / "sweep"
    run_here(argon, [parse_axis(text) for text in GRID[1::2]], folder)
    assert cli.main(["sweep", str(argon), *GRID, "-o", str(folder)]) == 0
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "sweep"))


def table(folder):
    with (folder / "sweep.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def states(folder):
    return {
        point["folder"]: point["state"]
        for point in json.loads((folder / "sweep.json").read_text())["points"]
    }


def written(folder):
    """The times at which runs ended, by point."""
    return {path.parent.name: path.stat().st_mtime_ns for path in folder.glob("*/summary.json")}


def same_runs(first, second):
    """Whether two sweeps have the same points, with the same bits in logs and trajectories."""
    names = sorted(path.parent.name for path in first.glob("*/log.csv"))
    assert names == sorted(path.parent.name for path in second.glob("*/log.csv"))
    files = ("log.csv", "trajectory.trr")
    return all(
        (first / n / f).read_bytes() == (second / n / f).read_bytes() for n in names for f in files
    )


def run_here(scene, axes, folder, **more):
    """The manifest of a sweep whose points ran in this process."""
    with sweeping.open_sweep(scene, axes, folder, **more) as manifest:
        for point in manifest.points:
            overrides = manifest.overrides(point.values)
            Simulation(Scene.read(scene, overrides), folder / point.folder).run(progress=False)
    return read_manifest(folder)


# What is requested


@pytest.mark.parametrize(
    ("text", "keys", "values"),
    [
        ("seed=1..4", ("seed",), (1, 2, 3, 4)),
        ("seed=1..3,7", ("seed",), (1, 2, 3, 7)),
        ("a.b=280, 290.5", ("a.b",), (280, 290.5)),
        ("a=-2..1", ("a",), (-2, -1, 0, 1)),
        ("a=spce,tip3p", ("a",), ("spce", "tip3p")),
        ("a=true,false", ("a",), (True, False)),
        ("a=[30,30,30],[31,31,31]", ("a",), ([30, 30, 30], [31, 31, 31])),
        ('a="x,y","z"', ("a",), ("x,y", "z")),
        ("a={b=1,c=[2,3]},{b=2,c=[4,5]}", ("a",), ({"b": 1, "c": [2, 3]}, {"b": 2, "c": [4, 5]})),
        ("a,b.c=1,2", ("a", "b.c"), (1, 2)),
    ],
)
def test_values_of_a_key(text, keys, values):
    assert parse_axis(text) == Axis(keys, values)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a=3", 3),
        ("a=[1,2]", [1, 2]),
        ("a=", None),
        ('a="1,2"', "1,2"),
        ("a=x.gro", "x.gro"),
        ("a=../x.gro", "../x.gro"),
    ],
)
def test_one_value_is_the_same_for_all_points(text, value):
    assert parse_axis(text) == Axis(("a",), (value,), swept=False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("seed", "is not KEY=VALUE"),
        ("=1,2", "is not KEY=VALUE"),
        ("a,=1,2", "is not KEY=VALUE"),
        ("seed=1,,2", "empty value"),
        ("seed=1,", "empty value"),
        ("seed=4..1", "the range 4..1 is empty"),
        ("seed=0.1..0.5", "not a range of whole numbers"),
        ("seed=1..10000000", "more than 100000 values"),
        ("a=[1,2", "brackets or quotation marks do not match"),
        ("a=1]", "brackets or quotation marks do not match"),
        ('a="x,y', "brackets or quotation marks do not match"),
        ("a=[1,2],x]", "brackets or quotation marks do not match"),
    ],
)
def test_values_that_are_none(text, expected):
    with pytest.raises(SceneError, match=re.escape(expected)):
        parse_axis(text)


def test_names_of_points():
    short = short_keys(["stages.0.temperature_K", "seed"])
    assert (
        point_name({"stages.0.temperature_K": 280.0, "seed": 1}, short)
        == "temperature_K=280_seed=1"
    )
    assert list(short_keys(["stages.0.timestep_fs", "stages.1.timestep_fs"]).values()) == [
        "0.timestep_fs",
        "1.timestep_fs",
    ]
    assert value_name([30, 30.5, 31]) == "30x30.5x31"
    assert (value_name(True), value_name(1e-5), value_name(0.1), value_name("spce")) == (
        "true",
        "1e-05",
        "0.1",
        "spce",
    )
    strange = [
        value_name(text)
        for text in ("../../etc", "..", "", "a b", "a/b", "a-b", "x" * 500, "é\n", "-")
    ]
    assert all(
        re.fullmatch(r"[\w.+\-]{0,60}", name) and not name.startswith(".") for name in strange
    )
    assert len({*strange}) == len(strange)
    long = [
        point_name(
            {f"key{k}": f"{'x' * 30}{end}" for k in range(9)},
            {f"key{k}": f"key{k}" for k in range(9)},
        )
        for end in "ab"
    ]
    assert long[0] != long[1]
    assert max(map(len, long)) < 140


def test_all_combinations_with_keys_that_go_together():
    axes = [Axis(("a", "b"), (1, 2)), Axis(("c",), (0,), swept=False), Axis(("seed",), (1, 2))]
    assert settings(axes) == [{"a": a, "seed": s} for a in (1, 2) for s in (1, 2)]


def test_cores_are_full(monkeypatch):
    monkeypatch.setattr(sweeping, "MOST_THREADS", 8)
    assert sweeping.jobs_and_threads(24, None, None) == (8, 1)
    assert sweeping.jobs_and_threads(3, None, None) == (3, 2)
    assert sweeping.jobs_and_threads(24, 2, None) == (2, 4)
    assert sweeping.jobs_and_threads(24, None, 4) == (2, 4)
    assert sweeping.jobs_and_threads(24, 16, None) == (16, 1)


# Runs


def test_a_sweep_is_a_folder_a_point_a_table_and_a_figure(finished):
    names = [f"temperature_K={t}_seed={s}" for t in (90, 120) for s in (1, 2)]
    assert states(finished) == dict.fromkeys(names, "finished")
    rows = table(finished)
    assert [(row["start.temperature_K"], row["runs"]) for row in rows] == [
        ("90", "2"),
        ("120", "2"),
    ]
    for row, temperature in zip(rows, (90, 120), strict=True):
        found = []
        for seed in (1, 2):
            with (finished / f"temperature_K={temperature}_seed={seed}" / "log.csv").open() as file:
                log = list(csv.DictReader(file))
            found.append(np.mean([float(line["Temperature (K)"]) for line in log]))
        assert float(row["Temperature (K)"]) == pytest.approx(np.mean(found), rel=1e-8)
        error = abs(found[0] - found[1]) / 2  # standard deviation over the root of 2
        assert float(row["Temperature (K) error"]) == pytest.approx(error, rel=1e-6)
        assert "Box Volume (nm^3) error" not in row  # a constant has no error
    assert (finished / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_a_point_has_the_bits_of_a_run(finished, argon, tmp_path, capsys):
    """In a process of its own."""
    changes = ["--set", "start.temperature_K=120", "--set", "seed=2..2"]
    assert cli.main(["sweep", str(argon), *changes, "-o", str(tmp_path / "s")]) == 0
    point = finished / "temperature_K=120_seed=2"
    assert cli.main(["compare", str(point), str(tmp_path / "s" / "seed=2")]) == 0
    for command in (["report"], ["analyse", "--only", "rdf"]):
        copy = shutil.copytree(point, tmp_path / command[0])
        assert cli.main([*command, str(copy)]) == 0


def test_the_energy_of_a_molecule_has_its_share_of_the_error(finished):
    """For a longer run, whose energies forget themselves from one sample to the next."""
    record = read_record(finished / "temperature_K=90_seed=1")
    columns = {name: np.resize(values, 40) for name, values in record.columns.items()}
    columns["time"] = np.linspace(0.0, 0.5, 40)
    columns["potential"] = np.random.default_rng(1).standard_normal(40) - 5.0
    found = summarise_run(replace(record, columns=columns))
    energy, error = found["Potential Energy (kJ/mole)"]
    assert error > 0.1
    assert found["Potential Energy per molecule (kJ/mole)"] == pytest.approx(
        (energy / 20, error / 20)
    )


def test_what_has_finished_is_not_run_again(copied, argon, capsys):
    before = written(copied)
    assert (
        cli.main(["sweep", str(argon), *GRID[2:], *GRID[:2], "-o", str(copied)]) == 0
    )  # keys in any order
    assert "4 skipped" in capsys.readouterr().out
    assert written(copied) == before
    # one value more, of a key that is varied
    more = ["--set", "start.temperature_K=90", "--set", "seed=3"]
    assert cli.main(["sweep", str(argon), *more, "-o", str(copied), "--jobs", "1"]) == 0
    assert "1 finished, 0 failed, 4 skipped" in capsys.readouterr().out
    assert {name: time for name, time in written(copied).items() if name in before} == before
    assert [row["runs"] for row in table(copied)] == ["3", "2"]


def test_a_point_with_a_longer_last_stage_counts_with_a_note(copied, argon, capsys):
    def lines_of(*command):
        code = cli.main([*command])
        output = capsys.readouterr()
        return code, output.out, output.err

    names = [point.folder for point in read_manifest(copied).points]
    before = written(copied)
    assert lines_of("resume", str(copied / names[0]), "--until", "0.7ps")[0] == 0
    note = f"the last stage of {names[0]} has another duration than in the sweep"
    for command in (
        ["sweep", str(argon), "-o", str(copied), "--collect"],
        ["sweep", str(argon), "-o", str(copied), *GRID],
        ["analyse", str(copied), "--only", "rdf"],
    ):
        code, out, err = lines_of(*command)
        assert code == 0 and err.count(note) == 1
        assert "4 of them finished" in out or "2 runs" in out
    assert set(states(copied).values()) == {"finished"}
    assert {name for name, at in written(copied).items() if at != before[name]} == {names[0]}
    with pytest.warns(RigidMDWarning, match=note):
        assert [len(row.runs) for row in rigidmd.read_run(copied).rows] == [2, 2]


def test_another_scene_is_refused(copied, argon, tmp_path, capsys):
    for changes, expected in (
        ([*GRID, "--set", "forces.cutoff_A=7.5"], "forces.cutoff_A is 7.5, there 8.0"),
        (GRID[:2], "it varies start.temperature_K and seed, not start.temperature_K"),
        ([*GRID, "--set", "stages.0.duration_ps=2"], "stages.0.duration_ps is 2.0, there 0.5"),
    ):
        assert cli.main(["sweep", str(argon), *changes, "-o", str(copied)]) == 2
        said = capsys.readouterr().err
        assert expected in said
        assert "--force starts it again" in said
    assert (copied / "temperature_K=90_seed=1" / "log.csv").exists()


def test_analyse_gives_errors_over_replicas(copied, argon, capsys):
    assert cli.main(["analyse", str(copied), "--only", "rdf,structure_factor"]) == 0
    assert "temperature_K = 90: 2 runs" in capsys.readouterr().out
    mean = copied / "temperature_K=90"
    own = [
        np.genfromtxt(copied / f"temperature_K=90_seed={k}" / "rdf.csv", delimiter=",", names=True)
        for k in (1, 2)
    ]
    both = np.genfromtxt(mean / "rdf.csv", delimiter=",", names=True)
    g, error = (name for name in both.dtype.names if name.startswith("g_"))
    assert both[g] == pytest.approx((own[0][g] + own[1][g]) / 2, abs=1e-7)
    assert both[error] == pytest.approx(np.abs(own[0][g] - own[1][g]) / 2, abs=1e-7)
    assert json.loads((mean / "analysis.json").read_text())["analyses"].keys() == {
        "rdf",
        "structure_factor",
    }
    with (copied / "analysis.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["runs"] for row in rows] == ["2", "2"]
    assert float(rows[0]["highest peak of S(k) error"]) > 0
    # --force removes what a sweep and its analyses wrote, and no more
    (copied / "notes.txt").write_text("mine")
    (copied / "temperature_K=90_seed=1" / "mine.txt").write_text("mine")
    with sweeping.open_sweep(argon, [Axis(("seed",), (1, 2))], copied, force=True) as manifest:
        assert len(manifest.unfinished) == 2
    assert [path.name for path in copied.iterdir() if path.is_dir()] == ["temperature_K=90_seed=1"]
    assert [path.name for path in (copied / "temperature_K=90_seed=1").iterdir()] == ["mine.txt"]
    assert {
        path.name for path in copied.iterdir() if path.is_file() and not path.name.startswith(".")
    } == {
        "notes.txt",
        "sweep.json",
    }
    assert states(copied) == {"seed=1": "waiting", "seed=2": "waiting"}


STEP = "stages.0.timestep_fs"


def test_averages_at_a_step_of_zero(argon, tmp_path, capsys, monkeypatch):
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
    assert cli.main(["analyse", str(folder), "--only", "rdf", "--extrapolate", STEP]) == 0
    assert re.search(r"first peak \(Å\) .*\d ± \d", capsys.readouterr().out)
    assert cli.main(["sweep", str(argon), *swept, *fixed, "--extrapolate", STEP]) == 0
    said = capsys.readouterr().out
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


def test_energy_at_a_step_of_zero_has_a_joint_fit(argon, tmp_path, capsys):
    """Next to the independent one, with a smaller error, and with the heat capacity."""
    folder = tmp_path / "steps"
    stage = {"ensemble": "nvt", "temperature_K": 150.0, "duration_ps": 120.0}
    fixed = {f"stages.0.{key}": value for key, value in stage.items()}
    fixed["box.lengths_A"] = 17.0
    axes = sweeping.axes_of({STEP: [10, 20], "seed": [1, 2]} | fixed)
    run_here(argon, axes, folder, step=STEP)
    assert (
        cli.main(["sweep", str(argon), "-o", str(folder), "--collect", "--extrapolate", STEP]) == 0
    )
    said = capsys.readouterr().out
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
    assert {limit.fit.order for limit in found.limits} == {4}
    limit = next(limit for limit in found.limits if len(limit.points) == 3)
    assert limit.fit == extrapolate(limit.points, order=4) != extrapolate(limit.points, order=2)


def test_a_file_of_one_point_that_changes_is_noticed(tmp_path, monkeypatch):
    """A key whose values are files."""
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        (tmp_path / f"{name}.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 5\n")
    text = ARGON.replace("count = 20\n", "") + '\n[structure]\nfile = "a.xyz"\n'
    (scene := tmp_path / "argon.toml").write_text(text)
    axes = sweeping.axes_of({"structure.file": ["a.xyz", "b.xyz"]})
    with sweeping.open_sweep(scene, axes, tmp_path / "s") as before:
        pass
    (tmp_path / "b.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 6\n")
    with (
        pytest.raises(
            OutputError, match=r"another scene: a file that file=b.xyz reads has changed"
        ),
        sweeping.open_sweep(scene, axes, tmp_path / "s"),
    ):
        pass
    (tmp_path / "b.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 5\n")
    with sweeping.open_sweep(scene, axes, tmp_path / "s") as after:
        pass
    assert [point.scene_sha256 for point in after.points] == [
        point.scene_sha256 for point in before.points
    ]


def test_what_cannot_be_extrapolated(argon, finished, tmp_path, capsys):
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
        assert cli.main(["sweep", str(scene), *arguments, "-o", str(tmp_path / "none")]) == 2
        assert expected in capsys.readouterr().err
        assert not (tmp_path / "none").exists()
    point = finished / "temperature_K=90_seed=1"
    assert (
        cli.main(["analyse", str(point), "--extrapolate", "stages.0.timestep_fs", "--only", "rdf"])
        == 2
    )
    assert "needs a sweep over a time step" in capsys.readouterr().err


@pytest.mark.parametrize("of_sweep", [["--extrapolate", "stages.0.timestep_fs"], ["pmf"]])
def test_a_sweep_that_is_not_there_is_no_run(of_sweep, capsys, tmp_path):
    assert cli.main(["analyse", str(tmp_path / "none"), *of_sweep]) == 2
    assert "none is not there" in capsys.readouterr().err


def test_analyses_of_a_sweep_go_on_without_a_damaged_point(copied, capsys, monkeypatch):
    """One point cannot be read, one analysis has an error of ours, one is not possible."""
    (copied / "temperature_K=90_seed=1" / "trajectory.trr").write_bytes(b"nothing")
    rdf = registry.KNOWN["rdf"]

    def broken(runs):
        raise ZeroDivisionError("of no use")

    monkeypatch.setitem(registry.KNOWN, "rdf", rdf._replace(function=broken))
    assert cli.main(["analyse", str(copied), "--only", "rdf,viscosity,structure_factor"]) == 1
    said = capsys.readouterr().out
    assert re.search(r"temperature_K=90_seed=1: .*cannot be read as a trajectory", said)
    assert (
        "rdf: an error of rigidmd, please report it: ZeroDivisionError: of no use (test_sweep.py:"
        in said
    )
    assert "viscosity: a viscosity needs the pressure tensor" in said
    with (copied / "analysis.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["runs"] for row in rows] == ["1", "2"]
    assert all(float(row["highest peak of S(k)"]) > 0 for row in rows)
    assert (copied / "analysis.png").read_bytes().startswith(b"\x89PNG")
    assert "analysis.png" in (copied / ".rigidmd-run").read_text()
    assert not (copied / "temperature_K=120" / "rdf.csv").exists()


def test_replicas_that_are_too_short_alone_are_analysed_together(copied, capsys):
    assert cli.main(["analyse", str(copied / "temperature_K=90_seed=1"), "--only", "msd"]) == 2
    assert "needs at least 20 frames" in capsys.readouterr().err
    assert cli.main(["analyse", str(copied), "--only", "msd"]) == 0
    assert (copied / "temperature_K=90" / "msd.csv").is_file()


def test_the_density_of_an_earlier_stage_is_in_the_table(tmp_path, argon, capsys):
    """A pair of stages, of which the first samples the density and the second keeps it."""
    stages = """
[[stages]]
name = "density"
ensemble = "npt"
temperature_K = 90.0
pressure_bar = 50.0
duration_ps = 2
timestep_fs = 5

[[stages]]
name = "production"
ensemble = "nvt"
temperature_K = 90.0
duration_ps = 1
timestep_fs = 5
"""
    text = ARGON.replace("[[stages]]\nduration_ps = 0.5\ntimestep_fs = 5\n", stages)
    (scene := tmp_path / "pair.toml").write_text(text + "log_interval_ps = 0.02\n")
    together = "stages.density.temperature_K,stages.production.temperature_K"
    folder = tmp_path / "s"
    points = run_here(scene, [parse_axis(f"{together}=90,110")], folder).points
    assert cli.main(["sweep", str(scene), "-o", str(folder), "--collect"]) == 0
    said = capsys.readouterr().out
    assert "density: Density (g/mL)" in said
    for row, point in zip(table(folder), points, strict=True):
        stage = json.loads((folder / point.folder / "summary.json").read_text())["stages"][0]
        assert float(row["density: Density (g/mL)"]) == pytest.approx(
            stage["density_g_cm3"], rel=1e-6
        )
        if stage["density_error_g_cm3"] is not None:
            assert float(row["density: Density (g/mL) error"]) == pytest.approx(
                stage["density_error_g_cm3"], rel=1e-6
            )
        assert float(row["density: Temperature (K)"]) == pytest.approx(
            stage["temperature_K"], rel=1e-6
        )
        assert "Density (g/mL) error" not in row  # it is constant in the last stage


@pytest.mark.parametrize(
    ("key", "together", "label"),
    [
        ("stages.density.temperature_K", [], "temperature of stages.density (K)"),
        ("box.density_g_cm3", ["box.density_g_cm3"], "density of box (g/cm³)"),
        (
            "stages.0.timestep_fs",
            ["stages.0.timestep_fs", "seed"],
            "timestep of stages.0 (fs)\ntogether with seed",
        ),
        ("molecules.0.count", [], "count of molecules.0"),
        ("seed", [], "seed"),
        ("stages.0.pressure_bar", [], "pressure of stages.0 (bar)"),
    ],
)
def test_axes_have_units_and_name_the_keys_that_vary_together(key, together, label):
    assert axis_label(key, together) == label


@pytest.mark.parametrize("errors", [0.5, None])
def test_a_figure_shows_all_points_of_all_curves(errors, tmp_path):
    """Curves with errors are displaced, which must not move them out of the panel."""
    rows = [
        SweepRow({"a.b_K": x, "word": word}, {None: {"x": (x + shift, errors)}})
        for x in (300.0, 280.0, 290.0)
        for word, shift in (("one", 0.0), ("two", 40.0))
    ]
    drawn = figure.draw_table(SweepTable(tmp_path, ["a.b_K", "word"], rows, ["x"]), ["x"])
    (axis,) = drawn.axes
    assert axis.get_xlim()[0] <= 280 < 300 <= axis.get_xlim()[1] < 310
    assert axis.get_ylim()[0] <= 280 < 340 <= axis.get_ylim()[1] < 350
    assert axis.lines[0].get_xdata().tolist() == [280, 290, 300]
    assert [text.get_text() for text in drawn.legends[0].texts] == ["word = one", "word = two"]


def test_a_row_has_the_error_over_its_runs_or_that_of_its_only_run():
    assert SweepRow({}, {1: {"x": (1.0, 0.5)}, 2: {"x": (3.0, 0.5)}})["x"] == (
        2.0,
        pytest.approx(1.0),
    )
    assert SweepRow({}, {1: {"x": (1.0, 0.5)}, 2: {}})["x"] == (1.0, 0.5)
    assert SweepRow({}, {1: {"x": (0.1, 0.0)}, 2: {"x": (0.1, 0.0)}, 3: {"x": (0.1, 0.0)}})[
        "x"
    ] == (0.1, None)


def test_bodies_and_words(tmp_path, capsys):
    """A body has no seeds; a key whose values are words has positions on the axis."""
    scene = ROOT / "systems" / "heavy_top_3.toml"
    fixed = {"run.duration_s": 0.02, "output.figures": False, "output.trajectory": False}
    integrators = {"run.integrator": ["velocity_verlet", "kahan_li_8"]}
    run_here(scene, sweeping.axes_of(integrators | fixed), tmp_path / "s")
    assert cli.main(["sweep", str(scene), "-o", str(tmp_path / "s"), "--collect"]) == 0
    errors = [float(row["energy_error largest"]) for row in table(tmp_path / "s")]
    assert errors[0] > 100 * errors[1]
    for row in table(tmp_path / "s"):
        lowest, mean, highest = (
            float(row[f"theta {word} (rad)"]) for word in ("lowest", "mean", "highest")
        )
        assert lowest < mean < highest
    assert (tmp_path / "s" / "sweep.png").exists()
    assert cli.main(["sweep", str(scene), "--replicas", "3", "-o", str(tmp_path / "t")]) == 2
    assert "a single body, whose motion has no seed" in capsys.readouterr().err
    assert not (tmp_path / "t").exists()


def test_from_python(argon, finished, copied):
    found = rigidmd.sweep(argon, {"start.temperature_K": [90, 120], "seed": range(1, 3)}, copied)
    assert found["start.temperature_K"].tolist() == [90, 120]
    assert found["Temperature (K)"] == pytest.approx(
        [float(row["Temperature (K)"]) for row in table(finished)]
    )
    assert (found.error("Temperature (K)") > 0).all()
    assert list(found.to_dataframe()["runs"]) == [2, 2]
    with pytest.raises(KeyError, match="there are"):
        found["no"]
    shown = found._repr_html_()
    temperatures = [row["Temperature (K)"] for row in table(finished)]
    for text in (
        "start.temperature_K",
        "<td>120</td>",
        "Temperature (K)",
        *(x.split(".")[0] for x in temperatures),
    ):
        assert text in shown
    with pytest.raises(OutputError, match="pmf needs a sweep over the distance of a restraint"):
        rigidmd.pmf(found)


# Stops


def test_values_of_numpy_in_a_sweep(argon, tmp_path):
    """Arrays and their numbers name folders as numbers do."""
    numbers = {"seed": [1, 2], "start.temperature_K": [90.5, 100.25], "stages.0.duration_ps": 0.5}
    arrays = {
        "seed": np.arange(1, 3),
        "start.temperature_K": np.array([90.5, 100.25]),
        "stages.0.duration_ps": np.float32(0.5),
    }
    listed = {
        "seed": (np.int64(k) for k in (1, 2)),
        "start.temperature_K": list(arrays["start.temperature_K"]),
    }
    wanted = sweeping.axes_of(numbers)
    assert sweeping.axes_of(arrays) == wanted
    assert sweeping.axes_of(listed) == wanted[:2]
    found = [
        [point.folder for point in long_sweep(argon, tmp_path / name, **changes).points]
        for name, changes in (("a", numbers), ("b", arrays))
    ]
    assert found[0] == found[1]


#: Two points that take seconds: the log is written each second.
LONG = {
    "stages.0.duration_ps": 6000.0,
    "output.trajectory_interval_ps": 200.0,
    "output.log_interval_ps": 10.0,
    "seed": range(1, 3),
}


def long_sweep(argon, folder, **more):
    """Manifest of a sweep of points that take seconds."""
    with sweeping.open_sweep(argon, sweeping.axes_of(LONG | more), folder) as manifest:
        return manifest


def finish(manifest, jobs=2, receive=lambda name, line: None, pool=None):
    """Run what is left of a sweep, and return the signal that stopped it."""
    bar = progress_of(1.0, "points", shown=False)
    with bar, pool or ThreadPoolExecutor(jobs) as executor:
        return sweep_points.run_points(manifest, executor, bar, receive=receive)


def names_in(manifest, *states):
    return [point.folder for point in manifest.points_in(*states)]


@contextmanager
def when_running(folder, act):
    """Within the block, call `act(name)` with the first point of a sweep whose log has grown, from
    another thread."""
    ended = threading.Event()

    def watch():
        while not ended.wait(0.05):
            for log in folder.glob("*/log.csv"):
                is_moving = log.read_bytes().count(b"\n") > 3
                if is_moving and not (log.parent / "summary.json").exists():
                    act(log.parent.name)
                    return

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


@pytest.fixture(scope="module")
def whole(argon, tmp_path_factory):
    """Two points that were never stopped."""
    folder = tmp_path_factory.mktemp("whole") / "sweep"
    run_here(argon, sweeping.axes_of(LONG), folder)
    return folder


def kill_run(folder):
    """Kill the process of a run in a folder."""
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (path / "cmdline").read_bytes().split(b"\0")
            if str(folder).encode() in words:
                os.kill(int(path.name), signal.SIGKILL)


def test_a_killed_process_loses_its_point_alone_and_a_signal_stops_all(argon, whole, tmp_path):
    """The first point that moves is killed, then the sweep is stopped, and continues later."""
    folder = tmp_path / "sweep"
    manifest, killed = long_sweep(argon, folder), []

    def kill_first(name):
        killed.append(name)
        kill_run(folder / name)

    def stop_later(name):
        kill_first(name)
        while states(folder)[name] not in ("failed", "finished"):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    with when_running(folder, stop_later):
        stopped = finish(manifest, jobs=1)  # the next point has only begun when the signal comes
    assert killed, "no point was seen while it ran"
    assert stopped == signal.SIGTERM
    assert names_in(manifest, "failed") == killed
    assert names_in(manifest, "interrupted", "waiting")
    failed = next(point for point in read_manifest(folder).points if point.folder == killed[0])
    assert "was killed" in failed.message
    assert set(states(folder).values()) <= {"interrupted", "waiting", "finished", "failed"}
    assert not list(folder.glob(".points-*"))
    again = long_sweep(argon, folder)
    assert finish(again) is None and not again.unfinished
    assert same_runs(folder, whole)


def test_a_second_interrupt_ends_all_points_at_once(argon, tmp_path):
    folder = tmp_path / "sweep"
    manifest = long_sweep(argon, folder, **{"stages.0.duration_ps": 1e6})

    with when_running(folder, lambda name: [os.kill(os.getpid(), signal.SIGINT) for _ in "12"]):
        assert finish(manifest) == signal.SIGINT
    assert not names_in(manifest, "finished", "failed")


def test_points_end_with_their_sweep(argon, tmp_path):
    """Their standard input ends with the process of the sweep, however it dies."""
    folder = tmp_path / "sweep"
    words = ["--set", "seed=1,2", "--set", "stages.0.duration_ps=1e6", "-o", str(folder)]
    command = [sys.executable, "-m", "rigidmd", "sweep", str(argon), *words, "--jobs", "1"]
    moving = threading.Event()
    with (
        process(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as sweep,
        when_running(folder, lambda name: moving.set()),
    ):
        wait_until(moving.is_set, sweep)
    wait_for_folder(folder / "seed=1", WAIT)
    assert (folder / "seed=1" / "checkpoint.npz").is_file()
    assert len(list(folder.glob(".points-*"))) == 1
    assert cli.main([*command[3:], "--walltime", "0:00:01"]) == 75
    assert not list(folder.glob(".points-*"))


def test_points_that_fail_are_told_and_repeated(argon, tmp_path, capsys):
    """A time step that is far too long ends a run."""
    folder = tmp_path / "sweep"
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "stages.0.timestep_fs=5,100000",
        "--set",
        "stages.0.duration_ps=100",
        "--set",
        "watch.stable_step=false",
        "-o",
        str(folder),
    ]
    assert cli.main(arguments) == 1
    assert states(folder) == {"timestep_fs=5": "finished", "timestep_fs=100000": "failed"}
    said = capsys.readouterr().out
    assert "failed: timestep_fs=100000" in said
    assert "the same command" in said


def test_a_wall_time_that_is_over_leaves_the_rest(argon, tmp_path, capsys):
    """Two points that nobody has the time for."""
    folder = tmp_path / "sweep"
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1,2",
        "--set",
        "stages.0.duration_ps=1e7",
        "--set",
        "output.trajectory=false",
        "--set",
        "output.log_interval_ps=100",
        "-o",
        str(folder),
    ]
    assert cli.main([*arguments, "--walltime", "0:00:03", "--jobs", "1"]) == 75
    assert set(states(folder).values()) <= {"interrupted", "waiting"}
    assert "the same command continues" in capsys.readouterr().out


def test_two_sweeps_do_not_share_a_folder(copied, argon, capsys):
    lock = FolderLock(copied)
    lock.take()
    try:
        assert cli.main(["sweep", str(argon), *GRID, "-o", str(copied)]) == 2
    finally:
        lock.release()
    assert "another run is writing" in capsys.readouterr().err


def test_a_point_waits_for_a_run_that_is_about_to_stop(tmp_path):
    lock = FolderLock(tmp_path)
    lock.take()
    with pytest.raises(OutputError, match="did not end within"):
        wait_for_folder(tmp_path, 0.1)
    lock.release()
    wait_for_folder(tmp_path, 0.1)


def test_a_scene_that_changes_meanwhile_is_not_run(argon, tmp_path):
    manifest = long_sweep(argon, tmp_path / "sweep", seed=[1, 2])
    for point in manifest.points:
        point.scene_sha256 = "other"
    finish(manifest)
    assert len(manifest.points_in("failed")) == 2
    assert "has changed since the sweep began" in manifest.points[0].message


@pytest.mark.soak
def test_a_sweep_that_is_killed_goes_on(argon, tmp_path):
    """3 temperatures, 8 seeds, two at a time; the sweep is killed in the middle."""
    arguments = [
        str(argon),
        "--set",
        "start.temperature_K=90,100,110",
        "--set",
        "seed=1..8",
        "--set",
        "stages.0.duration_ps=100",
        "--jobs",
        "2",
    ]
    command = [sys.executable, "-m", "rigidmd", "sweep", *arguments, "-o", str(tmp_path / "parts")]
    with process(command, start_new_session=True) as parent:
        wait_until(
            lambda: list(states_or_none(tmp_path / "parts").values()).count("finished") >= 6, parent
        )
    for point in (tmp_path / "parts").glob("seed=*"):
        wait_for_folder(point, WAIT)
    done = written(tmp_path / "parts")
    assert 6 <= len(done) < 24
    assert cli.main(["sweep", *arguments, "-o", str(tmp_path / "parts")]) == 0
    assert {
        name: when for name, when in written(tmp_path / "parts").items() if name in done
    } == done
    assert cli.main(["sweep", *arguments, "-o", str(tmp_path / "whole")]) == 0
    assert same_runs(tmp_path / "parts", tmp_path / "whole")
    assert (tmp_path / "parts" / "sweep.csv").read_bytes() == (
        tmp_path / "whole" / "sweep.csv"
    ).read_bytes()


def states_or_none(folder):
    return states(folder) if (folder / "sweep.json").exists() else {}


# Clusters


def test_points_run_on_a_cluster_of_dask(argon, finished, tmp_path, capsys):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as cluster:
        arguments = ["sweep", str(argon), "--set", "seed=1..1", "--set", "start.temperature_K=120"]
        arguments += ["-o", str(tmp_path / "sweep"), "--scheduler", cluster.scheduler_address]
        assert cli.main(arguments) == 0
    assert "1 finished" in capsys.readouterr().out
    ours, theirs = tmp_path / "sweep" / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()


@pytest.mark.soak
def test_a_signal_stops_a_cluster(argon, whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    folder = tmp_path / "sweep"
    manifest = long_sweep(argon, folder)
    with (
        distributed.LocalCluster(
            n_workers=1,
            threads_per_worker=2,
            processes=False,
            dashboard_address=None,
            protocol="tcp",
        ) as cluster,
        when_running(folder, lambda name: os.kill(os.getpid(), signal.SIGTERM)),
    ):
        stopped = finish(manifest, pool=sweep_points.cluster(cluster.scheduler_address))
    assert stopped == signal.SIGTERM
    assert manifest.unfinished and not manifest.points_in("failed")
    again = long_sweep(argon, folder)
    finish(again)
    assert not again.unfinished
    assert same_runs(folder, whole)


def test_without_a_cluster(argon, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sweep_points, "CONNECT_TIMEOUT", 0.5)
    arguments = ["sweep", str(argon), *GRID, "-o", str(tmp_path / "sweep"), "--scheduler"]
    if "distributed" in sys.modules:
        assert cli.main([*arguments, "tcp://127.0.0.1:9"]) == 2
        assert "no scheduler of dask.distributed answers" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "distributed", None)
    assert cli.main([*arguments, "tcp://127.0.0.1:9"]) == 2
    assert "pip install distributed" in capsys.readouterr().err


@pytest.fixture
def slurm(tmp_path, monkeypatch):
    """A working directory, and a stub of sbatch that runs an array at once."""
    (tmp_path / "bin").mkdir()
    stub = f"""#!{sys.executable}
import os, re, subprocess, sys
script = sys.argv[-1]
told = [a.partition("=")[2] for a in sys.argv[1:] if a.startswith("--array=")]
spec = told[0] if told else re.search("--array=(.*)", open(script).read())[1]
print("sbatch", spec, file=open("jobs", "a"))
for part in spec.split(","):
    first, _, last = part.partition("-")
    for k in range(int(first), int(last or first) + 1):
        subprocess.run(["bash", script], env=os.environ | {{"SLURM_ARRAY_TASK_ID": str(k)}})
"""
    for name, text in (
        ("sbatch", stub),
        ("rigidmd", f'#!/bin/bash\nexec {sys.executable} -m rigidmd "$@"\n'),
    ):
        (tmp_path / "bin" / name).write_text(text)
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")


def test_a_script_for_slurm(argon, finished, slurm, capsys):
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1..1",
        "--set",
        "start.temperature_K=120",
        "-o",
        "my sweep",
    ]
    assert cli.main([*arguments, "--to", "slurm", "--walltime", "0:10:00"]) == 0
    script = Path("my sweep/sweep.sbatch")
    text = script.read_text()
    assert "#SBATCH --array=0\n" in text
    assert "#SBATCH --time=0:10:00\n" in text
    assert not list(Path("my sweep").glob("*/log.csv"))
    subprocess.run(["sbatch", str(script.absolute())], check=True)
    assert cli.main(["sweep", str(argon), "-o", "my sweep", "--collect"]) == 0
    assert "1 of them finished" in capsys.readouterr().out
    ours, theirs = Path("my sweep") / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()
    assert (
        cli.main(
            [*arguments[:3], "seed=1..3", *arguments[4:], "--to", "slurm", "--walltime", "0:10:00"]
        )
        == 0
    )
    assert "#SBATCH --array=1,2\n" in script.read_text()


def test_commands_for_any_scheduler(argon, finished, slurm, capsys):
    """A line for each point that has not finished, which a shell runs."""
    axes = ["--set", "start.temperature_K=120", "--set", "seed=1..2"]
    assert cli.main(["sweep", str(argon), *axes, "-o", "my sweep", "--to", "commands"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert not list(Path("my sweep").glob("*/log.csv"))
    subprocess.run(["bash", "-c", lines[0]], check=True)
    assert cli.main(["sweep", str(argon), *axes, "-o", "my sweep", "--to", "commands"]) == 0
    assert capsys.readouterr().out.splitlines() == lines[1:]
    ours, theirs = Path("my sweep") / "seed=1", finished / "temperature_K=120_seed=1"
    assert (ours / "log.csv").read_bytes() == (theirs / "log.csv").read_bytes()


SPRING = """
from typing import NamedTuple

import rigidmd


class Spring(NamedTuple):
    stiffness: float
    tied_to_places = True


@rigidmd.compiled_force(Spring)
def add_spring(term, state, load, tally):
    load.force[0, 0] -= term.stiffness * state.position[0, 0]


def spring():
    return Spring({size})
"""


def test_each_point_trusts_the_file_that_it_runs(argon, tmp_path, capsys):
    """A sweep over modules, each of which has to be trusted."""
    text = argon.read_text() + '[[forces.custom]]\nmodule = "one.py"\nname = "spring"\n'
    (scene := tmp_path / "argon.toml").write_text(text)
    for name, size in (("one.py", 1.0), ("two.py", 2.0), ("three.py", 3.0)):
        (tmp_path / name).write_text(SPRING.format(size=size))
    names = [str(tmp_path / name) for name in ("one.py", "two.py", "three.py")]
    arguments = ["sweep", str(scene), "--set", f"forces.custom.0.module={names[0]},{names[1]}"]
    arguments += ["--to", "commands", "-o", str(tmp_path / "s")]
    trusted = ["--trust", names[0], "--trust", names[1]]
    assert cli.main([*arguments, *trusted, "--trust", names[2]]) == 2
    assert "three.py is not a file that [[forces.custom]]" in capsys.readouterr().err
    assert cli.main([*arguments, *trusted]) == 0
    for line, name in zip(capsys.readouterr().out.splitlines(), names, strict=False):
        assert shlex.split(line)[-2:] == ["--trust", name]


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        -0.25,
        1e-30,
        "spce",
        "a b,c",
        'quo"te\\',
        "3",
        [30, 30.5],
        ["x", "y"],
        {"between": [1, 2], "a key": {"x": "é"}},
    ],
)
def test_an_override_of_a_command_is_read_as_the_same_value(value):
    assert parse_override(format_override("a.b", value)) == ("a.b", value)


@pytest.mark.soak
def test_slurm_jobs_submit_themselves_again(argon, slurm):
    """Jobs whose time is up, until their points have finished."""
    arguments = [
        "sweep",
        str(argon),
        "--set",
        "seed=1..2",
        "--set",
        "stages.0.duration_ps=2500",
        "-o",
        "sweep",
    ]
    assert cli.main([*arguments, "--to", "slurm", "--walltime", "0:00:08"]) == 0
    subprocess.run(["sbatch", "sweep/sweep.sbatch"], check=True)
    assert len(Path("jobs").read_text().splitlines()) > 2
    assert cli.main(["sweep", str(argon), "-o", "sweep", "--collect"]) == 0
    assert cli.main([*arguments[:-1], "whole"]) == 0
    assert same_runs(Path("sweep"), Path("whole"))


def test_words_for_slurm():
    assert format_walltime(3661.9) == "1:01:01"
    assert format_walltime(100 * 3600) == "100:00:00"


# Bad input


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "no key has several values"),
        (["--set", "seed=3"], "no key has several values"),
        (["--set", "seed=1..3", "--set", "seed=5,6"], "seed is set 2 times"),
        (["--set", "seed=4..1", "--set", "a=1,,2"], "2 errors"),
        (["--set", "seed=1,1"], "seed: 1 is listed 2 times"),
        (["--set", "start.temperature_K=90,90.0"], "90 is listed 2 times"),
        (["--set", "sed=1..3"], "did you mean seed?"),
        (
            ["--set", "seed=1..1000", "--set", "start.temperature_K=1..1000"],
            "these are 1000000 points",
        ),
        (["--replicas", "3", "--set", "seed=1..3"], "Leave out one of them"),
        (["--set", "seed=1..3", "--to", "slurm"], "needs --walltime"),
        (
            ["--set", "seed=1..3", "--to", "slurm", "--walltime", "1:00:00", "--collect"],
            "cannot be combined",
        ),
        (["--set", "seed=1..3", "--to", "commands", "--walltime", "1:00:00"], "starts no run"),
        (["--set", "seed=1..3", "--trust", "nothing.py"], "there is no such file"),
    ],
)
def test_bad_input(arguments, expected, argon, tmp_path, capsys):
    assert cli.main(["sweep", str(argon), *arguments, "-o", str(tmp_path / "sweep")]) == 2
    assert expected in capsys.readouterr().err
    assert not (tmp_path / "sweep").exists()


def test_all_faults_of_all_points_at_once(argon, tmp_path, capsys):
    arguments = [
        "--set",
        "start.temperature_K=-5,100,cold",
        "--set",
        "forces.cutoff_A=8,12",
        "-o",
        str(tmp_path / "s"),
    ]
    assert cli.main(["sweep", str(argon), *arguments]) == 2
    said = capsys.readouterr().err
    assert "3 errors" in said
    assert (
        "at temperature_K = -5, cutoff_A = 8 and 1 more points: --set start.temperature_K: is -5"
        in said
    )
    assert "at temperature_K = 100, cutoff_A = 12: forces.cutoff_A = 12 is longer than half" in said
    assert "at temperature_K = cold" in said
    assert (
        cli.main(
            [
                "sweep",
                str(argon),
                "--set",
                "seed=1,2",
                "--set",
                "forces.cutoff_A=12",
                "-o",
                str(tmp_path / "s"),
            ]
        )
        == 2
    )
    assert capsys.readouterr().err.startswith(f"rigidmd: {argon}: forces.cutoff_A = 12")
    assert not (tmp_path / "s").exists()


def test_folders_that_are_none(argon, tmp_path, copied, capsys):
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    for name, expected in (("file", "is a file"), ("full", "holds no sweep")):
        for more in ([], ["--force"]):
            assert cli.main(["sweep", str(argon), *GRID, "-o", str(tmp_path / name), *more]) == 2
            assert expected in capsys.readouterr().err
    assert cli.main(["sweep", str(argon), "-o", str(tmp_path / "none"), "--collect"]) == 2
    assert "holds no sweep" in capsys.readouterr().err
    assert cli.main(["report", str(copied)]) == 2
    assert "is the folder of a sweep. Name one of the runs in it" in capsys.readouterr().err
    for text in (
        "",
        "{}",
        "[]",
        '{"schema": 1}',
        '{"schema": 99}',
        "{",
        '{"schema": 1, "points": [{"folder": "../x"}]}',
    ):
        (copied / "sweep.json").write_text(text)
        assert cli.main(["sweep", str(argon), *GRID, "-o", str(copied)]) == 2
        assert "sweep.json" in capsys.readouterr().err
        assert cli.main(["analyse", str(copied)]) == 2
        assert "sweep.json" in capsys.readouterr().err


def test_a_manifest_names_no_folder_outside(copied, argon, capsys):
    told = json.loads((copied / "sweep.json").read_text())
    for name in ("../outside", "..", "/tmp/x", ""):
        told["points"][0]["folder"] = name
        (copied / "sweep.json").write_text(json.dumps(told))
        assert cli.main(["sweep", str(argon), *GRID, "-o", str(copied)]) == 2
        assert "points with invalid names of folders" in capsys.readouterr().err


def test_an_invalid_manifest_is_refused(copied, argon, capsys):
    whole = json.loads((copied / "sweep.json").read_text())
    for change in (
        {"keys": []},
        {"keys": {"seed": ["other"], "start.temperature_K": ["start.temperature_K"]}},
        {"fixed": "x"},
        {"common": 3},
        {"name": None},
        {"points": 3},
        {"points": [3]},
        {"trust": ["evil.py"]},
        {"points": [whole["points"][0] | {"state": "done"}]},
        {"points": [whole["points"][0] | {"values": {}}]},
        {"points": [whole["points"][0] | {"seconds": "long"}]},
        {"points": whole["points"][:1] * 2},
    ):
        (copied / "sweep.json").write_text(json.dumps(whole | change))
        for command in (["sweep", str(argon), *GRID, "-o"], ["analyse"]):
            assert cli.main([*command, str(copied)]) == 2, change
            said = capsys.readouterr().err
            assert f"{copied / 'sweep.json'}" in said, change
            assert next(iter(change)) in said, change
            assert "--force starts the sweep again" in said, change
