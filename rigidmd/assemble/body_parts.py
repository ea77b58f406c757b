"""Parts of a single body from the tables of its scene: inertia, fluid, rotor, frame, resistance, forces."""

# isort: skip_file
from itertools import permutations

import numpy as np

from rigidmd.forces.body.applied import SteadyForce, TimeDependentForce
from rigidmd.forces.body.frame import InertialFrame, RotatingFrame
from rigidmd.forces.body.resistance import NoResistance, Resistance
from rigidmd.mechanics.free_rotor import DrivenRotor, split_rotor
from rigidmd.mechanics.inertia import inertia_tensor, shifted_inertia
from rigidmd.mechanics.rotation import unit_vector
from rigidmd.mechanics.solids import added_mass_of_ellipsoid, solid
from rigidmd.mechanics.time_functions import (
    TimeFunction, constant_function, integrate_function, interpolated_function, is_constant_function, pulse_function,
    sum_functions,
)  # fmt: skip
from rigidmd.scene import BodyScene
from rigidmd.scene.body_forces import Fluid, Friction, Timed
from rigidmd.scene.validation import not_none

#: Principal moments of a tensor are equal if they differ by less than this fraction of the largest.
ROUNDING = 1e-13


def inertia_of(scene: BodyScene) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Mass, inertia tensor about the centre of mass or pivot, its position, points to draw, names of the points."""
    body = scene.body
    centre = np.array(body.centre_of_mass_m or (0.0, 0.0, 0.0))
    mass = body.mass_kg or 0.0  # with points: their sum, below
    tensor = body.tensor
    if body.points is not None:
        masses = np.array([p.mass_kg for p in body.points])
        positions = np.array([p.position_m for p in body.points])
        mass = float(masses.sum())
        centre = masses @ positions / mass
        points = positions - centre
        tensor = inertia_tensor(masses, points)
    elif body.solid is not None:
        shape = solid(body.solid.shape, mass, body.solid.dimensions)
        points, tensor = shape.outline, np.diag(shape.inertia)
    else:
        about_centre = np.zeros((3, 3)) if tensor is None else tensor
        if body.inertia_about == "pivot":
            about_centre = shifted_inertia(about_centre, -mass, centre)
        points = _equal_ellipsoid(mass, about_centre)
    if tensor is None:
        tensor = np.zeros((3, 3))
    if body.pinned:
        if body.inertia_about == "centre_of_mass":
            tensor = shifted_inertia(tensor, mass, centre)
        points = np.vstack([np.zeros(3), centre + points])
        return mass, tensor, centre, points, ("PIVOT", *(f"P{k}" for k in range(1, len(points))))
    return mass, tensor, np.zeros(3), points, tuple(f"P{k}" for k in range(1, len(points) + 1))


def inertia_at_centre(scene: BodyScene) -> np.ndarray:
    """The inertia tensor (3, 3) about the centre of mass, at the start."""
    if scene.changing_inertia is not None:
        return np.diag(scene.changing_inertia.inertia_kg_m2[0])
    mass, tensor, centre, _, _ = inertia_of(scene)
    return shifted_inertia(tensor, -mass, centre) if scene.body.pinned else tensor


def _equal_ellipsoid(mass: float, tensor: np.ndarray) -> np.ndarray:
    """Centre and vertices (7, 3) of the homogeneous ellipsoid with this inertia tensor; one point without inertia."""
    moments, axes = np.linalg.eigh(tensor)
    half = np.sqrt(np.maximum(2.5 / mass * (moments.sum() - 2 * moments), 0.0))
    if not half.any():
        return np.zeros((1, 3))
    tips = (axes * half).T
    return np.concatenate([np.zeros((1, 3)), tips, -tips])


def principal(tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (3,) and right-handed axes (3, 3) as columns, each as close to the body's axis as possible."""
    rounding = ROUNDING * np.abs(tensor).max()
    if (np.abs(tensor - np.diag(np.diag(tensor))) <= rounding).all():
        moments, axes = np.diag(tensor).copy(), np.eye(3)
        return _without_rounding(moments), axes
    moments, axes = np.linalg.eigh(tensor)
    best = max(permutations(range(3)), key=lambda order: sum(abs(axes[k, order[k]]) for k in range(3)))
    moments, axes = np.maximum(moments, 0.0)[list(best)], axes[:, best]
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, np.abs(np.diag(axes)).argmin()] *= -1
    return _without_rounding(moments), axes


def _without_rounding(moments: np.ndarray) -> np.ndarray:
    """Moments that differ from each other or from 0 by rounding, made equal or 0, so that the rotor is exact."""
    rounding = ROUNDING * moments.max()
    moments = np.where(moments < rounding, 0.0, moments)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        if abs(moments[i] - moments[j]) <= rounding:
            moments[[i, j]] = 0.5 * (moments[i] + moments[j])
    return moments


