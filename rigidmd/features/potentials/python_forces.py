"""Forces on molecules that a Python function computes when the compiled step loop requests them."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.state import NEEDS_PYTHON_FORCES, OK, TALLY_SIZE, State
from rigidmd.forces.terms import Setup, add_forces


class PythonForces(NamedTuple):
    """Forces from a Python function, which the engine calls."""

    molecules: int
    turns: bool  # whether molecules rotate
    changes_momentum: np.ndarray  # (3,) components of the total momentum that they may change
    absolute_positions: bool  # whether the energy depends on positions in the lab

    def workspace(self, setup: Setup) -> "PythonForcesWorkspace":
        n = self.molecules
        return PythonForcesWorkspace(
            np.zeros(1, np.int64),
            np.zeros((n, 3)),
            np.zeros((n if self.turns else 0, 3)),
            np.zeros(TALLY_SIZE),
        )


class PythonForcesWorkspace(NamedTuple):
    """Workspace of a `PythonForces`. It requests new values (NEEDS_PYTHON_FORCES) whenever
    positions have changed."""

    fresh: np.ndarray  # (1,) 1 if the values are those at the current positions
    force: np.ndarray  # (n, 3) lab, u Å/ps²
    torque_body: np.ndarray  # (n, 3), u Å²/ps²
    tally: np.ndarray  # (10,) energy and molecular virial

    def update(
        self, function: Callable[["PythonForcesWorkspace", State], None], state: State
    ) -> None:
        """Let a function write the forces at a state into this workspace."""
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
