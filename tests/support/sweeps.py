"""A sweep of argon at two temperatures with two seeds, and what sweeps leave in their folders."""

import csv
import json
import shutil
from pathlib import Path

import pytest

from rigidmd.commands import cli
from rigidmd.features.studies.sweep import sweeping
from rigidmd.features.studies.sweep.folder import read_manifest
from rigidmd.features.studies.sweep.plan import parse_axis
from rigidmd.run import Simulation
from rigidmd.scene import Scene

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


@pytest.fixture(scope="session")
def argon(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "argon.toml"
    path.write_text(ARGON)
    return path


@pytest.fixture(scope="session")
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


def run_here(scene, axes, folder, **more):
    """The manifest of a sweep whose points ran in this process."""
    with sweeping.open_sweep(scene, axes, folder, **more) as manifest:
        for point in manifest.points:
            overrides = manifest.overrides(point.values)
            Simulation(Scene.read(scene, overrides), folder / point.folder).run(progress=False)
    return read_manifest(folder)
