"""The run time that `rigidmd check` expects."""

import pytest
from support.common import ROOT, small_scene

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe_system
from rigidmd.assemble.run_time import START_S, expected_seconds, in_words
from rigidmd.scene import Scene


def seconds(**changes) -> float:
    """Of the steps of the shipped water."""
    scene = Scene.read(ROOT / "systems" / "water.toml", {"threads": 1} | changes)
    expected = expected_seconds(build(scene))
    assert expected is not None
    return expected - START_S


def test_it_grows_with_steps_evaluations_precision_and_molecules():
    base = seconds()
    longer = seconds(**{"stages.production.duration_ps": 40.0})
    assert longer == pytest.approx(base * 42500 / 22500, rel=0.01)
    two_forces = seconds(**{"stages.production.integrator": "yoshida_4"})
    assert two_forces > 2 * base
    assert 1.6 < seconds(precision="double") / base < 2
    eight_times = {"molecules.0.count": 8 * 216}
    assert 6 < seconds(**eight_times) / base < 10


def test_molecules_without_a_box_cost_their_pairs():
    """A droplet has about the pairs of a box of its size, not none."""
    data = {"molecules": [{"model": "argon", "count": 500}], "start": {"temperature_K": 90.0}}
    stages = {"stages": [{"duration_ps": 1000.0, "timestep_fs": 5.0}], "threads": 1}
    stages["forces"] = {"cutoff_A": 9.0}
    droplet, box = (
        expected_seconds(build(Scene.from_dict(data | stages | {"box": each}))) - START_S
        for each in ({"lengths_A": 30.0, "periodic": False}, {"lengths_A": 30.0})
    )
    assert 0.3 < droplet / box < 1.5


def test_it_is_not_given_where_it_is_not_known():
    scene = Scene.read(ROOT / "systems" / "gay_berne.toml")
    system = build(scene)
    assert expected_seconds(system) is None
    assert "run time" not in describe_system(system)
    stages = [
        {"ensemble": "nve", "integrator": "auto", "duration_ps": 1.0, "trajectory_error": 1e-6}
    ]
    start = {"temperature_K": 90.0}
    chosen = small_scene({"argon": 20}, 20.0, stages=stages, start=start)
    assert expected_seconds(build(chosen)) is None


def test_it_follows_the_stages_in_the_report():
    text = describe_system(build(small_scene({"argon": 20}, 20.0)))
    stages = text.partition("stages:")[2].partition("\n\n")[0].splitlines()
    assert stages[-1].startswith("  run time: about 5 s on ")


@pytest.mark.parametrize(
    ("value", "expected"),
    [(5.2, "5 s"), (44.0, "40 s"), (200.0, "3 min"), (6000.0, "2 h"), (4e5, "5 days")],
)
def test_a_duration_has_one_digit(value, expected):
    assert in_words(value) == expected
