"""The engine for a single body by general ODE solvers: the equations of motion as a first-order
system.

Variables: attitude (matrix, quaternion or Euler angles), angular velocity (body frame), position
and velocity unless pinned, and the work of drives and resistance, for the energy balance. Solvers:
classical RK4 (compiled), and SciPy's DOP853 and Radau. They are an independent check of the
integrators, and only their accuracy keeps Q a rotation.
"""

from collections.abc import Callable

import numpy as np
from scipy.integrate import DOP853 as Dop853
from scipy.integrate import Radau

from rigidmd.core.integrators import DOP853, FORMULATIONS, RADAU, RK4, Scheme, Solver
from rigidmd.core.state import NOW, WORK, State, no_load
from rigidmd.engines.protocol import Halted, keep_time
from rigidmd.errors import SimulationError
from rigidmd.features.bodies.cpu_engine import BodyEngine
from rigidmd.features.bodies.ode.odes import (
    AttitudeForm,
    EulerAngles,
    Matrix,
    NoAttitude,
    Quaternion,
    attitude_variables,
)
from rigidmd.features.bodies.ode.rates import (
    SINGULAR,
    is_singular,
    moment_rates_of,
    read,
    rk4,
    write_rates,
)
from rigidmd.features.bodies.step_loop import Body

FORMS: dict[str, AttitudeForm] = dict(
    zip(FORMULATIONS, (Matrix(), Quaternion(), EulerAngles()), strict=True)
)

#: A step of DOP853 is at the limit of stability if step times eigenvalue is above STABLE. STIFF
#: such steps show a stiff problem, MILD other steps in a row restart the count. Relative changes
#: below ROUNDED within a step are rounding.
STABLE = 6.1
STIFF = 200
MILD = 6
ROUNDED = 1e-14


