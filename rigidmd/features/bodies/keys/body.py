"""The scene of a single body: a top, a gyroscope, a satellite, a falling stone. SI units
throughout.

The equations contain no physical constants, so any other consistent units work as well.
"""

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, Strict, ValidationInfo, field_validator

from rigidmd.core.integrators import (
    AUTO,
    FORMULATIONS,
    SCHEMES,
    SOLVERS,
    WITH_THERMOSTAT,
    Rotor,
    auto_errors,
)
from rigidmd.core.toml import Json
from rigidmd.errors import SceneError, option
from rigidmd.features.bodies.keys.forces import (
    Applied,
    ChangingInertia,
    Fluid,
    Frame,
    Friction,
    Gravity,
    NonNegativeVector,
    PositiveVector,
    Wheel,
)
from rigidmd.features.bodies.keys.solids import COMPONENTS_PER_DIMENSION, SOLIDS
from rigidmd.formats import BODY_TOPOLOGY, TRAJECTORY
from rigidmd.mechanics.inertia import (
    inertia_error,
    shifted_inertia,
)
from rigidmd.mechanics.rotation import (
    angular_velocity_of_euler_rates,
    from_attitude_matrix,
    from_axis,
    from_euler_angles,
    from_quaternion,
    from_yaw_pitch_roll,
    nearest_rotation,
    orthogonality_error,
    unit_vector,
)
from rigidmd.scene.base import Scene, file_name
from rigidmd.scene.integrators import VERLET_ELSEWHERE, MovedByScheme, advise_on_integrator
from rigidmd.scene.validation import (
    MOST_STEPS,
    MOST_TABLES,
    Flag,
    Limit,
    LimitOfEnergy,
    LimitOfRounding,
    NameIn,
    Number,
    Positive,
    Section,
    TrajectoryError,
    Vector,
    location_of,
    not_none,
    number_of_steps,
)

Matrix = tuple[Vector, Vector, Vector]
Quaternion = tuple[Number, Number, Number, Number]

#: A rotation matrix with fewer than about nine digits is an error without `project`.
LARGEST_ORTHOGONALITY_ERROR = 1e-9
FURTHEST_FROM_ROTATION = 0.1
#: Keys of [body] that give the inertia, of which a body has at most one.
WAYS_OF_INERTIA = ("solid", "solids", "points", "inertia_kg_m2", "inertia_tensor_kg_m2")
#: Those of them that are tables of parts with masses and positions.
PARTS = ("solids", "points")
#: Solids that are not symmetric about axis 3 for all dimensions, so that a direction does not fix
#: their orientation.
WITHOUT_AXIS = ("cuboid", "ellipsoid")

#: Moments of inertia are equal, for a picture, if they differ by less than this fraction of the
#: largest.
EQUAL_MOMENTS = 1e-6


def axis_of_symmetry(moments: np.ndarray) -> int | None:
    """The axis about which a body with these principal moments is symmetric: 2 (axis 3) if all are
    equal, or None."""
    near = EQUAL_MOMENTS * moments.max()
    return next((k for k in (2, 0, 1) if abs(moments[k - 1] - moments[k - 2]) <= near), None)


class Solid(Section):
    """A homogeneous solid. Axis 3 is its axis of symmetry. A cone stands on its tip."""

    shape: Literal[tuple(SOLIDS)]  # type: ignore[valid-type]
    """Shape"""
    radius_m: Positive | None = None
    """Radius of a cylinder, cone, sphere, disk, ring"""
    height_m: Positive | None = None
    """Height of a cylinder, cone"""
    length_m: Positive | None = None
    """Length of a rod"""
    lengths_m: PositiveVector | None = None
    """Edges of a cuboid"""
    semi_axes_m: PositiveVector | None = None
    """Semi-axes of an ellipsoid"""

    @property
    def dimensions(self) -> dict[str, float]:
        """The dimensions given."""
        return {
            key: value
            for key in COMPONENTS_PER_DIMENSION
            if (value := getattr(self, key)) is not None
        }

    def _errors(self):
        expected = set(SOLIDS[self.shape].dimensions)
        dimensions = set(self.dimensions)
        if expected != dimensions:
            yield (
                f"a {self.shape} has {' and '.join(sorted(expected))}, not"
                f" {' and '.join(sorted(dimensions)) or 'none'}"
            )


