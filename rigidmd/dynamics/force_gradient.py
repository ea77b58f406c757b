"""Kicks by the force and its gradient, for schemes of order 4 without negative steps (Takahashi &
Imada 1984; Chin 1997). The derivative is a difference of two force evaluations: see "Force
gradients" in the theory chapter `dynamics`.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.state import OK, Load, State, no_load
from rigidmd.forces.terms import FORCES_ONLY, INTO_OTHER_LOAD, compute_load, copy

#: The difference is taken over this fraction of tau a. Over the whole of tau a (Wisdom, Holman &
#: Touma 1996), the kick is not the gradient of a potential at order tau². With this fraction that
#: error is below the error of the scheme, and rounding is still below 1e-13 of the force.
FRACTION = 1 / 256


class GradientWorkspace(NamedTuple):
    """Arrays for forces at displaced positions."""

    position: np.ndarray  # to restore, as in State
    rotation: np.ndarray
    load: Load


def gradient_workspace(state: State) -> GradientWorkspace:
    return GradientWorkspace(
        np.empty_like(state.position), np.empty_like(state.rotation), no_load(state)
    )


def displace(model, state, load, tau):
    """Move every body by tau F/m and rotate it by tau I^-1 n_body, in place."""
    raise TypeError("compiled code only")


def add_gyration(model, load, tau, gain):
    """Add tau (I^-1 n_body) x n_body to the torques in `gain`, with n_body the torques in
    `load`."""
    raise TypeError("compiled code only")


@kernel
def evaluate(model, state, load, terms, displaced, tau, known):
    """One evaluation of forces: the load, or, if the load is known, the addition of the gradient to
    it. A status code. One function does both, because the forces take long to compile. The state is
    restored bit for bit."""
    if known:
        copy(state.position, displaced.position)
        copy(state.rotation, displaced.rotation)
        displace(model, state, load, FRACTION * tau)
    status = compute_load(
        terms, state, displaced.load if known else load, INTO_OTHER_LOAD if known else FORCES_ONLY
    )
    if known:
        copy(displaced.position, state.position)
        copy(displaced.rotation, state.rotation)
        if status == OK:
            add_gyration(model, load, FRACTION * tau, displaced.load)
            extrapolate(load.force, displaced.load.force)
            extrapolate(load.torque_body, displaced.load.torque_body)
    return status


@kernel
def extrapolate(value, elsewhere):
    """Extrapolate from `value` through `elsewhere`, at FRACTION of the distance, to the full
    distance. In place."""
    for n, there in enumerate(elsewhere.flat):
        value.flat[n] += (there - value.flat[n]) / FRACTION
