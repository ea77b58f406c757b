"""Runs of molecules and single bodies, from a scene to its results."""

from rigidmd.run.observers import Every, Moment, Observer
from rigidmd.run.results import Results
from rigidmd.run.simulation import Simulation, run_together

__all__ = ["Every", "Moment", "Observer", "Results", "Simulation", "run_together"]
