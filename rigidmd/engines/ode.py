"""The motion of a single body as in textbooks: a first-order system for a general ODE solver.

Variables: attitude (matrix, quaternion or Euler angles), angular velocity (body frame), position and velocity of a
body that flies, and the work of drives and resistance, for the balance of energy. It is solved by classical RK4
(compiled) or by SciPy's DOP853 and Radau. These solvers are for comparison with the flows of `body`; only their
accuracy keeps Q a rotation.
"""

from collections.abc import Callable
from math import hypot, sin

import numpy as np
from scipy.integrate import DOP853 as Dop853
from scipy.integrate import Radau

from rigidmd.compile import kernel
from rigidmd.core.integrators import DOP853, FORMULATIONS, RADAU, RK4, Scheme, Solver
from rigidmd.core.state import NOW, OK, ORIGIN, WORK, State, no_load
from rigidmd.dynamics.body_step_loop import Body, relative_motion
from rigidmd.engines.cpu import Engine, keep_time
from rigidmd.engines.protocol import Halted
from rigidmd.errors import SimulationError
from rigidmd.forces.body.frame import frame_rate
from rigidmd.forces.body.resistance import add_resistance
from rigidmd.forces.terms import compute_body_load, total_power
from rigidmd.mechanics.free_rotor import moment_rates
from rigidmd.mechanics.odes import (
    EulerAngles,
    Form,
    Matrix,
    NoAttitude,
    Quaternion,
    attitude_rates,
    read_attitude,
    variables_of,
)
from rigidmd.mechanics.translation import body_component, inertial_mass

FORMS: dict[str, Form] = dict(zip(FORMULATIONS, (Matrix(), Quaternion(), EulerAngles()), strict=True))

#: A step of DOP853 is at the limit of stability if it times the eigenvalue is beyond this; how many such steps are
#: stiff, and how many others in a row are not. Changes within a step below this share of the variables are rounding.
STABLE, STIFF, MILD, ROUNDED = 6.1, 200, 6, 1e-14
SINGULAR = 5  # beyond the codes of core.state: Euler angles too near theta = 0 or pi
#: Half of the digits of phi and psi are lost there, because theta has an error of 1e-16.
SMALLEST_SINE = 1e-8
#: Nearer to the pole than this, an axis may jump over it in one step.
NEAR_A_POLE = 0.1


@kernel(outer=True)
def moment_rates_of(rotor, time, k):
    """`moment_rates` for calls from Python."""
    return moment_rates(rotor, time, k)


@kernel(outer=True)
def read(form, model, state, time, y):
    """Write the variables into a state."""
    n = form.variables
    state.time[NOW] = time
    read_attitude(form, y, state.rotation)
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


@kernel(outer=True)
def slopes(form, model, terms, state, load, time, y, dy):
    """Write the rates of all variables; returns a status code. Lab vectors are along the axes of the frame.

    I w' = n + L x w + P x v - h' - I' w; X' = v - Omega x X; V' = F/m - Omega x V; attitude by w - Q^T Omega;
    W' = the power of drives and resistance, relative to the frame, and of changes of I and h.
    """
    read(form, model, state, time, y)
    status = compute_body_load(terms, state, load, None)
    if status != OK:
        return status
    velocity, omega = relative_motion(model, state)
    dy[-1] = total_power(terms, state, velocity, omega) + add_resistance(model.resistance, state, load, velocity, omega)
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
            torque = load.torque_body[m, k] + L[i] * y[n + j] - L[j] * y[n + i] - motor - growth * y[n + k]
            for b in range(len(state.position)):
                pi = model.flight.mass * body_component(q, state.velocity[b], i)
                pj = model.flight.mass * body_component(q, state.velocity[b], j)
                torque += pi * pj * (1 / inertial_mass(model.flight, j) - 1 / inertial_mass(model.flight, i))
            dy[n + k] = torque / inertia if inertia > 0 else 0.0
            dy[-1] -= (motor + 0.5 * growth * y[n + k]) * y[n + k]
        n += 3
    for m in range(len(state.position)):
        V = state.velocity[m]
        for k in range(3):
            i = (k + 1) % 3
            j = (k + 2) % 3
            dy[n + k] = velocity[k]
            dy[n + 3 + k] = load.force[m, k] / model.flight.mass - W[i] * V[j] + W[j] * V[i]
    return OK


