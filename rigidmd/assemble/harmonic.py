"""How steps of a method follow a harmonic motion: up to which step it is stable, and with which
error."""

from functools import cache
from math import floor, inf, log10, sqrt

import numpy as np

from rigidmd.core.integrators import DRIFT, KICK, RK4, Scheme, Solver

#: Largest error of a step, as a fraction of the forces, without a warning: 6 fs for water with
#: velocity Verlet. What is advised instead has half of it.
INACCURATE = 0.1
#: Below this w dt the error of a step is extrapolated by the order of the scheme.
SMALL_ANGLE = 0.03
#: Leading digits of round steps, which divide usual intervals.
DIGITS = (5.0, 4.0, 2.5, 2.0, 1.0)


def _trace(scheme: Scheme, square: np.ndarray) -> np.ndarray:
    """Trace (k,) of the matrix by which a step multiplies (x, v dt) of a harmonic motion with (w
    dt)² (k,)."""
    x, v = np.tile(np.eye(2)[:, :, None], square.size)  # rows of the matrix
    for flow in scheme.flows:
        if flow.kind == KICK:
            v = v - flow.fraction * square * (1 - flow.gradient * square) * x
        elif flow.kind == DRIFT:
            x = x + flow.fraction * v
    return x[0] + v[1]


@cache
def stable_angle(method: Scheme | Solver) -> float:
    """Largest w dt at which a harmonic motion of angular frequency w stays bounded, for this and
    all smaller steps: while |trace| <= 2 (docs/theory/dynamics.md). Infinite for solvers that
    choose their own steps."""
    if isinstance(method, Solver):
        return 2 * sqrt(2) if method.name == RK4 else inf
    angle = np.linspace(0, 30, 30_001)
    beyond = np.abs(_trace(method, angle**2)) > 2 + 1e-9
    return float(angle[beyond.argmax()]) if beyond.any() else inf


def step_error(scheme: Scheme, angle: float) -> float:
    """The error of a step as an error of the forces: a harmonic motion with w dt = `angle` is
    followed as if its force constant were wrong by this fraction, (angle)²/12 for velocity Verlet.
    Infinite for an unstable step."""
    if angle >= stable_angle(scheme):
        return inf
    small = min(SMALL_ANGLE, stable_angle(scheme) / 4)
    if angle < small:  # rounding of the trace would be most of it
        return step_error(scheme, small) * (angle / small) ** scheme.order
    followed = np.arccos(np.clip(_trace(scheme, np.array([angle**2]))[0] / 2, -1, 1))
    return abs(float(followed / angle) ** 2 - 1)


def round_steps(longest: float) -> list[float]:
    """Round time steps between half of the longest one and this, in the same unit."""
    decade = floor(log10(longest))
    steps = [float(f"{digit}e{k}") for k in (decade, decade - 1) for digit in DIGITS]
    return [step for step in steps if longest / 2 <= step <= longest]
