"""Non-inertial frames: motion relative to axes that rotate about an origin, which may be accelerated.

Momenta are those relative to non-rotating axes, in components along the axes of the frame. The frame then adds one
flow, a rotation of position, velocity and Q, from which Coriolis, centrifugal and Euler forces follow. The acceleration
of the origin is a uniform field.
"""

from math import sqrt
from typing import NamedTuple

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.mechanics.free_rotor import rotate_vector, sine_and_versine
from rigidmd.mechanics.time_functions import TimeFunction, value


class InertialFrame(NamedTuple):
    rate: float = 0.0


class RotatingFrame(NamedTuple):
    """Axes that rotate. The flow is exact for a constant rate, and for one about a fixed axis that is linear in time.
    Otherwise each drift is symmetric and of order 2: compositions of symmetric steps keep their order, other schemes
    fall to order 2."""

    angular_velocity: TimeFunction  # along the axes of the frame


@chosen_by_type(inline=True)
def rotate_with_frame(frame, state, time, h):
    """Rotate the state of a single body from the frame's axes at `time` to those at time + h, in place."""
    if is_a(frame, InertialFrame):
        return lambda frame, state, time, h: None

    def rotate_back(frame, state, time, h):
        middle = time + 0.5 * h
        x = -h * value(frame.angular_velocity, middle, 0)
        y = -h * value(frame.angular_velocity, middle, 1)
        z = -h * value(frame.angular_velocity, middle, 2)
        if len(state.position):
            rotate_in_place(state.position[0], x, y, z)
            rotate_in_place(state.velocity[0], x, y, z)
        for k in range(len(state.rotation)):
            for column in range(3):
                rotate_in_place(state.rotation[k, :, column], x, y, z)

    return rotate_back


@kernel(inline=True)
def rotate_in_place(vector, x, y, z):
    """Rotate a vector (3,) by the rotation vector (x, y, z), in place (Rodrigues)."""
    angle = sqrt(x * x + y * y + z * z)
    if angle == 0.0:
        return
    s, versine = sine_and_versine(angle)
    vector[0], vector[1], vector[2] = rotate_vector(
        vector[0], vector[1], vector[2], x / angle, y / angle, z / angle, s, versine
    )


@chosen_by_type(inline=True)
def frame_rate(frame, time):
    """Angular velocity of the frame along its axes, as a tuple."""
    if is_a(frame, InertialFrame):
        return lambda frame, time: (0.0, 0.0, 0.0)

    def rate(frame, time):
        omega = frame.angular_velocity
        return value(omega, time, 0), value(omega, time, 1), value(omega, time, 2)

    return rate
