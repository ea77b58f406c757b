"""Timings of tests are short."""

import pytest
from support.common import small_scene

from rigidmd.features.studies.accuracy import measurement


@pytest.fixture(scope="module", autouse=True)
def short_timings():
    """Seconds of computing are not what most of these tests are about."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement, "TIMING_SECONDS", 0.002)
        yield


@pytest.fixture(scope="module")
def water():
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.5},
        {"duration_ps": 1.0, "timestep_fs": 1.0},
    ]
    forces = {"cutoff_A": 6.0, "truncation": "smooth_switch"}
    return small_scene({"spce": 64}, 12.42, forces=forces, stages=stages)
