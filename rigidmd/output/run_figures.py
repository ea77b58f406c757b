"""The figures of a run in memory: what energy.png and the figures of a body are drawn from."""

from typing import TYPE_CHECKING, Any

import numpy as np

from rigidmd.assemble.body import BodySystem
from rigidmd.assemble.system import System
from rigidmd.forces.body.frame import Inertial
from rigidmd.measure.motion import Motion, drawn_axis
from rigidmd.measure.samples import Samples, moving
from rigidmd.mechanics.rotor import SplitRotor
from rigidmd.output.body_figures import motion_figures
from rigidmd.output.report import energy_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def run_figures(system: System | BodySystem, samples: Samples | Motion, summary: dict[str, Any]) -> "dict[str, Figure]":
    """The figures of a run by the names of their files; those that there are samples for."""
    if isinstance(system, BodySystem):
        return body_figures(system, samples) if isinstance(samples, Motion) else {}
    if isinstance(samples, Samples) and moving(system.scene.stages, samples["stage"]).sum() > 1:
        return {"energy": energy_figure(system, samples, summary)}
    return {}


def body_figures(system: BodySystem, samples: Motion) -> "dict[str, Figure]":
    """Figures of the axis, angles, omega, path and errors; none of fewer than three samples."""
    if len(samples) <= 2:
        return {}
    columns = dict(samples.columns)
    if system.turns:  # omega along the principal axes, where it lies on ellipsoids
        omega = np.stack([samples[f"omega_body_{k}"] for k in (1, 2, 3)], axis=-1) @ system.axes
        columns |= {f"omega_body_{k + 1}": omega[:, k] for k in range(3)}
    gravity = system.scene.gravity and system.scene.gravity.acceleration_m_s2
    return motion_figures(
        system.scene.name,
        columns=columns,
        axis_body=drawn_axis(system),
        inertia=system.inertia if _keeps_its_ellipsoids(system, samples) else None,
        invariants=samples.invariants,
        gravity=None if gravity is None else np.array(gravity),
        flies=system.flies,
    )


def _keeps_its_ellipsoids(system: BodySystem, samples: Motion) -> bool:
    """Whether the inertia is constant, the frame does not turn, and |L| is conserved: no torque acts."""
    steady = isinstance(system.body.rotor, SplitRotor) and isinstance(system.body.frame, Inertial)
    return steady and "L_size" in samples.invariants
