"""Free-rotor flows: how a body turns under no torque.

A rotor is a term: `turn(rotor, ...)` is chosen by its type when compiled, so a scene of points compiles no rotation.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.jit import implements, is_a, kernel
from rigidmd.mechanics.course import Course, piece, rate, value


class SplitRotor(NamedTuple):
    """Composition of exact rotations about the principal axes (Dullweber, Leimkuhler & McLachlan 1997).

    R1(h/2) R2(h/2) R3(h) R2(h/2) R1(h/2): order 2, symplectic, reversible; |L| and Q^T Q are kept to rounding.

    Bodies with two equal moments turn exactly instead: about L where all moments that are not zero are equal (linear
    and spherical bodies; there the split would move momentum onto the axis of a linear body, where none can be), about
    L and then about their own axis where they are symmetric.
    """

    inverse_inertia: np.ndarray  # (species, 3), 1/(u Å²); 0 where the moment is 0
    symmetry: np.ndarray  # (species,) ROUND, or the axis of symmetry 0, 1, 2, or NONE


NONE, ROUND = -1, 3  # of SplitRotor.symmetry


def split_rotor(inertia: np.ndarray) -> SplitRotor:
    """The rotor of bodies with these principal moments (species, 3), u Å²."""
    with np.errstate(divide="ignore"):
        inverse = np.where(inertia > 0, 1 / inertia, 0.0)
    return SplitRotor(inverse, np.array([_symmetry(moments) for moments in inertia]))


def _symmetry(moments: np.ndarray) -> int:
    if len(set(moments[moments > 0])) <= 1:
        return ROUND
    return next((k for k in range(3) if moments[k - 1] == moments[k - 2]), NONE)


class DrivenRotor(NamedTuple):
    """A single body that carries rotors or changes its inertia: L = I(t) omega + h(t), about fixed principal axes.

    h is the angular momentum of all rotors relative to the lab, along the body's axes. L' = L x omega + n then holds
    the terms -h' and -I' omega of Euler's equations, and H = sum (L_k - h_k)²/(2 I_k) still splits into exact plane
    rotations. I and h are those of the middle of each time interval.
    """

    inertia: Course
    momentum: Course
    work: np.ndarray  # (1,) done on the body by what drives h and I so far: the sum of the exact changes of H


class NoRotor(NamedTuple):
    """Points: nothing turns."""

    inverse_inertia: float = 0.0


def turn(rotor, species, rotation, angular_momentum_body, m, h):
    """Let molecule m of the given species turn freely for a time h: Q' = Q hat(I^-1 L), L' = L x I^-1 L, in place."""
    raise TypeError(f"{type(rotor).__name__} is no rotor, or this was called outside compiled code")


@implements(turn, inline=True)
def _turn_points(rotor, species, rotation, angular_momentum_body, m, h):
    if is_a(rotor, NoRotor):
        return lambda rotor, species, rotation, angular_momentum_body, m, h: None


@implements(turn, inline=True)
def _turn_split(rotor, species, rotation, angular_momentum_body, m, h):
    if not is_a(rotor, SplitRotor):
        return None

    def turn_split(rotor, species, rotation, angular_momentum_body, m, h):
        inverse = rotor.inverse_inertia[species]
        symmetry = rotor.symmetry[species]
        if symmetry == NONE:
            turn_by_axes(rotation, angular_momentum_body, m, inverse, (0.0, 0.0, 0.0), h)
        elif symmetry == ROUND:
            about_momentum(rotation, angular_momentum_body, m, h * max(inverse[0], inverse[1], inverse[2]))
        else:
            # L' = L x I^-1 L and Q' = Q hat(I^-1 L) with I^-1 L = L/I1 + (1/I3 - 1/I1) L3 e3: the two parts commute
            i = (symmetry + 1) % 3
            j = (symmetry + 2) % 3
            about_momentum(rotation, angular_momentum_body, m, h * inverse[i])
            angle = h * (inverse[symmetry] - inverse[i]) * angular_momentum_body[m, symmetry]
            about_axis(rotation, angular_momentum_body, m, symmetry, i, j, angle)

    return turn_split


@kernel(inline=True)
def turn_by_axes(rotation, angular_momentum_body, m, inverse, offset, h):
    """Five exact rotations, angles h (L_k - offset_k)/I_k. A gyrostat's offset is the momentum of its rotors."""
    L = angular_momentum_body
    about_axis(rotation, L, m, 0, 1, 2, 0.5 * h * (L[m, 0] - offset[0]) * inverse[0])
    about_axis(rotation, L, m, 1, 2, 0, 0.5 * h * (L[m, 1] - offset[1]) * inverse[1])
    about_axis(rotation, L, m, 2, 0, 1, h * (L[m, 2] - offset[2]) * inverse[2])
    about_axis(rotation, L, m, 1, 2, 0, 0.5 * h * (L[m, 1] - offset[1]) * inverse[1])
    about_axis(rotation, L, m, 0, 1, 2, 0.5 * h * (L[m, 0] - offset[0]) * inverse[0])


@kernel(inline=True)
def about_axis(rotation, angular_momentum_body, m, k, i, j, angle):
    """Exact flow of (L_k - offset)²/(2 I_k): L <- R_k(angle)^T L, Q <- Q R_k(angle); (k, i, j) cyclic."""
    if angle != 0.0:
        s, versine = sine_and_versine(angle)
        a = angular_momentum_body[m, i]
        b = angular_momentum_body[m, j]
        angular_momentum_body[m, i] = a + (s * b - versine * a)
        angular_momentum_body[m, j] = b - (s * a + versine * b)
        for row in range(3):
            a = rotation[m, row, i]
            b = rotation[m, row, j]
            rotation[m, row, i] = a + (s * b - versine * a)
            rotation[m, row, j] = b - (s * a + versine * b)


