"""Rates and periods of the motion of a single body: precession, nutation, spin, flips, each
measured from the samples of a run, and by theory where there is a closed form."""

from typing import NamedTuple

import numpy as np

from rigidmd.features.bodies.forces.applied import PythonForce, TimeDependentForce
from rigidmd.features.bodies.forces.resistance import NoResistance
from rigidmd.features.bodies.keys.body import EQUAL_MOMENTS
from rigidmd.features.bodies.motion import Motion
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.bodies.theory import free_body_period, heavy_top_motion
from rigidmd.features.bodies.translation import FluidTranslation, InertialFrame
from rigidmd.mechanics.free_rotor import SplitRotor

#: Minimum samples of a motion, and of each period in it.
LEAST_SAMPLES, SAMPLES_PER_PERIOD = 16, 8
#: Angle (rad) within which an axis that stays there is along another, and an angle that stays there
#: is constant.
SMALL_ANGLE = 1e-6
#: Change of an angle (rad) between two samples from which on it is not known how far the axis went.
LARGEST_CHANGE = np.pi / 2
#: The middle axis of a free body comes as near to the angular momentum as this cosine if the body
#: flips.
FLIP_COSINE = np.cos(np.radians(30))


class Rate(NamedTuple):
    """A rate or period, in the unit of its key. None if the samples do not show it, or if there is
    no closed form."""

    measured: float | None
    theory: float | None


@np.errstate(all="ignore")
def body_rates(system: BodySystem, motion: Motion) -> dict[str, Rate]:
    """Rates and periods that this motion has, by their names with units.

    precession_rad_s : mean rate of the axis about the vertical, over whole periods of nutation
    precession_about_L_rad_s : rate of the axis of a free symmetric body about the angular momentum
    nutation_period_s : period of the tilt of the axis against the vertical
    spin_rad_s : angular velocity about the axis of symmetry
    omega_period_s : period of the angular velocity in a free body with three different moments
    flip_interval_s : time between two flips of such a body, half of this period
    """
    if (
        not system.rotates
        or len(motion) < LEAST_SAMPLES
        or not isinstance(system.body.frame, InertialFrame)
    ):
        return {}
    forces = [term for term in system.steady_forces if term.force.any()]
    # the direction of all forces, and the sum of force times point of action along it: U = -down .
    # Q moment
    down = forces[0].force / np.linalg.norm(forces[0].force) if forces else np.zeros(3)
    if any(
        np.linalg.norm(np.cross(term.force, down)) > EQUAL_MOMENTS * np.linalg.norm(term.force)
        for term in forces
    ):
        return {}
    moment = sum((term.force @ down * term.point for term in forces), np.zeros(3))
    if moment.any():
        rates = _of_heavy_body(system, motion, down, moment)
    else:
        rates = _of_free_body(system, motion) if _has_theory(system) else {}
    finite = {name: Rate(*map(_finite_or_none, rate)) for name, rate in rates.items()}
    return {name: rate for name, rate in finite.items() if rate != Rate(None, None)}


