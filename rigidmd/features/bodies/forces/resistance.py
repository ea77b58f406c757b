"""Resistance: bearings, air and fluids that take energy from a single body, along and about its
axes. It acts within the kick, by a closed form at fixed positions: see the theory chapter
`bodies`."""

from math import copysign, exp, expm1, log1p, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.core.state import WORK
from rigidmd.features.bodies.driven_rotor import all_moments, moments, omega_in_frame
from rigidmd.features.bodies.translation import NoTranslation, all_inertial_masses, frame_rate
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.mechanics.vectors import body_component, body_vector

MAX_ITERATIONS = 100  # for |v|; about six are needed
SPEED_TOLERANCE = 1e-14  # relative error of |v|


class NoResistance(NamedTuple):
    nothing: float = 0.0


class Resistance(NamedTuple):
    """Force -(linear + quadratic |v|) v and torque -(linear + quadratic |w|) w - dry sign(w), for
    each body axis. v and w are relative to the frame. |v| and |w| are the lengths of the
    vectors."""

    linear: np.ndarray  # (3,)
    quadratic: np.ndarray  # (3,)
    rotation_dry: np.ndarray  # (3,)
    rotation_linear: np.ndarray  # (3,)
    rotation_quadratic: np.ndarray  # (3,)


@chosen_by_type(inline=True)
def kick_with_resistance(resistance, translation, rotor, frame, state, load, h):
    """Change the momenta of a single body by a load and resistance for a time h at fixed positions,
    in place."""
    flies, turns = not is_a(translation, NoTranslation), not is_a(rotor, NoRotor)
    if is_a(resistance, NoResistance):

        def kick_freely(resistance, translation, rotor, frame, state, load, h):
            for m in range(len(load.force)):
                for k in range(3):
                    state.velocity[m, k] += h / translation.mass * load.force[m, k]
            for m in range(len(load.torque_body)):
                for k in range(3):
                    if (
                        moments(rotor, state.time[0], k)[0] > 0
                    ):  # an axis without inertia has no momentum
                        state.angular_momentum_body[m, k] += h * load.torque_body[m, k]

        return kick_freely

    def kick_against_resistance(resistance, translation, rotor, frame, state, load, h):
        if flies:
            kick_translation(resistance, translation, rotor, frame, state, load, h)
        if turns:
            kick_rotation(resistance, rotor, frame, state, load, h)

    return kick_against_resistance


@kernel
def kick_rotation(resistance, rotor, frame, state, load, h):
    """Change L by torque and resistance. |w| is its value at the middle of the kick."""
    L, torque = state.angular_momentum_body[0], load.torque_body[0]
    inverse, carried = all_moments(rotor, state.time[0])
    dragged = body_vector(state.rotation[0], frame_rate(frame, state.time[0]))
    before = omega_in_frame(rotor, state, dragged)
    pushes = times(inverse, torque)
    dry, linear, quadratic = (
        resistance.rotation_dry,
        resistance.rotation_linear,
        resistance.rotation_quadratic,
    )
    dries = times(inverse, dry)
    size = midpoint_speed(before, pushes, dries, inverse, linear, quadratic, h)
    for k in range(3):
        if inverse[k] > 0.0:
            rate = inverse[k] * (linear[k] + quadratic[k] * size)
            after, turned = resisted_motion(before[k], pushes[k], dries[k], rate, h)
            L[k] = (after + dragged[k]) / inverse[k] + carried[k]
            state.energy_ledger[WORK] += (
                0.5 * (after - before[k]) * (after + before[k]) - pushes[k] * turned
            ) / inverse[k]