@kernel(inline=True)
def sine_and_versine(angle):
    """sin and 1 - cos, which a turn adds to what it turns.

    cos² + sin² is 1 only to rounding, and a turn by the same angle repeats the same error at every step: written as a
    change, its error is smaller by the angle squared, and only the sum rounds, differently every time. Below a quarter
    of a radian, where steps are, Taylor's series are good to 1e-17 and half as long as two calls of the library.
    """
    x = angle * angle
    if x < 0.0625:
        x2 = x * x
        odd = (1 - 1 / 6 * x) + x2 * (
            (1 / 120 - 1 / 5040 * x) + x2 * ((1 / 362880 - 1 / 39916800 * x) + 1 / 6227020800 * x2)
        )
        even = (1 / 2 - 1 / 24 * x) + x2 * (
            (1 / 720 - 1 / 40320 * x) + x2 * ((1 / 3628800 - 1 / 479001600 * x) + 1 / 87178291200 * x2)
        )
        return angle * odd, x * even
    s = sin(angle)
    c = cos(angle)
    return s, (s * s / (1 + c) if c > 0 else 1 - c)


@kernel(inline=True)
def about_momentum(rotation, angular_momentum_body, m, share):
    """Turn about L by the angle share |L|: L stays, Q <- Q R(share L)."""
    x = angular_momentum_body[m, 0]
    y = angular_momentum_body[m, 1]
    z = angular_momentum_body[m, 2]
    size = sqrt(x * x + y * y + z * z)
    if size == 0.0:
        return
    s, versine = sine_and_versine(share * size)
    x /= size
    y /= size
    z /= size
    for row in range(3):
        a = rotation[m, row, 0]
        b = rotation[m, row, 1]
        d = rotation[m, row, 2]
        p = b * z - d * y
        q = d * x - a * z
        r = a * y - b * x
        rotation[m, row, 0] = a + (s * p + versine * (q * z - r * y))
        rotation[m, row, 1] = b + (s * q + versine * (r * x - p * z))
        rotation[m, row, 2] = d + (s * r + versine * (p * y - q * x))


def turn_alone(rotor, state, time, h):
    """Let a single body turn freely from `time` for h, in place."""
    raise TypeError("compiled code only")


@implements(turn_alone, inline=True)
def _turn_alone(rotor, state, time, h):
    if not is_a(rotor, DrivenRotor):
        return lambda rotor, state, time, h: turn(rotor, 0, state.rotation, state.angular_momentum_body, 0, h)

    def turn_driven(rotor, state, time, h):
        L = state.angular_momentum_body
        before = driven_energy(rotor, L, time)
        middle = time + 0.5 * h
        at = piece(rotor.inertia, middle)
        inverse = (1 / value(rotor.inertia, at, 0), 1 / value(rotor.inertia, at, 1), 1 / value(rotor.inertia, at, 2))
        at = piece(rotor.momentum, middle)
        offset = (value(rotor.momentum, at, 0), value(rotor.momentum, at, 1), value(rotor.momentum, at, 2))
        rotor.work[0] += driven_energy(rotor, L, middle) - before
        turn_by_axes(state.rotation, L, 0, inverse, offset, h)
        rotor.work[0] += driven_energy(rotor, L, time + h) - driven_energy(rotor, L, middle)

    return turn_driven


@kernel
def driven_energy(rotor, angular_momentum_body, time):
    """sum (L_k - h_k)²/(2 I_k) at a time."""
    energy = 0.0
    at_inertia = piece(rotor.inertia, time)
    at_momentum = piece(rotor.momentum, time)
    for k in range(3):
        own = angular_momentum_body[0, k] - value(rotor.momentum, at_momentum, k)
        energy += 0.5 * own * own / value(rotor.inertia, at_inertia, k)
    return energy


def moments(rotor, time, k):
    """(1/I_k, h_k) of a single body's rotor at a time; 1/I_k is 0 about an axis without inertia."""
    raise TypeError("compiled code only")


@implements(moments, inline=True)
def _moments(rotor, time, k):
    if is_a(rotor, SplitRotor):
        return lambda rotor, time, k: (rotor.inverse_inertia[0, k], 0.0)
    if is_a(rotor, DrivenRotor):
        return lambda rotor, time, k: (
            1 / value(rotor.inertia, piece(rotor.inertia, time), k),
            value(rotor.momentum, piece(rotor.momentum, time), k),
        )
    if is_a(rotor, NoRotor):
        return lambda rotor, time, k: (0.0, 0.0)


def moment_rates(rotor, time, k):
    """(I_k, I_k', h_k, h_k') of a single body's rotor at a time."""
    raise TypeError("compiled code only")


@implements(moment_rates, inline=True)
def _moment_rates(rotor, time, k):
    if is_a(rotor, DrivenRotor):

        def driven(rotor, time, k):
            a = piece(rotor.inertia, time)
            b = piece(rotor.momentum, time)
            return (
                value(rotor.inertia, a, k),
                rate(rotor.inertia, a, k),
                value(rotor.momentum, b, k),
                rate(rotor.momentum, b, k),
            )

        return driven

    def constant(rotor, time, k):
        inverse, carried = moments(rotor, time, k)
        return (1 / inverse if inverse > 0 else 0.0), 0.0, carried, 0.0

    return constant
