"""The longest stable time step of a body, estimated from its swing and its spin at the start."""

from math import inf, sqrt

import numpy as np

from rigidmd.assemble.harmonic import INACCURATE, round_steps, stable_angle, step_error
from rigidmd.core.integrators import Scheme
from rigidmd.features.bodies.system import BodySystem
from rigidmd.mechanics.free_rotor import SplitRotor


def stable_step(system: BodySystem) -> float | None:
    """The longest stable step (s) at the start. None for a body at rest, for solvers that choose
    their own steps, or if the scene does not want it."""
    rate, angle = fastest_rate(system), stable_angle(system.method)
    return angle / rate if system.scene.watch.stable_step and rate > 0 and angle < inf else None


def step_errors(system: BodySystem) -> list[str]:
    """Errors of a step that is unstable for the motion of a body at its start."""
    run, longest = system.scene.run, stable_step(system)
    if longest is None or run.timestep_s <= longest:
        return []
    return [
        f"run: timestep_s = {run.timestep_s:g} is unstable: {_moves(system)}, which"
        f" {run.integrator} can follow up to {longest:.3g} s. Use"
        f" {round_steps(longest)[0]:g} s or less"
    ]


def step_warnings(system: BodySystem) -> list[str]:
    """Warnings of a stable step that is inaccurate for the motion of a body at its start."""
    run, method, longest = system.scene.run, system.method, stable_step(system)
    if longest is None or run.timestep_s > longest or not isinstance(method, Scheme):
        return []
    error = step_error(method, fastest_rate(system) * run.timestep_s)
    if error <= INACCURATE:
        return []
    return [
        f"run: timestep_s = {run.timestep_s:g} is inaccurate: {_moves(system)}, which"
        f" {run.integrator} follows as if its torques were wrong by {error:.0%}"
    ]


def _moves(system: BodySystem) -> str:
    return f"at its start the body swings or spins at {fastest_rate(system):.3g} rad/s"


def fastest_rate(system: BodySystem) -> float:
    """The fastest rate (rad/s) that a body's steps have to resolve at its start: swing under its
    weight, or spin.

    The exact rotor is exact for a free body at any spin, the split rotor only for a symmetric body.
    With a weight on the axis of symmetry only the nutation has to be resolved. With general
    solvers, the whole spin.
    """
    if not system.rotates:
        return 0.0
    inertia, momentum = system.inertia, system.state.angular_momentum_body[0]
    weights = system.steady_forces
    stiffness, spins = np.zeros(3), np.divide(momentum, inertia, out=np.zeros(3), where=inertia > 0)
    for term in weights:
        arms = np.sqrt(np.maximum(term.point @ term.point - term.point**2, 0.0))
        stiffness += np.linalg.norm(term.force) * np.divide(
            arms, inertia, out=np.zeros(3), where=inertia > 0
        )
    method = system.method
    flows = isinstance(method, Scheme)
    followed = not flows or isinstance(system.engine().model_for(method).rotor, SplitRotor)
    for k in range(3) if flows else ():
        i, j = (k + 1) % 3, (k + 2) % 3
        if inertia[i] == inertia[j] > 0 and len(weights) == len(system.terms) and not stiffness[k]:
            followed = False
            spins = momentum / inertia[i]
    followed = followed or stiffness.any() or len(weights) < len(system.terms)
    return max(sqrt(stiffness.max()), float(np.linalg.norm(spins)) if followed else 0.0)
