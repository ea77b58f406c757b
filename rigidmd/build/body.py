"""A scene of a single body becomes what runs: flight, rotor, frame, resistance, terms, the first state."""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import permutations
from typing import NamedTuple

import numpy as np

from rigidmd.build.system import Sites
from rigidmd.dynamics.body import Body
from rigidmd.dynamics.engine import Engine
from rigidmd.dynamics.odes import SOLVERS, OdeEngine, Solver
from rigidmd.dynamics.schemes import SCHEMES, Scheme
from rigidmd.errors import SceneError, SimulationError
from rigidmd.forces.fields import Drive, SteadyForce, Told
from rigidmd.forces.frame import Inertial, Turning
from rigidmd.forces.resistance import NoResistance, Resistance
from rigidmd.forces.space import Unbounded
from rigidmd.forces.terms import State
from rigidmd.mechanics.course import Course, during, integral, is_steady, steady, table, total, value_at, window
from rigidmd.mechanics.flight import Free, Immersed, Pinned
from rigidmd.mechanics.inertia import Kind, inertia_tensor, kind_of_body, shifted
from rigidmd.mechanics.rotation import direction
from rigidmd.mechanics.rotor import DrivenRotor, NoRotor, split_rotor
from rigidmd.mechanics.solids import added_mass_of_ellipsoid, solid
from rigidmd.scene import BodyScene
from rigidmd.scene.body import Timed

#: Principal moments from a tensor that differ by less than this fraction of the largest differ by rounding.
ROUNDING = 1e-13
DEFAULT_TOLERANCE = 1e-10
TRAJECTORY_RADIUS = 10.0  # Å
LARGEST_IN_GRO = 9e4  # Å: eight columns in nm


class Pose(NamedTuple):
    """Where a body is and how it moves, for a Python function that applies a force. Relative to the frame."""

    time: float  # s
    position: np.ndarray  # (3,) centre of mass, m
    velocity: np.ndarray  # (3,) m/s
    rotation: np.ndarray  # (3, 3) Q, body to lab
    angular_velocity_body: np.ndarray  # (3,) rad/s


