"""Barostats in scenes: boxes that cannot change, compressibilities, pressures by component."""

import numpy as np
import pytest
from support.common import small_scene

from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.errors import SceneError
from rigidmd.units import BAR

NPT = {"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0, "duration_ps": 0.1}


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"box": {"lengths_A": 30.0, "periodic": False}}, "box.periodic is false"),
        (
            {
                "molecules": [
                    {"model": "argon", "count": 9},
                    {"model": "krypton", "count": 9, "frozen": True},
                ]
            },
            "frozen",
        ),
    ],
)
def test_scenes_without_a_box_to_change(scene, message):
    with pytest.raises(SceneError, match=message):
        small_scene({"argon": 20}, 30.0, **({"stages": [NPT]} | scene))


def test_a_compressibility_in_another_unit_is_reported():
    scene = small_scene({"argon": 20}, 30.0, stages=[NPT | {"compressibility_per_bar": 4.5e-10}])
    assert any("another unit" in note for note in build(scene).notes)
    assert not any(
        "another unit" in note
        for note in build(small_scene({"argon": 20}, 30.0, stages=[NPT])).notes
    )


def test_pressures_become_components():
    stage = NPT | {"pressure_coupling": "flexible", "pressure_bar": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]}
    run = {"remove_momentum_interval_ps": False}
    system = build(small_scene({"argon": 20}, 30.0, stages=[stage], run=run))
    box = integrator_of_stage(system, 0).barostat
    assert box.pressure.first == pytest.approx(np.arange(1, 7) * BAR)
    assert integrator_of_stage(system, 0).flows[-1].every == 25
