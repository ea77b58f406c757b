"""The translation of a single body: free, none, or through an ideal fluid with added mass.

`translate(translation, ...)` is chosen by the type at compile time, so a pinned body compiles no translation.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.mechanics.free_rotor import rotate_body


class FreeTranslation(NamedTuple):
    """The centre of mass moves freely."""

    mass: float


class NoTranslation(NamedTuple):
    """A pinned body: one point is fixed at the origin; position and velocity are not stored."""

    mass: float


class FluidTranslation(NamedTuple):
    """A body in an ideal fluid: Kirchhoff's equations P' = P x omega, L' = L x omega + P x v with v = M^-1 P.

    `state.velocity` is the impulse of body and fluid over the body's mass, lab frame. The principal axes of M are those
    of I, and the centre of mass is the centre of the fluid's inertia (Lamb, Hydrodynamics, art. 124). The moments of
    inertia of the rotor include the added ones.
    """

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
    p0 = translation.mass * body_component(q, state.velocity[0], 0)
    p1 = translation.mass * body_component(q, state.velocity[0], 1)
    p2 = translation.mass * body_component(q, state.velocity[0], 2)
    v0 = p0 / translation.inertial_mass[0]
    v1 = p1 / translation.inertial_mass[1]
    v2 = p2 / translation.inertial_mass[2]
    for k in range(3):
        state.position[0, k] += h * (q[k, 0] * v0 + q[k, 1] * v1 + q[k, 2] * v2)
    state.angular_momentum_body[0, 0] += h * (p1 * v2 - p2 * v1)
    state.angular_momentum_body[0, 1] += h * (p2 * v0 - p0 * v2)
    state.angular_momentum_body[0, 2] += h * (p0 * v1 - p1 * v0)


@kernel(inline=True)
def body_component(rotation, vector_lab, k):
    """Component of a lab vector (3,) along body axis k."""
    return rotation[0, k] * vector_lab[0] + rotation[1, k] * vector_lab[1] + rotation[2, k] * vector_lab[2]


@chosen_by_type(inline=True)
def inertial_mass(translation, k):
    """Mass, with added mass, for motion along body axis k."""
    if is_a(translation, FluidTranslation):
        return lambda translation, k: translation.inertial_mass[k]
    return lambda translation, k: translation.mass


def inertial_masses(translation: FreeTranslation | NoTranslation | FluidTranslation) -> np.ndarray:
    """Mass, with added mass, along the body's axes (3,), for Python."""
    return translation.inertial_mass if isinstance(translation, FluidTranslation) else np.full(3, translation.mass)
