"""The step loop of a single body, and its flows. The types choose each part, so only what a scene
has is compiled."""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from rigidmd.compile import chosen_by_type, implements, is_a, kernel
from rigidmd.core.integrators import DRIFT, KICK, Scheme
from rigidmd.core.state import NOW, OK, ORIGIN, WORK
from rigidmd.dynamics.force_gradient import (
    GradientWorkspace,
    add_gyration,
    displace,
    evaluate,
)
from rigidmd.features.bodies.driven_rotor import DrivenRotor, all_moments, omega_in_frame
from rigidmd.features.bodies.forces.resistance import NoResistance, Resistance, kick_with_resistance
from rigidmd.features.bodies.translation import (
    FluidTranslation,
    FreeTranslation,
    InertialFrame,
    NoTranslation,
    RotatingFrame,
    all_inertial_masses,
    frame_rate,
    rotate_with_frame,
    translate,
)
from rigidmd.forces.terms import TermTable, add_forces, compute_load, power, trait, worse_status
from rigidmd.mechanics.free_rotor import (
    ORTHOGONALITY_INTERVAL,
    ExactRotor,
    NoRotor,
    SplitRotor,
    restore_orthogonality,
    rotate_by_vector,
)
from rigidmd.mechanics.vectors import body_vector, lab_vector

#: Indices of the progress of a step: flows done; whether the load belongs to the current positions
#: (1), and the load of a kick with gradient too (2).
DONE, LOADED = 0, 1


class Body(NamedTuple):
    """The constant part of a single body, in SI units. The counterpart of `Model` for molecules."""

    translation: FreeTranslation | NoTranslation | FluidTranslation
    rotor: SplitRotor | ExactRotor | DrivenRotor | NoRotor
    frame: InertialFrame | RotatingFrame = InertialFrame()
    resistance: NoResistance | Resistance = NoResistance()


class FlowArrays(NamedTuple):
    """The kicks and drifts of a scheme as arrays, in their order."""

    kind: np.ndarray  # (flows,) KICK or DRIFT
    fraction: np.ndarray  # (flows,) of the time step
    moment: np.ndarray  # (flows,) the sum of the fractions of the drifts up to each flow
    gradient: np.ndarray | None  # (flows,) of dt²; None (not compiled) where no kick has a gradient
    last: int  # index of the last drift


def flow_arrays(scheme: Scheme) -> FlowArrays:
    kind = np.array([flow.kind for flow in scheme.flows])
    fraction = np.array([flow.fraction for flow in scheme.flows])
    moment = np.cumsum(np.where(kind == DRIFT, fraction, 0.0))
    last = int(np.flatnonzero(kind == DRIFT)[-1])
    moment[last:] = 1.0
    gradient = np.array([flow.gradient for flow in scheme.flows])
    return FlowArrays(kind, fraction, moment, gradient if scheme.has_gradient else None, last)


@kernel(from_python=True)
def advance_body(model, state, load, terms, flows, gradient_workspace, dt, until, progress):
    """Take steps of dt of a body until state.step is `until`. Returns a status code, after which
    another call continues exactly where this one stopped.

    terms : a tuple of workspaces; flows : see `FlowArrays`; progress : see DONE
    gradient_workspace : None compiles no kicks with gradients
    """
    while state.step[NOW] < until:
        while progress[DONE] < len(flows.kind):
            k = progress[DONE]
            h = flows.fraction[k] * dt
            if flows.kind[k] == KICK:
                tau = 0.0
                if gradient_workspace is not None:
                    tau = flows.gradient[k] * dt * dt
                while needs_forces(progress, gradient_workspace, tau):
                    known = progress[LOADED] != 0
                    status = _evaluate(model, state, load, terms, gradient_workspace, tau, known)
                    if status != OK:
                        return status
                    progress[LOADED] = 2 if known else 1
                pushing = load_of_kick(load, gradient_workspace, tau)
                accumulate_work(model, terms, state, 0.5 * h)
                kick_with_resistance(
                    model.resistance,
                    model.translation,
                    model.rotor,
                    model.frame,
                    state,
                    pushing,
                    h,
                )
                accumulate_work(model, terms, state, 0.5 * h)
            else:
                time = state.time[NOW]
                translate(model.translation, model.rotor, state, time, h)
                rotate_with_frame(model.frame, state, time, h)
                state.time[NOW] = (
                    state.time[ORIGIN]
                    + (state.step[NOW] - state.step[ORIGIN] + flows.moment[k]) * dt
                )
                progress[LOADED] = 0
                if k == flows.last and (state.step[NOW] + 1) % ORTHOGONALITY_INTERVAL == 0:
                    restore_orthogonality(state.rotation, state.angular_momentum_body)
            progress[DONE] += 1
        progress[DONE] = 0
        state.step[NOW] += 1
    return OK


