"""The longest stable time step of a body, estimated from its swing and its spin at the start."""

from math import inf, sqrt

import numpy as np

from rigidmd.assemble.harmonic import INACCURATE, stable_angle, step_error
from rigidmd.core.integrators import Scheme
from rigidmd.features.bodies.system import BodySystem
from rigidmd.mechanics.free_rotor import SplitRotor


def stable_step(system: BodySystem) -> float | None:
    """The longest stable step (s) at the start. None for a body at rest, for solvers that choose
    their own steps, or if the scene does not want it."""
    rate, angle = fastest_rate(system), stable_angle(system.method)
    return angle / rate if system.scene.watch.stable_step and rate > 0 and angle < inf else None


def step_warnings(system: BodySystem) -> list[str]:
    """Warnings of a step that is unstable or inaccurate for the motion of a body at its start."""
    run, method = system.scene.run, system.method
    longest = stable_step(system)
    if longest is None:
        return []
    rate = fastest_rate(system)
    moves = f"at its start the body swings or spins at {rate:.3g} rad/s"
    if run.timestep_s > longest:
        follows = f"which {run.integrator} can follow up to {longest:.3g} s"
        return [
            f"timestep_s = {run.timestep_s:g} is longer than what is stable: {moves}, {follows}"
        ]
    error = step_error(method, rate * run.timestep_s) if isinstance(method, Scheme) else 0.0
    if error > INACCURATE:
        what = f"as if its torques were wrong by {error:.0%}"
        return [
            f"timestep_s = {run.timestep_s:g} is inaccurate: {moves}, which {run.integrator}"
            f" follows {what}"
        ]
    return []


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
