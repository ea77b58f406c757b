"""The rotation of a single body, whose inertia may change and which may carry wheels."""

from typing import NamedTuple

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.core.state import NOW, WORK
from rigidmd.features.bodies.time_functions import TimeFunction, rate, value
from rigidmd.mechanics.free_rotor import NoRotor, rotate, rotate_about_axes


class DrivenRotor(NamedTuple):
    """A single body with wheels or a changing inertia, with L = I(t) omega + h(t): see the theory
    chapter `bodies`. I and h are evaluated at the middle of each time interval. The changes of H
    with them are computed exactly, as work done on the body."""

    inertia: TimeFunction
    momentum: TimeFunction


@chosen_by_type(inline=True)
def rotate_body(rotor, state, time, h):
    """Rotate a single body freely from `time` to time + h, in place."""
    if not is_a(rotor, DrivenRotor):
        return lambda rotor, state, time, h: rotate(
            rotor, 0, state.rotation, state.angular_momentum_body, 0, h
        )

    def rotate_driven(rotor, state, time, h):
        L = state.angular_momentum_body
        before = driven_energy(rotor, L, time)
        middle = time + 0.5 * h
        inverse, offset = all_moments(rotor, middle)
        state.energy_ledger[WORK] += driven_energy(rotor, L, middle) - before
        rotate_about_axes(state.rotation, L, 0, (0, 1, 2), inverse, offset, h)
        state.energy_ledger[WORK] += driven_energy(rotor, L, time + h) - driven_energy(
            rotor, L, middle
        )

    return rotate_driven


@kernel
def driven_energy(rotor, angular_momentum_body, time):
    """sum (L_k - h_k)²/(2 I_k) at a time."""
    energy = 0.0
    for k in range(3):
        L = angular_momentum_body[0, k] - value(rotor.momentum, time, k)
        energy += 0.5 * L * L / value(rotor.inertia, time, k)
    return energy


@chosen_by_type(inline=True)
def moments(rotor, time, k):
    """(1/I_k, h_k) of a single body's rotor at a time, 1/I_k is 0 for an axis without inertia."""
    if is_a(rotor, DrivenRotor):
        return lambda rotor, time, k: (
            1 / value(rotor.inertia, time, k),
            value(rotor.momentum, time, k),
        )
    if is_a(rotor, NoRotor):
        return lambda rotor, time, k: (0.0, 0.0)
    return lambda rotor, time, k: (rotor.inverse_inertia[0, k], 0.0)


@kernel(inline=True)
def all_moments(rotor, time):
    """`moments` of all axes: 1/I (3,) and h (3,) as tuples."""
    i0, h0 = moments(rotor, time, 0)
    i1, h1 = moments(rotor, time, 1)
    i2, h2 = moments(rotor, time, 2)
    return (i0, i1, i2), (h0, h1, h2)


@kernel(inline=True)
def omega_in_frame(rotor, state, frame_body):
    """Angular velocity along the body axes relative to a frame, whose rate is `frame_body` along
    them, as a tuple."""
    L = state.angular_momentum_body[0]
    i, h = all_moments(rotor, state.time[NOW])
    return (
        (L[0] - h[0]) * i[0] - frame_body[0],
        (L[1] - h[1]) * i[1] - frame_body[1],
        (L[2] - h[2]) * i[2] - frame_body[2],
    )


@chosen_by_type(inline=True)
def moment_rates(rotor, time, k):
    """(I_k, I_k', h_k, h_k') of a single body's rotor at a time."""
    if is_a(rotor, DrivenRotor):

        def driven(rotor, time, k):
            inertia, carried = rotor.inertia, rotor.momentum
            return (
                value(inertia, time, k),
                rate(inertia, time, k),
                value(carried, time, k),
                rate(carried, time, k),
            )

        return driven

    def constant(rotor, time, k):
        inverse, carried = moments(rotor, time, k)
        return (1 / inverse if inverse > 0 else 0.0), 0.0, carried, 0.0

    return constant