class SolidPart(Solid):
    """A homogeneous solid of a body made of several. Where two overlap, the masses of both are
    there."""

    mass_kg: Positive | None = None
    """Mass of this solid"""
    density_kg_m3: Positive | None = None
    """Density of this solid, instead of its mass"""
    position_m: Vector = (0.0, 0.0, 0.0)
    """Position of its centre of mass, along the body axes, from any origin. If the body is pinned,
    from the pivot"""
    axis: Vector | None = None
    """Direction of its axis 3, along the body axes, with any length. For a cone it points from the
    tip to the base. Default: axis 3 of the body"""
    euler_angles_deg: Vector | None = None
    """Its orientation in the body axes: phi, theta, psi (3-1-3), x_body = Rz(phi) Rx(theta) Rz(psi)
    x_solid"""

    def _errors(self):
        errors = [*super()._errors()]
        ways = [key for key in ("mass_kg", "density_kg_m3") if getattr(self, key) is not None]
        if len(ways) != 1:
            errors.append("give mass_kg or density_kg_m3" + (", not both" if ways else ""))
        elif ways == ["density_kg_m3"] and SOLIDS[self.shape].volume == 0:
            errors.append(f"a {self.shape} has no volume: give mass_kg instead of density_kg_m3")
        elif not errors and not Scene.SIZES[0] <= self.mass <= Scene.SIZES[1]:
            errors.append(
                f"its mass is {self.mass:g} kg, must be between {Scene.SIZES[0]:g} and"
                f" {Scene.SIZES[1]:g}"
            )
        if self.axis is not None and self.euler_angles_deg is not None:
            errors.append("give axis or euler_angles_deg, not both")
        elif self.axis is not None and self.shape in WITHOUT_AXIS:
            errors.append(
                f"axis is not enough, as {'an' if self.shape == 'ellipsoid' else 'a'} {self.shape}"
                " may be rotated about its axis: give euler_angles_deg"
            )
        elif self.axis is not None and not any(self.axis):
            errors.append("axis is zero, which is not a direction")
        return errors

    @property
    def mass(self) -> float:
        """Its mass, kg."""
        if self.mass_kg is not None:
            return self.mass_kg
        shape = SOLIDS[self.shape]
        return (
            not_none(self.density_kg_m3) * shape.volume * float(shape.scale(self.dimensions).prod())
        )

    @property
    def rotation(self) -> np.ndarray:
        """Rotation (3, 3) from the axes of the solid to the axes of the body."""
        if self.euler_angles_deg is not None:
            return from_euler_angles(np.radians(self.euler_angles_deg))
        return from_axis(self.axis or (0.0, 0.0, 1.0))


class PointMass(Section):
    """A point of a body made of points."""

    mass_kg: Positive
    """Mass"""
    position_m: Vector
    """Position along the body axes, from any origin. If the body is pinned, from the pivot"""


