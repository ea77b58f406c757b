"""Tables of a scene that act on a single body: fields, forces, friction, fluids, frames, wheels. SI
units."""

from collections.abc import Iterator, Mapping
from itertools import pairwise
from math import inf
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from rigidmd.mechanics.inertia import inertia_error
from rigidmd.scene.validation import NonNegative, Number, Positive, Section, Vector

NonNegativeVector = tuple[NonNegative, NonNegative, NonNegative]
PositiveVector = tuple[Positive, Positive, Positive]
Times = Annotated[tuple[NonNegative, ...], Field(min_length=2)]


class Gravity(Section):
    """Uniform gravity."""

    acceleration_m_s2: Vector = (0.0, 0.0, -9.81)
    """Acceleration along the axes of the lab, or of the frame"""


class Timed(Section):
    """Quantities that are constant, limited to a window of time, or interpolated linearly in a
    table."""

    times_s: Times | None = None
    """Increasing times. Each quantity is then a list with one value for each time"""
    from_s: NonNegative | None = None
    """Start of the time window. Default: 0"""
    to_s: NonNegative | None = None
    """End of the time window. Default: none"""

    @field_validator("times_s")
    @classmethod
    def _increase(cls, times):
        for k, (a, b) in enumerate(pairwise(times or ())):
            if not b > a:
                raise ValueError(f"must increase: entry {k + 1} is {b:g} after {a:g}")
        return times

    def timing_errors(
        self, values: Mapping[str, float | tuple[object, ...] | None], entry: type
    ) -> Iterator[str]:
        """Messages on quantities that do not match the times. A single value has the type
        `entry`."""
        times = self.times_s
        if times is not None and (self.from_s is not None or self.to_s is not None):
            yield "from_s and to_s would have no effect next to times_s"
        if not (self.to_s is None or self.to_s > (self.from_s or 0)):
            yield f"to_s = {self.to_s:g} is not after from_s = {self.from_s or 0:g}"
        for key, value in values.items():
            many = isinstance(value, tuple) and (
                entry is float or isinstance(next(iter(value), None), tuple)
            )
            if value == ():
                yield f"{key} is an empty list"
            elif times is None and many:
                yield f"{key} is a list of values: times_s is missing"
            elif times is not None and value is not None and not many:
                yield f"{key} is one value: with times_s it must be a list of {len(times)}"
            elif times is not None and isinstance(value, tuple) and len(value) != len(times):
                yield f"{key} has {len(value)} values for {len(times)} times"

    @property
    def window(self) -> tuple[float, float]:
        return self.from_s or 0.0, inf if self.to_s is None else self.to_s


class Applied(Timed):
    """An external force and torque."""

    axes: Literal["lab", "body"] = "lab"
    """Axes of the components: fixed in the lab, or rotating with the body"""
    force_N: Vector | tuple[Vector, ...] | None = None
    """Force"""
    torque_N_m: Vector | tuple[Vector, ...] | None = None
    """Torque in addition to the torque of the force"""
    at_m: Vector | None = None
    """Point of action, along the body axes, from the centre of mass, or from the pivot of a pinned
    body. Default: that point itself"""

    def _errors(self):
        yield from self.timing_errors(
            {"force_N": self.force_N, "torque_N_m": self.torque_N_m}, tuple
        )
        if self.force_N is None and self.torque_N_m is None:
            yield "needs force_N or torque_N_m"
        if self.at_m is not None and self.force_N is None:
            yield "at_m would have no effect without force_N"


class Friction(Section):
    """Friction of bearings, about the body's axes, relative to the frame."""

    viscous_N_m_s: NonNegativeVector = (0.0, 0.0, 0.0)
    """Torque per angular velocity, about each axis"""
    dry_N_m: NonNegativeVector = (0.0, 0.0, 0.0)
    """Torque against any rotation, about each axis"""