def _finite_or_none(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def _has_theory(system: BodySystem) -> bool:
    """Whether a rigid body is without all but steady forces."""
    body = system.body
    driven = (TimeDependentForce, PythonForce)
    return (
        isinstance(body.rotor, SplitRotor)
        and isinstance(body.resistance, NoResistance)
        and not isinstance(body.translation, FluidTranslation)
        and not any(isinstance(term, driven) for term in system.terms.values())
    )


def _of_heavy_body(
    system: BodySystem, motion: Motion, down: np.ndarray, moment: np.ndarray
) -> dict[str, Rate]:
    """Rates of a body on which a constant force acts. down (3,) : its direction. moment (3,) :
    force times point of action, principal axes, N m"""
    axis = moment / np.linalg.norm(moment)
    size = float(np.linalg.norm(moment))
    polar, azimuth = _angles(motion["Q"] @ (system.axes @ axis), -down)
    rates = {}
    along = axis**2 @ system.inertia
    across = float(np.delete(system.inertia, np.abs(axis).argmax())[0])
    even = across * np.eye(3) + (along - across) * np.outer(axis, axis)
    symmetric = np.abs(even - np.diag(system.inertia)).max() <= EQUAL_MOMENTS * system.inertia.max()
    nutation = precession = None
    if symmetric and _has_theory(system):
        momentum = _vectors(motion, "L_body")[0] @ system.axes
        spin = float(momentum @ axis)
        across_axis = momentum - spin * axis
        up_body = -down @ motion["Q"][0] @ system.axes
        precession, nutation = heavy_top_motion(
            across,
            size,
            spin,
            float(up_body @ axis),
            float(across_axis @ across_axis),
            float(across_axis @ up_body),
        )
        rates["spin_rad_s"] = Rate(
            float((_vectors(motion, "omega_body") @ system.axes @ axis).mean()), None
        )
    if azimuth is None:
        return rates
    rates["precession_rad_s"] = Rate(_slope(motion["time"], azimuth), precession)
    if np.ptp(polar) > SMALL_ANGLE:
        cosine = np.cos(polar)
        period, rate = _periods(
            motion["time"], cosine, 0.5 * (cosine.max() + cosine.min()), azimuth
        )
        rates["nutation_period_s"] = Rate(period, nutation)
        if precession is not None:
            rates["precession_rad_s"] = Rate(rate, precession)
    return rates


def _of_free_body(system: BodySystem, motion: Motion) -> dict[str, Rate]:
    """Rates of a body that no torque acts on."""
    momentum = _vectors(motion, "L_lab")[0]
    inertia = system.inertia
    size = float(np.linalg.norm(momentum))
    if size == 0:
        return {}
    if system.kind == "symmetric":
        k = int(np.abs(inertia - np.median(inertia)).argmax())
        polar, azimuth = _angles(motion["Q"] @ system.axes[:, k], momentum / size)
        omega = _vectors(motion, "omega_body") @ system.axes[:, k]
        rates = {"spin_rad_s": Rate(float(omega.mean()), None)}
        if SMALL_ANGLE < polar[0] < np.pi - SMALL_ANGLE:
            measured = None if azimuth is None else _slope(motion["time"], azimuth)
            rates["precession_about_L_rad_s"] = Rate(measured, size / float(inertia[k - 1]))
        return rates
    omega = _vectors(motion, "omega_body") @ system.axes
    if (
        system.kind != "asymmetric"
        or np.ptp(omega, axis=0).max() <= SMALL_ANGLE * np.abs(omega).max()
    ):
        return {}
    middle = int(np.argsort(inertia)[1])
    time = motion["time"]
    swings = omega[:, middle]
    period = free_body_period(inertia, omega[0])
    rates = {"omega_period_s": Rate(_periods(time, swings, 0.0, swings)[0], period)}
    if np.abs(swings).max() * inertia[middle] > FLIP_COSINE * size:
        rates["flip_interval_s"] = Rate(
            _periods(time, swings, 0.0, swings, both_ways=True)[0], period / 2
        )
    return rates


def _vectors(motion: Motion, family: str) -> np.ndarray:
    """A family of three columns as vectors (t, 3)."""
    return np.stack(
        [motion[f"{family}_{k}"] for k in ("xyz" if family.endswith("lab") else "123")], axis=-1
    )


def _angles(path: np.ndarray, pole: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Polar angle (t,) of directions (t, 3) from a pole, and their azimuth about it, continuous.
    None where samples do not show how far it went: near the pole, or with too few of them."""
    first = np.cross(pole, np.eye(3)[np.abs(pole).argmin()])
    first /= np.linalg.norm(first)
    x, y, z = path @ first, path @ np.cross(pole, first), path @ pole
    polar = np.arctan2(np.hypot(x, y), z)
    azimuth = np.unwrap(np.arctan2(y, x))
    stays = np.minimum(polar, np.pi - polar).max() < SMALL_ANGLE
    return polar, None if stays or np.abs(np.diff(azimuth)).max() > LARGEST_CHANGE else azimuth


def _periods(
    time: np.ndarray,
    values: np.ndarray,
    level: float,
    other: np.ndarray,
    *,
    both_ways: bool = False,
) -> tuple[float | None, float | None]:
    """The mean time between passages of samples (t,) through a level, and the mean rate of another
    series (t,) from the first to the last passage. None if there are less than two, or a period has
    too few samples.

    both_ways : passages upwards and downwards, not upwards alone
    """
    time, rows = np.unique(time, return_index=True)
    above = (values := values[rows] - level) > 0
    passes = np.flatnonzero(above[1:] != above[:-1])
    if 2 * len(time) < SAMPLES_PER_PERIOD * len(passes):
        return None, None
    counted = passes if both_ways else passes[above[passes + 1]]
    if len(counted) < 2:
        return None, None
    (begin, before), (end, after) = (
        _interpolated(int(k), time, values, other[rows]) for k in counted[[0, -1]]
    )
    return (end - begin) / (len(counted) - 1), (after - before) / (end - begin)


def _interpolated(
    k: int, time: np.ndarray, values: np.ndarray, other: np.ndarray
) -> tuple[float, float]:
    """Time between samples k and k + 1 at which values are 0, and the value of the other series
    there, by cubic polynomials through the four samples around."""
    near = slice(first := min(max(k - 1, 0), len(time) - 4), first + 4)
    span = time[k + 1] - time[k]
    fractions = (time[near] - time[k]) / span
    size = np.abs(values[near]).max()
    roots = np.roots(np.polyfit(fractions, values[near] / size, 3))
    straight = values[k] / (values[k] - values[k + 1])
    fraction = float(roots[np.abs(roots - straight).argmin()].real)
    begin = other[k]  # angles of many rotations keep their digits
    return float(time[k] + span * fraction), float(
        begin + np.polyval(np.polyfit(fractions, other[near] - begin, 3), fraction)
    )


def _slope(time: np.ndarray, values: np.ndarray) -> float:
    """The mean rate of change."""
    return float((values[-1] - values[0]) / (time[-1] - time[0]))
