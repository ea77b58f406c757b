"""Runs that are stopped, resumed, and compared with one that was not."""

import os
import signal
from pathlib import Path

import numpy as np

import rigidmd
from rigidmd import Scene


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
