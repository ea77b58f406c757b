"""The motion of a single body: the columns of motion.csv, with the errors of the conserved
quantities."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rigidmd.core.quantities import Quantity
from rigidmd.core.state import NOW, WORK, State
from rigidmd.engines.samples import MATRIX, SampleTable
from rigidmd.features.bodies.driven_rotor import DrivenRotor
from rigidmd.features.bodies.forces.applied import (
    PythonForce,
    TimeDependentForce,
    steady_energies,
)
from rigidmd.features.bodies.forces.resistance import NoResistance
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.bodies.time_functions import is_constant_function
from rigidmd.features.bodies.translation import FluidTranslation, InertialFrame, inertial_masses
from rigidmd.mechanics.rotation import to_euler_angles, to_quaternion, unit_vector


class Family(NamedTuple):
    names: tuple[str, ...]
    unit: str
    about: str


def _named(pattern: str, parts: Iterable[str]) -> tuple[str, ...]:
    return tuple(map(pattern.format, parts))


FAMILIES = {
    "time": Family(("time",), "s", "time"),
    "position": Family(("x", "y", "z"), "m", "centre of mass"),
    "velocity": Family(("vx", "vy", "vz"), "m/s", "its velocity"),
    "rotation": Family(
        tuple(f"q{i}{j}" for i in "123" for j in "123"),
        "1",
        "rotation matrix Q by rows: lab = Q body",
    ),
    "quaternion": Family(
        ("qw", "qx", "qy", "qz"), "1", "Q as a quaternion whose sign does not jump"
    ),
    "euler_angles": Family(("phi", "theta", "psi"), "rad", "Q as Euler angles, 3-1-3"),
    "h_body": Family(
        _named("h_body_{}", "123"), "kg m²/s", "angular momentum of wheels, body axes"
    ),
    "omega_body": Family(_named("omega_body_{}", "123"), "rad/s", "angular velocity, body axes"),
    "omega_lab": Family(_named("omega_lab_{}", "xyz"), "rad/s", "angular velocity, lab axes"),
    "L_body": Family(
        _named("L_body_{}", "123"),
        "kg m²/s",
        "angular momentum with wheels, body axes",
    ),
    "L_lab": Family(_named("L_lab_{}", "xyz"), "kg m²/s", "angular momentum with wheels, lab axes"),
    "kinetic": Family(
        ("kinetic",), "J", "kinetic energy of I omega. Less Omega · J in a rotating frame"
    ),
    "potential": Family(("potential",), "J", "potential energy"),
    "energy": Family(("energy",), "J", "kinetic and potential energy"),
    "work": Family(("work",), "J", "work of drives and resistance: energy - work is conserved"),
    "energy_error": Family(
        ("energy_error",), "1", "change of energy - work, relative to the largest kinetic energy"
    ),
    "L_error": Family(
        _named("L_{}_error", ("lab", "size", *"xyz123")),
        "1",
        "change of L, relative to the largest abs(L)",
    ),
    "orthogonality_error": Family(("orthogonality_error",), "1", "largest entry of abs(QᵀQ - 1)"),
}


COLUMNS = {n: Quantity(n, n, f.unit, f.about) for f in FAMILIES.values() for n in f.names}
#: Header of a column of motion.csv -> its name, also without units, as earlier versions wrote them.
NAMES = {name: name for name in COLUMNS} | {"t": "time"} | {c.header: n for n, c in COLUMNS.items()}


@dataclass(repr=False)
class Motion(SampleTable):
    """The samples of a run as columns.

    columns : name -> array (t,) in SI units. `described` explains them. Position, velocity,
        attitude and omega are relative to the frame. L is the angular momentum relative to
        non-rotating axes, wheels (h) included, along the axes of the frame (lab) or of the body.
        The kinetic energy is without that of wheels about their axes.
    """

    columns: dict[str, np.ndarray]

    def __post_init__(self) -> None:
        self.described = {name: COLUMNS[name] for name in self.columns if name in COLUMNS}
        if FAMILIES["rotation"].names[0] in self.columns:
            about = "the rotation matrices (n, 3, 3): lab = Q body"
            self.described[MATRIX] = Quantity(MATRIX, "", "1", about)

    @property
    def invariants(self) -> list[str]:
        """Names of conserved quantities. Column NAME_error is the change since the start, of
        energies relative to the largest kinetic energy, of L relative to the largest |L|."""
        names = FAMILIES["energy_error"].names + FAMILIES["L_error"].names
        return [name.removesuffix("_error") for name in names if name in self.columns]

    def _array(self, name: str) -> np.ndarray:
        """An array (t,) in SI units; of "Q", for a body that rotates, matrices (t, 3, 3)."""
        if name == MATRIX:
            return np.stack(
                [self.columns[name] for name in FAMILIES["rotation"].names], axis=-1
            ).reshape(-1, 3, 3)
        return self.columns[name]


def stacked(states: Sequence[State], names: Sequence[str] = State._fields) -> dict[str, np.ndarray]:
    """The arrays of states, stacked along axis 0, by name."""
    return {name: np.array([getattr(state, name) for state in states]) for name in names}


def states_of(arrays: Mapping[str, np.ndarray]) -> list[State]:
    """The states of arrays that are stacked."""
    return [State(*state) for state in zip(*(arrays[n] for n in State._fields), strict=True)]


def motion(system: BodySystem, samples: Sequence[State]) -> Motion:
    """The motion of a body from its states."""
    states = State(**stacked(samples, State._fields[:-1]), extra_variables=np.zeros(0))
    times = states.time[:, NOW]
    position, velocity, rotation, omega = system.motion(times, states)
    columns = {"time": times} | _columns("position", position) | _columns("velocity", velocity)
    if system.rotates:
        columns |= _columns("rotation", rotation.reshape(-1, 9))
        columns |= _columns("quaternion", _continuous(to_quaternion(rotation)))
        columns |= _columns("euler_angles", to_euler_angles(rotation))
        if isinstance(system.body.rotor, DrivenRotor):
            columns |= _columns("h_body", system.moments(times)[1] @ system.axes.T)
        for name, body in (
            ("omega", omega),
            ("L", states.angular_momentum_body.reshape(-1, 3) @ system.axes.T),
        ):
            columns |= _columns(f"{name}_body", body)
            columns |= _columns(f"{name}_lab", np.einsum("tij,tj->ti", rotation, body))
    columns |= energies(system, times, states)
    columns |= {f"{name}_error": error for name, error in _errors(system, columns).items()}
    if system.rotates:
        columns["orthogonality_error"] = np.abs(
            np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)
        ).max(axis=(1, 2))
    return Motion(columns)


def _columns(family: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """The columns of a family from values (t, n)."""
    return dict(zip(FAMILIES[family].names, values.T, strict=True))


def _continuous(quaternions: np.ndarray) -> np.ndarray:
    """The same rotations, with signs that do not jump from one sample to the next."""
    overlap = np.sign(np.sum(quaternions[1:] * quaternions[:-1], axis=1))
    return (
        quaternions * np.concatenate([[1.0], np.cumprod(np.where(overlap < 0, -1.0, 1.0))])[:, None]
    )


def is_balanced(system: BodySystem) -> bool:
    """Whether the energy less the work is conserved: in an inertial frame or one that rotates
    uniformly."""
    frame = system.body.frame
    return isinstance(frame, InertialFrame) or is_constant_function(frame.angular_velocity)


def energies_of(system: BodySystem, state: State) -> dict[str, float]:
    """The columns of `energies` at one state, J."""
    columns = energies(system, state.time[:1], State(*(array[None] for array in state)))
    return {name: float(values[0]) for name, values in columns.items()}


def energies(system: BodySystem, times: np.ndarray, states: State) -> dict[str, np.ndarray]:
    """Kinetic energy (less Omega . J in a rotating frame), potential energy, their sum, and work of
    other forces."""
    n = len(times)
    kinetic = np.zeros(n)
    potential = np.zeros(n)
    about_origin = np.zeros((n, 3))
    if system.rotates:
        rotation = states.rotation.reshape(n, 3, 3)
        momentum = states.angular_momentum_body.reshape(n, 3)
        inertia, carried = system.moments(times)
        twice = np.divide(
            (momentum - carried) ** 2, inertia, out=np.zeros((n, 3)), where=inertia > 0
        )
        kinetic += 0.5 * twice.sum(axis=1)
        about_origin += np.einsum("tij,tj->ti", rotation, momentum)
    if system.translates:
        position = states.position.reshape(n, 3)
        impulse = system.mass * states.velocity.reshape(n, 3)
        along = np.einsum("tji,tj->ti", rotation, impulse) if system.rotates else impulse
        kinetic += 0.5 * (along**2 / inertial_masses(system.body.translation)).sum(axis=1)
        about_origin += np.cross(position, impulse)
    kinetic -= (system.frame_rates(times) * about_origin).sum(axis=1)
    for term in system.steady_forces:
        potential += steady_energies(term, states.position, states.rotation)
    return {
        "kinetic": kinetic,
        "potential": potential,
        "energy": kinetic + potential,
        "work": states.energy_ledger.reshape(n, 3)[:, WORK],
    }


def _errors(system: BodySystem, columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Relative changes since the start of the quantities that this scene conserves."""
    body = system.body
    forces = system.steady_forces
    driven = any(
        isinstance(term, TimeDependentForce | PythonForce) for term in system.terms.values()
    )
    lossless = isinstance(body.resistance, NoResistance)
    inertial = isinstance(body.frame, InertialFrame)
    errors = {}
    if is_balanced(system):
        balance = columns["energy"] - columns["work"]
        errors["energy"] = _relative(
            balance - balance[0], np.abs(columns["kinetic"]).max() or np.abs(balance[0])
        )
    if not system.rotates:
        return errors
    momentum = {k: columns[f"L_lab_{k}"] for k in "xyz"}
    size = np.sqrt(sum(part**2 for part in momentum.values()))
    arms = [term.point for term in forces if term.force.any()]
    if lossless and not driven and inertial and not isinstance(body.translation, FluidTranslation):
        if not any(arm.any() for arm in arms):
            errors["L_lab"] = _relative(
                np.sqrt(sum((part - part[0]) ** 2 for part in momentum.values())), size.max()
            )
            errors["L_size"] = _relative(size - size[0], size.max())
        else:
            pulling = [
                np.flatnonzero(term.force)
                for term in forces
                if term.point.any() and term.force.any()
            ]
            if all(len(p) == 1 and p[0] == pulling[0][0] for p in pulling):
                k = "xyz"[pulling[0][0]]
                errors[f"L_{k}"] = _relative(momentum[k] - momentum[k][0], size.max())
    axis = _kept_axis(system, arms, driven=driven)
    if axis is not None:
        along = columns[f"L_body_{axis + 1}"]
        errors[f"L_{axis + 1}"] = _relative(along - along[0], size.max())
    return errors