@kernel(inline=True)
def times(a, b):
    """The products of components, as a tuple."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel
def midpoint_speed(before, pushes, dries, inverse, linear, quadratic, h):
    """|v| at the middle of a kick with the resistance that this |v| causes.

    All arguments are per unit inertia. The computed |v| minus the assumed |v| changes sign between
    0 and the largest |v| that the load can cause. Regula falsi (Illinois) finds the root. With a
    single guess a fast body would stop at the middle, or not be braked at all.
    """
    if quadratic[0] == 0.0 and quadratic[1] == 0.0 and quadratic[2] == 0.0:
        return 0.0
    low, high = 0.0, 0.0
    for k in range(3):
        high += (abs(before[k]) + 0.5 * h * abs(pushes[k])) ** 2
    high = sqrt(high)
    above = speed_after_half_kick(before, pushes, dries, inverse, linear, quadratic, h, low)
    below = speed_after_half_kick(before, pushes, dries, inverse, linear, quadratic, h, high) - high
    if not above > 0.0 or not below < 0.0:
        return low if not above > 0.0 else high
    side = 0
    for _ in range(MAX_ITERATIONS):
        size = (low * below - high * above) / (below - above)
        found = (
            speed_after_half_kick(before, pushes, dries, inverse, linear, quadratic, h, size) - size
        )
        if abs(found) <= SPEED_TOLERANCE * size or high - low <= SPEED_TOLERANCE * high:
            return size
        if found > 0.0:
            low, above = size, found
            below *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            high, below = size, found
            above *= 0.5 if side == -1 else 1.0
            side = -1
    return size


@kernel
def speed_after_half_kick(before, pushes, dries, inverse, linear, quadratic, h, size):
    """|v| after half of h, with the resistance of an assumed |v| = size."""
    squares = 0.0
    for k in range(3):
        if inverse[k] > 0.0:
            rate = inverse[k] * (linear[k] + quadratic[k] * size)
            middle, _ = resisted_motion(before[k], pushes[k], dries[k], rate, 0.5 * abs(h))
            squares += middle * middle
    return sqrt(squares)


@chosen_by_type
def kick_translation(resistance, translation, rotor, frame, state, load, h):
    """Change the velocity (or impulse over mass) by force and resistance. |v| is found like |w| in
    `kick_rotation`."""
    turns = not is_a(rotor, NoRotor)

    def kick_translation(resistance, translation, rotor, frame, state, load, h):
        W = frame_rate(frame, state.time[0])
        x = state.position[0]
        V = state.velocity[0]
        F = load.force[0]
        wind = (W[1] * x[2] - W[2] * x[1], W[2] * x[0] - W[0] * x[2], W[0] * x[1] - W[1] * x[0])
        mass = all_inertial_masses(translation)
        inverse = (1 / mass[0], 1 / mass[1], 1 / mass[2])
        if turns:
            q = state.rotation[0]
            v, u, f = body_vector(q, V), body_vector(q, wind), body_vector(q, F)
            m = translation.mass
            along = times((m * inverse[0], m * inverse[1], m * inverse[2]), v)
            before = (along[0] - u[0], along[1] - u[1], along[2] - u[2])
            pulls = times(inverse, f)
        else:
            before = (V[0] - wind[0], V[1] - wind[1], V[2] - wind[2])
            pulls = times(inverse, F)
        linear, quadratic = resistance.linear, resistance.quadratic
        size = midpoint_speed(before, pulls, (0.0, 0.0, 0.0), inverse, linear, quadratic, h)
        for k in range(3):
            after, flown = resisted_motion(
                before[k], pulls[k], 0.0, (linear[k] + quadratic[k] * size) * inverse[k], h
            )
            state.energy_ledger[WORK] += mass[k] * (
                0.5 * (after - before[k]) * (after + before[k]) - pulls[k] * flown
            )
            gain = (after - before[k]) * mass[k] / translation.mass
            if turns:
                for i in range(
                    3
                ):  # along axis k only, so that components along the other axes do not change
                    V[i] += state.rotation[0, i, k] * gain
            else:
                V[k] += gain

    return kick_translation


@kernel
def resisted_motion(speed, push, dry, linear, h):
    """(s, integral of s) after a time h of s' = push - dry sign(s) - linear s, per unit inertia.
    Dry, linear >= 0."""
    s = abs(speed)
    sign = copysign(1.0, speed)
    if s == 0.0:
        if abs(push) <= dry:
            return 0.0, 0.0
        sign = copysign(1.0, push)
    net = sign * push - dry
    if net < 0.0:
        rest = log1p(linear * s / -net) / linear if linear > 0.0 else s / -net
        if rest <= h:  # the body stops, and the push may then reverse the motion
            back = max(0.0, abs(push) - dry) if sign * push < 0.0 else 0.0
            there = drag_integrals(linear, rest)
            after, way = linear_drag_motion(0.0, back, linear, h - rest)
            return -sign * after, sign * (s * there[0] + net * there[1] - way)
    after, way = linear_drag_motion(s, net, linear, h)
    return sign * after, sign * way


@kernel(inline=True)
def linear_drag_motion(s, net, linear, h):
    """(s, integral of s) after a time h of s' = net - linear s."""
    first, second = drag_integrals(linear, h)
    return s * exp(-linear * h) + net * first, s * first + net * second


@kernel(inline=True)
def drag_integrals(linear, h):
    """(1 - e^-x)/linear and (h - (1 - e^-x)/linear)/linear with x = linear h; h and h²/2 without
    resistance."""
    x = linear * h
    if x < 1e-2:  # a series avoids the difference of nearly equal numbers
        return (
            h * (1 - x / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6 * (1 - x / 7)))))),
            h * h / 2 * (1 - x / 3 * (1 - x / 4 * (1 - x / 5 * (1 - x / 6 * (1 - x / 7))))),
        )
    first = -expm1(-x) / linear
    return first, (h - first) / linear


@chosen_by_type
def add_resistance(resistance, state, load, velocity, omega):
    """Add resistance to a load, and return its power. Velocity (lab), angular velocity (body)
    relative to the frame."""
    if is_a(resistance, NoResistance):
        return lambda resistance, state, load, velocity, omega: 0.0

    def brake(resistance, state, load, velocity, omega):
        power = 0.0
        for m in range(len(load.force)):
            size = sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
            for k in range(3):
                v = (
                    body_component(state.rotation[m], velocity, k)
                    if len(state.rotation)
                    else velocity[k]
                )
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
                torque = (
                    -(resistance.rotation_linear[k] + resistance.rotation_quadratic[k] * size)
                    * omega[k]
                )
                load.torque_body[m, k] += torque
                power += torque * omega[k]
        return power

    return brake
