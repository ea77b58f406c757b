"""The system of a scene of a single body, which an engine moves."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.core.integrators import RK4, SCHEMES, SOLVERS, Scheme, Solver
from rigidmd.core.state import State
from rigidmd.core.state_file import errors_of_arrays
from rigidmd.engines.sites import Sites
from rigidmd.errors import SimulationError
from rigidmd.features.bodies.cpu_engine import BodyEngine
from rigidmd.features.bodies.driven_rotor import DrivenRotor
from rigidmd.features.bodies.forces.applied import SteadyForce
from rigidmd.features.bodies.forces.resistance import NoResistance
from rigidmd.features.bodies.keys.body import FORMULATION, SAMPLES
from rigidmd.features.bodies.step_loop import Body
from rigidmd.features.bodies.time_functions import TimeFunction, piece_at, values_at
from rigidmd.features.bodies.translation import FluidTranslation, InertialFrame
from rigidmd.forces.neighbors.space import Unbounded
from rigidmd.mechanics.inertia import BodyKind, kind_of_body
from rigidmd.scene import BodyScene
from rigidmd.scene.validation import not_none, number_of_steps

#: An angular momentum below this fraction of the largest is 0.
ROUNDING = 1e-12

Component = TypeVar("Component", bound=NamedTuple)


class Pose(NamedTuple):
    """Position, attitude and velocities of a body relative to the frame. Functions in `applied` are
    called with it.

    Attributes
    ----------
    time : float
        Time since the start, s
    position : ndarray
        Centre of mass (3,), m
    velocity : ndarray
        Its velocity (3,), m/s
    rotation : ndarray
        Rotation matrix Q (3, 3), body to lab
    angular_velocity_body : ndarray
        Angular velocity (3,), body frame, rad/s
    """

    time: float
    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    angular_velocity_body: np.ndarray


@dataclass
class BodySystem:
    """The system of a single body, in its principal axes. `axes` (3, 3) has them as columns, in the
    scene's body axes.

    inertia (3,): principal moments at the start, kg m², about the pivot or the centre of mass, with
    the added inertia of a fluid. centre (3,): centre of mass from there. Points (k, 3): points of
    the trajectory, both in the body axes.
    """

    scene: BodyScene
    body: Body
    state: State
    terms: dict[str, NamedTuple]
    mass: float
    axes: np.ndarray
    inertia: np.ndarray
    centre: np.ndarray
    points: np.ndarray
    point_names: tuple[str, ...]
    applied: dict[str, Callable]
    warnings: list[str] = field(default_factory=list)  # of what is allowed and probably not meant
    space = Unbounded()

    def __repr__(self) -> str:
        return f"<BodySystem of {self.scene.in_short}>"

    @property
    def notes(self) -> list[str]:
        """Notes on a duration or an interval that is not a whole number of steps."""
        notes = []
        run = self.scene.run
        dt = run.timestep_s
        interval = not_none(self.scene.output.interval_s)
        is_set = interval != run.duration_s / SAMPLES
        for key, duration in (
            ("run.duration_s", run.duration_s),
            ("output.interval_s", is_set and interval),
        ):
            used = duration and number_of_steps(duration, dt) * dt
            if not run.is_auto and duration and abs(used - duration) > 1e-9 * duration:
                notes.append(
                    f"{key} = {duration:g} is not a whole number of steps of {dt:g} s:"
                    f" {used:g} s is used"
                )
        return notes

    @property
    def left_out(self) -> list[str]:
        """What is not compiled for this body, and why."""
        reasons = {
            "box, neighbour lists, pair forces, threads: there is one body": True,
            "translation: the body is pinned": not self.translates,
            "rotation: the body is a point": not self.rotates,
            "frame: its axes do not rotate": isinstance(self.body.frame, InertialFrame),
            "resistance: none": isinstance(self.body.resistance, NoResistance),
            "wheels and changing inertia: none": not isinstance(self.body.rotor, DrivenRotor),
            "forces: none": not self.terms,
        }
        return [reason for reason, applies in reasons.items() if applies]

    @property
    def rotates(self) -> bool:
        """Whether the body has an orientation. A point has none."""
        return len(self.state.rotation) > 0

    @property
    def translates(self) -> bool:
        """Whether the body is not pinned."""
        return len(self.state.position) > 0

    @property
    def steady_forces(self) -> list[SteadyForce]:
        """The terms that have a potential energy."""
        return [term for term in self.terms.values() if isinstance(term, SteadyForce)]

    @property
    def kind(self) -> BodyKind:
        """Kind of body, about the pivot or the centre of mass."""
        return kind_of_body(self.inertia)

    @property
    def degrees_of_freedom(self) -> int:
        return 3 * self.translates + int((self.inertia > 0).sum())

    @property
    def method(self) -> Scheme | Solver:
        run = self.scene.run
        if run.is_auto:
            return SCHEMES["velocity_verlet"]
        if run.has_scheme:
            return run.scheme
        solver = Solver(run.integrator, run.formulation or FORMULATION, run.duration_s)
        if run.integrator == RK4:
            return solver
        relative, absolute = not_none(run.relative_tolerance), not_none(run.absolute_tolerance)
        return solver._replace(relative_tolerance=relative, absolute_tolerance=absolute)

    def engine(self) -> BodyEngine:
        """A new engine for this body at time 0, which calls the functions in `applied`."""
        kind = BodyEngine
        if self.scene.run.integrator in SOLVERS:
            from rigidmd.features.bodies.ode.engine import (
                OdeEngine as kind,  # SciPy is slow to import
            )
        python_forces = {
            name: self._load_function(function) for name, function in self.applied.items()
        }
        return kind(*self.terms_at(0.0), python_forces=python_forces)

    def state_errors(self, state: State) -> list[str]:
        """Messages on positions and momenta of a state from outside which this body cannot have."""
        pinned = "" if self.translates else ", pinned"
        if errors := errors_of_arrays(state, self.state, f"the scene is a single body{pinned}"):
            return errors
        if np.isfinite(state.cell).all():
            return ["the state has a periodic box, and a single body has none"]
        momentum = np.abs(state.angular_momentum_body)
        along = momentum[:, (self.inertia == 0) & (not isinstance(self.body.rotor, DrivenRotor))]
        if along.max(initial=0.0) > ROUNDING * momentum.max(initial=0.0):
            return ["angular_momentum_body of the state is not 0 about an axis without inertia"]
        return []

    def breaks(self) -> list[float]:
        """Times within the run at which a prescribed function of time has a jump or a kink."""
        end = self.scene.run.steps * self.scene.run.timestep_s
        parts = (*self.body, *self.terms.values())
        functions = [value for part in parts for value in part if isinstance(value, TimeFunction)]
        return sorted({float(t) for function in functions for t in function.times if 0 < t < end})

    def terms_at(self, time: float) -> tuple[Body, dict[str, NamedTuple]]:
        """Body and terms from a time to the next break."""
        terms = {name: _piece(term, time) for name, term in self.terms.items()}
        return Body._make(_piece(part, time) for part in self.body), terms

    def velocity_dependent_functions(self) -> list[str]:
        """Names of the functions in `applied` that give another force or torque at the start with
        other velocities, but the same one with the same."""
        start = self.pose(0.0, self.state)
        reach = float(np.linalg.norm(self.points, axis=1).max()) or 1.0
        rate = 1.0 / self.scene.run.duration_s
        along = np.array([1.0, -0.7, 0.4])
        velocity = (
            1.3 * start.velocity + rate * reach * along if self.translates else start.velocity
        )
        if self.rotates:
            spin = 1.3 * start.angular_velocity_body + rate * along[::-1]
        else:
            spin = start.angular_velocity_body
        other = start._replace(velocity=velocity, angular_velocity_body=spin)
        names = []
        for name, function in self.applied.items():
            try:
                one, again, moved = (
                    np.concatenate([np.asarray(part, float).reshape(3) for part in function(pose)])
                    for pose in (start, start, other)
                )
            except (Exception, SystemExit):  # user code may raise anything; the run reports it
                continue
            if np.array_equal(one, again) and not np.array_equal(one, moved):
                names.append(name)
        return names

    def _load_function(self, function: Callable[[Pose], tuple]) -> Callable[[float, State], tuple]:
        """A user's function of a pose as a function of time and state that returns force and
        torque, checked."""

        def load(time: float, state: State) -> tuple:
            returned = function(self.pose(time, state))
            try:
                force, torque = (np.asarray(part, dtype=float).reshape(3) for part in returned)
            except (TypeError, ValueError):
                raise SimulationError(
                    f"t = {time:g} s: an applied function gave {returned!r}, must give force and"
                    " torque of 3 numbers each"
                ) from None
            # the force acts at the centre of mass, the torque is about the pivot
            if not self.translates:
                torque = torque + np.cross(self.centre, self.pose(time, state).rotation.T @ force)
            if not (np.isfinite(force).all() and np.isfinite(torque).all()):
                raise SimulationError(
                    f"t = {time:g} s: an applied function gave infinite or NaN values: {returned!r}"
                )
            return force, self.axes.T @ torque

        return load

    def pose(self, time: float, state: State) -> Pose:
        """The pose of a state in the scene's body axes, relative to the frame."""
        motion = self.motion(
            np.array([time]), State(*(np.array(array) for array in zip(state, strict=True)))
        )
        return Pose(time, *(part[0] for part in motion))

    def motion(self, times: np.ndarray, states: State):
        """position, velocity, rotation, angular_velocity_body at times (t,), of states stacked
        along axis 0."""
        n = len(times)
        frame = self.frame_rates(times)
        if self.rotates:
            engine_rotation = states.rotation.reshape(n, 3, 3)
            rotation = engine_rotation @ self.axes.T
            inertia, carried = self.moments(times)
            with np.errstate(divide="ignore", invalid="ignore"):
                principal = np.where(
                    inertia > 0,
                    (states.angular_momentum_body.reshape(n, 3) - carried) / inertia,
                    0.0,
                )
            omega = principal @ self.axes.T - np.einsum("tji,tj->ti", rotation, frame)
        else:
            engine_rotation = rotation = np.broadcast_to(np.eye(3), (n, 3, 3))
            omega = np.zeros((n, 3))
        if self.translates:
            position, velocity = states.position.reshape(n, 3), states.velocity.reshape(n, 3)
            if isinstance(self.body.translation, FluidTranslation):
                ratio = self.mass / self.body.translation.inertial_mass
                velocity = np.einsum(
                    "tij,j,tkj,tk->ti", engine_rotation, ratio, engine_rotation, velocity
                )
            velocity = velocity - np.cross(frame, position)
        else:
            position = rotation @ self.centre
            velocity = np.einsum("tij,tj->ti", rotation, np.cross(omega, self.centre))
        return position, velocity, rotation, omega

    def frame_rates(self, times: np.ndarray) -> np.ndarray:
        """Angular velocity (t, 3) of the frame, in its own axes."""
        if isinstance(self.body.frame, InertialFrame):
            return np.zeros((len(times), 3))
        return values_at(self.body.frame.angular_velocity, times)

    def moments(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Principal moments (t, 3) and angular momentum of the rotors (t, 3), in the principal
        axes."""
        rotor = self.body.rotor
        if isinstance(rotor, DrivenRotor):
            return values_at(rotor.inertia, times), values_at(rotor.momentum, times)
        return np.broadcast_to(self.inertia, (len(times), 3)), np.zeros((len(times), 3))

    # Interface for trajectories: points as sites, Å for metres, ps for seconds.

    @property
    def scale(self) -> float:
        """Å of the trajectory per metre."""
        return not_none(self.scene.output.trajectory_A_per_m)

    @cached_property
    def sites(self) -> Sites:
        n = len(self.points)
        names = np.array(self.point_names, dtype=object)
        return Sites(
            np.zeros(n, int),
            self.points,
            names,
            np.full(n, "X", dtype=object),
            np.full(n, self.mass / n),
        )

    @property
    def charges(self) -> np.ndarray:
        return np.zeros(len(self.points))

    def connections(self, *, massless: bool = False) -> np.ndarray:
        """Pairs (b, 2) of points that are joined, see `edges_of`."""
        from rigidmd.features.bodies.edges import edges_of

        return edges_of(self)

    @property
    def residue_names(self) -> np.ndarray:
        return np.array(["BODY"], dtype=object)

    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray:
        """Positions (k, 3) of the points, Å of the trajectory."""
        origin = state.position[0] if self.translates else np.zeros(3)
        rotation = (state.rotation @ self.axes.T)[0] if self.rotates else np.eye(3)
        return self.scale * (origin + self.points @ rotation.T)

    def site_velocities(self, state: State) -> np.ndarray:
        """Velocities (k, 3) of the points, Å/ps of the trajectory."""
        pose = self.pose(float(state.time[0]), state)
        origin = pose.velocity if self.translates else np.zeros(3)
        return self.scale * (
            origin + np.cross(pose.angular_velocity_body, self.points) @ pose.rotation.T
        )


def _piece(part: Component, time: float) -> Component:
    """A component of a body, with its prescribed functions of time continued from `time`."""
    courses = {
        key: piece_at(value, time)
        for key, value in part._asdict().items()
        if isinstance(value, TimeFunction)
    }
    return part._replace(**courses)
