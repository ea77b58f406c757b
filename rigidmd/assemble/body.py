"""The system of a scene of a single body: translation, rotor, frame, resistance, terms, state at the start."""

from collections.abc import Callable

import numpy as np

from rigidmd.assemble.body_errors import body_errors, integrator_errors, torque_errors
from rigidmd.assemble.body_parts import (
    carried_fluid,
    frame_of,
    inertia_of,
    principal,
    resistance_of,
    rotor_of,
    terms_of,
)
from rigidmd.assemble.defaults import body_with_defaults
from rigidmd.assemble.memory_check import check_memory_of_samples
from rigidmd.core.state import State, state_of
from rigidmd.dynamics.body_step_loop import Body
from rigidmd.engines.body_system import BodySystem, Pose
from rigidmd.errors import SceneError
from rigidmd.forces.body.applied import PythonForce
from rigidmd.forces.body.frame import InertialFrame
from rigidmd.forces.body.resistance import NoResistance
from rigidmd.io.formats import format_of
from rigidmd.mechanics.free_rotor import DrivenRotor, NoRotor
from rigidmd.mechanics.time_functions import values_at
from rigidmd.mechanics.translation import FluidTranslation, FreeTranslation, NoTranslation
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none


def build_body(scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None = None) -> BodySystem:
    """The system of a scene. Raises SceneError with all errors.

    applied : name -> function of a `Pose` that returns a force (3,) in N along the lab's axes, at the centre of mass,
        and a torque (3,) in N m along the body's axes
    """
    mass, tensor, centre, points, names = inertia_of(scene)
    added_mass, added_inertia, displaced = carried_fluid(scene)
    if scene.changing_inertia is not None:
        moments, axes = np.array(scene.changing_inertia.inertia_kg_m2[0]), np.eye(3)
    else:
        moments, axes = principal(tensor)
    moments = moments + added_inertia
    rotates, applied = bool(moments.any()), applied or {}
    faults = body_errors(scene, centre, moments, axes, added_mass)
    attitude = scene.start.attitude
    spin = axes.T @ scene.start.angular_velocity  # along the principal axes
    without_inertia = (moments == 0) & (np.abs(spin) > 1e-12 * np.abs(spin).max(initial=0.0))
    if rotates and without_inertia.any():
        faults.append("start: the body rotates about an axis without inertia")
    faults += integrator_errors(scene, bool(added_mass.any()), bool(applied))
    taken = {"gravity", "buoyancy", "origin_acceleration", *(f"applied_{k}" for k in range(len(scene.applied)))}
    faults += [
        f"applied: {name!r} is the name of a force of the scene; choose another" for name in applied if name in taken
    ]
    for k, entry in enumerate(scene.applied):
        faults += torque_errors(entry, k, axes, moments, rotates)
    if faults:
        raise SceneError(scene.source, faults)

    scene = body_with_defaults(scene, rotates, float(np.linalg.norm(points, axis=1).max()))
    check_memory_of_samples(scene)
    rotor = rotor_of(scene, moments, added_inertia, axes) if rotates else NoRotor()
    frame = frame_of(scene)
    if scene.body.pinned:
        translation = NoTranslation(mass)
    elif added_mass.any():
        translation = FluidTranslation(mass, mass + added_mass)
    else:
        translation = FreeTranslation(mass)
    body = Body(translation, rotor, frame, resistance_of(scene))
    terms = terms_of(scene, mass, axes, centre, displaced)
    terms |= {name: PythonForce() for name in applied}
    system = BodySystem(
        scene=scene, body=body, state=_first_state(scene, body, moments, axes, attitude, spin, rotates), terms=terms,
        mass=mass, axes=axes, inertia=moments, centre=centre, points=points, point_names=names, applied=applied,
    )  # fmt: skip
    system.left_out = _left_out(system)
    if scene.output.trajectory and system.translates:
        form = not_none(format_of(not_none(scene.output.topology)))
        if form.exceeded(system.site_positions(system.state)) is not None:
            reach = system.scale * np.abs(system.state.position).max()
            fault = f"start.position_m is {reach:.3g} Å in the trajectory, which {scene.output.topology} cannot hold"
            advice = "set output.trajectory_A_per_m to less, or output.trajectory = false"
            raise SceneError(scene.source, [f"{fault}: {advice}"])
    return system


def _first_state(scene, body, moments, axes, attitude, spin, rotates) -> State:
    """The state at the start; spin (3,) along the principal axes, relative to the frame."""
    start = scene.start
    time = np.zeros(1)
    frame = np.zeros(3) if isinstance(body.frame, InertialFrame) else values_at(body.frame.angular_velocity, time)[0]
    position = velocity = np.zeros((0, 3))
    rotation, momentum = np.zeros((0, 3, 3)), np.zeros((0, 3))
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


def _left_out(system: BodySystem) -> list[str]:
    """What is not compiled for this body, and why."""
    body = system.body
    reasons = {
        "box, neighbour lists, pair forces, threads: there is one body": True,
        "translation: the body is pinned": not system.translates,
        "rotation: the body is a point": not system.rotates,
        "frame: its axes do not rotate": isinstance(body.frame, InertialFrame),
        "resistance: none": isinstance(body.resistance, NoResistance),
        "wheels and changing inertia: none": not isinstance(body.rotor, DrivenRotor),
        "forces: none": not system.terms,
    }
    return [reason for reason, applies in reasons.items() if applies]