class BodyTable(Section):
    """The body: mass, inertia and pivot. Without inertia it is a point."""

    mass_kg: Positive | None = None
    """Mass. With solids or points it is the sum of their masses"""
    solid: Solid | None = None
    """Inertia of a homogeneous solid"""
    solids: tuple[SolidPart, ...] | None = Field(default=None, min_length=1, max_length=MOST_TABLES)
    """Inertia of several homogeneous solids, joined"""
    points: tuple[PointMass, ...] | None = Field(default=None, min_length=1)
    """Inertia of point masses"""
    inertia_kg_m2: NonNegativeVector | None = None
    """Principal moments, along the body's axes"""
    inertia_tensor_kg_m2: Matrix | None = None
    """Inertia tensor along the body's axes. Off-diagonal entries have the sign of the tensor"""
    inertia_about: Literal["centre_of_mass", "pivot"] = "centre_of_mass"
    """Reference point of the given inertia"""
    pinned: Flag = False
    """Whether one point of the body is fixed"""
    centre_of_mass_m: Vector | None = None
    """Centre of mass of a pinned body, from the pivot, along the body axes"""

    def _errors(self):
        ways = [key for key in WAYS_OF_INERTIA if getattr(self, key)]
        parts = "".join(key for key in PARTS if getattr(self, key))
        has_parts = bool(parts)
        has_centre = self.centre_of_mass_m is not None
        about_pivot = self.inertia_about == "pivot"
        has_mass = self.mass_kg is not None
        errors = {
            f"give one of {', '.join(ways)}": len(ways) > 1,
            "mass_kg is missing": not (has_parts or has_mass),
            f"mass_kg would have no effect: the {parts} have masses": has_parts and has_mass,
            "centre_of_mass_m is for a pinned body, from its pivot. This one is not pinned": (
                has_centre and not self.pinned
            ),
            f"centre_of_mass_m would have no effect: it follows from the {parts}": (
                has_centre and has_parts
            ),
            "inertia_about = 'pivot', but no inertia is given": about_pivot and not ways,
            "inertia_about = 'pivot', but the body is not pinned": about_pivot and not self.pinned,
            f"inertia_about would have no effect with {''.join(ways[:1])}": (
                about_pivot and ways[:1] in (["solid"], ["solids"], ["points"])
            ),
        }
        messages = [error for error, is_there in errors.items() if is_there]
        tensor = self.tensor
        if messages or tensor is None or self.mass_kg is None:
            return messages
        if np.abs(tensor - tensor.T).max() > 1e-12 * np.abs(tensor).max():
            return ["inertia_tensor_kg_m2 is not symmetric"]
        if why := inertia_error(tensor):
            return [f"no body has this inertia: {why}"]
        if self.inertia_about == "pivot":
            at_centre = shifted_inertia(
                tensor, -self.mass_kg, np.array(self.centre_of_mass_m or (0, 0, 0))
            )
            if why := inertia_error(at_centre, np.abs(tensor).max()):
                return [
                    "no body of this mass has this inertia about its pivot: about its centre of"
                    f" mass {why}"
                ]
        return []

    @property
    def tensor(self) -> np.ndarray | None:
        """The inertia tensor (3, 3) from moments or tensor, about the point of `inertia_about`."""
        if self.inertia_tensor_kg_m2 is not None:
            return np.array(self.inertia_tensor_kg_m2)
        return None if self.inertia_kg_m2 is None else np.diag(self.inertia_kg_m2)


#: Keys of the attitude at the start, and Q (3, 3) from each.
ATTITUDES = {
    "euler_angles_deg": lambda angles: from_euler_angles(np.radians(angles)),
    "yaw_pitch_roll_deg": lambda angles: from_yaw_pitch_roll(np.radians(angles)),
    "quaternion_wxyz": lambda quaternion: from_quaternion(unit_vector(quaternion)),
    "rotation": nearest_rotation,
    "attitude_matrix": lambda matrix: nearest_rotation(from_attitude_matrix(matrix)),
}


