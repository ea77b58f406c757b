"""The system of a scene of a single body: flight, rotor, frame, resistance, terms, first state."""

from collections.abc import Callable

import numpy as np

from rigidmd.assemble.body_faults import body_errors, integrator_errors, torque_errors
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
from rigidmd.mechanics.free_rotor import DrivenRotor, NoRotor
from rigidmd.mechanics.time_functions import values_at
from rigidmd.mechanics.translation import FluidTranslation, FreeTranslation, NoTranslation
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none

LARGEST_IN = {".gro": 9e4, ".pdb": 990.0}  # Å: columns of text


def build_body(scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None = None) -> BodySystem:
    """The system of a scene. Raises SceneError with every fault.

    applied : name -> function of a `Pose` that gives a force (3,) in N along the lab's axes, at the centre of mass, and
        a torque (3,) in N m along the body's axes
    """
    faults: list[str] = []
    mass, tensor, centre, points, names = inertia_of(scene)
    added_mass, added_inertia, displaced = carried_fluid(scene)
    if scene.changing_inertia is not None:
        moments, axes = np.array(scene.changing_inertia.inertia_kg_m2[0]), np.eye(3)
    else:
        moments, axes = principal(tensor)
    moments = moments + added_inertia
    turning = bool(moments.any())
    faults += body_errors(scene, centre, moments, axes, added_mass)
    attitude, spin = scene.start.attitude, scene.start.angular_velocity
    own_spin = axes.T @ spin
    idle = (moments == 0) & (np.abs(own_spin) > 1e-12 * np.abs(own_spin).max(initial=0.0))
    if turning and idle.any():
        faults.append("start: the body has no inertia about an axis about which it is to turn")
    faults += integrator_errors(scene, bool(added_mass.any()), bool(applied))
    taken = {"gravity", "buoyancy", "origin_acceleration", *(f"applied_{k}" for k in range(len(scene.applied)))}
    faults += [
        f"applied: {name!r} is the name of a force of the scene; choose another"
        for name in applied or {}
        if name in taken
    ]
    for k, entry in enumerate(scene.applied):
        faults += torque_errors(entry, k, axes, moments, turning)
    if faults:
        raise SceneError(scene.source, faults)

    scene = body_with_defaults(scene, turning, float(np.linalg.norm(points, axis=1).max()))
    check_memory_of_samples(scene)
    rotor = rotor_of(scene, moments, added_inertia, axes) if turning else NoRotor()
    frame = frame_of(scene)
    if scene.body.pinned:
        flight = NoTranslation(mass)
    elif added_mass.any():
        flight = FluidTranslation(mass, mass + added_mass)
    else:
        flight = FreeTranslation(mass)
    body = Body(flight, rotor, frame, resistance_of(scene))
    applied = applied or {}
    terms = terms_of(scene, mass, axes, centre, displaced)
    terms |= {name: PythonForce() for name in applied}
    system = BodySystem(
        scene=scene,
        body=body,
        state=_first_state(scene, body, moments, axes, attitude, own_spin, turning),
        terms=terms,
        mass=mass,
        axes=axes,
        inertia=moments,
        centre=centre,
        points=points,
        point_names=names,
        applied=applied,
    )
    system.left_out = _left_out(system)
    if scene.output.trajectory and system.translates:
        reach = system.scale * np.abs(system.state.position).max()
        if not reach < LARGEST_IN[not_none(scene.output.topology)[-4:]]:
            raise SceneError(
                scene.source,
                [
                    f"start.position_m is {reach:.3g} Å in the trajectory, which {scene.output.topology} cannot hold: "
                    "set output.trajectory_A_per_m to less, or output.trajectory = false"
                ],
            )
    return system


def _first_state(scene, body, moments, axes, attitude, own_spin, turning) -> State:
    start = scene.start
    time = np.zeros(1)
    frame = np.zeros(3) if isinstance(body.frame, InertialFrame) else values_at(body.frame.angular_velocity, time)[0]
    position = velocity = np.zeros((0, 3))
    rotation, momentum = np.zeros((0, 3, 3)), np.zeros((0, 3))
    own_rotation = attitude @ axes
    if turning:
        rotation = own_rotation[None].copy()
        momentum = (moments * (own_spin + own_rotation.T @ frame))[None].copy()
        if isinstance(body.rotor, DrivenRotor):
            momentum += values_at(body.rotor.momentum, time)
    if not scene.body.pinned:
        position = np.array([start.position_m or (0.0, 0.0, 0.0)])
        velocity = np.array([start.velocity_m_s or (0.0, 0.0, 0.0)]) + np.cross(frame, position)
        if isinstance(body.flight, FluidTranslation):
            share = body.flight.inertial_mass / body.flight.mass
            velocity = (own_rotation @ (share * (own_rotation.T @ velocity[0])))[None]
    return state_of(position, velocity, rotation, momentum)


def _left_out(system: BodySystem) -> list[str]:
    """What is not compiled for this body, and why."""
    out = ["box, neighbour lists, pair forces, threads: there is one body"]
    if not system.translates:
        out.append("translation: the body is pinned")
    if not system.rotates:
        out.append("rotation: the body is a point")
    body = system.body
    if isinstance(body.frame, InertialFrame):
        out.append("frame: its axes do not turn")
    if isinstance(body.resistance, NoResistance):
        out.append("resistance: there is none")
    if not isinstance(body.rotor, DrivenRotor):
        out.append("wheels and changing inertia: there are none")
    if not system.terms:
        out.append("forces: there are none")
    return out