def carried_fluid(scene: BodyScene) -> tuple[np.ndarray, np.ndarray, float]:
    """Added mass (3,), added inertia (3,) and displaced mass."""
    fluid = scene.fluid
    if fluid is None:
        return np.zeros(3), np.zeros(3), 0.0
    if fluid.density_kg_m3 is None:
        mass, inertia = (np.array(added or np.zeros(3)) for added in (fluid.added_mass_kg, fluid.added_inertia_kg_m2))
        return mass, inertia, fluid.displaced_mass_kg or 0.0
    shape = not_none(scene.body.solid)
    half = np.array(shape.semi_axes_m or (shape.radius_m,) * 3)
    return *added_mass_of_ellipsoid(half, fluid.density_kg_m3), fluid.density_kg_m3 * 4 / 3 * np.pi * half.prod()


def rotor_of(scene: BodyScene, moments: np.ndarray, added_inertia: np.ndarray, axes: np.ndarray):
    if not scene.wheels and scene.changing_inertia is None:
        return split_rotor(moments[None])
    changing = scene.changing_inertia
    inertia = constant_function(moments)
    if changing is not None:
        inertia = interpolated_function(changing.times_s, np.array(changing.inertia_kg_m2) + added_inertia)
    momenta = []
    for wheel in scene.wheels:
        axis = axes.T @ unit_vector(wheel.axis)
        motor = wheel.motor_torque_N_m
        values = 0.0 if motor is None else motor
        torque = _time_function(wheel, np.multiply.outer(values, axis))
        momenta.append(integrate_function(torque, wheel.momentum_kg_m2_s * axis))
    return DrivenRotor(inertia, sum_functions(momenta) if momenta else constant_function(np.zeros(3)))


def _time_function(timed: Timed, values) -> TimeFunction:
    """A value as a function of time: constant, within a window of time, or from a table."""
    if timed.times_s is not None:
        return interpolated_function(timed.times_s, values)
    if timed.from_s is not None or timed.to_s is not None:
        return pulse_function(values, *timed.window)
    return constant_function(values)


def frame_of(scene: BodyScene):
    frame = scene.frame
    if frame is None or (frame.angular_velocity_rad_s is None and frame.angular_acceleration_rad_s2 is None):
        return InertialFrame()
    rate = np.array(frame.angular_velocity_rad_s or (0.0, 0.0, 0.0))
    if frame.angular_acceleration_rad_s2 is not None:
        return RotatingFrame(integrate_function(constant_function(frame.angular_acceleration_rad_s2), rate))
    return RotatingFrame(_time_function(frame, rate))


def resistance_of(scene: BodyScene):
    friction, fluid = scene.friction or Friction(), scene.fluid or Fluid()
    parts = (
        np.array(fluid.linear_resistance_kg_s),
        np.array(fluid.quadratic_resistance_kg_m),
        np.array(friction.dry_N_m),
        np.array(friction.viscous_N_m_s) + np.array(fluid.linear_rotational_resistance_N_m_s),
        np.array(fluid.quadratic_rotational_resistance_N_m_s2),
    )
    return Resistance(*parts) if any(part.any() for part in parts) else NoResistance()


def terms_of(scene: BodyScene, mass: float, axes: np.ndarray, centre: np.ndarray, displaced: float):
    terms = {}
    at_centre = axes.T @ centre
    if scene.gravity is not None:
        g = np.array(scene.gravity.acceleration_m_s2)
        terms["gravity"] = SteadyForce(mass * g, at_centre)
        if displaced:
            buoyancy = not_none(scene.fluid).centre_of_buoyancy_m
            at = centre if buoyancy is None else np.array(buoyancy)
            terms["buoyancy"] = SteadyForce(-displaced * g, axes.T @ at)
    if scene.frame is not None and scene.frame.origin_acceleration_m_s2 is not None:
        force = _time_function(scene.frame, -mass * np.array(scene.frame.origin_acceleration_m_s2))
        terms["origin_acceleration"] = _force(force, constant_function(np.zeros(3)), at_centre, False)
    for k, entry in enumerate(scene.applied):
        force, torque = (
            constant_function(np.zeros(3)) if given is None else _time_function(entry, given)
            for given in (entry.force_N, entry.torque_N_m)
        )
        if entry.axes == "body":
            force, torque = _rotated(force, axes.T), _rotated(torque, axes.T)
        at = axes.T @ np.array(entry.at_m or (0.0, 0.0, 0.0))
        terms[f"applied_{k}"] = _force(force, torque, at, entry.axes == "body")
    return terms


def _rotated(course: TimeFunction, matrix: np.ndarray) -> TimeFunction:
    return TimeFunction(course.times, *(part @ matrix.T for part in course[1:]))


def _force(force: TimeFunction, torque: TimeFunction, point: np.ndarray, follows_body: bool):
    """The term of a force: with a potential energy if it is constant in the lab, else the ledger has its work."""
    if not follows_body and is_constant_function(force) and is_constant_function(torque) and not torque.constant.any():
        return SteadyForce(force.constant[0], point)
    return TimeDependentForce(force, torque, point, follows_body)