@dataclass
class BodySystem:
    """What a scene of a body becomes. The engine moves it along its principal axes; `axes` leads back to the scene's.

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
        """What moves it."""
        run = self.scene.run
        if run.integrator in SCHEMES:
            return SCHEMES[run.integrator].with_rotor(run.rotor)
        tolerances = (run.relative_tolerance or DEFAULT_TOLERANCE, run.absolute_tolerance or DEFAULT_TOLERANCE)
        return Solver(run.integrator, run.formulation or "matrix", run.duration_s, *tolerances)

    def engine(self) -> Engine:
        """A new engine for it at time 0, which calls the Python functions that apply forces."""
        kind = OdeEngine if self.scene.run.integrator in SOLVERS else Engine
        return kind(*self.during(0.0), {name: self._asker(f) for name, f in self.applied.items()})

    def breaks(self) -> list[float]:
        """Times within the run at which something that follows time as told jumps or bends."""
        parts = (*self.body, *self.terms.values())
        times = {float(t) for part in parts for value in part if isinstance(value, Course) for t in value.times}
        return sorted(t for t in times if 0 < t < self.scene.run.duration_s)

    def during(self, time: float) -> tuple[Body, dict[str, NamedTuple]]:
        """Body and terms with what holds from a time to the next break."""
        terms = {name: _at(term, time) for name, term in self.terms.items()}
        return Body(*(_at(part, time) for part in self.body)), terms

    def _asker(self, function: Callable[[Pose], tuple]) -> Callable[[float, State], tuple]:
        def ask(time: float, state: State) -> tuple:
            told = function(self.pose(time, state))
            try:
                force, torque = (np.asarray(part, dtype=float).reshape(3) for part in told)
            except (TypeError, ValueError):
                raise SimulationError(
                    f"t = {time:g} s: an applied function gave {told!r}, must give force and torque of 3 numbers each"
                ) from None
            if not self.flies:  # it acts at the centre of mass, which is not the pivot
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
            rotation, omega = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
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

    # What trajectories ask of a system: points as sites, ångström for metres, picoseconds for seconds.

    @property
    def scale(self) -> float:
        """Å in the trajectory for a metre."""
        radius = np.linalg.norm(self.points, axis=1).max()
        return self.scene.output.trajectory_A_per_m or (TRAJECTORY_RADIUS / radius if radius > 0 else 1.0)

    @property
    def sites(self) -> Sites:
        """The points as sites of one molecule."""
        n = len(self.points)
        names = np.array(self.point_names, dtype=object)
        return Sites(np.zeros(n, int), self.points, names, np.full(n, "X", dtype=object), np.full(n, self.mass / n))

    @property
    def residue_names(self) -> np.ndarray:
        """One molecule."""
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
    mass, tensor, centre, points, names = _inertia(scene)
    added_mass, added_inertia, displaced = _carried_fluid(scene)
    if scene.changing_inertia is not None:
        moments, axes = np.array(scene.changing_inertia.inertia_kg_m2[0]), np.eye(3)
    else:
        moments, axes = _principal(tensor)
    bare = moments
    moments = moments + added_inertia
    turning = bool(moments.any())
    faults += _unfit(scene, centre, bare, moments, axes, added_mass)
    attitude, spin = scene.start.attitude, scene.start.angular_velocity
    own_spin = axes.T @ spin
    idle = (moments == 0) & (np.abs(own_spin) > 1e-12 * np.abs(own_spin).max(initial=0.0))
    if turning and idle.any():
        faults.append("start: the body has no inertia about an axis about which it is to turn")
    faults += _order_faults(scene, bool(added_mass.any()))
    taken = {"gravity", "buoyancy", "origin_acceleration", *(f"applied_{k}" for k in range(len(scene.applied)))}
    faults += [
        f"applied: {name!r} is the name of a force of the scene; choose another"
        for name in applied or {}
        if name in taken
    ]
    for k, entry in enumerate(scene.applied):
        faults += _unresisted(entry, k, axes, moments, turning)
    if faults:
        raise SceneError(scene.source, faults)

    rotor = _rotor(scene, moments, added_inertia, axes) if turning else NoRotor()
    frame = _frame(scene)
    if scene.body.pinned:
        flight = Pinned(mass)
    elif added_mass.any():
        flight = Immersed(mass, mass + added_mass)
    else:
        flight = Free(mass)
    body = Body(flight, rotor, frame, _resistance(scene))
    applied = applied or {}
    terms = _terms(scene, mass, axes, centre, displaced)
    terms |= {name: Told(np.zeros(1, np.int64), np.zeros(3), np.zeros(3)) for name in applied}
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
        if not reach < LARGEST_IN_GRO:
            raise SceneError(
                scene.source,
                [
                    f"start.position_m is {reach:.3g} Å in the trajectory, which {scene.output.topology} cannot hold: "
                    "set output.trajectory_A_per_m to less, or output.trajectory = false"
                ],
            )
    return system


def _inertia(scene: BodyScene):
    """Mass, tensor about the centre of mass or pivot, centre of mass from there, points to draw and their names."""
    table_ = scene.body
    centre = np.array(table_.centre_of_mass_m or (0.0, 0.0, 0.0))
    mass = table_.mass_kg
    tensor = table_.tensor
    if table_.points is not None:
        masses = np.array([p.mass_kg for p in table_.points])
        places = np.array([p.position_m for p in table_.points])
        mass = float(masses.sum())
        centre = masses @ places / mass
        points = places - centre
        tensor = inertia_tensor(masses, points)
    elif table_.solid is not None:
        shape = solid(table_.solid.shape, mass, table_.solid.dimensions)
        points, tensor = shape.outline, np.diag(shape.inertia)
    else:
        about_centre = np.zeros((3, 3)) if tensor is None else tensor
        if table_.inertia_about == "pivot":
            about_centre = shifted(tensor, -mass, centre)
        points = _equal_ellipsoid(mass, about_centre)
    if tensor is None:
        tensor = np.zeros((3, 3))
    if table_.pinned:
        if table_.inertia_about == "centre_of_mass":
            tensor = shifted(tensor, mass, centre)
        points = np.vstack([np.zeros(3), centre + points])
        return mass, tensor, centre, points, ("PIVOT", *(f"P{k}" for k in range(1, len(points))))
    return mass, tensor, np.zeros(3), points, tuple(f"P{k}" for k in range(1, len(points) + 1))


def _equal_ellipsoid(mass: float, tensor: np.ndarray) -> np.ndarray:
    """Centre and tips of the axes (7, 3) of the homogeneous ellipsoid of this inertia tensor; of a point, its place."""
    moments, axes = np.linalg.eigh(tensor)
    half = np.sqrt(np.maximum(2.5 / mass * (moments.sum() - 2 * moments), 0.0))
    if not half.any():
        return np.zeros((1, 3))
    tips = (axes * half).T
    return np.concatenate([np.zeros((1, 3)), tips, -tips])


def _principal(tensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal moments (3,) and axes (3, 3) as columns, right-handed, each as near to the body's own as can be."""
    rounding = ROUNDING * np.abs(tensor).max()
    if (np.abs(tensor - np.diag(np.diag(tensor))) <= rounding).all():
        moments, axes = np.diag(tensor).copy(), np.eye(3)
        return _even(moments), axes
    moments, axes = np.linalg.eigh(tensor)
    best = max(permutations(range(3)), key=lambda order: sum(abs(axes[k, order[k]]) for k in range(3)))
    moments, axes = np.maximum(moments, 0.0)[list(best)], axes[:, best]
    axes = axes * np.where(np.diag(axes) < 0, -1.0, 1.0)
    if np.linalg.det(axes) < 0:
        axes[:, np.abs(np.diag(axes)).argmin()] *= -1
    return _even(moments), axes


