"""The system for a single-body scene, and errors for keys that do not apply to the body or have no
effect on it."""

from collections.abc import Callable, Iterator, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import SCHEMES, SOLVERS
from rigidmd.core.state import State, state_of
from rigidmd.errors import SceneError
from rigidmd.features.bodies.defaults import (
    body_warnings,
    body_with_defaults,
    check_memory_of_samples,
)
from rigidmd.features.bodies.driven_rotor import DrivenRotor
from rigidmd.features.bodies.forces.applied import PythonForce, SteadyForce, TimeDependentForce
from rigidmd.features.bodies.forces.resistance import NoResistance, Resistance
from rigidmd.features.bodies.keys.body import SolidPart, axis_of_symmetry
from rigidmd.features.bodies.keys.forces import Fluid, Friction, Timed
from rigidmd.features.bodies.keys.solids import added_mass_of_ellipsoid, solid
from rigidmd.features.bodies.motion import energies_of
from rigidmd.features.bodies.step_loop import Body
from rigidmd.features.bodies.system import BodySystem, Pose
from rigidmd.features.bodies.time_functions import (
    TimeFunction,
    constant_function,
    has_constant_direction,
    integrate_function,
    interpolated_function,
    is_constant_function,
    pulse_function,
    sum_functions,
    values_at,
)
from rigidmd.features.bodies.translation import (
    FluidTranslation,
    FreeTranslation,
    InertialFrame,
    NoTranslation,
    RotatingFrame,
)
from rigidmd.formats import format_of
from rigidmd.mechanics.free_rotor import NoRotor, split_rotor
from rigidmd.mechanics.inertia import inertia_tensor, shifted_inertia
from rigidmd.mechanics.rotation import unit_vector
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none


def build_body(
    scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None = None
) -> BodySystem:
    """The system of a scene. Raises SceneError with all errors.

    applied : name -> function of a `Pose` that returns a force (3,) in N along the lab's axes, at
        the centre of mass, and a torque (3,) in N m along the body's axes
    """
    mass, tensor, centre, points, names = inertia_of(scene)
    added_mass, added_inertia, displaced = carried_fluid(scene)
    if scene.changing_inertia is not None:
        moments = np.array(scene.changing_inertia.inertia_kg_m2[0])
        axes = np.eye(3)
    else:
        moments, axes = principal(tensor)
    moments = moments + added_inertia
    rotates = bool(moments.any())
    applied = applied or {}
    errors = [*_body_errors(scene, centre, moments, axes, added_mass)]
    attitude = scene.start.attitude
    spin = axes.T @ scene.start.angular_velocity  # along the principal axes
    if rotates and ((moments == 0) & (np.abs(spin) > 1e-12 * np.abs(spin).max(initial=0.0))).any():
        errors.append("start: the body rotates about an axis without inertia")
    errors += _integrator_errors(
        scene, immersed=bool(added_mass.any()), has_functions=bool(applied)
    )
    taken = {
        "gravity",
        "buoyancy",
        "origin_acceleration",
        *(f"applied_{k}" for k in range(len(scene.applied))),
    }
    why = "is the name of a force of the scene. Choose another"
    errors += [f"applied: {name!r} {why}" for name in applied if name in taken]
    errors += _torque_errors(scene, axes, moments)
    if errors:
        raise SceneError(scene.source, errors)

    scene = body_with_defaults(
        scene, rotates=rotates, radius=float(np.linalg.norm(points, axis=1).max())
    )
    check_memory_of_samples(scene)
    rotor = rotor_of(scene, moments, added_inertia, axes) if rotates else NoRotor()
    translation = NoTranslation(mass) if scene.body.pinned else FreeTranslation(mass)
    if added_mass.any() and not scene.body.pinned:
        translation = FluidTranslation(mass, mass + added_mass)
    body = Body(translation, rotor, frame_of(scene), resistance_of(scene))
    terms: dict[str, NamedTuple] = terms_of(scene, mass, axes, centre, displaced)
    terms |= {name: PythonForce() for name in applied}
    system = BodySystem(
        scene=scene,
        body=body,
        state=_first_state(scene, body, moments, axes, attitude, spin, rotates),
        terms=terms,
        mass=mass,
        axes=axes,
        inertia=moments,
        centre=centre,
        points=points,
        point_names=names,
        applied=applied,
        warnings=body_warnings(scene),
    )
    if not has_finite_energy(system):
        reason = "are too large for floating-point numbers"
        raise SceneError(
            scene.source, [f"the energy at the start: mass, moments of inertia or rates {reason}"]
        )
    if scene.output.trajectory and system.translates:
        form = not_none(format_of(not_none(scene.output.topology)))
        if form.exceeded(system.site_positions(system.state)) is not None:
            reach = system.scale * np.abs(system.state.position).max()
            error = (
                f"start.position_m is {reach:.3g} Å in the trajectory, which"
                f" {scene.output.topology} cannot hold"
            )
            advice = "set output.trajectory_A_per_m to less, or output.trajectory = false"
            raise SceneError(scene.source, [f"{error}: {advice}"])
    return system