@kernel(outer=True)
def singular(form, y, dy, dt):
    """Whether theta is within a step of 0 or pi, or so near that phi and psi have lost half of their digits."""
    if form.variables != 3:
        return False
    s = abs(sin(y[1]))
    return s <= SMALLEST_SINE or (s < NEAR_A_POLE and s <= dt * hypot(dy[1], dy[0] * s))


@kernel(outer=True)
def rk4(form, model, terms, state, load, y, stages, dt, until, cursor):
    """Classical Runge-Kutta until state.step is `until`; cursor (1,): stages done in a step; stages (5, variables)."""
    shift = (0.0, 0.5, 0.5, 1.0)
    while state.step[NOW] < until:
        time = state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN]) * dt
        while cursor[0] < 4:
            k = cursor[0]
            for i in range(len(y)):
                stages[4, i] = y[i] + shift[k] * dt * stages[max(k - 1, 0), i] if k else y[i]
            status = slopes(form, model, terms, state, load, time + shift[k] * dt, stages[4], stages[k])
            if status != OK:
                return status
            if k == 0 and singular(form, y, stages[0], dt):
                return SINGULAR
            cursor[0] += 1
        for i in range(len(y)):
            y[i] += dt / 6 * (stages[0, i] + 2 * stages[1, i] + 2 * stages[2, i] + stages[3, i])
        cursor[0] = 0
        state.step[NOW] += 1
    return OK