def _even(moments: np.ndarray) -> np.ndarray:
    """Moments that differ by rounding made equal to the last bit, which the rotor turns exactly; rounded zeros zero."""
    rounding = ROUNDING * moments.max()
    moments = np.where(moments < rounding, 0.0, moments)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        if abs(moments[i] - moments[j]) <= rounding:
            moments[[i, j]] = 0.5 * (moments[i] + moments[j])
    return moments


def _at(part: NamedTuple, time: float) -> NamedTuple:
    """A part of a body with each of its courses as it goes on from a time."""
    courses = {key: during(value, time) for key, value in part._asdict().items() if isinstance(value, Course)}
    return part._replace(**courses)


def _unfit(scene: BodyScene, centre, bare, moments, axes, added_mass) -> list[str]:
    """What a scene asks of a body that this body cannot do, or what would do nothing to it."""
    faults, body, fluid = [], scene.body, scene.fluid
    turning, principal = bool(moments.any()), np.array_equal(axes, np.eye(3))
    if not turning:
        faults += _idle_of_points(scene)
        if body.pinned:
            faults.append("body: a point at the pivot has nothing to move; give it inertia or a centre_of_mass_m")
        if added_mass.any():
            faults.append("fluid.added_mass_kg: a point carries no fluid along; add the mass to mass_kg of its inertia")
        for key in ("linear_resistance_kg_s", "quadratic_resistance_kg_m"):
            if fluid is not None and len(set(getattr(fluid, key))) > 1:
                faults.append(f"fluid.{key}: a point has no axes: give three equal numbers")
    elif added_mass.any():
        for k in np.flatnonzero(moments == 0):
            if added_mass[k - 1] != added_mass[k - 2]:
                faults.append("fluid.added_mass_kg: a linear body has equal added masses across its axis")
    if turning and not principal:
        faults += _needs_principal_axes(scene)
    if (scene.wheels or scene.changing_inertia) and turning and not (moments > 0).all():
        faults.append("wheels and changing_inertia need a body with inertia about every axis")
    if body.pinned:
        if scene.changing_inertia is not None and centre.any():
            faults.append("changing_inertia: the centre of mass must be at the pivot of a pinned body")
        if scene.gravity is not None and not centre.any() and turning:
            faults.append("gravity does nothing to a body pinned at its centre of mass; give body.centre_of_mass_m")
        faults += [
            f"applied.{k}.force_N does nothing at the pivot; say where it acts with at_m"
            for k, entry in enumerate(scene.applied)
            if entry.force_N is not None and not any(entry.at_m or ())
        ]
    return faults


