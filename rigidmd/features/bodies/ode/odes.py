"""The attitude as variables of a first-order system of ODEs: rotation matrix, quaternion or Euler
angles.

The attitude variables come first in y. Their rates follow from the angular velocity relative to the
frame of reference, along the body's axes. Kernels are chosen by the type of the form.
"""

from math import cos, sin
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a
from rigidmd.mechanics.rotation import to_euler_angles, to_quaternion


class Matrix(NamedTuple):
    """Nine direction cosines, Q' = Q hat(omega). Q^T Q = 1 is not enforced. Its error measures the
    accuracy."""

    variables: int = 9


class Quaternion(NamedTuple):
    """w, x, y, z with q' = q (0, omega) / 2. |q| = 1 is not enforced. Its error measures the
    accuracy."""

    variables: int = 4


class EulerAngles(NamedTuple):
    """phi, theta, psi (3-1-3). Singular at theta = 0 and pi."""

    variables: int = 3


class NoAttitude(NamedTuple):
    """No attitude: a point."""

    variables: int = 0


AttitudeForm = Matrix | Quaternion | EulerAngles | NoAttitude


def attitude_variables(form: AttitudeForm, rotation: np.ndarray) -> np.ndarray:
    """The attitude variables of a rotation matrix (1, 3, 3)."""
    if isinstance(form, NoAttitude):
        return np.zeros(0)
    return {Matrix: np.ravel, Quaternion: to_quaternion, EulerAngles: to_euler_angles}[type(form)](
        rotation[0]
    )


@chosen_by_type(inline=True)
def write_rotation(form, y, rotation):
    """Write Q (1, 3, 3) from the variables, without normalisation: Q of a quaternion is |q|² times
    a rotation."""
    if is_a(form, NoAttitude):
        return lambda form, y, rotation: None
    if is_a(form, Matrix):

        def from_matrix(form, y, rotation):
            for i in range(3):
                for j in range(3):
                    rotation[0, i, j] = y[3 * i + j]

        return from_matrix
    if is_a(form, Quaternion):

        def from_quaternion(form, y, rotation):
            q = rotation[0]
            w = y[0]
            a = y[1]
            b = y[2]
            c = y[3]
            q[0, 0] = w * w + a * a - b * b - c * c
            q[1, 1] = w * w - a * a + b * b - c * c
            q[2, 2] = w * w - a * a - b * b + c * c
            q[0, 1] = 2 * (a * b - w * c)
            q[1, 0] = 2 * (a * b + w * c)
            q[0, 2] = 2 * (a * c + w * b)
            q[2, 0] = 2 * (a * c - w * b)
            q[1, 2] = 2 * (b * c - w * a)
            q[2, 1] = 2 * (b * c + w * a)

        return from_quaternion

    def from_euler_angles(form, y, rotation):
        q = rotation[0]
        c1, s1 = cos(y[0]), sin(y[0])
        c2, s2 = cos(y[1]), sin(y[1])
        c3, s3 = cos(y[2]), sin(y[2])
        q[0, 0] = c1 * c3 - s1 * c2 * s3
        q[0, 1] = -c1 * s3 - s1 * c2 * c3
        q[0, 2] = s1 * s2
        q[1, 0] = s1 * c3 + c1 * c2 * s3
        q[1, 1] = -s1 * s3 + c1 * c2 * c3
        q[1, 2] = -c1 * s2
        q[2, 0] = s2 * s3
        q[2, 1] = s2 * c3
        q[2, 2] = c2

    return from_euler_angles


@chosen_by_type(inline=True)
def attitude_rates(form, y, w0, w1, w2, rates):
    """Write the rates of the attitude variables for an angular velocity along the body's axes."""
    if is_a(form, NoAttitude):
        return lambda form, y, w0, w1, w2, rates: None
    if is_a(form, Matrix):

        def matrix_rates(form, y, w0, w1, w2, rates):
            for i in range(0, 9, 3):
                rates[i] = y[i + 1] * w2 - y[i + 2] * w1
                rates[i + 1] = y[i + 2] * w0 - y[i] * w2
                rates[i + 2] = y[i] * w1 - y[i + 1] * w0

        return matrix_rates
    if is_a(form, Quaternion):

        def quaternion_rates(form, y, w0, w1, w2, rates):
            rates[0] = 0.5 * (-y[1] * w0 - y[2] * w1 - y[3] * w2)
            rates[1] = 0.5 * (y[0] * w0 + y[2] * w2 - y[3] * w1)
            rates[2] = 0.5 * (y[0] * w1 + y[3] * w0 - y[1] * w2)
            rates[3] = 0.5 * (y[0] * w2 + y[1] * w1 - y[2] * w0)

        return quaternion_rates

    def euler_rates(form, y, w0, w1, w2, rates):
        across = w0 * sin(y[2]) + w1 * cos(y[2])
        rates[0] = across / sin(y[1])
        rates[1] = w0 * cos(y[2]) - w1 * sin(y[2])
        rates[2] = w2 - rates[0] * cos(y[1])

    return euler_rates
