"""The loop between observations, for molecules and for a single body: everything from a scene to its results."""

from rigidmd.run.body import BodySimulation
from rigidmd.run.loop import Every, Moment, Results, Simulation
from rigidmd.run.molecules import MolecularSimulation

__all__ = ["BodySimulation", "Every", "MolecularSimulation", "Moment", "Results", "Simulation"]
