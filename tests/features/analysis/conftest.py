"""One run of water for the tests of analyses, which all read."""

import pytest
from support.analysis import SHORT
from support.common import ROOT

from rigidmd import Scene, Simulation


@pytest.fixture(scope="session")
def water(tmp_path_factory):
    """216 waters, 51 frames of 0.2 ps at constant energy."""
    folder = tmp_path_factory.mktemp("runs") / "water"
    Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT), folder).run()
    return folder