@kernel
def needs_forces(progress, gradient, tau):
    """Whether a kick has to wait for an evaluation of forces.

    progress : see DONE; gradient : the `GradientWorkspace`, or None; tau : of the kick, 0
    without gradient
    """
    if gradient is None:
        return progress[LOADED] == 0
    if tau == 0.0 or progress[LOADED] == 0:
        return progress[LOADED] == 0
    return progress[LOADED] == 1 or gradient.tau[0] != tau


@kernel
def load_of_kick(load, gradient, tau):
    """The forces and torques of a kick. For the arguments see `needs_forces`."""
    if gradient is None:
        return load
    return load if tau == 0.0 else gradient.load


@chosen_by_type
def _evaluate(model, state, load, terms, gradient_workspace, tau, known):
    """`evaluate`, of which a scheme without gradients compiles the forces only. A status code."""
    if not is_a(gradient_workspace, GradientWorkspace):
        return lambda model, state, load, terms, gradient_workspace, tau, known: compute_body_load(
            terms, state, load
        )
    return lambda model, state, load, terms, gradient_workspace, tau, known: evaluate(
        model, state, load, terms, gradient_workspace, tau, known
    )


@kernel(inline=True)
def compute_body_load(terms, state, load):
    """Write the forces and torques of all terms (a tuple) at the current positions. The worst
    status code."""
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = worse_status(status, add_forces(term, state, load, None))
    return status


@implements(compute_load)
def _compute_load(terms, state, load, which):
    """The forces of a tuple of terms, without energies."""
    if is_a(terms, TermTable):
        return None
    return lambda terms, state, load, which: compute_body_load(terms, state, load)


@kernel
def total_power(terms, state, velocity, omega):
    total = 0.0
    for term in literal_unroll(terms):
        total += power(term, state, velocity, omega)
    return total


@implements(displace, Body, inline=True)
def _displace_body(model, state, load, tau):
    for k in range(len(load.force)):
        for i in range(3):
            state.position[k, i] += tau / model.translation.mass * load.force[k, i]
    for k in range(len(load.torque_body)):
        n = load.torque_body[k]
        i, _ = all_moments(model.rotor, state.time[NOW])
        rotate_by_vector(state.rotation[k], tau * i[0] * n[0], tau * i[1] * n[1], tau * i[2] * n[2])


@implements(add_gyration, Body, inline=True)
def _add_gyration_of_body(model, load, tau, gain):
    for b in range(len(load.torque_body)):
        n = load.torque_body[b]
        i, _ = all_moments(model.rotor, 0.0)
        gain.torque_body[b, 0] += tau * (i[1] - i[2]) * n[1] * n[2]
        gain.torque_body[b, 1] += tau * (i[2] - i[0]) * n[2] * n[0]
        gain.torque_body[b, 2] += tau * (i[0] - i[1]) * n[0] * n[1]


@chosen_by_type(inline=True)
def accumulate_work(model, terms, state, h):
    """Add the work of time-dependent terms over h to the energy ledger, half before a kick and half
    after it: their power at the current velocity."""
    if not any(trait(term.instance_class, "time_dependent") for term in terms.types):
        return lambda model, terms, state, h: None

    def accumulate_work_of_body(model, terms, state, h):
        velocity, omega = relative_motion(model, state)
        state.energy_ledger[WORK] += h * total_power(terms, state, velocity, omega)

    return accumulate_work_of_body


@kernel
def relative_motion(model, state):
    """(velocity along lab axes, omega along body axes) relative to the frame, as tuples, 0 where
    the body has none."""
    W = frame_rate(model.frame, state.time[NOW])
    velocity = omega = (0.0, 0.0, 0.0)
    if len(state.position):
        V = state.velocity[0]
        velocity = (V[0], V[1], V[2])
        if len(state.rotation):
            q, mass = state.rotation[0], model.translation.mass
            a, b, c = body_vector(q, V)
            m0, m1, m2 = all_inertial_masses(model.translation)
            velocity = lab_vector(q, a * mass / m0, b * mass / m1, c * mass / m2)
        x = state.position[0]
        u, v, w = velocity
        velocity = (
            u - W[1] * x[2] + W[2] * x[1],
            v - W[2] * x[0] + W[0] * x[2],
            w - W[0] * x[1] + W[1] * x[0],
        )
    if len(state.rotation):
        omega = omega_in_frame(model.rotor, state, body_vector(state.rotation[0], W))
    return velocity, omega
