"""Stages of minimisation and their results."""

from rigidmd.core.state import State
from rigidmd.run import Simulation
from rigidmd.scene.models import load_model
from rigidmd.units import BOLTZMANN
from support.common import ROOT

WELL = 119.8 * BOLTZMANN  # of argon
#: Forces to about 1e-6 of those of a liquid.
TIGHT = {"force_limit_kJ_mol_A": 1e-5, "torque_limit_kJ_mol": 1e-5}


def stage_of(**keys) -> dict:
    return {"ensemble": "minimise"} | keys


def minimum_of(scene, state: State | None = None):
    """The results of a scene from a state, and the figures of its last stage's minimum."""
    simulation = Simulation(scene)
    if state is not None:
        simulation.start_from(state)
    results = simulation.run()
    return results, results.summary["stages"][-1]["minimum"]


#: Models whose charges have no repulsion of their own.
BARE = [
    name
    for name in sorted(path.stem for path in (ROOT / "rigidmd" / "models").glob("*.toml"))
    if ((load_model(name).charges != 0) & (load_model(name).epsilon == 0)).any()
]
