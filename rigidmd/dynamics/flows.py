"""The flows of a scheme as arrays, for the loops over steps."""

from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import DRIFT, Scheme
from rigidmd.dynamics.registers import AFTER_BAROSTAT, FAILED

#: Steps between two corrections of the rounding errors of QᵀQ. They would grow, and with them the
#: error of the total torque: a step of two waters had one of 5e-14 of the forces after 1e3 steps
#: and 1e-12 after 5e5 steps, and their angular momentum drifted faster than a random walk.
ORTHOGONALITY_INTERVAL = 256


class FlowArrays(NamedTuple):
    """The flows of a scheme as arrays, in their order."""

    kind: np.ndarray  # (flows,) KICK, DRIFT, ..., see core.integrators
    fraction: np.ndarray  # (flows,) of the time step
    moment: np.ndarray  # (flows,) the sum of the fractions of the drifts up to each flow
    every: np.ndarray  # (flows,) the interval in steps at which the flow acts,
    phase: np.ndarray  # (flows,) at its start, 0, or at its end, 1
    row: np.ndarray  # (flows,) of its pass, see `coupling_passes`; -1 for kicks and drifts
    gradient: np.ndarray | None  # (flows,) of dt²; None (not compiled) where no kick has a gradient
    last: int  # index of the last drift
    trajectory: int  # steps of a trajectory of hybrid Monte Carlo, or 0
    tallies: int  # what a step with a barostat computes, see `barostats.needed_tallies`
    after_barostat: int  # row of the pass after a move of the box, or -1
    failed: int  # row of the pass after forces that failed, or -1


def flow_arrays(scheme: Scheme, rows: dict[int, int] | None = None, tallies: int = 0) -> FlowArrays:
    """rows : kind of a flow -> row of its pass; tallies : see `FlowArrays`"""
    rows = rows or {}
    kind = np.array([flow.kind for flow in scheme.flows])
    fraction = np.array([flow.fraction for flow in scheme.flows])
    moment = np.cumsum(np.where(kind == DRIFT, fraction, 0.0))
    last = int(np.flatnonzero(kind == DRIFT)[-1])
    moment[last:] = 1.0
    return FlowArrays(
        kind=kind,
        fraction=fraction,
        moment=moment,
        every=np.array([flow.every for flow in scheme.flows]),
        phase=np.array([flow.phase for flow in scheme.flows]),
        row=np.array([rows.get(flow.kind, -1) for flow in scheme.flows]),
        gradient=np.array([flow.gradient for flow in scheme.flows])
        if scheme.has_gradient
        else None,
        last=last,
        trajectory=scheme.trajectory_steps,
        tallies=tallies,
        after_barostat=rows.get(AFTER_BAROSTAT, -1),
        failed=rows.get(FAILED, -1),
    )
