"""Short runs that pages and animations show."""

import pytest
from support.common import ROOT
from support.pages import SHORT_WATER

from rigidmd import Scene, Simulation


@pytest.fixture(scope="session")
def top(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "top"
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.5, "output.figures": False}
    )
    Simulation(scene, folder).run()
    return folder


@pytest.fixture(scope="session")
def water(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "water"
    Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT_WATER), folder).run()
    return folder
