"""A run of 40 waters and its last state as atoms of ASE."""

import pytest
from ase import Atoms
from support.ase_atoms import NVE, OUTPUT
from support.scenes import forty_waters

from rigidmd import Scene, Simulation


@pytest.fixture(scope="session")
def results():
    """A run of 40 waters without files."""
    return Simulation(Scene.from_dict(forty_waters(NVE, output=OUTPUT))).run()


@pytest.fixture(scope="session")
def waters(results) -> Atoms:
    """Its last state."""
    return results.atoms()
