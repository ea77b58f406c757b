"""The translation of a single body: free, none, or through an ideal fluid with added mass. Frames
of reference. `translate(translation, ...)` is chosen by the type at compile time, so a pinned body
compiles no translation. See the theory chapter `bodies`."""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.features.bodies.driven_rotor import rotate_body
from rigidmd.features.bodies.time_functions import TimeFunction, vector_at
from rigidmd.mechanics.free_rotor import rotate_vector, sine_and_versine
from rigidmd.mechanics.vectors import body_vector, lab_vector


class FreeTranslation(NamedTuple):
    """The centre of mass moves freely."""

    mass: float


class NoTranslation(NamedTuple):
    """A pinned body: one point is fixed at the origin. Position and velocity are not stored."""

    mass: float


class FluidTranslation(NamedTuple):
    """A body in an ideal fluid: Kirchhoff's equations, see the theory chapter `bodies`.
    `state.velocity` is the impulse of body and fluid over the body's mass, lab frame. The moments
    of inertia of the rotor include the added ones."""

    mass: float
    inertial_mass: np.ndarray  # (3,) mass and added mass along the body's axes


@chosen_by_type(inline=True)
def translate(translation, rotor, state, time, h):
    """Flow of the kinetic energy of a single body, from `time` to time + h, in place."""
    if is_a(translation, NoTranslation):
        return lambda translation, rotor, state, time, h: rotate_body(rotor, state, time, h)
    if is_a(translation, FreeTranslation):

        def translate_free(translation, rotor, state, time, h):
            for k in range(3):
                state.position[0, k] += h * state.velocity[0, k]
            rotate_body(rotor, state, time, h)

        return translate_free

    def translate_fluid(translation, rotor, state, time, h):
        translate_in_fluid(translation, state, 0.5 * h)
        rotate_body(rotor, state, time, h)
        translate_in_fluid(translation, state, 0.5 * h)

    return translate_fluid


@kernel(inline=True)
def translate_in_fluid(translation, state, h):
    """Exact flow of sum P_k²/(2 M_k): P and Q are constant, X += h Q v, L += h P x v."""
    q = state.rotation[0]
    a, b, c = body_vector(q, state.velocity[0])
    p0, p1, p2 = translation.mass * a, translation.mass * b, translation.mass * c
    m0, m1, m2 = all_inertial_masses(translation)
    v0, v1, v2 = p0 / m0, p1 / m1, p2 / m2
    u = lab_vector(q, v0, v1, v2)
    for k in range(3):
        state.position[0, k] += h * u[k]
    state.angular_momentum_body[0, 0] += h * (p1 * v2 - p2 * v1)
    state.angular_momentum_body[0, 1] += h * (p2 * v0 - p0 * v2)
    state.angular_momentum_body[0, 2] += h * (p0 * v1 - p1 * v0)


@chosen_by_type(inline=True)
def inertial_mass(translation, k):
    """Mass, with added mass, for motion along body axis k."""
    if is_a(translation, FluidTranslation):
        return lambda translation, k: translation.inertial_mass[k]
    return lambda translation, k: translation.mass


@kernel(inline=True)
def all_inertial_masses(translation):
    """`inertial_mass` along all body axes, as a tuple."""
    t = translation
    return inertial_mass(t, 0), inertial_mass(t, 1), inertial_mass(t, 2)


def inertial_masses(translation: FreeTranslation | NoTranslation | FluidTranslation) -> np.ndarray:
    """Mass, with added mass, along the body's axes (3,), for Python."""
    return (
        translation.inertial_mass
        if isinstance(translation, FluidTranslation)
        else np.full(3, translation.mass)
    )


class InertialFrame(NamedTuple):
    rate: float = 0.0


class RotatingFrame(NamedTuple):
    """Axes that rotate, by one more flow: see the theory chapter `bodies` for its order."""

    angular_velocity: TimeFunction  # along the axes of the frame


@chosen_by_type(inline=True)
def rotate_with_frame(frame, state, time, h):
    """Rotate the state of a single body from the frame's axes at `time` to those at time + h, in
    place."""
    if is_a(frame, InertialFrame):
        return lambda frame, state, time, h: None

    def rotate_back(frame, state, time, h):
        a, b, c = frame_rate(frame, time + 0.5 * h)
        x, y, z = -h * a, -h * b, -h * c
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

    return lambda frame, time: vector_at(frame.angular_velocity, time)
