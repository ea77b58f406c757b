"""Resistance: bearings, air and fluids that take energy from a single body, along and about its own axes.

It acts within the kick: momentum under a constant load and resistance, positions held, follows each axis in closed
form. So a body in a thick fluid moves at its terminal speed whatever the step, and dry friction holds what it can hold.
The step is of order 2.
"""

from math import copysign, exp, expm1, log1p, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.forces.frame import frame_rate
from rigidmd.jit import implements, is_a, kernel
from rigidmd.mechanics.flight import Pinned, along, inertial_mass
from rigidmd.mechanics.rotor import NoRotor, moments


class NoResistance(NamedTuple):
    """Nothing is lost."""

    nothing: float = 0.0


class Resistance(NamedTuple):
    """Force -(linear + quadratic |v|) v and torque -(linear + quadratic |w|) w - dry sign(w), by body axis.

    v and w are relative to the frame, |v| and |w| their whole size, so equal coefficients mean resistance alike in all
    directions. Dry friction is that of a bearing about a body axis under constant load.
    """

    linear: np.ndarray  # (3,)
    quadratic: np.ndarray  # (3,)
    rotation_dry: np.ndarray  # (3,)
    rotation_linear: np.ndarray  # (3,)
    rotation_quadratic: np.ndarray  # (3,)


def push(resistance, flight, rotor, frame, state, load, h):
    """Momentum of a single body under a load and resistance for a time h, positions held, in place."""
    raise TypeError("compiled code only")


@implements(push, inline=True)
def _push(resistance, flight, rotor, frame, state, load, h):
    flies, turns = not is_a(flight, Pinned), not is_a(rotor, NoRotor)
    if is_a(resistance, NoResistance):

        def push_freely(resistance, flight, rotor, frame, state, load, h):
            for m in range(len(load.force)):
                for k in range(3):
                    state.velocity[m, k] += h / flight.mass * load.force[m, k]
            for m in range(len(load.torque_body)):
                for k in range(3):
                    if moments(rotor, state.time[0], k)[0] > 0:  # no momentum gathers on an axis without inertia
                        state.angular_momentum_body[m, k] += h * load.torque_body[m, k]

        return push_freely

    def push_against(resistance, flight, rotor, frame, state, load, h):
        if flies:
            push_flight(resistance, flight, rotor, frame, state, load, h)
        if turns:
            push_spin(resistance, rotor, frame, state, load, h)

    return push_against


@kernel
def push_spin(resistance, rotor, frame, state, load, h):
    """L under torque and resistance; |w| is that of the middle of the kick, from a first try with that of its start."""
    W = frame_rate(frame, state.time[0])
    q = state.rotation[0]
    L = state.angular_momentum_body[0]
    size = 0.0
    for trial in range(2):
        squares = 0.0
        for k in range(3):
            inverse, carried = moments(rotor, state.time[0], k)
            before = (L[k] - carried) * inverse - along(q, W, k)
            if trial == 0:
                squares += before * before
            elif inverse > 0.0:
                linear = inverse * (resistance.rotation_linear[k] + resistance.rotation_quadratic[k] * size)
                push_k, dry = inverse * load.torque_body[0, k], inverse * resistance.rotation_dry[k]
                middle, _ = pushed(before, push_k, dry, linear, 0.5 * h)
                squares += middle * middle
        size = sqrt(squares)
    for k in range(3):
        inverse, carried = moments(rotor, state.time[0], k)
        if inverse > 0.0:
            dragged = along(q, W, k)
            before = (L[k] - carried) * inverse - dragged
            linear = inverse * (resistance.rotation_linear[k] + resistance.rotation_quadratic[k] * size)
            push_k, dry = inverse * load.torque_body[0, k], inverse * resistance.rotation_dry[k]
            after, turned = pushed(before, push_k, dry, linear, h)
            L[k] = (after + dragged) / inverse + carried
            state.work[0] += (0.5 * (after - before) * (after + before) - push_k * turned) / inverse


def push_flight(resistance, flight, rotor, frame, state, load, h):
    """Velocity (or impulse over mass) under force and resistance; |v| as |w| in `push_spin`."""
    raise TypeError("compiled code only")


