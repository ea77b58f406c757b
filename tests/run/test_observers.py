"""Observers of a run: what they are given, and errors in them."""

import json
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT, same_bits, small_scene

import rigidmd
from rigidmd.errors import OutputError, RigidMDWarning
from rigidmd.features.bodies.figures import FIGURES
from rigidmd.features.view.figures import style
from rigidmd.run import Every, Observer, Simulation
from rigidmd.scene import Scene


def arrays_of(moment):
    """All arrays that a moment gives."""
    seen = moment.observation
    fields = seen if isinstance(seen, tuple) else vars(seen).values()
    lazy = [getattr(seen, name, None) for name in ("force", "torque_body", "momentum")]
    given = [moment.site_positions, *moment.state, *fields, *lazy]
    return [part for part in given if isinstance(part, np.ndarray)]


def test_what_an_observer_keeps_does_not_change(scene_of_both):
    kept, copies = [], []

    def observe(moment):
        kept.append(arrays_of(moment))
        copies.append([part.copy() for part in kept[-1]])

    Simulation(scene_of_both[1], observers=Every(0.002, observe), warn=str).run()
    assert len(kept) > 2
    for now, then in zip(kept, copies, strict=True):
        assert same_bits(now, then)
    assert any(
        not np.array_equal(first, last) for first, last in zip(copies[0], copies[-1], strict=True)
    )


def test_results_are_a_mapping_of_their_columns(scene_of_both):
    results = Simulation(scene_of_both[1], warn=str).run()
    assert "energy" in results
    assert "enthalpy" not in results
    assert list(results) == list(results.units)
    assert all(len(results[name]) == len(results.samples) for name in results)


def test_observers_cannot_write_to_the_state():
    def meddle(moment):
        moment.state.position[:] = 0

    with pytest.raises(ValueError, match="read-only"):
        Simulation(
            small_scene({"argon": 10}, 20.0), observers=[Every(0.002, meddle)], warn=str
        ).run()


class Failing(Observer):
    """An observer whose method of this name fails, and a picture if it draws."""

    ends = True
    interval = 0.002

    def __init__(self, method, draws=False):
        self.draws = draws
        setattr(self, method, self.fail)

    def fail(self, *given):
        if not (isinstance(given[0], rigidmd.Moment) and given[0].step < 2):
            raise ValueError("it does not work")


class FailingTwice(Failing):
    """One whose file cannot be closed either."""

    def close(self):
        raise OutputError("the disk is full")


FILES_OF = {
    "argon": {
        "scene.toml",
        "topology.gro",
        "trajectory.xtc",
        "log.csv",
        "final.npz",
        "energy.png",
        "summary.json",
    },
    "top": {
        "scene.toml",
        "topology.pdb",
        "trajectory.xtc",
        "motion.csv",
        "motion.npz",
        "axis.png",
        "summary.json",
    },
}


@pytest.fixture(params=["argon", "top"])
def scene_of_both(request):
    if request.param == "argon":
        return "argon", small_scene(
            {"argon": 10},
            20.0,
            stages=[{"duration_ps": 0.01}],
            output={"log_interval_ps": 0.002, "figures": True},
        )
    changed = {"run.duration_s": 0.05, "output.npz": True, "output.interval_s": 0.001}
    return "top", Scene.read(ROOT / "systems" / "heavy_top_3.toml", changed)


@pytest.mark.parametrize("method", ["observe", "end"])
def test_an_observer_that_fails_costs_no_file_of_another(tmp_path, scene_of_both, method):
    kind, scene = scene_of_both
    seen = []
    others = [Every(0.002, seen.append), Failing(method), Every(0.002, seen.append)]
    with pytest.warns(RigidMDWarning, match="Failing failed at .* it does not work"):
        run = Simulation(scene, tmp_path / "out", observers=others)
        with pytest.raises(ValueError, match="it does not work"):
            run.run()
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there >= FILES_OF[kind]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["interrupted"] == (method == "observe")
    assert sum("Failing failed at" in note for note in summary["notes"]) == 1
    assert {Path(name).name for name in summary["files"]} <= there
    assert seen[-1].step == seen[-2].step  # also those after it saw the moment
    again = Simulation(
        scene, tmp_path / "out", observers=[Every(0.002, seen.append)] * 3, resume=True, warn=str
    )
    if method == "observe" and kind == "argon":
        assert not again.run().interrupted


def test_an_error_is_not_hidden_by_those_that_follow_from_it(tmp_path, scene_of_both):
    run = Simulation(
        scene_of_both[1], tmp_path / "out", observers=[FailingTwice("observe")], warn=str
    )
    with pytest.raises(ValueError, match="it does not work"):
        run.run()


def test_a_picture_that_fails_is_a_note(tmp_path, scene_of_both, monkeypatch):
    kind, scene = scene_of_both

    def fail(*given, **options):
        raise ValueError("ParseException: no mathematics")

    monkeypatch.setattr(style, "save_files", fail)
    pictures = [Failing("observe", draws=True), Failing("end", draws=True)]
    notes = []
    results = Simulation(scene, tmp_path / "out", observers=pictures, warn=notes.append).run()
    assert not results.interrupted
    assert [note.split(" cannot be drawn: ValueError: ") for note in notes] == [
        ["Failing", "it does not work"],
        [
            {"argon": "energy.png"}.get(
                kind, ", ".join(f"{stem}.png, {stem}.svg" for stem in FIGURES)
            ),
            "ParseException: no mathematics",
        ],
        ["Failing", "it does not work"],
    ]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["notes"][-3:] == notes == results.summary["notes"][-3:]
    there = {path.name for path in (tmp_path / "out").iterdir()}
    assert there >= {name for name in FILES_OF[kind] if not name.endswith(".png")}
    assert [path for path in results.files if not path.is_file()] == []


def test_one_figure_of_a_body_that_fails_leaves_the_others(tmp_path, monkeypatch):
    def fails_first(figure, stem, suffixes, write=style.save_files):
        if stem.name == "axis":
            raise ValueError("no axis")
        return write(figure, stem, suffixes)

    monkeypatch.setattr(style, "save_files", fails_first)
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.05, "output.interval_s": 0.001}
    )
    results = Simulation(scene, tmp_path / "out", warn=str).run()
    assert {path.name for path in results.files} >= {"angles.png", "omega.png", "summary.json"}
    assert "no axis" in results.summary["notes"][-1]


def test_a_name_in_a_figure_costs_no_summary(tmp_path):
    stages = [{"name": "$`$", "duration_ps": 0.01}]
    scene = small_scene({"argon": 10}, 20.0, stages=stages, output={"log_interval_ps": 0.002})
    Simulation(scene, tmp_path / "out", warn=str).run()
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["stages"][0]["name"] == "$`$"
