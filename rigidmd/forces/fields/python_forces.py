"""Forces on molecules that Python computes, and the compiled loop asks for."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import NEEDS_PYTHON_FORCES, OK, TALLY_SIZE, State
from rigidmd.forces.terms import Setup, add_forces


class PythonForces(NamedTuple):
    """Forces from a Python function, which the engine holds."""

    molecules: int
    turns: bool  # whether molecules turn
    changes_momentum: np.ndarray  # (3,) components of the total momentum that they may change
    tied_to_places: bool  # the energy depends on places in the lab

    def workspace(self, setup: Setup) -> "PythonForcesWorkspace":
        """Room for the values."""
        n = self.molecules
        return PythonForcesWorkspace(
            np.zeros(1, np.int64), np.zeros((n, 3)), np.zeros((n if self.turns else 0, 3)), np.zeros(TALLY_SIZE)
        )


class PythonForcesWorkspace(NamedTuple):
    """Workspace of a `PythonForces`; it asks for new values whenever positions have changed."""

    fresh: np.ndarray  # (1,) 1 if the values are those of the present moment
    force: np.ndarray  # (n, 3) lab, u Å/ps²
    torque_body: np.ndarray  # (n, 3), u Å²/ps²
    tally: np.ndarray  # (10,) energy and molecular virial

    def update(self, function: Callable[["PythonForcesWorkspace", State], None], state: State) -> None:
        """Let a function fill in the forces at a state."""
        function(self, state)


@implements(add_forces, PythonForcesWorkspace)
def _add_python_forces(term, state, load, tally):
    if term.fresh[0] == 0:
        return NEEDS_PYTHON_FORCES
    term.fresh[0] = 0
    for m in range(len(term.force)):
        for k in range(3):
            load.force[m, k] += term.force[m, k]
    for m in range(len(term.torque_body)):
        for k in range(3):
            load.torque_body[m, k] += term.torque_body[m, k]
    if tally is not None:
        for k in range(len(tally)):
            tally[k] += term.tally[k]
    return OK
