"""Vectors as given functions of time, such as the torque of a motor, a changing inertia or a frame
that spins up."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel


class TimeFunction(NamedTuple):
    """A vector that is piecewise constant, linear or quadratic in time.

    Piece i, from times[i] to times[i + 1], is constant[i] + d slope[i] + d² curvature[i] with d = t
    - times[i]. The first piece starts at time 0, like every run. The last has no end. Compiled code
    gets one piece at a time (`piece_at`), and a run stops at every break, so that no step contains
    a jump or a kink.
    """

    times: np.ndarray  # (k,) increasing, the first 0
    constant: np.ndarray  # (k, 3)
    slope: np.ndarray  # (k, 3)
    curvature: np.ndarray  # (k, 3)


def constant_function(vector) -> TimeFunction:
    """A constant vector (3,)."""
    return TimeFunction(
        np.zeros(1), np.array([vector], dtype=float), np.zeros((1, 3)), np.zeros((1, 3))
    )


def interpolated_function(times, values) -> TimeFunction:
    """Linear interpolation of values (k, 3) at increasing times (k,) >= 0. Constant before and
    after these times."""
    times, values = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
    if times[0] > 0:
        times = np.insert(times, 0, 0.0)
        values = np.insert(values, 0, values[0], axis=0)
    slope = np.zeros_like(values)
    slope[:-1] = np.diff(values, axis=0) / np.diff(times)[:, None]
    return TimeFunction(times, values, slope, np.zeros_like(values))


def pulse_function(vector, begin: float, end: float) -> TimeFunction:
    """A vector (3,) from time `begin` to time `end`, which may be infinite. Zero outside."""
    on = np.asarray(vector, dtype=float)
    off = np.zeros(3)
    pieces = [(0.0, off)] * (begin > 0) + [(max(begin, 0.0), on)] + [(end, off)] * (end < inf)
    times, values = (np.array(column) for column in zip(*pieces, strict=True))
    return TimeFunction(times, values, np.zeros_like(values), np.zeros_like(values))


def integrate_function(function: TimeFunction, start) -> TimeFunction:
    """start (3,) plus the integral from time 0 of a function without curvature."""
    constant = np.empty_like(function.constant)
    constant[0] = start
    for i, length in enumerate(np.diff(function.times)):
        constant[i + 1] = constant[i] + length * (
            function.constant[i] + 0.5 * length * function.slope[i]
        )
    return TimeFunction(function.times, constant, function.constant, 0.5 * function.slope)


def is_constant_function(function: TimeFunction) -> bool:
    return not (
        function.slope.any() or function.curvature.any() or np.ptp(function.constant, axis=0).any()
    )


def has_constant_direction(function: TimeFunction) -> bool:
    """Whether every piece is linear and the vector remains on one line through zero."""
    parts = np.concatenate([function.constant, function.slope])
    longest = parts[np.linalg.norm(parts, axis=1).argmax()]
    off = np.abs(np.cross(parts, longest)).max()
    return not function.curvature.any() and bool(off <= 1e-12 * (longest @ longest))


def values_at(function: TimeFunction, times: np.ndarray) -> np.ndarray:
    """Values (t, 3) at times (t,)."""
    i, d = _locate(function, times)
    return function.constant[i] + d * (function.slope[i] + d * function.curvature[i])


def piece_at(function: TimeFunction, time: float) -> TimeFunction:
    """The piece that starts or continues at a time, as a function without an end."""
    times = np.array([time])
    i, d = _locate(function, times)
    slope = function.slope[i] + 2 * d * function.curvature[i]
    return TimeFunction(times, values_at(function, times), slope, function.curvature[i])


def sum_functions(functions: list[TimeFunction]) -> TimeFunction:
    """The sum of several functions."""
    times = np.unique(np.concatenate([function.times for function in functions]))
    constant = sum(values_at(function, times) for function in functions)
    slope, curvature = np.zeros((2, len(times), 3))
    for function in functions:
        i, d = _locate(function, times)
        slope += function.slope[i] + 2 * d * function.curvature[i]
        curvature += function.curvature[i]
    return TimeFunction(times, constant, slope, curvature)


def _locate(function: TimeFunction, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    i = np.searchsorted(function.times, times, side="right") - 1
    return i, (times - function.times[i])[:, None]


@kernel(inline=True)
def value(function, time, k):
    """Component k at a time, from the first piece."""
    d = time - function.times[0]
    return function.constant[0, k] + d * (function.slope[0, k] + d * function.curvature[0, k])


@kernel(inline=True)
def vector_at(function, time):
    """A function of time with three components, as a tuple."""
    return value(function, time, 0), value(function, time, 1), value(function, time, 2)


@kernel(inline=True)
def rate(function, time, k):
    """Rate of change of component k at a time, from the first piece."""
    return function.slope[0, k] + 2 * (time - function.times[0]) * function.curvature[0, k]
