"""Strength of the kicks in the next step of molecules."""

import numpy as np

from rigidmd.core.state import Load
from rigidmd.dynamics.advance import Model


def kicks(model: Model, load: Load, thermal: float, dt: float) -> np.ndarray:
    """Largest kick of each molecule (n,) in a step, relative to the thermal size of that momentum.

    A kick F dt beyond sqrt(m kT), or n dt beyond sqrt(I kT), comes from an overlap, not from a liquid. The measure is
    relative to the scene's own masses, temperature and time step.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        found = np.abs(load.force).max(axis=1) * dt * np.sqrt(model.inverse_mass[model.species] / thermal)
        turn = np.abs(load.torque_body) * dt / np.sqrt(model.inertia[model.species] * thermal)[: len(load.torque_body)]
    turn = np.where((model.inertia[model.species] > 0)[: len(turn)], turn, 0.0)
    found[: len(turn)] = np.maximum(found[: len(turn)], turn.max(axis=1, initial=0.0))
    return found
