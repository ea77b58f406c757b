"""Resistance: bearings, air and fluids that take energy from a single body, along and about its own axes.

The flow of resistance alone, everything else held, is solved exactly on each axis; it acts for half a step before and
half a step after the rest, which makes the step of order 2 and stable for any strength.
"""

from math import copysign, exp, expm1, pi, sqrt, tan, tanh
from typing import NamedTuple

import numpy as np

from rigidmd.forces.frame import frame_rate
from rigidmd.jit import implements, is_a, kernel
from rigidmd.mechanics.flight import Pinned, along, inertial_mass
from rigidmd.mechanics.rotor import NoRotor, moments


class NoResistance(NamedTuple):
    """Nothing is lost."""

    work: float = 0.0


class Resistance(NamedTuple):
    """Force -(linear v + quadratic |v| v) on each body axis, torque -(dry sign(w) + linear w + quadratic |w| w).

    v and w are relative to the frame. Dry friction is that of a bearing about a body axis under constant load.
    """

    linear: np.ndarray  # (3,)
    quadratic: np.ndarray  # (3,)
    rotation_dry: np.ndarray  # (3,)
    rotation_linear: np.ndarray  # (3,)
    rotation_quadratic: np.ndarray  # (3,)
    work: np.ndarray  # (1,) done on the body so far; not positive


def resist(resistance, flight, rotor, frame, state, time, h):
    """The flow of resistance alone over a time h, in place."""
    raise TypeError("compiled code only")


@implements(resist, inline=True)
def _resist(resistance, flight, rotor, frame, state, time, h):
    if is_a(resistance, NoResistance):
        return lambda resistance, flight, rotor, frame, state, time, h: None
    translates, turns = not is_a(flight, Pinned), not is_a(rotor, NoRotor)

    def slow_down(resistance, flight, rotor, frame, state, time, h):
        if translates:
            resistance.work[0] += slow_flight(resistance, flight, rotor, frame, state, time, h)
        if turns:
            resistance.work[0] += slow_spin(resistance, rotor, frame, state, time, h)

    return slow_down


@kernel(inline=True)
def slow_spin(resistance, rotor, frame, state, time, h):
    """Each L_k as resistance about axis k leaves it; the work done."""
    turning = frame_rate(frame, time)
    q = state.rotation[0]
    work = 0.0
    for k in range(3):
        inverse, carried = moments(rotor, time, k)
        if inverse > 0.0:
            own = state.angular_momentum_body[0, k] - carried
            dragged = q[0, k] * turning[0] + q[1, k] * turning[1] + q[2, k] * turning[2]
            before = own * inverse - dragged
            after = slowed(
                before,
                inverse * resistance.rotation_dry[k],
                inverse * resistance.rotation_linear[k],
                inverse * resistance.rotation_quadratic[k],
                h,
            )
            state.angular_momentum_body[0, k] = (after + dragged) / inverse + carried
            work += 0.5 * (after - before) * (after + before) / inverse
    return work


def slow_flight(resistance, flight, rotor, frame, state, time, h):
    """Each P_k as resistance along axis k leaves it; the work done."""
    raise TypeError("compiled code only")


@implements(slow_flight, inline=True)
def _slow_flight(resistance, flight, rotor, frame, state, time, h):
    turns = not is_a(rotor, NoRotor)

    def slow_flight(resistance, flight, rotor, frame, state, time, h):
        w = frame_rate(frame, time)
        x = state.position[0]
        v = state.velocity[0]
        dragged = (w[1] * x[2] - w[2] * x[1], w[2] * x[0] - w[0] * x[2], w[0] * x[1] - w[1] * x[0])
        work = 0.0
        for k in range(3):
            mass = inertial_mass(flight, k)
            if turns:
                q = state.rotation[0]
                before = flight.mass * along(q, v, k) / mass - along(q, dragged, k)
            else:
                before = v[k] - dragged[k]
            after = slowed(before, 0.0, resistance.linear[k] / mass, resistance.quadratic[k] / mass, h)
            work += 0.5 * mass * (after - before) * (after + before)
            gain = (after - before) * mass / flight.mass
            if turns:
                for i in range(3):  # along axis k only: what the other axes see stays as it was
                    v[i] += state.rotation[0, i, k] * gain
            else:
                v[k] += gain
        return work

    return slow_flight


@kernel
def slowed(speed, dry, linear, quadratic, h):
    """Solution after h of s' = -(dry sign(s) + linear s + quadratic |s| s), all rates per unit inertia, none negative.

    A Riccati equation with constant coefficients; dry friction brings it to rest in finite time, the others never.
    """
    s = abs(speed)
    if s == 0.0:
        return 0.0
    if dry == 0.0:
        decay = exp(-linear * h)
        reach = -expm1(-linear * h) / linear if linear > 0.0 else h
        return speed * decay / (1 + quadratic * s * reach)
    discriminant = linear * linear - 4 * quadratic * dry
    root = sqrt(abs(discriminant))
    if discriminant > 0.0:
        g = tanh(0.5 * root * h) / root
    elif discriminant < 0.0:
        if 0.5 * root * h >= 0.5 * pi:
            return 0.0
        g = tan(0.5 * root * h) / root
    else:
        g = 0.5 * h
    left = max(0.0, (s * (1 - linear * g) - 2 * dry * g) / (1 + (linear + 2 * quadratic * s) * g))
    return copysign(left, speed)


def braking(resistance, state, load, velocity, omega):
    """Add resistance to a load at a velocity (lab) and angular velocity (body), relative to the frame; its power."""
    raise TypeError("compiled code only")


@implements(braking)
def _braking(resistance, state, load, velocity, omega):
    if is_a(resistance, NoResistance):
        return lambda resistance, state, load, velocity, omega: 0.0

    def brake(resistance, state, load, velocity, omega):
        power = 0.0
        for m in range(len(load.force)):
            for k in range(3):
                if len(state.rotation):
                    q = state.rotation[m]
                    v = along(q, velocity, k)
                    f = -(resistance.linear[k] + resistance.quadratic[k] * abs(v)) * v
                    for i in range(3):
                        load.force[m, i] += q[i, k] * f
                else:
                    v = velocity[k]
                    f = -(resistance.linear[k] + resistance.quadratic[k] * abs(v)) * v
                    load.force[m, k] += f
                power += f * v
        for m in range(len(load.torque_body)):
            for k in range(3):
                w = omega[k]
                torque = -(resistance.rotation_linear[k] + resistance.rotation_quadratic[k] * abs(w)) * w
                torque -= resistance.rotation_dry[k] * np.sign(w)
                load.torque_body[m, k] += torque
                power += torque * w
        return power

    return brake