@np.errstate(over="ignore", invalid="ignore")
def has_finite_energy(system: BodySystem) -> bool:
    """Whether the energies of a body at its start are numbers."""
    return all(map(np.isfinite, energies_of(system, system.state).values()))


def _first_state(scene, body, moments, axes, attitude, spin, rotates) -> State:
    """The state at the start. Spin (3,) along the principal axes, relative to the frame."""
    start = scene.start
    time = np.zeros(1)
    if isinstance(body.frame, InertialFrame):
        frame = np.zeros(3)
    else:
        frame = values_at(body.frame.angular_velocity, time)[0]
    position = velocity = np.zeros((0, 3))
    rotation = np.zeros((0, 3, 3))
    momentum = np.zeros((0, 3))
    principal_rotation = attitude @ axes
    if rotates:
        rotation = principal_rotation[None].copy()
        momentum = (moments * (spin + principal_rotation.T @ frame))[None].copy()
        if isinstance(body.rotor, DrivenRotor):
            momentum += values_at(body.rotor.momentum, time)
    if not scene.body.pinned:
        position = np.array([start.position_m or (0.0, 0.0, 0.0)])
        velocity = np.array([start.velocity_m_s or (0.0, 0.0, 0.0)]) + np.cross(frame, position)
        if isinstance(body.translation, FluidTranslation):
            ratio = body.translation.inertial_mass / body.translation.mass
            velocity = (principal_rotation @ (ratio * (principal_rotation.T @ velocity[0])))[None]
    return state_of(position, velocity, rotation, momentum)


def _body_errors(
    scene: BodyScene,
    centre: np.ndarray,
    moments: np.ndarray,
    axes: np.ndarray,
    added_mass: np.ndarray,
) -> Iterator[str]:
    """Messages on keys of any table that do not apply to this body, or would have no effect on
    it."""
    fluid = scene.fluid
    rotates = bool(moments.any())
    if not rotates:
        yield from _rotation_keys_of_point(scene)
        if scene.body.pinned:
            yield "body: a point at the pivot cannot move. Set its inertia or its centre_of_mass_m"
        if added_mass.any():
            yield "fluid.added_mass_kg: a point carries no fluid along. Leave it out"
        for key in ("linear_resistance_kg_s", "quadratic_resistance_kg_m"):
            if fluid is not None and len(set(getattr(fluid, key))) > 1:
                yield f"fluid.{key}: a point has no axes: give three equal numbers"
    elif any(added_mass[k - 1] != added_mass[k - 2] for k in np.flatnonzero(moments == 0)):
        yield "fluid.added_mass_kg: a linear body has equal added masses across its axis"
    if rotates and not np.array_equal(axes, np.eye(3)):
        yield from _keys_of_principal_axes(scene)
    if (scene.wheels or scene.changing_inertia) and rotates and not (moments > 0).all():
        yield "wheels and changing_inertia need a body with inertia about every axis"
    if scene.output.drawn_as == "top" and rotates:
        at_centre, _ = principal(inertia_at_centre(scene))
        if axis_of_symmetry(at_centre) is None:
            yield (
                "output.drawn_as: a top has two equal moments of inertia about its centre of"
                f" mass, and these are {', '.join(f'{x:.4g}' for x in at_centre)} kg m². Name"
                " 'cuboid', 'ellipsoid' or a solid"
            )
    if scene.body.pinned:
        if scene.changing_inertia is not None and centre.any():
            yield "changing_inertia: the centre of mass must be at the pivot of a pinned body"
        if scene.gravity is not None and not centre.any() and rotates:
            yield (
                "gravity has no effect on a body pinned at its centre of mass. Give"
                " body.centre_of_mass_m"
            )
        for k, entry in enumerate(scene.applied):
            if entry.force_N is not None and not any(entry.at_m or ()):
                yield (
                    f"applied.{k}.force_N has no effect at the pivot. Give its point of action,"
                    " at_m"
                )


