"""Runs that are stopped, resumed, and compared with one that was not."""

import os
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

import rigidmd
from rigidmd import Scene
from rigidmd.run import Simulation


def stopped_at(steps: set[int]) -> "rigidmd.Every":
    """An observer that sends SIGTERM to this process after some of the steps of a run."""

    def stop(moment):
        if moment.step in steps:
            steps.discard(moment.step)
            os.kill(os.getpid(), signal.SIGTERM)

    return rigidmd.Every(0.001, stop)


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a run that have to be the same to the bit."""
    names = [
        path.name
        for path in folder.iterdir()
        if path.name.startswith(("trajectory", "log", "topology", "motion", "pressure_tensor"))
    ]
    found = {name: (folder / name).read_bytes() for name in names}
    if (folder / "final.npz").exists():
        with np.load(folder / "final.npz") as data:
            found |= {name: data[name].tobytes() for name in data.files}
    return found


def same_after_stops(data: dict, steps: list[int], folder: Path) -> None:
    """Run once without a stop, once with stops after these steps, each time with another number of
    threads."""
    observers = rigidmd.Every(
        0.001, lambda moment: None
    )  # observes at the same steps as those that stop
    rigidmd.Simulation(
        Scene.from_dict(data | {"threads": 1}), folder / "whole", observers=observers
    ).run()
    left, runs = set(steps), 0
    while True:
        simulation = rigidmd.Simulation(
            Scene.from_dict(data | {"threads": 1 + runs % 2}),
            folder / "parts",
            observers=stopped_at(left),
            resume=True,
        )
        results = simulation.run()
        runs += 1
        if not results.interrupted:
            break
        assert results.signal == signal.SIGTERM
    assert runs == len(steps) + 1
    whole, parts = contents(folder / "whole"), contents(folder / "parts")
    assert whole.keys() == parts.keys() and len(whole) > 3
    assert [name for name in whole if whole[name] != parts[name]] == []


TOP = {
    "body": {
        "mass_kg": 0.15,
        "inertia_kg_m2": [3e-4, 3.1e-4, 1.2e-4],
        "pinned": True,
        "inertia_about": "pivot",
        "centre_of_mass_m": [0.0, 0.0, 0.04],
    },
    "gravity": {},
    "start": {"euler_angles_deg": [0.0, 40.0, 0.0], "euler_rates_rad_s": [0.0, 0.0, 60.0]},
    "run": {"duration_s": 0.5, "timestep_s": 0.005},
    "output": {"interval_s": 0.02, "figures": False},
}


def top(integrator: str) -> dict:
    """A heavy top."""
    return TOP | {"run": TOP["run"] | {"integrator": integrator}}


@pytest.fixture(scope="session")
def stopped(tmp_path_factory):
    """A run that was stopped after 60 of 100 steps, with checkpoints at 0 and 60: its folder, its
    scene."""
    folder = tmp_path_factory.mktemp("stopped")
    (folder / "water.toml").write_text(
        "[box]\ndensity_g_cm3 = 0.9\n[[molecules]]\nmodel = 'spce'\ncount = 40\n"
        "[forces]\ncutoff_A = 5.0\ntruncation = 'smooth_switch'\npme_order = 6\n"
        "[start]\ntemperature_K = 298.0\n"
        "[[stages]]\nensemble = 'nvt'\ntemperature_K = 298.0\nduration_ps = 0.1\ntimestep_fs = 1.0\n"
        "[output]\nlog_interval_ps = 0.01\ntrajectory_interval_ps = 0.02\nfigures = false\n"
    )
    own = Scene.read(folder / "water.toml", {"threads": 1})
    Simulation(own, folder / "run", observers=stopped_at({60})).run()
    return folder


@pytest.fixture
def again(stopped, tmp_path):
    """A copy of it."""
    shutil.copytree(stopped, tmp_path / "copy")
    return tmp_path / "copy"


def everything(folder: Path) -> dict[str, object]:
    """All that is in a folder: bytes of files, targets of links."""
    found = {path.name: path for path in sorted(folder.iterdir()) if path.name != ".rigidmd-lock"}
    return {
        name: os.readlink(path)
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else path.stat().st_mode
        for name, path in found.items()
    }


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