class BodyStart(Section):
    """Attitude and motion at the start, relative to [frame] if there is one."""

    euler_angles_deg: Vector | None = None
    """phi, theta, psi (3-1-3): Q = Rz(phi) Rx(theta) Rz(psi)"""
    yaw_pitch_roll_deg: Vector | None = None
    """yaw, pitch, roll (3-2-1): Q = Rz(yaw) Ry(pitch) Rx(roll)"""
    quaternion_wxyz: Quaternion | None = None
    """Quaternion with any length except zero"""
    rotation: Matrix | None = None
    """Rows of Q, body to lab: x_lab = Q x_body"""
    attitude_matrix: Matrix | None = None
    """Rows of T = Q^T, lab to body, the usual convention for satellites"""
    project: Flag = False
    """Replace the given matrix by the nearest rotation"""
    euler_rates_rad_s: Vector | None = None
    """phi', theta', psi'"""
    angular_velocity_body_rad_s: Vector | None = None
    """Angular velocity along the body axes"""
    angular_velocity_lab_rad_s: Vector | None = None
    """Angular velocity along the axes of the lab, or of the frame"""
    position_m: Vector | None = None
    """Position of the centre of mass of a body that is not pinned"""
    velocity_m_s: Vector | None = None
    """Velocity of the centre of mass of a body that is not pinned"""

    def _errors(self):
        for keys in (
            ATTITUDES,
            ("euler_rates_rad_s", "angular_velocity_body_rad_s", "angular_velocity_lab_rad_s"),
        ):
            set_keys = [key for key in keys if getattr(self, key) is not None]
            if len(set_keys) > 1:
                yield f"give one of {', '.join(set_keys)}"
        matrix = self.rotation or self.attitude_matrix
        if self.project and matrix is None:
            yield "project would have no effect: no matrix is given"
        if matrix is not None:
            error = orthogonality_error(np.array([matrix]))
            sense = np.linalg.det(matrix)
            if self.project and (sense <= 0 or error > FURTHEST_FROM_ROTATION):
                what = (
                    f"determinant {sense:.3g}, |Q^T Q - 1| is {error:.2g}, must be below"
                    f" {FURTHEST_FROM_ROTATION:g}"
                )
                yield f"the matrix is not a rotation with rounded digits: {what}"
            elif not self.project and (error > LARGEST_ORTHOGONALITY_ERROR or sense < 0):
                if error <= LARGEST_ORTHOGONALITY_ERROR:
                    what = "a reflection"
                else:
                    what = f"|Q^T Q - 1| is {error:.2g}"
                yield (
                    f"the matrix is not a rotation: {what}, must be below"
                    f" {LARGEST_ORTHOGONALITY_ERROR:g}. project = true uses the nearest rotation"
                )
        if self.quaternion_wxyz is not None and not any(self.quaternion_wxyz):
            yield "quaternion_wxyz is zero, which is not a rotation"
        if self.euler_rates_rad_s is not None:
            if self.euler_angles_deg is None:
                yield "euler_rates_rad_s needs euler_angles_deg"
            elif self.euler_angles_deg[1] % 180 == 0:
                yield (
                    f"euler_rates_rad_s with theta = {self.euler_angles_deg[1]:g}: phi' and psi'"
                    " rotate about the same axis there. Give angular_velocity_body_rad_s"
                )

    @property
    def attitude(self) -> np.ndarray:
        """Q (3, 3), a rotation to rounding."""
        attitudes = [(to_rotation, getattr(self, key)) for key, to_rotation in ATTITUDES.items()]
        return next(
            (to_rotation(np.array(value)) for to_rotation, value in attitudes if value is not None),
            np.eye(3),
        )

    @property
    def angular_velocity(self) -> np.ndarray:
        """Angular velocity (3,) along the body axes, rad/s."""
        if self.euler_rates_rad_s is not None and self.euler_angles_deg is not None:
            return angular_velocity_of_euler_rates(
                np.radians(self.euler_angles_deg), np.array(self.euler_rates_rad_s)
            )
        if self.angular_velocity_lab_rad_s is not None:
            return self.attitude.T @ self.angular_velocity_lab_rad_s
        return np.array(self.angular_velocity_body_rad_s or (0.0, 0.0, 0.0))


#: Integrators of molecules and of other programs -> advice.
OTHER_INTEGRATORS = {
    **dict.fromkeys(WITH_THERMOSTAT, "it has a thermostat, for molecules"),
    **VERLET_ELSEWHERE,
}