def _rotation_keys_of_point(scene: BodyScene) -> list[str]:
    """Messages on keys of rotation, which a point does not have."""
    start = scene.start
    none = type(scene.start)()
    named = [
        f"start.{key}"
        for key in type(start).model_fields
        if getattr(start, key) != getattr(none, key)
    ]
    idle = [key for key in named if key not in ("start.position_m", "start.velocity_m_s")]
    idle += [key for key in ("friction", "wheels") if getattr(scene, key)]
    idle += [
        f"run.{key}" for key in ("formulation", "rotor") if getattr(scene.run, key) is not None
    ]
    if scene.fluid is not None:
        keys = (
            "linear_rotational_resistance_N_m_s",
            "quadratic_rotational_resistance_N_m_s2",
            "added_inertia_kg_m2",
        )
        idle += [f"fluid.{key}" for key in keys if any(getattr(scene.fluid, key) or ())]
    if scene.output.axis is not None:
        idle.append("output.axis")
    return [f"{key}: the body has no inertia: a point does not rotate" for key in idle]


def _keys_of_principal_axes(scene: BodyScene) -> Iterator[str]:
    """Messages on keys along the body's axes, which must be principal axes unless all three values
    are equal."""
    for name, section in (("friction", scene.friction), ("fluid", scene.fluid)):
        for key, value in section or ():
            if not isinstance(value, tuple) or key == "centre_of_buoyancy_m":
                continue
            if len(set(value)) > 1 or (key == "dry_N_m" and any(value)):
                yield (
                    f"{name}.{key} is given along the body's axes, which are not principal axes of"
                    " its inertia: give the body in its principal axes"
                )


def _torque_errors(scene: BodyScene, axes: np.ndarray, moments: np.ndarray) -> Iterator[str]:
    """Messages on torques about axes without inertia."""
    for k, entry in enumerate(scene.applied):
        if not moments.any() and (entry.torque_N_m is not None or entry.at_m is not None):
            yield f"applied.{k}: a point has no inertia, and a torque cannot rotate it"
        elif (moments == 0).any() and (entry.axes == "body" or entry.at_m is not None):
            torques = np.atleast_2d(entry.torque_N_m or np.zeros(3)) @ axes
            arm = axes.T @ np.array(entry.at_m or (0.0, 0.0, 0.0))
            if torques[:, moments == 0].any() or arm[moments > 0].any():
                yield f"applied.{k}: nothing resists a torque about the axis of a linear body"


def _integrator_errors(scene: BodyScene, *, immersed: bool, has_functions: bool) -> list[str]:
    """Messages on integrators that cannot move this body, or lose their order; immersed: the fluid
    adds mass; has_functions: Python functions apply forces."""
    run = scene.run
    resistance = resistance_of(scene)
    resisted = not isinstance(resistance, NoResistance)
    if run.is_auto:
        return []
    if run.integrator in SOLVERS:
        what = (
            f"dry friction is discontinuous where a body stops, which {run.integrator} cannot"
            " resolve"
        )
        if resisted and resistance.rotation_dry.any():
            return [f"run: {what}: use velocity_verlet"]
        return []
    scheme = run.scheme
    if resisted and min(scheme.kicks) < 0:
        forward = ", ".join(name for name, other in SCHEMES.items() if min(other.kicks) >= 0)
        return [
            f"run: {run.integrator} has negative substeps, which a resistance does not allow: use"
            f" one of {forward}"
        ]
    if scheme.has_gradient and (resisted or scene.applied or has_functions):
        plain = [
            name for name, other in SCHEMES.items() if other.order > 2 and not other.has_gradient
        ]
        what = "the gradient of the forces, which resistance and applied forces do not have"
        return [f"run: {run.integrator} needs {what}. Use one of {', '.join(plain)}"]
    frame = frame_of(scene)
    axis_changes = isinstance(frame, RotatingFrame) and not has_constant_direction(
        frame.angular_velocity
    )
    why = {
        "wheels": scene.wheels,
        "changing_inertia": scene.changing_inertia,
        "added mass": immersed,
        "a frame that changes its axis": axis_changes,
    }
    split = [name for name, other in SCHEMES.items() if not other.exact_rotor]
    return [
        f"run: the free motion of a body with {what} has no exact flow: {run.integrator} would be"
        f" of order 2. Use one of {', '.join(split)} with rotor = 'split'"
        for what, is_present in why.items()
        if is_present and scheme.exact_rotor
    ]


#: Principal moments of a tensor are equal if they differ by less than this fraction of the largest.
ROUNDING = 1e-13