@implements(push_flight)
def _push_flight(resistance, flight, rotor, frame, state, load, h):
    turns = not is_a(rotor, NoRotor)

    def push_flight(resistance, flight, rotor, frame, state, load, h):
        W = frame_rate(frame, state.time[0])
        x = state.position[0]
        V = state.velocity[0]
        F = load.force[0]
        wind = (W[1] * x[2] - W[2] * x[1], W[2] * x[0] - W[0] * x[2], W[0] * x[1] - W[1] * x[0])
        size = 0.0
        for trial in range(3):
            squares = 0.0
            for k in range(3):
                mass = inertial_mass(flight, k)
                if turns:
                    q = state.rotation[0]
                    before = flight.mass * along(q, V, k) / mass - along(q, wind, k)
                    pull = along(q, F, k) / mass
                else:
                    before = V[k] - wind[k]
                    pull = F[k] / mass
                linear = (resistance.linear[k] + resistance.quadratic[k] * size) / mass
                if trial == 0:
                    squares += before * before
                elif trial == 1:
                    middle, _ = pushed(before, pull, 0.0, linear, 0.5 * h)
                    squares += middle * middle
                else:
                    after, flown = pushed(before, pull, 0.0, linear, h)
                    state.work[0] += mass * (0.5 * (after - before) * (after + before) - pull * flown)
                    gain = (after - before) * mass / flight.mass
                    if turns:
                        for i in range(3):  # along axis k only: what the other axes see stays as it was
                            V[i] += state.rotation[0, i, k] * gain
                    else:
                        V[k] += gain
            size = sqrt(squares)

    return push_flight


@kernel
def pushed(speed, push, dry, linear, h):
    """(s, integral of s) after h of s' = push - dry sign(s) - linear s, per unit inertia; dry and linear not negative.

    Dry friction brings it to rest in finite time, and holds it there unless the push is stronger.
    """
    s = abs(speed)
    sign = copysign(1.0, speed)
    if s == 0.0:
        if abs(push) <= dry:
            return 0.0, 0.0
        sign = copysign(1.0, push)
    net = sign * push - dry
    if net < 0.0:
        rest = log1p(linear * s / -net) / linear if linear > 0.0 else s / -net
        if rest <= h:  # it stops, and may then be pushed the other way
            back = max(0.0, abs(push) - dry) if sign * push < 0.0 else 0.0
            there = eased(linear, rest)
            after, way = run_up(0.0, back, linear, h - rest)
            return -sign * after, sign * (s * there[0] + net * there[1] - way)
    after, way = run_up(s, net, linear, h)
    return sign * after, sign * way


@kernel(inline=True)
def run_up(s, net, linear, h):
    """(s, way) of s' = net - linear s."""
    first, second = eased(linear, h)
    return s * exp(-linear * h) + net * first, s * first + net * second


@kernel(inline=True)
def eased(linear, h):
    """(1 - e^-x)/linear and (h - (1 - e^-x)/linear)/linear with x = linear h: h and h²/2 where nothing resists."""
    x = linear * h
    if x < 1e-2:  # the difference of nearly equal numbers, by its series
        return (
            h * (1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6 * (1 - x / 7)))))),
            h * h / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6 * (1 - x / 7))))),
        )
    first = -expm1(-x) / linear
    return first, (h - first) / linear


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
            size = sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
            for k in range(3):
                v = along(state.rotation[m], velocity, k) if len(state.rotation) else velocity[k]
                f = -(resistance.linear[k] + resistance.quadratic[k] * size) * v
                power += f * v
                if len(state.rotation):
                    for i in range(3):
                        load.force[m, i] += state.rotation[m, i, k] * f
                else:
                    load.force[m, k] += f
        for m in range(len(load.torque_body)):
            size = sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2)
            for k in range(3):
                torque = -(resistance.rotation_linear[k] + resistance.rotation_quadratic[k] * size) * omega[k]
                load.torque_body[m, k] += torque
                power += torque * omega[k]
        return power

    return brake
