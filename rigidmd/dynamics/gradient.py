"""Kicks by the force and its own gradient, for schemes of order 4 without steps back in time.

Such a kick is that of the potential U - (tau/2) [sum |F|²/m + sum n . I^-1 n] (Takahashi & Imada 1984; Chin 1997):

    F + tau (d F/d x) . a,    n_body + tau [(d n_body/d x) . a + (I^-1 n_body) x n_body]

where a moves every body along its own F/m and turns it along its own I^-1 n_body. The derivative along a is a
difference of two evaluations of the forces, not a formula: every law, list and field then has it. The second term of
the torque is there because turns do not commute: n_body is no gradient of coordinates.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.core.state import OK, Load, State, no_load
from rigidmd.forces.terms import load_bodies

#: The difference is taken over this fraction of tau a. Over the whole of it, as others do (Wisdom, Holman & Touma
#: 1996), the kick is no gradient of a potential in order tau²; this much smaller, that is below what is left of the
#: scheme's own error, and rounding still below 1e-13 of the force.
FRACTION = 1 / 256


class Probe(NamedTuple):
    """Room to look at forces elsewhere."""

    position: np.ndarray  # as in State
    rotation: np.ndarray
    load: Load


def probe_for(state: State) -> Probe:
    """Room for the bodies of a state."""
    return Probe(np.empty_like(state.position), np.empty_like(state.rotation), no_load(state))


def displace(model, state, load, tau):
    """Move every body by tau F/m and turn it by tau I^-1 n_body, in place."""
    raise TypeError("compiled code only")


def add_gyration(model, load, tau, gain):
    """Add tau (I^-1 n_body) x n_body of every body's torque in `load` to the torque in `gain`."""
    raise TypeError("compiled code only")


@kernel
def evaluate(model, state, load, terms, probe, tau, known):
    """One evaluation of forces: of the load, or where that is known, of what the gradient adds to it. A status code.

    A single place for both, because what is compiled here is large. The state comes back to the bit.
    """
    if known:
        copy(state.position, probe.position)
        copy(state.rotation, probe.rotation)
        displace(model, state, load, FRACTION * tau)
    status = load_bodies(terms, state, probe.load if known else load, None)
    if known:
        copy(probe.position, state.position)
        copy(probe.rotation, state.rotation)
        if status == OK:
            add_gyration(model, load, FRACTION * tau, probe.load)
            extrapolate(load.force, probe.load.force)
            extrapolate(load.torque_body, probe.load.torque_body)
    return status


@kernel
def copy(source, target):
    """target[:] = source; as a loop it compiles ten times faster."""
    for n, value in enumerate(source.flat):
        target.flat[n] = value


@kernel
def extrapolate(value, elsewhere):
    """Go on from `value` past `elsewhere`, which is a FRACTION of the way, in place."""
    for n, there in enumerate(elsewhere.flat):
        value.flat[n] += (there - value.flat[n]) / FRACTION