def inertia_of(
    scene: BodyScene,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, tuple[str, ...]]:
    """Mass, inertia tensor about the centre of mass or pivot, its position, points to draw, names
    of the points."""
    body = scene.body
    centre = np.array(body.centre_of_mass_m or (0.0, 0.0, 0.0))
    mass = body.mass_kg or 0.0  # with points or solids: their sum, below
    tensor = np.zeros((3, 3)) if body.tensor is None else body.tensor
    if body.points is not None:
        masses = np.array([p.mass_kg for p in body.points])
        positions = np.array([p.position_m for p in body.points])
        mass = float(masses.sum())
        centre = masses @ positions / mass
        points = positions - centre
        tensor = inertia_tensor(masses, points)
    elif body.solids is not None:
        mass, centre, tensor, outlines = assembled(body.solids)
        points = np.concatenate(outlines)
    elif body.solid is not None:
        shape = solid(body.solid.shape, mass, body.solid.dimensions)
        points = shape.outline
        tensor = np.diag(shape.inertia)
    else:
        about_pivot = body.inertia_about == "pivot"
        points = _equal_ellipsoid(
            mass, shifted_inertia(tensor, -mass, centre) if about_pivot else tensor
        )
    if body.pinned:
        if body.inertia_about == "centre_of_mass":
            tensor = shifted_inertia(tensor, mass, centre)
        points = np.vstack([np.zeros(3), centre + points])
        return mass, tensor, centre, points, ("PIVOT", *(f"P{k}" for k in range(1, len(points))))
    return mass, tensor, np.zeros(3), points, tuple(f"P{k}" for k in range(1, len(points) + 1))


class Assembly(NamedTuple):
    """A body of several solids, along the body's axes: mass, centre of mass (3,), inertia tensor
    (3, 3) about it, and the outline (k, 3) of each solid from it."""

    mass: float
    centre: np.ndarray
    tensor: np.ndarray
    outlines: list[np.ndarray]


def assembled(solids: Sequence[SolidPart]) -> Assembly:
    """The rigid body of [[body.solids]], whose masses and inertia add up, by the parallel axis
    theorem. Where solids overlap, both masses are there."""
    masses = np.array([part.mass for part in solids])
    mass = float(masses.sum())
    centre = masses @ np.array([part.position_m for part in solids]) / mass
    tensor = np.zeros((3, 3))
    outlines = []
    for part in solids:
        shape = solid(part.shape, part.mass, part.dimensions)
        position = part.position_m - centre
        tensor_of_part = part.rotation @ np.diag(shape.inertia) @ part.rotation.T
        tensor += shifted_inertia(tensor_of_part, part.mass, position)
        outlines.append(position + shape.outline @ part.rotation.T)
    return Assembly(mass, centre, 0.5 * (tensor + tensor.T), outlines)


def inertia_at_centre(scene: BodyScene) -> np.ndarray:
    """The inertia tensor (3, 3) about the centre of mass, at the start."""
    if scene.changing_inertia is not None:
        return np.diag(scene.changing_inertia.inertia_kg_m2[0])
    mass, tensor, centre, _, _ = inertia_of(scene)
    return shifted_inertia(tensor, -mass, centre) if scene.body.pinned else tensor


def _equal_ellipsoid(mass: float, tensor: np.ndarray) -> np.ndarray:
    """Centre and vertices (7, 3) of the homogeneous ellipsoid with this inertia tensor. One point
    without inertia."""
    moments, axes = np.linalg.eigh(tensor)
    half = np.sqrt(np.maximum(2.5 / mass * (moments.sum() - 2 * moments), 0.0))
    if not half.any():
        return np.zeros((1, 3))
    tips = (axes * half).T
    return np.concatenate([np.zeros((1, 3)), tips, -tips])


