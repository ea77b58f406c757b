"""External forces on a single body: weight, buoyancy, forces from a scene, and forces from a Python
function."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, kernel
from rigidmd.core.state import NEEDS_PYTHON_FORCES, OK, State
from rigidmd.features.bodies.time_functions import TimeFunction, vector_at
from rigidmd.forces.terms import Setup, add_forces, power
from rigidmd.mechanics.vectors import body_component, body_vector, lab_vector


class SteadyForce(NamedTuple):
    """A constant force at a point of the body: weight, buoyancy. Energy -F . (X + Q point)."""

    force: np.ndarray  # (3,) lab
    point: np.ndarray  # (3,) body, from the centre of mass, or from the pivot of a pinned body


class TimeDependentForce(NamedTuple):
    """A force at a point of the body and a torque, as functions of time, along lab axes or body
    axes."""

    force: TimeFunction
    torque: TimeFunction
    point: np.ndarray  # (3,) body
    follows_body: bool  # whether force and torque are along the axes of the body

    def workspace(self, setup: Setup) -> "TimeDependentForceWorkspace":
        return TimeDependentForceWorkspace(*self, np.zeros(3), np.zeros(3))


class TimeDependentForceWorkspace(NamedTuple):
    force: TimeFunction
    torque: TimeFunction
    point: np.ndarray
    follows_body: bool
    force_lab: np.ndarray  # (3,) as last evaluated
    torque_body: np.ndarray  # (3,) as last evaluated, with the torque of the force

    time_dependent = True


class PythonForce(NamedTuple):
    """Force and torque from a Python function, which the engine calls."""

    def workspace(self, setup: Setup) -> "PythonForceWorkspace":
        return PythonForceWorkspace(np.zeros(1, np.int64), np.zeros(3), np.zeros(3))


class PythonForceWorkspace(NamedTuple):
    """Workspace of a `PythonForce`. It requests new values (NEEDS_PYTHON_FORCES) whenever positions
    have changed."""

    fresh: np.ndarray  # (1,) 1 if the values are those at the current positions
    force_lab: np.ndarray  # (3,)
    torque_body: np.ndarray  # (3,)

    time_dependent = True

    def update(self, function: Callable[[float, State], tuple], state: State) -> None:
        """Call a function of (time, state) for a force (3,) in the lab frame and a torque (3,) in
        the body frame."""
        self.force_lab[:], self.torque_body[:] = function(float(state.time[0]), state)
        self.fresh[0] = 1


@implements(add_forces, SteadyForce, inline=True)
def _add_steady_force(term, state, load, tally):
    for k in range(len(load.force)):
        for i in range(3):
            load.force[k, i] += term.force[i]
    for k in range(len(load.torque_body)):
        add_torque(term.point, state.rotation[k], term.force, load.torque_body[k])
    if tally is not None:
        tally[0] += steady_energy(term, state.position, state.rotation)
    return OK


@kernel(inline=True)
def steady_energy(term, position, rotation):
    """-F . (X + Q point) of the body. Position and rotation as in State, empty where the body has
    none."""
    energy = 0.0
    for i in range(3):
        x = 0.0
        if len(position):
            x += position[0, i]
        if len(rotation):
            q = rotation[0]
            x += q[i, 0] * term.point[0] + q[i, 1] * term.point[1] + q[i, 2] * term.point[2]
        energy -= term.force[i] * x
    return energy


@kernel(from_python=True)
def steady_energies(term, position, rotation):
    """`steady_energy` at t times, (t,). Position and rotation as in State, stacked along a new axis
    0."""
    energy = np.empty(len(position))
    for t in range(len(energy)):
        energy[t] = steady_energy(term, position[t], rotation[t])
    return energy


@kernel(inline=True)
def add_torque(point, rotation, force_lab, torque_body):
    """Add point x Q^T F to a torque (3,), all in the body frame."""
    a, b, c = body_vector(rotation, force_lab)
    torque_body[0] += point[1] * c - point[2] * b
    torque_body[1] += point[2] * a - point[0] * c
    torque_body[2] += point[0] * b - point[1] * a


@implements(add_forces, TimeDependentForceWorkspace)
def _add_time_dependent_force(term, state, load, tally):
    now = state.time[0]
    force, torque = vector_at(term.force, now), vector_at(term.torque, now)
    for k in range(3):
        term.force_lab[k] = force[k]
        term.torque_body[k] = torque[k]
    if len(state.rotation):
        q = state.rotation[0]
        along_lab = lab_vector(q, force[0], force[1], force[2])
        for k in range(3):
            if term.follows_body:
                term.force_lab[k] = along_lab[k]
            else:
                term.torque_body[k] = body_component(q, torque, k)
        add_torque(term.point, q, term.force_lab, term.torque_body)
    return add_to_load(term, load)


@implements(add_forces, PythonForceWorkspace)
def _add_python_force(term, state, load, tally):
    if term.fresh[0] == 0:
        return NEEDS_PYTHON_FORCES
    term.fresh[0] = 0
    return add_to_load(term, load)


@kernel(inline=True)
def add_to_load(term, load):
    """Add the current force and torque of a term to the load of the body. Returns OK."""
    for k in range(len(load.force)):
        for i in range(3):
            load.force[k, i] += term.force_lab[i]
    for k in range(len(load.torque_body)):
        for i in range(3):
            load.torque_body[k, i] += term.torque_body[i]
    return OK


@implements(power, (TimeDependentForceWorkspace, PythonForceWorkspace))
def _drive_power(term, state, velocity, omega):
    total = 0.0
    for k in range(3):
        if len(state.position):
            total += term.force_lab[k] * velocity[k]
        if len(state.rotation):
            total += term.torque_body[k] * omega[k]
    return total