class OdeEngine(BodyEngine):
    """An engine that moves a body by a general solver.

    The solver's variables are in `state.extra_variables`, and the rest of the state is computed
    from them. DOP853 and Radau step beyond the requested time, so for them these are (time and
    length of the last step, variables at its start, variables now, scales of all variables except
    the work). DOP853 resumes from them to the same bits, Radau within its tolerance, because it
    also has a Jacobian.
    """

    model: Body
    _solver: Dop853 | Radau | None = None
    _dense_output: Callable[[float], np.ndarray] | None = None
    _restart = False  # whether forces have changed, so that earlier steps are useless
    _steps = 0  # steps that DOP853 or Radau has taken
    #: Consecutive steps at the limit of stability and not, as Hairer counts them
    _stiff_steps, _other_steps = 0, 0
    is_stiff = False

    @property
    def chosen_steps(self) -> tuple[int, int] | None:
        return None if self._solver is None else (self._steps, self._solver.nfev)

    def variables(self, state: State, integrator: Scheme | Solver) -> np.ndarray:
        solver = _as_solver(integrator)
        omega = []
        if len(state.rotation):
            for k in range(3):
                inertia, _, carried, _ = moment_rates_of(self.model.rotor, state.time[NOW], k)
                omega.append(
                    (state.angular_momentum_body[0, k] - carried) / inertia if inertia > 0 else 0.0
                )
        translation = [state.position.ravel(), state.velocity.ravel()]
        y = np.concatenate(
            [
                attitude_variables(_form(solver, state), state.rotation),
                omega,
                *translation,
                state.energy_ledger[[WORK]],
            ]
        )
        if solver.name != RK4:
            y = np.concatenate([[state.time[NOW], 0.0], y, y, self._scales(solver, state, y)])
        return y

    def advance(
        self,
        state: State,
        integrator: Scheme | Solver,
        dt: float,
        until: int,
        observed: bool = False,
    ) -> None:
        """As `Engine.advance`. DOP853 and Radau choose their steps in between. Raises
        SimulationError, Halted."""
        solver = _as_solver(integrator)
        self._prepare(state)
        keep_time(state, dt)
        form = _form(solver, state)
        if self.load is None:
            self.load = no_load(state)
        if solver.name != RK4:
            self._adaptive(form, state, solver, dt, until)
            return
        y = state.extra_variables
        cursor = np.zeros(1, np.int64)
        stages = np.zeros((5, len(y)))
        while status := rk4(
            form, self.model, self._workspaces, state, self.load, y, stages, dt, until, cursor
        ):
            if status == SINGULAR:
                raise SingularError(y[1], state.time_of(state.step[NOW], dt))
            self._handle_status(status, state)
        read(form, self.model, state, state.time_of(until, dt), y)

    def memory(self) -> dict[str, np.ndarray] | None:
        """As `Engine.memory`. None for Radau, which would resume only within its tolerance."""
        return None if isinstance(self._solver, Radau) else super().memory()

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        super().recall(state, memory)
        self._restart = False

    def forget(self) -> None:
        super().forget()
        self._solver = self._dense_output = None
        self._restart = True

    def _adaptive(
        self, form: AttitudeForm, state: State, solver: Solver, dt: float, until: int
    ) -> None:
        variables = len(state.extra_variables) // 3
        begun, y_begin, y, scales = np.split(
            state.extra_variables, [2, 2 + variables, 2 + 2 * variables]
        )
        end = state.time_of(until, dt)
        if self._restart:
            begun[:], y_begin[:] = (state.time[NOW], 0.0), y
            scales[:] = self._scales(solver, state, y)
            self._restart = False
        variables_before = state.extra_variables.copy()
        running = self._solver
        if running is None:
            if is_singular(form, y_begin, y_begin, 0.0):
                raise SingularError(y_begin[1], begun[0])
            running = self._solver = self._new_solver(form, state, solver, begun, y_begin, scales)
        while running.t < end:
            begun[:] = running.t, running.h_abs
            y_begin[:] = running.y
            with np.errstate(all="ignore"):
                problem = running.step()
                self._count_stiff(running)
            self._steps += 1
            if is_singular(form, running.y, running.y, 0.0):
                raise SingularError(running.y[1], running.t)
            if problem or not np.isfinite(running.y).all():
                limits = (
                    f"{solver.relative_tolerance:g} relative, {solver.absolute_tolerance:g}"
                    " absolute"
                )
                problem = f"{solver.name} finds no step that keeps its tolerances ({limits})"
                raise SimulationError(f"at t = {running.t:.6g}: {problem}")
            self._dense_output = running.dense_output()
            # restore the last observation: the rates have changed the state
            if self.stop_requested():
                state.extra_variables[:] = variables_before
                read(form, self.model, state, state.time_of(state.step[NOW], dt), y)
                raise Halted
        if self._dense_output is not None:
            y[:] = self._dense_output(end)
        state.step[NOW] = until
        read(form, self.model, state, end, y)

    def _count_stiff(self, running: Dop853 | Radau) -> None:
        """Find out whether stability limits the steps of DOP853, from the largest eigenvalue as the
        code of Hairer & Wanner estimates it (Solving Ordinary Differential Equations II, section
        IV.2)."""
        if isinstance(running, Radau):
            return
        h = running.t - running.t_old
        stages = running.K
        last = running.y_old + h * (running.A[-1, :-1] @ stages[: len(running.A) - 1])
        change = np.linalg.norm(running.y - last)
        moved = change > ROUNDED * np.linalg.norm(running.y)
        if (
            moved
            and h * np.linalg.norm(stages[len(running.A)] - stages[len(running.A) - 1])
            > STABLE * change
        ):
            self._stiff_steps, self._other_steps = self._stiff_steps + 1, 0
            self.is_stiff = self.is_stiff or self._stiff_steps >= STIFF
        else:
            self._other_steps += 1
            self._stiff_steps *= self._other_steps < MILD

    def _new_solver(
        self, form: AttitudeForm, state: State, solver: Solver, begun, y_begin, scales
    ) -> Dop853 | Radau:
        """SciPy's solver at the start of one of its steps. It chooses the length of an unknown
        step."""
        dy = np.zeros(len(y_begin))

        def rates(time, y):
            while status := write_rates(
                form, self.model, self._workspaces, state, self.load, time, y, dy
            ):
                self._handle_status(status, state)
            return dy.copy()

        kind = {DOP853: Dop853, RADAU: Radau}[solver.name]
        absolute = solver.absolute_tolerance * np.append(scales, np.inf)
        step = {"first_step": begun[1]} if begun[1] else {}
        return kind(
            rates,
            begun[0],
            y_begin.copy(),
            np.inf,
            rtol=solver.relative_tolerance,
            atol=absolute,
            **step,
        )

    def _scales(self, solver: Solver, state: State, y: np.ndarray) -> np.ndarray:
        """Scales of all variables except the work, from their values and the forces over the
        duration of the run."""
        load, _ = self.evaluate(state)
        form = _form(solver, state)
        duration = solver.duration
        parts = [np.ones(form.variables)]
        if len(state.rotation):
            inertia = max(
                moment_rates_of(self.model.rotor, state.time[NOW], k)[0] for k in range(3)
            )
            torque = np.abs(load.torque_body).max() * duration / inertia
            parts.append(
                np.full(3, max(np.abs(y[form.variables :][:3]).max(), torque, 1 / duration))
            )
        if len(state.position):
            force = np.abs(load.force).max() * duration / self.model.translation.mass
            speed = max(np.abs(state.velocity).max(), force)
            way = max(np.abs(state.position).max(), speed * duration)
            parts += [np.full(3, way or 1.0), np.full(3, speed or 1.0)]
        return np.concatenate(parts)


def _as_solver(integrator: Scheme | Solver) -> Solver:
    """The same integrator, if it is a solver. Raises TypeError for a scheme."""
    if isinstance(integrator, Scheme):
        raise TypeError(
            f"{integrator.name} is an integrator of flows. OdeEngine needs a general solver"
        )
    return integrator


def _form(solver: Solver, state: State) -> AttitudeForm:
    return FORMS[solver.formulation] if len(state.rotation) else NoAttitude()


class SingularError(SimulationError):
    def __init__(self, theta: float, time: float):
        where = "0" if np.cos(theta) > 0 else "pi"
        problem = f"theta = {theta:.9g} is too near {where}, where phi and psi are not defined"
        hint = "use formulation = 'matrix' or 'quaternion', or another integrator"
        super().__init__(f"the Euler angles became singular at t = {time:.6g}: {problem}; {hint}")