def principal(tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (3,) and right-handed axes (3, 3) as columns, each as close to the body's
    axis as possible."""
    if (np.abs(tensor - np.diag(np.diag(tensor))) <= ROUNDING * np.abs(tensor).max()).all():
        return _without_rounding(np.diag(tensor)), np.eye(3)
    moments, axes = np.linalg.eigh(tensor)
    best = max(
        permutations(range(3)), key=lambda order: sum(abs(axes[k, order[k]]) for k in range(3))
    )
    moments = np.maximum(moments, 0.0)[list(best)]
    axes = axes[:, best]
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, np.abs(np.diag(axes)).argmin()] *= -1
    return _without_rounding(moments), axes


def _without_rounding(moments: np.ndarray) -> np.ndarray:
    """Moments that differ from each other or from 0 by rounding, made equal or 0, so that the rotor
    is exact."""
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
        mass, inertia = (
            np.array(added or np.zeros(3))
            for added in (fluid.added_mass_kg, fluid.added_inertia_kg_m2)
        )
        return mass, inertia, fluid.displaced_mass_kg or 0.0
    shape = not_none(scene.body.solid)
    half = np.array(shape.semi_axes_m or (shape.radius_m,) * 3)
    return (
        *added_mass_of_ellipsoid(half, fluid.density_kg_m3),
        fluid.density_kg_m3 * 4 / 3 * np.pi * half.prod(),
    )


def rotor_of(scene: BodyScene, moments: np.ndarray, added_inertia: np.ndarray, axes: np.ndarray):
    """The rotor of a body with moments about its axes, and wheels."""
    if not scene.wheels and scene.changing_inertia is None:
        return split_rotor(moments[None])
    changing = scene.changing_inertia
    inertia = constant_function(moments)
    if changing is not None:
        inertia = interpolated_function(
            changing.times_s, np.array(changing.inertia_kg_m2) + added_inertia
        )
    momenta = []
    for wheel in scene.wheels:
        axis = axes.T @ unit_vector(wheel.axis)
        motor = wheel.motor_torque_N_m
        torque = _time_function(wheel, np.multiply.outer(0.0 if motor is None else motor, axis))
        momenta.append(integrate_function(torque, wheel.momentum_kg_m2_s * axis))
    return DrivenRotor(
        inertia, sum_functions(momenta) if momenta else constant_function(np.zeros(3))
    )


def _time_function(timed: Timed, values) -> TimeFunction:
    """A value as a function of time: constant, within a window of time, or from a table."""
    if timed.times_s is not None:
        return interpolated_function(timed.times_s, values)
    if timed.from_s is not None or timed.to_s is not None:
        return pulse_function(values, *timed.window)
    return constant_function(values)


def frame_of(scene: BodyScene):
    """The frame of reference of a scene."""
    frame = scene.frame
    if frame is None or (
        frame.angular_velocity_rad_s is None and frame.angular_acceleration_rad_s2 is None
    ):
        return InertialFrame()
    rate = np.array(frame.angular_velocity_rad_s or (0.0, 0.0, 0.0))
    if frame.angular_acceleration_rad_s2 is not None:
        return RotatingFrame(
            integrate_function(constant_function(frame.angular_acceleration_rad_s2), rate)
        )
    return RotatingFrame(_time_function(frame, rate))


def resistance_of(scene: BodyScene):
    """The resistance of bearings and of the fluid of a scene."""
    friction, fluid = scene.friction or Friction(), scene.fluid or Fluid()
    viscous = np.add(friction.viscous_N_m_s, fluid.linear_rotational_resistance_N_m_s)
    of_translation = fluid.linear_resistance_kg_s, fluid.quadratic_resistance_kg_m
    parts = np.array(
        [*of_translation, friction.dry_N_m, viscous, fluid.quadratic_rotational_resistance_N_m_s2]
    )
    return Resistance(*parts) if parts.any() else NoResistance()


def terms_of(scene: BodyScene, mass: float, axes: np.ndarray, centre: np.ndarray, displaced: float):
    """The terms of the forces of a scene."""
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
        terms["origin_acceleration"] = _force(
            force, constant_function(np.zeros(3)), at_centre, follows_body=False
        )
    for k, entry in enumerate(scene.applied):
        force, torque = (
            constant_function(np.zeros(3)) if vector is None else _time_function(entry, vector)
            for vector in (entry.force_N, entry.torque_N_m)
        )
        if entry.axes == "body":
            force, torque = _rotated(force, axes.T), _rotated(torque, axes.T)
        at = axes.T @ np.array(entry.at_m or (0.0, 0.0, 0.0))
        terms[f"applied_{k}"] = _force(force, torque, at, follows_body=entry.axes == "body")
    return terms


def _rotated(course: TimeFunction, matrix: np.ndarray) -> TimeFunction:
    return TimeFunction(course.times, *(part @ matrix.T for part in course[1:]))


def _force(force: TimeFunction, torque: TimeFunction, point: np.ndarray, *, follows_body: bool):
    """The term of a force: with a potential energy if it is constant in the lab, else the ledger
    has its work."""
    if (
        not follows_body
        and is_constant_function(force)
        and is_constant_function(torque)
        and not torque.constant.any()
    ):
        return SteadyForce(force.constant[0], point)
    return TimeDependentForce(force, torque, point, follows_body)