class OdeEngine(Engine):
    """An engine that moves a body by a general solver.

    The variables are in `state.extra_variables`, which `begin` makes; the rest of the state is computed from them. DOP853 and
    Radau step beyond the requested time, so for them it also holds the begin and the length of the last step: (time,
    length, variables there, variables now, sizes of all variables but the work). DOP853 continues from it to the bit;
    Radau within its tolerance, because it also remembers a Jacobian.
    """

    model: Body
    _solver: Dop853 | Radau | None = None
    _between: Callable[[float], np.ndarray] | None = None
    _anew = False  # whether forces have changed, so that earlier steps are of no use
    own_steps = 0  # that DOP853 or Radau has taken
    halts: Callable[[], bool] = staticmethod(lambda: False)  # whether to end now; asked at each of these steps
    _stiff, _mild = 0, 0  # steps in a row at the limit of stability, and not, as Hairer counts them
    is_stiff = False  # whether DOP853 was held there for long

    @property
    def evaluations(self) -> int:
        """Evaluations of the slopes by DOP853 or Radau since its last start."""
        return self._solver.nfev if self._solver is not None else 0

    def variables(self, state: State, row: Scheme | Solver) -> np.ndarray:
        """The variables of a solver at a state."""
        solver = _solver_of(row)
        omega = []
        if len(state.rotation):
            for k in range(3):
                inertia, _, carried, _ = moment_rates_of(self.model.rotor, state.time[NOW], k)
                omega.append((state.angular_momentum_body[0, k] - carried) / inertia if inertia > 0 else 0.0)
        flight = [state.position.ravel(), state.velocity.ravel()]
        y = np.concatenate(
            [variables_of(_form(solver, state), state.rotation), omega, *flight, state.energy_ledger[[WORK]]]
        )
        if solver.name != RK4:
            y = np.concatenate([[state.time[NOW], 0.0], y, y, self._sizes(solver, state, y)])
        return y

    def advance(self, state: State, row: Scheme | Solver, dt: float, until: int, observed: bool = False) -> None:
        """As `Engine.advance`. DOP853 and Radau choose their own steps in between. Raises SimulationError, Halted."""
        solver = _solver_of(row)
        self._prepare(state)
        keep_time(state, dt)
        self._moved = state
        form = _form(solver, state)
        if self.load is None:
            self.load = no_load(state)
        if solver.name == RK4:
            self._rk4(form, state, dt, until)
        else:
            self._adaptive(form, state, solver, dt, until)

    def memory(self) -> dict[str, np.ndarray] | None:
        """As `Engine.memory`; None of Radau, which would go on only within its tolerance."""
        return None if isinstance(self._solver, Radau) else super().memory()

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """As `Engine.recall`; DOP853 goes on from its last step."""
        super().recall(state, memory)
        self._anew = False

    def check(self, state: State, row: Scheme | Solver, dt: float, start: State | None) -> None:
        """Raise ValueError unless a state that was recalled is the one that its variables give.

        start : where the run began, if forces have not changed since
        """
        solver, variables = _solver_of(row), len(state.extra_variables) // 3
        if solver.name != RK4:
            time, length = state.extra_variables[:2]
            sizes = state.extra_variables[2 + 2 * variables :]
            if not (0 <= time <= state.time[NOW] and length >= 0 and (sizes > 0).all()):
                raise ValueError("the last step of its solver is none")
            if start is not None and not np.array_equal(sizes, self.variables(start, row)[2 + 2 * variables :]):
                raise ValueError("the sizes of its variables are not those of the start")
        again = state.copy()
        try:
            self.advance(again, row, dt, int(state.step[NOW]))
        except (SimulationError, ValueError) as error:
            raise ValueError(f"its solver finds no way to its state: {error}") from None
        for name, found, there in zip(State._fields, again, state, strict=True):
            if not np.allclose(found, there, rtol=1e-9, atol=1e-9 * np.abs(there[np.isfinite(there)]).max(initial=0.0)):
                raise ValueError(f"its state has another {name} than its variables")

    def forget(self) -> None:
        """As `Engine.forget`; the variables stay, and the solver restarts."""
        super().forget()
        self._solver = self._between = None
        self._anew = True

    def _rk4(self, form: Form, state: State, dt: float, until: int) -> None:
        y = state.extra_variables
        cursor, stages = np.zeros(1, np.int64), np.zeros((5, len(y)))
        while status := rk4(form, self.model, self._workspaces, state, self.load, y, stages, dt, until, cursor):
            if status == SINGULAR:
                raise SingularError(y[1], state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN]) * dt)
            self._answer(status, state)
        read(form, self.model, state, state.time[ORIGIN] + (until - state.step[ORIGIN]) * dt, y)

    def _adaptive(self, form: Form, state: State, solver: Solver, dt: float, until: int) -> None:
        variables = len(state.extra_variables) // 3
        begun, there, y, sizes = np.split(state.extra_variables, [2, 2 + variables, 2 + 2 * variables])
        end = state.time[ORIGIN] + (until - state.step[ORIGIN]) * dt
        if self._anew:
            begun[:], there[:] = (state.time[NOW], 0.0), y
            sizes[:] = self._sizes(solver, state, y)
            self._anew = False
        kept, running = state.extra_variables.copy(), self._solver
        if running is None:
            if singular(form, there, there, 0.0):
                raise SingularError(there[1], begun[0])
            running = self._solver = self._new_solver(form, state, solver, begun, there, sizes)
        while running.t < end:
            begun[:] = running.t, running.h_abs
            there[:] = running.y
            with np.errstate(all="ignore"):
                problem = running.step()
                self._count_stiff(running)
            self.own_steps += 1
            if singular(form, running.y, running.y, 0.0):
                raise SingularError(running.y[1], running.t)
            if problem or not np.isfinite(running.y).all():
                raise SimulationError(
                    f"at t = {running.t:.6g}: {solver.name} finds no step that keeps its tolerances "
                    f"({solver.relative_tolerance:g} relative, {solver.absolute_tolerance:g} absolute)"
                )
            self._between = running.dense_output()
            if self.halts():  # back to the last look: the slopes have moved the state
                state.extra_variables[:] = kept
                read(form, self.model, state, state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN]) * dt, y)
                raise Halted
        if self._between is not None:
            y[:] = self._between(end)
        state.step[NOW] = until
        read(form, self.model, state, end, y)

    def _count_stiff(self, running: Dop853 | Radau) -> None:
        """See whether stability, not accuracy, limits the steps of DOP853, from the largest eigenvalue as the code of
        Hairer & Wanner estimates it (Solving Ordinary Differential Equations II, section IV.2)."""
        if isinstance(running, Radau):
            return
        h, stages = running.t - running.t_old, running.K
        last = running.y_old + h * (running.A[-1, :-1] @ stages[: len(running.A) - 1])
        change = np.linalg.norm(running.y - last)
        moved = change > ROUNDED * np.linalg.norm(running.y)
        if moved and h * np.linalg.norm(stages[len(running.A)] - stages[len(running.A) - 1]) > STABLE * change:
            self._stiff, self._mild = self._stiff + 1, 0
            self.is_stiff |= self._stiff >= STIFF
        else:
            self._mild += 1
            self._stiff *= self._mild < MILD

    def _new_solver(self, form: Form, state: State, solver: Solver, begun, there, sizes) -> Dop853 | Radau:
        """SciPy's solver at the begin of one of its steps; it chooses the length if none is known."""
        dy = np.zeros(len(there))

        def rates(time, y):
            while status := slopes(form, self.model, self._workspaces, state, self.load, time, y, dy):
                self._answer(status, state)
            return dy.copy()

        kind = {DOP853: Dop853, RADAU: Radau}[solver.name]
        absolute = solver.absolute_tolerance * np.append(sizes, np.inf)
        step = {"first_step": begun[1]} if begun[1] else {}
        return kind(rates, begun[0], there.copy(), np.inf, rtol=solver.relative_tolerance, atol=absolute, **step)

    def _sizes(self, solver: Solver, state: State, y: np.ndarray) -> np.ndarray:
        """Sizes of all variables but the work, from their values and from the forces over the duration of the run."""
        load, _ = self.evaluate(state)
        form, duration = _form(solver, state), solver.duration
        parts = [np.ones(form.variables)]
        if len(state.rotation):
            inertia = max(moment_rates_of(self.model.rotor, state.time[NOW], k)[0] for k in range(3))
            torque = np.abs(load.torque_body).max() * duration / inertia
            parts.append(np.full(3, max(np.abs(y[form.variables :][:3]).max(), torque, 1 / duration)))
        if len(state.position):
            force = np.abs(load.force).max() * duration / self.model.flight.mass
            speed = max(np.abs(state.velocity).max(), force)
            way = max(np.abs(state.position).max(), speed * duration)
            parts += [np.full(3, way or 1.0), np.full(3, speed or 1.0)]
        return np.concatenate(parts)


def _solver_of(row: Scheme | Solver) -> Solver:
    """The row itself. Raises TypeError unless it is a solver."""
    if isinstance(row, Scheme):
        raise TypeError(f"{row.name} is a row of flows; OdeEngine moves a body by general solvers")
    return row


def _form(solver: Solver, state: State) -> Form:
    return FORMS[solver.formulation] if len(state.rotation) else NoAttitude()


class SingularError(SimulationError):
    """Singular Euler angles."""

    def __init__(self, theta: float, time: float):
        where = "0" if np.cos(theta) > 0 else "pi"
        super().__init__(
            f"the Euler angles became singular at t = {time:.6g}: theta = {theta:.9g} is too near {where}, where phi "
            "and psi are not defined; use formulation = 'matrix' or 'quaternion', or the engine's own integrators"
        )
