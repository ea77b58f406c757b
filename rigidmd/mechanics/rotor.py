"""Free-rotor flows: how a body turns under no torque.

A rotor is a term: `turn(rotor, ...)` is chosen by its type when compiled, so a scene of points compiles no rotation.
"""

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.jit import implements, is_a, kernel


class SplitRotor(NamedTuple):
    """Composition of exact rotations about the principal axes (Dullweber, Leimkuhler & McLachlan 1997).

    R1(h/2) R2(h/2) R3(h) R2(h/2) R1(h/2): order 2, symplectic, reversible; |L| and Q^T Q are kept to rounding.

    Where all moments that are not zero are equal (linear and spherical bodies) the body turns about L itself, which is
    exact. The split would do harm there: it moves momentum onto the axis of a linear body, where none can be.
    """

    inverse_inertia: np.ndarray  # (species, 3), 1/(u Å²); 0 where the moment is 0
    is_round: np.ndarray  # (species,) bool: all moments that are not zero are equal


def split_rotor(inertia: np.ndarray) -> SplitRotor:
    """The rotor of bodies with these principal moments (species, 3), u Å²."""
    turning = inertia > 0
    with np.errstate(divide="ignore"):
        inverse = np.where(turning, 1 / inertia, 0.0)
    largest = inertia.max(axis=1, keepdims=True)
    is_round = (~turning | (inertia == largest)).all(axis=1)
    return SplitRotor(inverse, is_round)


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
        if rotor.is_round[species]:
            about_momentum(rotor, species, rotation, angular_momentum_body, m, h)
            return
        about_axis(rotor, species, rotation, angular_momentum_body, m, 0, 1, 2, 0.5 * h)
        about_axis(rotor, species, rotation, angular_momentum_body, m, 1, 2, 0, 0.5 * h)
        about_axis(rotor, species, rotation, angular_momentum_body, m, 2, 0, 1, h)
        about_axis(rotor, species, rotation, angular_momentum_body, m, 1, 2, 0, 0.5 * h)
        about_axis(rotor, species, rotation, angular_momentum_body, m, 0, 1, 2, 0.5 * h)

    return turn_split


@kernel(inline=True)
def about_axis(rotor, species, rotation, angular_momentum_body, m, k, i, j, h):
    """Exact flow of L_k²/(2 I_k): angle a = h L_k/I_k, L <- R_k(a)^T L, Q <- Q R_k(a); (k, i, j) cyclic."""
    angle = h * angular_momentum_body[m, k] * rotor.inverse_inertia[species, k]
    if angle != 0.0:
        c = cos(angle)
        s = sin(angle)
        a = angular_momentum_body[m, i]
        b = angular_momentum_body[m, j]
        angular_momentum_body[m, i] = c * a + s * b
        angular_momentum_body[m, j] = c * b - s * a
        for row in range(3):
            a = rotation[m, row, i]
            b = rotation[m, row, j]
            rotation[m, row, i] = c * a + s * b
            rotation[m, row, j] = c * b - s * a


@kernel(inline=True)
def about_momentum(rotor, species, rotation, angular_momentum_body, m, h):
    """Exact flow where L and omega are parallel: L stays, Q <- Q R(L h/I)."""
    x = angular_momentum_body[m, 0]
    y = angular_momentum_body[m, 1]
    z = angular_momentum_body[m, 2]
    size = sqrt(x * x + y * y + z * z)
    if size == 0.0:
        return
    inverse = rotor.inverse_inertia[species]
    angle = h * size * max(inverse[0], inverse[1], inverse[2])
    x /= size
    y /= size
    z /= size
    c = cos(angle)
    s = sin(angle)
    for row in range(3):
        a = rotation[m, row, 0]
        b = rotation[m, row, 1]
        d = rotation[m, row, 2]
        along = (1 - c) * (a * x + b * y + d * z)
        rotation[m, row, 0] = c * a + along * x - s * (y * d - z * b)
        rotation[m, row, 1] = c * b + along * y - s * (z * a - x * d)
        rotation[m, row, 2] = c * d + along * z - s * (x * b - y * a)
