"""Features can be absent: what does not use one works without it, and what needs one ends with one
sentence."""

import os
import subprocess
import sys

import pytest
from support.common import ROOT

from rigidmd.feature import Feature
from rigidmd.features import FEATURES

NAMES = [row.name for row in FEATURES]
WATER = ["systems/water.toml", "--set", "stages.equilibration.duration_ps=0.02"]
WATER += ["--set", "stages.production.duration_ps=0.02"]
#: Feature -> a command that needs it.
NEEDING = {
    "analysis": ["analyse", "run"],
    "bodies": ["check", "systems/heavy_top_3.toml"],
    "crystals": ["check", "systems/lta.toml"],
    "external": ["verify", "systems/water.toml"],
    "free_energy": ["virial", "spce"],
    "monte_carlo": ["check", *WATER, "--set", "stages.1.thermostat=hybrid_monte_carlo"],
    "potentials": ["check", "systems/gay_berne.toml"],
    "studies": ["sweep", "systems/water.toml"],
    "view": ["report", "run"],
}


def without(folder, *hidden):
    """A copy of the package by links, without some features. Returns its folder."""
    (folder / "rigidmd" / "features").mkdir(parents=True)
    (folder / "systems").symlink_to(ROOT / "systems")
    for path in (ROOT / "rigidmd").iterdir():
        if path.name not in ("features", "__pycache__"):
            (folder / "rigidmd" / path.name).symlink_to(path)
    for path in (ROOT / "rigidmd" / "features").iterdir():
        if path.name not in ("__pycache__", *hidden):
            (folder / "rigidmd" / "features" / path.name).symlink_to(path)
    return folder


def run(folder, *words):
    """Exit code and output of a command in that folder."""
    done = subprocess.run(
        [sys.executable, "-m", "rigidmd", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout


def test_the_list_names_folders_their_needs_and_their_methods():
    folders = {path.parent.name for path in (ROOT / "rigidmd" / "features").glob("*/__init__.py")}
    assert set(NAMES) == folders
    assert len(NAMES) == len(folders)
    for row in FEATURES:
        assert {*row.needs} <= {*NAMES} - {row.name}
        assert row.summary
        if (folder := ROOT / "rigidmd" / "features" / row.name).joinpath("feature.py").is_file():
            feature = row.load()
            ours = {name for name in vars(type(feature)) if not name.startswith("_")}
            assert ours <= {*vars(Feature), *row.provides}, "the core does not call it"
        commands = folder / "commands"
        assert {*row.commands} == {path.stem for path in commands.glob("[a-z]*.py")}


@pytest.mark.parametrize("name", NEEDING)
def test_what_needs_an_absent_feature_names_it(name, tmp_path):
    folder = without(tmp_path, name)
    (folder / "run").mkdir()
    code, text = run(folder, *NEEDING[name])
    assert code == 2, text
    assert len(text.splitlines()) == 1, text
    assert f"needs the feature {name} (" in text


def test_water_is_checked_without_any_feature(tmp_path):
    folder = without(tmp_path, *NAMES)
    code, text = run(folder, "check", *WATER)
    assert code == 0, text
    code, text = run(folder, "--help")
    assert code == 0
    commands = {command for row in FEATURES for command in row.commands}
    assert not [line for line in text.splitlines() if line.split()[:1] in [[c] for c in commands]]


@pytest.mark.extended
@pytest.mark.parametrize("name", [*NAMES, "all"])
def test_water_runs_without_a_feature(name, tmp_path):
    folder = without(tmp_path, *(NAMES if name == "all" else [name]))
    code, text = run(folder, "run", *WATER, "-o", "run")
    assert code == 0, text
    assert (folder / "run" / "summary.json").is_file()