def _idle_of_points(scene: BodyScene) -> list[str]:
    """Keys about turning, which a point does not do."""
    start, none = scene.start, type(scene.start)()
    named = [f"start.{key}" for key in type(start).model_fields if getattr(start, key) != getattr(none, key)]
    idle = [key for key in named if key not in ("start.position_m", "start.velocity_m_s")]
    idle += [key for key in ("friction", "wheels") if getattr(scene, key)]
    idle += [f"run.{key}" for key in ("formulation", "rotor") if getattr(scene.run, key) is not None]
    if scene.fluid is not None:
        turning = (
            "linear_rotational_resistance_N_m_s",
            "quadratic_rotational_resistance_N_m_s2",
            "added_inertia_kg_m2",
        )
        idle += [f"fluid.{key}" for key in turning if any(getattr(scene.fluid, key) or ())]
    if scene.output.axis is not None:
        idle.append("output.axis")
    return [f"{key}: the body has no inertia: a point does not turn" for key in idle]


def _needs_principal_axes(scene: BodyScene) -> list[str]:
    """What acts along the body's axes must find them principal, unless it is the same along all."""
    faults = []
    for name, section in (("friction", scene.friction), ("fluid", scene.fluid)):
        for key in type(section).model_fields if section else ():
            value = getattr(section, key)
            if not isinstance(value, tuple) or key == "centre_of_buoyancy_m":
                continue
            if len(set(value)) > 1 or (key == "dry_N_m" and any(value)):
                faults.append(
                    f"{name}.{key} is told along the body's axes, which are not principal axes of its inertia: "
                    "give the body in its principal axes"
                )
    return faults


def _unresisted(entry, k: int, axes: np.ndarray, moments: np.ndarray, turning: bool) -> list[str]:
    """Torques that nothing resists."""
    if entry.torque_N_m is None and entry.at_m is None:
        return []
    if not turning:
        return [f"applied.{k}: a point cannot be turned"]
    if (moments == 0).any() and (entry.axes == "body" or entry.at_m is not None):
        torques = np.atleast_2d(entry.torque_N_m if entry.torque_N_m is not None else np.zeros(3)) @ axes
        arm = axes.T @ np.array(entry.at_m or (0.0, 0.0, 0.0))
        if torques[:, moments == 0].any() or arm[moments > 0].any():
            return [f"applied.{k}: nothing resists a torque about the axis of a linear body"]
    return []


def _order_faults(scene: BodyScene, immersed: bool) -> list[str]:
    """Integrators that would not be what they are for this body."""
    run, resistance = scene.run, _resistance(scene)
    braked = not isinstance(resistance, NoResistance)
    if run.integrator in SOLVERS:
        if braked and resistance.rotation_dry.any():
            return [
                f"run: dry friction jumps where a body stops, which {run.integrator} cannot step over: "
                "use velocity_verlet"
            ]
        return []
    scheme = SCHEMES[run.integrator].with_rotor(run.rotor)
    if braked and min(scheme.kicks) < 0:
        forward = [name for name, other in SCHEMES.items() if min(other.kicks) >= 0]
        return [
            f"run: {run.integrator} takes steps back in time, which a resistance does not allow: use one of "
            f"{', '.join(forward)}"
        ]
    why = {"wheels": scene.wheels, "changing_inertia": scene.changing_inertia, "added mass": immersed}
    split = [name for name, other in SCHEMES.items() if not other.exact_rotor]
    return [
        f"run: the free motion of a body with {what} has no exact flow: {run.integrator} would be of order 2; "
        f"use one of {', '.join(split)} with rotor = 'split'"
        for what, there in why.items()
        if there and scheme.exact_rotor
    ]


def _carried_fluid(scene: BodyScene) -> tuple[np.ndarray, np.ndarray, float]:
    """Added mass (3,), added inertia (3,) and displaced mass."""
    fluid = scene.fluid
    if fluid is None:
        return np.zeros(3), np.zeros(3), 0.0
    if fluid.density_kg_m3 is None:
        zero = (0.0, 0.0, 0.0)
        return (
            np.array(fluid.added_mass_kg or zero),
            np.array(fluid.added_inertia_kg_m2 or zero),
            fluid.displaced_mass_kg or 0.0,
        )
    shape = scene.body.solid
    half = np.array(shape.semi_axes_m or (shape.radius_m,) * 3)
    return *added_mass_of_ellipsoid(half, fluid.density_kg_m3), fluid.density_kg_m3 * 4 / 3 * np.pi * half.prod()


