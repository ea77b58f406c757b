"""Courses: vectors as given functions of time (a motor's torque, a changing inertia, a frame that spins up)."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel


class TimeFunction(NamedTuple):
    """A vector that is piecewise constant, linear or quadratic in time.

    Piece i, from times[i] to times[i + 1], is constant[i] + d slope[i] + d² curvature[i] with d = t - times[i]. The
    first piece begins at time 0, like every run; the last has no end. Compiled code gets one piece at a time
    (`piece_at`): a run is stepped from break to break, so that no step contains a jump or a kink.
    """

    times: np.ndarray  # (k,) increasing, the first 0
    constant: np.ndarray  # (k, 3)
    slope: np.ndarray  # (k, 3)
    curvature: np.ndarray  # (k, 3)


def constant_function(vector) -> TimeFunction:
    """A constant vector (3,)."""
    return TimeFunction(np.zeros(1), np.array([vector], dtype=float), np.zeros((1, 3)), np.zeros((1, 3)))


def interpolated_function(times, values) -> TimeFunction:
    """Linear interpolation of values (k, 3) at increasing times (k,) >= 0; constant before and after these times."""
    times, values = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if times[0] > 0:
        times, values = np.insert(times, 0, 0.0), np.insert(values, 0, values[0], axis=0)
    slope = np.zeros_like(values)
    slope[:-1] = np.diff(values, axis=0) / np.diff(times)[:, None]
    return TimeFunction(times, values, slope, np.zeros_like(values))


def pulse_function(vector, begin: float, end: float) -> TimeFunction:
    """A vector (3,) from time `begin` to time `end`, which may be infinite; zero outside."""
    on, off = np.asarray(vector, dtype=float), np.zeros(3)
    pieces = [(0.0, off)] * (begin > 0) + [(max(begin, 0.0), on)] + [(end, off)] * (end < inf)
    times, values = (np.array(column) for column in zip(*pieces, strict=True))
    return TimeFunction(times, values, np.zeros_like(values), np.zeros_like(values))


def integrate_function(course: TimeFunction, start) -> TimeFunction:
    """start (3,) plus the integral from time 0 of a course with constant and linear pieces."""
    constant = np.empty_like(course.constant)
    constant[0] = start
    for i, length in enumerate(np.diff(course.times)):
        constant[i + 1] = constant[i] + length * (course.constant[i] + 0.5 * length * course.slope[i])
    return TimeFunction(course.times, constant, course.constant, 0.5 * course.slope)


def is_constant_function(course: TimeFunction) -> bool:
    """Whether a course is constant."""
    return not (course.slope.any() or course.curvature.any() or np.ptp(course.constant, axis=0).any())


def has_constant_direction(course: TimeFunction) -> bool:
    """Whether every piece is linear and the vector stays on one line through zero."""
    parts = np.concatenate([course.constant, course.slope])
    longest = parts[np.linalg.norm(parts, axis=1).argmax()]
    off = np.abs(np.cross(parts, longest)).max()
    return not course.curvature.any() and bool(off <= 1e-12 * (longest @ longest))


def values_at(course: TimeFunction, times: np.ndarray) -> np.ndarray:
    """Values (t, 3) at times (t,)."""
    i, d = _places(course, times)
    return course.constant[i] + d * (course.slope[i] + d * course.curvature[i])


def piece_at(course: TimeFunction, time: float) -> TimeFunction:
    """The piece just after a time, without an end, as a course."""
    i, d = _places(course, np.array([time]))
    constant = course.constant[i] + d * (course.slope[i] + d * course.curvature[i])
    return TimeFunction(np.array([time]), constant, course.slope[i] + 2 * d * course.curvature[i], course.curvature[i])


def sum_functions(courses: list[TimeFunction]) -> TimeFunction:
    """The sum of courses."""
    times = np.unique(np.concatenate([course.times for course in courses]))
    constant = sum(values_at(course, times) for course in courses)
    slope, curvature = np.zeros((2, len(times), 3))
    for course in courses:
        i, d = _places(course, times)
        slope += course.slope[i] + 2 * d * course.curvature[i]
        curvature += course.curvature[i]
    return TimeFunction(times, constant, slope, curvature)


def _places(course: TimeFunction, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    i = np.searchsorted(course.times, times, side="right") - 1
    return i, (times - course.times[i])[:, None]


@kernel(inline=True)
def value(course, time, k):
    """Component k at a time, from the first piece."""
    d = time - course.times[0]
    return course.constant[0, k] + d * (course.slope[0, k] + d * course.curvature[0, k])


@kernel(inline=True)
def rate(course, time, k):
    """Rate of change of component k at a time, from the first piece."""
    return course.slope[0, k] + 2 * (time - course.times[0]) * course.curvature[0, k]
