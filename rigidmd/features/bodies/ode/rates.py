"""The compiled equations of motion of a single body as a first-order system, for general ODE
solvers."""

from math import hypot, sin

from rigidmd.compile import kernel
from rigidmd.core.state import NOW, OK, ORIGIN, WORK
from rigidmd.features.bodies.driven_rotor import moment_rates
from rigidmd.features.bodies.forces.resistance import add_resistance
from rigidmd.features.bodies.ode.odes import attitude_rates, write_rotation
from rigidmd.features.bodies.step_loop import compute_body_load, relative_motion, total_power
from rigidmd.features.bodies.translation import frame_rate, inertial_mass
from rigidmd.mechanics.vectors import body_component

SINGULAR = 5  # status code beyond those of core.state: Euler angles too near theta = 0 or pi
#: Below this sine, half of the digits of phi and psi are lost, because theta has an error of 1e-16.
SMALLEST_SINE = 1e-8
#: Below this sine, a step may jump over the pole.
NEAR_A_POLE = 0.1


@kernel(from_python=True)
def moment_rates_of(rotor, time, k):
    """`moment_rates` for calls from Python."""
    return moment_rates(rotor, time, k)


@kernel(from_python=True)
def read(form, model, state, time, y):
    """Write the solver's variables into a state."""
    n = form.variables
    state.time[NOW] = time
    write_rotation(form, y, state.rotation)
    for m in range(len(state.angular_momentum_body)):
        for k in range(3):
            inertia, _, carried, _ = moment_rates(model.rotor, time, k)
            state.angular_momentum_body[m, k] = inertia * y[n + k] + carried
        n += 3
    for m in range(len(state.position)):
        for k in range(3):
            state.position[m, k] = y[n + k]
            state.velocity[m, k] = y[n + 3 + k]
    state.energy_ledger[WORK] = y[-1]


@kernel(from_python=True)
def write_rates(form, model, terms, state, load, time, y, dy):
    """Write the rates of all variables into dy. Returns a status code. Lab vectors are along the
    axes of the frame. See "The equations of motion" in the theory chapter `bodies`."""
    read(form, model, state, time, y)
    status = compute_body_load(terms, state, load)
    if status != OK:
        return status
    velocity, omega = relative_motion(model, state)
    dy[-1] = total_power(terms, state, velocity, omega) + add_resistance(
        model.resistance, state, load, velocity, omega
    )
    W = frame_rate(model.frame, time)
    n = form.variables
    for m in range(len(state.rotation)):
        attitude_rates(form, y, omega[0], omega[1], omega[2], dy)
        q = state.rotation[m]
        L = state.angular_momentum_body[m]
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            inertia, growth, _, motor = moment_rates(model.rotor, time, k)
            torque = (
                load.torque_body[m, k]
                + L[i] * y[n + j]
                - L[j] * y[n + i]
                - motor
                - growth * y[n + k]
            )
            for b in range(len(state.position)):
                pi = model.translation.mass * body_component(q, state.velocity[b], i)
                pj = model.translation.mass * body_component(q, state.velocity[b], j)
                torque += (
                    pi
                    * pj
                    * (
                        1 / inertial_mass(model.translation, j)
                        - 1 / inertial_mass(model.translation, i)
                    )
                )
            dy[n + k] = torque / inertia if inertia > 0 else 0.0
            dy[-1] -= (motor + 0.5 * growth * y[n + k]) * y[n + k]
        n += 3
    for m in range(len(state.position)):
        V = state.velocity[m]
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            dy[n + k] = velocity[k]
            dy[n + 3 + k] = load.force[m, k] / model.translation.mass - W[i] * V[j] + W[j] * V[i]
    return OK


@kernel(from_python=True)
def is_singular(form, y, dy, dt):
    """Whether theta is within zero time step or pi, or so near that phi and psi lose half of their
    digits."""
    if form.variables != 3:
        return False
    s = abs(sin(y[1]))
    return s <= SMALLEST_SINE or (s < NEAR_A_POLE and s <= dt * hypot(dy[1], dy[0] * s))


@kernel(from_python=True)
def rk4(form, model, terms, state, load, y, stages, dt, until, cursor):
    """Classical Runge-Kutta until state.step is `until`. cursor (1,): stages done in a step. Stages
    (5, variables)."""
    shift = (0.0, 0.5, 0.5, 1.0)
    while state.step[NOW] < until:
        time = state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN]) * dt
        while cursor[0] < 4:
            k = cursor[0]
            for i in range(len(y)):
                stages[4, i] = y[i] + shift[k] * dt * stages[max(k - 1, 0), i] if k else y[i]
            status = write_rates(
                form, model, terms, state, load, time + shift[k] * dt, stages[4], stages[k]
            )
            if status != OK:
                return status
            if k == 0 and is_singular(form, y, stages[0], dt):
                return SINGULAR
            cursor[0] += 1
        for i in range(len(y)):
            y[i] += dt / 6 * (stages[0, i] + 2 * stages[1, i] + 2 * stages[2, i] + stages[3, i])
        cursor[0] = 0
        state.step[NOW] += 1
    return OK