class Run(MovedByScheme):
    """Duration and integrator."""

    duration_s: Positive
    """Duration"""
    timestep_s: Positive
    """Time step. With dop853 and radau, whose steps are adaptive, it is the interval between
    observations. With auto it is the longest step"""
    integrator: Annotated[str, NameIn((*SCHEMES, AUTO, *SOLVERS), in_scene=True)] = (
        "velocity_verlet"
    )
    """A scheme of flows. auto: the scheme and step that keep the requested error with the fewest
    force evaluations, or a general ODE solver for the textbook equations: rk4, dop853, radau"""
    energy_error: Positive | None = None
    """With auto: rms error of the energy over the run, as a fraction of the largest kinetic
    energy"""
    trajectory_error: TrajectoryError | None = None
    """With auto: largest error of Q at the end. For a point it is the error of X in m"""
    rotor: Rotor | None = None
    """Free rotation by the split or the exact flow. Default: the flow that the integrator needs"""
    formulation: Literal[tuple(FORMULATIONS)] | None = None  # type: ignore[valid-type]
    """Variables of the attitude for rk4, dop853 and radau. Default: matrix"""
    relative_tolerance: Annotated[float, Strict(), Field(ge=1e-13, lt=1)] | None = None
    """Relative tolerance of dop853 and radau. Default: 1e-10"""
    absolute_tolerance: Positive | None = None
    """Absolute tolerance of dop853 and radau, as a fraction of the size of each variable in the
    run. Default: 1e-10"""

    @field_validator("integrator", mode="before")
    @classmethod
    def _moves_bodies(cls, name: object, info: ValidationInfo):
        known = (*SCHEMES, AUTO, *SOLVERS)
        return advise_on_integrator(name, OTHER_INTEGRATORS, known, info.context)

    def _errors(self):
        if self.rotor is not None and self.integrator in SOLVERS:
            yield f"rotor would have no effect with {self.integrator}"
        yield from self._rotor_errors()
        if self.formulation is not None and self.integrator not in SOLVERS:
            yield (
                f"formulation would have no effect with {self.integrator}: it is for"
                f" {', '.join(SOLVERS)}"
            )
        tolerances = [
            key
            for key in ("relative_tolerance", "absolute_tolerance")
            if getattr(self, key) is not None
        ]
        if tolerances and self.integrator not in ("dop853", "radau"):
            yield f"{', '.join(tolerances)} would have no effect with {self.integrator}"
        asked = {"energy_error": self.energy_error, "trajectory_error": self.trajectory_error}
        yield from auto_errors(self.integrator, asked, ["rotor"] if self.rotor is not None else [])
        if not self.duration_s / self.timestep_s < MOST_STEPS:
            yield f"duration_s / timestep_s is more than {MOST_STEPS:g} steps"
        elif self.duration_s < 0.5 * self.timestep_s:
            yield f"duration_s = {self.duration_s:g} is less than one step of {self.timestep_s:g} s"

    @property
    def steps(self) -> int:
        return number_of_steps(self.duration_s, self.timestep_s)


class BodyOutput(Section):
    """Files in the folder of the run."""

    interval_s: Positive | None = None
    """Time between samples in motion.csv and the trajectory. Default: the duration divided by
    2000"""
    npz: Flag = False
    """Also write motion.npz, the same columns as arrays"""
    trajectory: Annotated[
        str | Literal[False], file_name(lambda form: form.encoder and not form.even)
    ] = TRAJECTORY
    """Trajectory of points of the body for viewers, or false for none. The extension sets the
    format"""
    topology: Annotated[str | None, file_name(lambda form: form.topology)] = None
    """Topology file that viewers need for the trajectory: .gro, or .pdb, whose bonds are the edges
    of the body. Default: topology.pdb, or topology.gro for a body that starts more than 900 Å away
    in the trajectory"""
    trajectory_A_per_m: Positive | None = None
    """Scale of the trajectory, in Å per metre. Default: the body gets a radius of 10 Å. A second
    becomes a ps"""
    figures: Flag = True
    """Draw the motion"""
    checkpoint_minutes: Annotated[float, Strict(), Field(gt=0, le=1e9)] | Literal[False] = 5.0
    """Wall time between checkpoints, or false for none. `rigidmd resume` continues a run from a
    checkpoint. Runs with radau have no checkpoints"""
    axis: Vector | None = None
    """Body axis whose path is drawn. Default: towards the centre of mass, else the axis of
    symmetry, else axis 3"""
    drawn_as: Literal["top", "ellipsoid", "cuboid"] | Solid | None = None
    """Shape in animations and pages. No effect on the motion. "top", "ellipsoid" or "cuboid" with
    the mass and inertia of the body, or a solid with its dimensions, such as { shape = "cone",
    radius_m = 0.03, height_m = 0.06 }. Default: the solids or the points of the body, else a
    cylinder or ball of its inertia if two moments are equal, on a stem if it is pinned outside,
    else a cuboid"""

    def _errors(self):
        if self.trajectory and self.trajectory == (self.topology or BODY_TOPOLOGY):
            yield f"topology and trajectory are both {self.trajectory}. Give them different names"
        if self.axis is not None and not any(self.axis):
            yield "axis is zero, which is not a direction"


class BodyWatch(Section):
    """Limits beyond which a run of a single body stops, false switches a check off."""

    energy: LimitOfEnergy = 1.0
    """Largest change of the energy minus the work done, in units of the largest energy exchanged so
    far: the kinetic energy at the start and changes of potential energy and work"""
    orthogonality: LimitOfRounding | None = None
    """Largest entry of abs(QᵀQ - 1). Default: 1e-9, or 0.1 with rk4, dop853 and radau, which do not
    preserve it"""
    turn_rad: Limit = False
    """Largest rotation of the body in a step"""
    stable_step: Flag = True
    """Estimate the longest stable step from the body's spin and swing, and warn if timestep_s is
    longer"""


