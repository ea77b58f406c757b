"""Kicks by the force and its gradient, for schemes of order 4 without negative steps (Takahashi &
Imada 1984; Chin 1997). The derivative is a difference of two force evaluations: see "Force
gradients" in the theory chapter `dynamics`.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.state import NEEDS_PYTHON_FORCES, OK, Load, State, no_load
from rigidmd.forces.terms import FORCES_ONLY, INTO_OTHER_LOAD, compute_load, copy

#: The difference is taken over this fraction of tau a. Over the whole of tau a (Wisdom, Holman &
#: Touma 1996), the kick is not the gradient of a potential at order tau². With this fraction that
#: error is below the error of the scheme, and rounding is still below 1e-13 of the force.
FRACTION = 1 / 256


class GradientWorkspace(NamedTuple):
    """Arrays for kicks with gradient, and for forces at displaced positions."""

    position: np.ndarray  # to restore, as in State
    rotation: np.ndarray
    load: Load  # forces and torques with their gradient
    tau: np.ndarray  # (1,) the time squared of the gradient in `load`
    # (1,) whether the state is displaced: it waits for forces of a Python function
    is_displaced: np.ndarray


def gradient_workspace(state: State) -> GradientWorkspace:
    """Arrays for the force gradient at a state."""
    return GradientWorkspace(
        np.empty_like(state.position),
        np.empty_like(state.rotation),
        no_load(state),
        np.zeros(1),
        np.zeros(1, np.int64),
    )


def displace(model, state, load, tau):
    """Move every body by tau F/m and rotate it by tau I^-1 n_body, in place."""
    raise TypeError("compiled code only")


def add_gyration(model, load, tau, gain):
    """Add tau (I^-1 n_body) x n_body to the torques in `gain`, with n_body the torques in
    `load`."""
    raise TypeError("compiled code only")


@kernel
def evaluate(model, state, load, terms, gradient, tau, known):
    """One evaluation of forces: the load, or, if this is known, the load with gradient. A status
    code. One function does both, because the forces take long to compile. The state is restored bit
    for bit, after a call of Python functions by the call that follows it."""
    if known and gradient.is_displaced[0] == 0:
        copy(state.position, gradient.position)
        copy(state.rotation, gradient.rotation)
        displace(model, state, load, FRACTION * tau)
        gradient.is_displaced[0] = 1
    status = compute_load(
        terms, state, gradient.load if known else load, INTO_OTHER_LOAD if known else FORCES_ONLY
    )
    if known and status != NEEDS_PYTHON_FORCES:
        restore(gradient, state)
        if status == OK:
            add_gyration(model, load, FRACTION * tau, gradient.load)
            extrapolate(load.force, gradient.load.force)
            extrapolate(load.torque_body, gradient.load.torque_body)
            gradient.tau[0] = tau
    return status


@kernel(from_python=True)
def restore(gradient, state):
    """Move a displaced state back to its positions and orientations."""
    if gradient.is_displaced[0] != 0:
        copy(gradient.position, state.position)
        copy(gradient.rotation, state.rotation)
        gradient.is_displaced[0] = 0


@kernel
def extrapolate(value, elsewhere):
    """Extrapolate from `value` through `elsewhere`, at FRACTION of the distance, to the full
    distance. Into `elsewhere`."""
    for n, start in enumerate(value.flat):
        elsewhere.flat[n] = start + (elsewhere.flat[n] - start) / FRACTION