def _rotor(scene: BodyScene, moments: np.ndarray, added_inertia: np.ndarray, axes: np.ndarray):
    if not scene.wheels and scene.changing_inertia is None:
        return split_rotor(moments[None])
    changing = scene.changing_inertia
    inertia = steady(moments)
    if changing is not None:
        inertia = table(changing.times_s, np.array(changing.inertia_kg_m2) + added_inertia)
    momenta = []
    for wheel in scene.wheels:
        axis = axes.T @ direction(wheel.axis)
        motor = wheel.motor_torque_N_m
        values = 0.0 if motor is None else motor
        torque = _course(wheel, np.multiply.outer(values, axis))
        momenta.append(integral(torque, wheel.momentum_kg_m2_s * axis))
    return DrivenRotor(inertia, total(momenta) if momenta else steady(np.zeros(3)))


def _course(timed: Timed, values) -> Course:
    """The course of a constant, of a window of time, or of a table."""
    if timed.times_s is not None:
        return table(timed.times_s, values)
    if timed.from_s is not None or timed.to_s is not None:
        return window(values, *timed.window)
    return steady(values)


def _frame(scene: BodyScene):
    frame = scene.frame
    if frame is None or (frame.angular_velocity_rad_s is None and frame.angular_acceleration_rad_s2 is None):
        return Inertial()
    rate = np.array(frame.angular_velocity_rad_s or (0.0, 0.0, 0.0))
    if frame.angular_acceleration_rad_s2 is not None:
        return Turning(integral(steady(frame.angular_acceleration_rad_s2), rate))
    return Turning(_course(frame, rate))


def _resistance(scene: BodyScene):
    friction, fluid = scene.friction, scene.fluid
    zero = (0.0, 0.0, 0.0)
    parts = (
        np.array(fluid.linear_resistance_kg_s if fluid else zero),
        np.array(fluid.quadratic_resistance_kg_m if fluid else zero),
        np.array(friction.dry_N_m if friction else zero),
        np.array(friction.viscous_N_m_s if friction else zero)
        + np.array(fluid.linear_rotational_resistance_N_m_s if fluid else zero),
        np.array(fluid.quadratic_rotational_resistance_N_m_s2 if fluid else zero),
    )
    return Resistance(*parts) if any(part.any() for part in parts) else NoResistance()


def _terms(scene: BodyScene, mass: float, axes: np.ndarray, centre: np.ndarray, displaced: float):
    terms = {}
    where = axes.T @ centre
    if scene.gravity is not None:
        g = np.array(scene.gravity.acceleration_m_s2)
        terms["gravity"] = SteadyForce(mass * g, where)
        if displaced:
            at = centre if scene.fluid.centre_of_buoyancy_m is None else np.array(scene.fluid.centre_of_buoyancy_m)
            terms["buoyancy"] = SteadyForce(-displaced * g, axes.T @ at)
    if scene.frame is not None and scene.frame.origin_acceleration_m_s2 is not None:
        course = _course(scene.frame, -mass * np.array(scene.frame.origin_acceleration_m_s2))
        terms["origin_acceleration"] = _force(course, steady(np.zeros(3)), where, False)
    for k, entry in enumerate(scene.applied):
        force, torque = (
            steady(np.zeros(3)) if given is None else _course(entry, given)
            for given in (entry.force_N, entry.torque_N_m)
        )
        if entry.axes == "body":
            force, torque = _turned(force, axes.T), _turned(torque, axes.T)
        terms[f"applied_{k}"] = _force(
            force, torque, axes.T @ np.array(entry.at_m or (0.0, 0.0, 0.0)), entry.axes == "body"
        )
    return terms


def _turned(course: Course, matrix: np.ndarray) -> Course:
    return Course(course.times, *(part @ matrix.T for part in course[1:]))


def _force(force: Course, torque: Course, point: np.ndarray, follows_body: bool):
    """A force that never changes in the lab has an energy; any other keeps an account of its work."""
    if not follows_body and is_steady(force) and is_steady(torque) and not torque.constant.any():
        return SteadyForce(force.constant[0], point)
    return Drive(force, torque, point, follows_body, np.zeros(3), np.zeros(3))


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
    return State(position, velocity, rotation, momentum, time, np.zeros(1))


def _left_out(system: BodySystem) -> list[str]:
    """What is not compiled, and why."""
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
