"""The system of a scene of a single body: flight, rotor, frame, resistance, terms, first state."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.assemble.body_faults import order_faults, unfit, unresisted
from rigidmd.assemble.body_parts import (
    carried_fluid,
    frame_of,
    inertia_of,
    principal,
    resistance_of,
    rotor_of,
    terms_of,
)
from rigidmd.assemble.resolve import FORMULATION, SAMPLES, resolve_body
from rigidmd.assemble.room import check_samples
from rigidmd.assemble.system import Sites
from rigidmd.core.schemes import RK4, SCHEMES, SOLVERS, Scheme, Solver
from rigidmd.core.state import State, state_of
from rigidmd.dynamics.body import Body
from rigidmd.engines.cpu import Engine
from rigidmd.engines.textbook import OdeEngine
from rigidmd.errors import SceneError, SimulationError
from rigidmd.forces.body.fields import Told
from rigidmd.forces.body.frame import Inertial
from rigidmd.forces.body.resistance import NoResistance
from rigidmd.forces.pairs.space import Unbounded
from rigidmd.mechanics.course import Course, during, value_at
from rigidmd.mechanics.flight import Free, Immersed, Pinned
from rigidmd.mechanics.inertia import Kind, kind_of_body
from rigidmd.mechanics.rotor import DrivenRotor, NoRotor
from rigidmd.scene import BodyScene
from rigidmd.validation import settled

Part = TypeVar("Part", bound=NamedTuple)

LARGEST_IN = {".gro": 9e4, ".pdb": 990.0}  # Å: columns of text


class Pose(NamedTuple):
    """Position, attitude and velocities of a body, relative to the frame, for Python functions that apply forces."""

    time: float  # s
    position: np.ndarray  # (3,) centre of mass, m
    velocity: np.ndarray  # (3,) m/s
    rotation: np.ndarray  # (3, 3) Q, body to lab
    angular_velocity_body: np.ndarray  # (3,) rad/s


@dataclass
class BodySystem:
    """The system of a single body. The engine uses its principal axes; `axes` leads back to those of the scene.

    axes (3, 3): the principal axes as columns, in the body's axes. inertia (3,): principal moments at the start, kg m²,
    about the pivot or the centre of mass, added inertia of a fluid included; centre (3,): centre of mass from there, in
    the body's axes; points (k, 3): what the trajectory shows, in the body's axes from there.
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
    left_out: list[str] = field(default_factory=list)
    space = Unbounded()

    def __repr__(self) -> str:
        return f"<BodySystem of {self.scene.in_short}>"

    @property
    def notes(self) -> list[str]:
        """A sentence for duration and interval of samples that are not whole numbers of steps."""
        run, found = self.scene.run, []
        interval = settled(self.scene.output.interval_s)
        given = interval != run.duration_s / SAMPLES
        for key, wanted in (("run.duration_s", run.duration_s), ("output.interval_s", given and interval)):
            taken = wanted and max(1, round(wanted / run.timestep_s)) * run.timestep_s
            if not run.is_open and wanted and abs(taken - wanted) > 1e-9 * wanted:
                found.append(
                    f"{key} = {wanted:g} is not a whole number of steps of {run.timestep_s:g} s: it is {taken:g} s"
                )
        return found

    @property
    def turns(self) -> bool:
        """Whether it has an orientation."""
        return len(self.state.rotation) > 0

    @property
    def flies(self) -> bool:
        """Whether it is not pinned."""
        return len(self.state.position) > 0

    @property
    def kind(self) -> Kind:
        """Kind of body, about the pivot or the centre of mass."""
        return kind_of_body(self.inertia)

    @property
    def degrees_of_freedom(self) -> int:
        """Three of translation unless pinned, and those of rotation."""
        return 3 * self.flies + int((self.inertia > 0).sum())

    @property
    def method(self) -> Scheme | Solver:
        run = self.scene.run
        if run.is_open:
            return SCHEMES["velocity_verlet"]
        if run.integrator in SCHEMES:
            return SCHEMES[run.integrator].with_rotor(run.rotor)
        found = Solver(run.integrator, run.formulation or FORMULATION, run.duration_s)
        if run.integrator == RK4:
            return found
        return found._replace(
            relative_tolerance=settled(run.relative_tolerance), absolute_tolerance=settled(run.absolute_tolerance)
        )

    def engine(self) -> Engine:
        """A new engine for this body at time 0, which calls the Python functions that apply forces."""
        kind = OdeEngine if self.scene.run.integrator in SOLVERS else Engine
        return kind(*self.during(0.0), applied={name: self._asker(f) for name, f in self.applied.items()})

    def breaks(self) -> list[float]:
        """Times within the run at which a prescribed function of time has a jump or a kink."""
        parts = (*self.body, *self.terms.values())
        times = {float(t) for part in parts for value in part if isinstance(value, Course) for t in value.times}
        run = self.scene.run
        return sorted(t for t in times if 0 < t < run.steps * run.timestep_s)

    def during(self, time: float) -> tuple[Body, dict[str, NamedTuple]]:
        """Body and terms as they are from a time to the next break."""
        flight, rotor, frame, resistance = self.body
        body = Body(_at(flight, time), _at(rotor, time), _at(frame, time), _at(resistance, time))
        return body, {name: _at(term, time) for name, term in self.terms.items()}

    def _asker(self, function: Callable[[Pose], tuple]) -> Callable[[float, State], tuple]:
        def ask(time: float, state: State) -> tuple:
            told = function(self.pose(time, state))
            try:
                force, torque = (np.asarray(part, dtype=float).reshape(3) for part in told)
            except (TypeError, ValueError):
                raise SimulationError(
                    f"t = {time:g} s: an applied function gave {told!r}, must give force and torque of 3 numbers each"
                ) from None
            if not self.flies:  # the force acts at the centre of mass, the torque is about the pivot
                torque = torque + np.cross(self.centre, self.pose(time, state).rotation.T @ force)
            if not (np.isfinite(force).all() and np.isfinite(torque).all()):
                raise SimulationError(f"t = {time:g} s: an applied function gave what is no finite number: {told!r}")
            return force, self.axes.T @ torque

        return ask

    def pose(self, time: float, state: State) -> Pose:
        """The state in the body's own axes, relative to the frame."""
        motion = self.motion(np.array([time]), State(*(np.array(array) for array in zip(state, strict=True))))
        return Pose(time, *(part[0] for part in motion))

    def motion(self, times: np.ndarray, states: State):
        """(position, velocity, rotation, angular_velocity_body) over times (t,) of states stacked along axis 0."""
        n = len(times)
        frame = self.frame_rates(times)
        if self.turns:
            engine_rotation = states.rotation.reshape(n, 3, 3)
            rotation = engine_rotation @ self.axes.T
            inertia, carried = self.moments(times)
            with np.errstate(divide="ignore", invalid="ignore"):
                own = np.where(inertia > 0, (states.angular_momentum_body.reshape(n, 3) - carried) / inertia, 0.0)
            omega = own @ self.axes.T - np.einsum("tji,tj->ti", rotation, frame)
        else:
            engine_rotation = rotation = np.broadcast_to(np.eye(3), (n, 3, 3))
            omega = np.zeros((n, 3))
        if self.flies:
            position, velocity = states.position.reshape(n, 3), states.velocity.reshape(n, 3)
            if isinstance(self.body.flight, Immersed):
                share = self.mass / self.body.flight.inertial_mass
                velocity = np.einsum("tij,j,tkj,tk->ti", engine_rotation, share, engine_rotation, velocity)
            velocity = velocity - np.cross(frame, position)
        else:
            position = rotation @ self.centre
            velocity = np.einsum("tij,tj->ti", rotation, np.cross(omega, self.centre))
        return position, velocity, rotation, omega

    def frame_rates(self, times: np.ndarray) -> np.ndarray:
        """Angular velocity (t, 3) of the frame along its axes."""
        if isinstance(self.body.frame, Inertial):
            return np.zeros((len(times), 3))
        return value_at(self.body.frame.angular_velocity, times)

    def moments(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Principal moments and the momentum of rotors (t, 3) each, principal axes."""
        rotor = self.body.rotor
        if isinstance(rotor, DrivenRotor):
            return value_at(rotor.inertia, times), value_at(rotor.momentum, times)
        return np.broadcast_to(self.inertia, (len(times), 3)), np.zeros((len(times), 3))

    # The interface for trajectories: points as sites, Å for metres, ps for seconds.

    @property
    def scale(self) -> float:
        """Å in the trajectory for a metre."""
        return settled(self.scene.output.trajectory_A_per_m)

    @property
    def sites(self) -> Sites:
        """The points as sites of one molecule."""
        n = len(self.points)
        names = np.array(self.point_names, dtype=object)
        return Sites(np.zeros(n, int), self.points, names, np.full(n, "X", dtype=object), np.full(n, self.mass / n))

    @property
    def residue_names(self) -> np.ndarray:
        return np.array(["BODY"], dtype=object)

    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray:
        """Positions (k, 3) of the points, Å of the trajectory."""
        pose = self.pose(float(state.time[0]), state)
        origin = pose.position if self.flies else np.zeros(3)
        return self.scale * (origin + self.points @ pose.rotation.T)

    def site_velocities(self, state: State) -> np.ndarray:
        """Velocities (k, 3) of the points, Å/ps of the trajectory."""
        pose = self.pose(float(state.time[0]), state)
        origin = pose.velocity if self.flies else np.zeros(3)
        return self.scale * (origin + np.cross(pose.angular_velocity_body, self.points) @ pose.rotation.T)


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
    faults += unfit(scene, centre, moments, axes, added_mass)
    attitude, spin = scene.start.attitude, scene.start.angular_velocity
    own_spin = axes.T @ spin
    idle = (moments == 0) & (np.abs(own_spin) > 1e-12 * np.abs(own_spin).max(initial=0.0))
    if turning and idle.any():
        faults.append("start: the body has no inertia about an axis about which it is to turn")
    faults += order_faults(scene, bool(added_mass.any()), bool(applied))
    taken = {"gravity", "buoyancy", "origin_acceleration", *(f"applied_{k}" for k in range(len(scene.applied)))}
    faults += [
        f"applied: {name!r} is the name of a force of the scene; choose another"
        for name in applied or {}
        if name in taken
    ]
    for k, entry in enumerate(scene.applied):
        faults += unresisted(entry, k, axes, moments, turning)
    if faults:
        raise SceneError(scene.source, faults)

    scene = resolve_body(scene, turning, float(np.linalg.norm(points, axis=1).max()))
    check_samples(scene)
    rotor = rotor_of(scene, moments, added_inertia, axes) if turning else NoRotor()
    frame = frame_of(scene)
    if scene.body.pinned:
        flight = Pinned(mass)
    elif added_mass.any():
        flight = Immersed(mass, mass + added_mass)
    else:
        flight = Free(mass)
    body = Body(flight, rotor, frame, resistance_of(scene))
    applied = applied or {}
    terms = terms_of(scene, mass, axes, centre, displaced)
    terms |= {name: Told() for name in applied}
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
    if scene.output.trajectory and system.flies:
        reach = system.scale * np.abs(system.state.position).max()
        if not reach < LARGEST_IN[settled(scene.output.topology)[-4:]]:
            raise SceneError(
                scene.source,
                [
                    f"start.position_m is {reach:.3g} Å in the trajectory, which {scene.output.topology} cannot hold: "
                    "set output.trajectory_A_per_m to less, or output.trajectory = false"
                ],
            )
    return system


def _at(part: Part, time: float) -> Part:
    """A part of a body with each of its courses continued from a time."""
    courses = {key: during(value, time) for key, value in part._asdict().items() if isinstance(value, Course)}
    return part._replace(**courses)


def _first_state(scene, body, moments, axes, attitude, own_spin, turning) -> State:
    start = scene.start
    time = np.zeros(1)
    frame = np.zeros(3) if isinstance(body.frame, Inertial) else value_at(body.frame.angular_velocity, time)[0]
    position = velocity = np.zeros((0, 3))
    rotation, momentum = np.zeros((0, 3, 3)), np.zeros((0, 3))
    own_rotation = attitude @ axes
    if turning:
        rotation = own_rotation[None].copy()
        momentum = (moments * (own_spin + own_rotation.T @ frame))[None].copy()
        if isinstance(body.rotor, DrivenRotor):
            momentum += value_at(body.rotor.momentum, time)
    if not scene.body.pinned:
        position = np.array([start.position_m or (0.0, 0.0, 0.0)])
        velocity = np.array([start.velocity_m_s or (0.0, 0.0, 0.0)]) + np.cross(frame, position)
        if isinstance(body.flight, Immersed):
            share = body.flight.inertial_mass / body.flight.mass
            velocity = (own_rotation @ (share * (own_rotation.T @ velocity[0])))[None]
    return state_of(position, velocity, rotation, momentum)


def _left_out(system: BodySystem) -> list[str]:
    """What is not compiled for this body, and why."""
    out = ["box, neighbour lists, pair forces, threads: there is one body"]
    if not system.flies:
        out.append("translation: the body is pinned")
    if not system.turns:
        out.append("rotation: the body is a point")
    body = system.body
    if isinstance(body.frame, Inertial):
        out.append("frame: its axes do not turn")
    if isinstance(body.resistance, NoResistance):
        out.append("resistance: there is none")
    if not isinstance(body.rotor, DrivenRotor):
        out.append("wheels and changing inertia: there are none")
    if not system.terms:
        out.append("forces: there are none")
    return out