class Fluid(Section):
    """A fluid at rest around the body: resistance, buoyancy, added mass. Along the body's axes."""

    linear_resistance_kg_s: NonNegativeVector = (0.0, 0.0, 0.0)
    """Force per velocity"""
    quadratic_resistance_kg_m: NonNegativeVector = (0.0, 0.0, 0.0)
    """Force per velocity squared"""
    linear_rotational_resistance_N_m_s: NonNegativeVector = (0.0, 0.0, 0.0)
    """Torque per angular velocity"""
    quadratic_rotational_resistance_N_m_s2: NonNegativeVector = (0.0, 0.0, 0.0)
    """Torque per angular velocity squared"""
    density_kg_m3: Positive | None = None
    """Density of the fluid. The displaced mass and the added mass of a sphere or ellipsoid follow
    from it"""
    displaced_mass_kg: NonNegative | None = None
    """Mass of the displaced fluid. Buoyancy is its weight"""
    centre_of_buoyancy_m: Vector | None = None
    """Point where buoyancy acts, along the body axes, from the centre of mass, or from the pivot of
    a pinned body. Default: the centre of mass"""
    added_mass_kg: NonNegativeVector | None = None
    """Mass of the fluid that the body carries along each axis"""
    added_inertia_kg_m2: NonNegativeVector | None = None
    """Inertia of the fluid that the body carries about each axis"""


class Frame(Timed):
    """A frame with rotating axes or an accelerated origin. The motion is relative to it."""

    angular_velocity_rad_s: Vector | tuple[Vector, ...] | None = None
    """Angular velocity of the frame, along the axes of the frame"""
    angular_acceleration_rad_s2: Vector | None = None
    """Angular acceleration of the frame, along the axes of the frame, constant from the start"""
    origin_acceleration_m_s2: Vector | tuple[Vector, ...] | None = None
    """Acceleration of the frame's origin, along the frame's axes. The body has the opposite
    acceleration"""

    def _errors(self):
        timed = {
            key: getattr(self, key)
            for key in ("angular_velocity_rad_s", "origin_acceleration_m_s2")
        }
        yield from self.timing_errors(timed, tuple)
        if self.from_s is not None or self.to_s is not None:
            yield "from_s and to_s are not supported here. Use times_s"
        if self.angular_acceleration_rad_s2 is not None and self.times_s is not None:
            yield "angular_acceleration_rad_s2 and times_s contradict each other"
        if (
            all(value is None for value in timed.values())
            and self.angular_acceleration_rad_s2 is None
        ):
            yield (
                "needs angular_velocity_rad_s, angular_acceleration_rad_s2 or"
                " origin_acceleration_m_s2"
            )


class Wheel(Timed):
    """A rotor on an axis fixed in the body. The inertia of the body includes the wheel, except
    about this axis."""

    axis: Vector
    """Direction of the axis, along the body axes, with any length"""
    momentum_kg_m2_s: Number = 0.0
    """Initial angular momentum along the axis, relative to the lab"""
    motor_torque_N_m: Number | tuple[Number, ...] | None = None
    """Torque of the motor on the wheel. The opposite torque acts on the body"""

    def _errors(self):
        yield from self.timing_errors({"motor_torque_N_m": self.motor_torque_N_m}, float)
        if not any(self.axis):
            yield "axis is zero, which is not a direction"
        idle = [key for key in ("times_s", "from_s", "to_s") if getattr(self, key) is not None]
        if self.motor_torque_N_m is None and idle:
            yield f"{', '.join(idle)} would have no effect without motor_torque_N_m"


class ChangingInertia(Timed):
    """Principal moments about the centre of mass as given functions of time, along fixed body axes.
    Mass and centre of mass do not change. The pivot of a pinned body must be its centre of mass."""

    inertia_kg_m2: tuple[PositiveVector, ...]
    """Principal moments at each time"""

    def _errors(self):
        timed = {"inertia_kg_m2": self.inertia_kg_m2}
        yield from (
            ["times_s is missing"] if self.times_s is None else self.timing_errors(timed, tuple)
        )
        if self.from_s is not None or self.to_s is not None:
            yield "from_s and to_s are not supported here. Use times_s"
        for k, moments in enumerate(self.inertia_kg_m2):
            if why := inertia_error(np.diag(moments)):
                yield f"no body has the inertia of entry {k}: {why}"
