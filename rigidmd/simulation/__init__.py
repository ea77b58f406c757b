"""The loop between observations, for molecules and for a single body: everything from a scene to its results."""

from rigidmd.simulation.body import BodySimulation
from rigidmd.simulation.loop import Every, Moment, Results, Simulation
from rigidmd.simulation.molecules import MolecularSimulation

__all__ = ["BodySimulation", "Every", "MolecularSimulation", "Moment", "Results", "Simulation"]