class BodyScene(Scene):
    """One body that moves."""

    kind: ClassVar[str] = "body"
    subject: ClassVar[str] = "a single body"
    time_unit: ClassVar[str] = "s"

    body: BodyTable
    start: BodyStart = BodyStart.model_construct()
    gravity: Gravity | None = None
    applied: tuple[Applied, ...] = Field(default=(), max_length=MOST_TABLES)
    friction: Friction | None = None
    fluid: Fluid | None = None
    frame: Frame | None = None
    wheels: tuple[Wheel, ...] = Field(default=(), max_length=MOST_TABLES)
    changing_inertia: ChangingInertia | None = None
    run: Run
    output: BodyOutput = BodyOutput.model_construct()
    watch: BodyWatch = BodyWatch.model_construct()

    @property
    def in_short(self) -> str:
        run = self.run
        how = "" if run.is_auto else f" in {run.steps} steps of {run.timestep_s:g} s"
        pinned = ", pinned" if self.body.pinned else ""
        return f"{self.name}: one body{pinned}; {run.duration_s:g} s{how}, {run.integrator}"

    def with_end(self, time: float) -> "BodyScene":
        raise SceneError(
            self.source,
            [f"{option('until')} is for molecules. Set run.duration_s of a single body"],
        )

    @classmethod
    def contradictions(cls, data: Json, text: str) -> list[str]:
        messages: list[tuple[list, str]] = []
        tables = {key: value for key, value in data.items() if isinstance(value, dict)}
        body, start, fluid = (tables.get(key, {}) for key in ("body", "start", "fluid"))
        if body.get("pinned") is True:
            moved = "the body is pinned at a point and cannot be moved: omit it"
            messages += [
                (["start", key], moved) for key in ("position_m", "velocity_m_s") if key in start
            ]
            forces = ("linear_resistance_kg_s", "quadratic_resistance_kg_m", "added_mass_kg")
            resisting = [
                key
                for key in forces
                if isinstance(fluid.get(key), list | tuple) and any(fluid[key])
            ]
            messages += [
                (["fluid", key], "the body is pinned at a point: no such force acts on it")
                for key in resisting
            ]
        inertias = [key for key in WAYS_OF_INERTIA if key in body]
        if "changing_inertia" in data and inertias:
            messages.append(
                (["body", inertias[0]], "changing_inertia defines the inertia: omit one of them")
            )
        if "fluid" in data and "frame" in data:
            messages.append(
                (["frame"], "a fluid at rest and an accelerated frame together are not supported")
            )
        return [f"{location_of(keys, text)}: {error}" for keys, error in messages]

    def _errors(self):
        fluid, body = self.fluid, self.body
        if fluid is not None:
            if fluid.density_kg_m3 is not None:
                if (
                    body.solid is None
                    or body.solid.shape not in ("sphere", "ellipsoid")
                    or body.pinned
                ):
                    yield (
                        "fluid.density_kg_m3 needs a body.solid that is a sphere or an ellipsoid,"
                        " not pinned"
                    )
                follow = ("displaced_mass_kg", "added_mass_kg", "added_inertia_kg_m2")
                set_keys = [key for key in follow if getattr(fluid, key) is not None]
                yield from [
                    f"fluid.{key} contradicts fluid.density_kg_m3, from which it follows"
                    for key in set_keys
                ]
            buoyant = fluid.displaced_mass_kg is not None or fluid.density_kg_m3 is not None
            if fluid.centre_of_buoyancy_m is not None and not buoyant:
                yield (
                    "fluid.centre_of_buoyancy_m would have no effect without displaced_mass_kg or"
                    " density_kg_m3"
                )
            if (fluid.displaced_mass_kg or fluid.density_kg_m3) and self.gravity is None:
                yield "fluid: buoyancy needs [gravity]"
        if self.output.interval_s is not None and self.output.interval_s > self.run.duration_s:
            yield f"output.interval_s = {self.output.interval_s:g} is longer than run.duration_s"


SCENE = BodyScene
MOTION = "motion.csv"  # the file of the samples
SAMPLES = 2000  # of the motion of a body
FORMULATION = "matrix"