def _kept_axis(system: BodySystem, arms: list[np.ndarray], *, driven: bool) -> int | None:
    """The symmetry axis of a body if no torque acts about it, so that L along it is conserved."""
    body = system.body
    if (
        driven
        or not np.array_equal(system.axes, np.eye(3))
        or isinstance(body.translation, FluidTranslation)
    ):
        return None
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        symmetric = system.inertia[i] == system.inertia[j] and system.inertia[k] > 0
        on_axis = not any(arm[[i, j]].any() for arm in arms)
        if isinstance(body.rotor, DrivenRotor):
            inertia, momentum = body.rotor.inertia, body.rotor.momentum
            symmetric &= is_constant_function(inertia) and not any(
                part[:, [i, j]].any() for part in momentum[1:]
            )
        if not isinstance(body.resistance, NoResistance):
            drag = body.resistance
            symmetric &= not any(
                x[k] for x in (drag.rotation_dry, drag.rotation_linear, drag.rotation_quadratic)
            )
        if symmetric and on_axis:
            return k
    return None


def _relative(error: np.ndarray, scale: float) -> np.ndarray:
    return error / scale if scale > 0 else error


def drawn_axis(system: BodySystem) -> np.ndarray:
    """The body axis (3,) whose path is drawn: given in the scene, else to the centre of mass, of
    symmetry, or 3."""
    if system.scene.output.axis is not None:
        return unit_vector(np.array(system.scene.output.axis))
    if system.centre.any():
        return unit_vector(system.centre)
    for k in (2, 0, 1):
        if system.inertia[k - 1] == system.inertia[k - 2] != system.inertia[k]:
            return system.axes[:, k]
    return system.axes[:, 2]
