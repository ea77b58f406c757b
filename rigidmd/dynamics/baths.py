"""Baths: flows on the momenta that keep a temperature, chosen by type; NVE compiles none.

`apply(bath, model, state, h, draw)` acts where the row of a step says. What a bath puts in is in `state.books[HEAT]`;
its random numbers are counted by the step, from `draw` on, see `noise`.
"""

from math import exp, inf, sqrt
from typing import NamedTuple

from rigidmd.compile import implements, is_a, kernel
from rigidmd.core.state import HEAT, NOW
from rigidmd.dynamics.noise import Key, chi_square, normals


class NoBath(NamedTuple):
    """NVE."""

    rate: float = 0.0


class VelocityRescaling(NamedTuple):
    """Stochastic velocity rescaling (Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101).

    All momenta, translational and rotational together, are scaled by one factor such that the kinetic energy follows
    its own exactly solved stochastic equation; the canonical distribution is sampled, total momentum keeps its
    direction, and the time scale of single molecules is hardly touched.
    """

    thermal_energy: float  # kB T, u Å²/ps²
    time_constant: float  # ps; if infinite it does nothing
    degrees_of_freedom: int
    key: Key


def apply(bath, model, state, h, draw):
    """The flow of a bath over a time h (ps), in place; `draw` is its first draw in this step."""
    raise TypeError("compiled code only")


@implements(apply)
def _apply_none(bath, model, state, h, draw):
    if is_a(bath, NoBath):
        return lambda bath, model, state, h, draw: None


@implements(apply)
def _apply_rescaling(bath, model, state, h, draw):
    if not is_a(bath, VelocityRescaling):
        return None

    def rescale(bath, model, state, h, draw):
        if bath.time_constant == inf:
            return
        kinetic = kinetic_energy(model, state)
        freedom = bath.degrees_of_freedom
        if kinetic == 0.0 or freedom == 0:
            return
        # eq. A7, with one Gaussian apart and the sum of the squares of the others at once
        c = exp(-h / bath.time_constant)
        share = 0.5 * bath.thermal_energy * (1 - c) / kinetic
        gauss, _ = normals(bath.key, draw, 0, state.step[NOW])
        others = chi_square(bath.key, draw + 1, 0, state.step[NOW], freedom - 1)
        scale2 = c + share * (gauss * gauss + others) + 2 * gauss * sqrt(c * share)
        state.books[HEAT] += (scale2 - 1) * kinetic
        scale = sqrt(scale2)
        for m in range(len(state.velocity)):
            for k in range(3):
                state.velocity[m, k] *= scale
        for m in range(len(state.angular_momentum_body)):
            for k in range(3):
                state.angular_momentum_body[m, k] *= scale

    return rescale


@kernel
def kinetic_energy(model, state):
    """Translational and rotational kinetic energy of all molecules (u Å²/ps²)."""
    total = 0.0
    for m in range(len(state.velocity)):
        v2 = 0.0
        for k in range(3):
            v2 += state.velocity[m, k] ** 2
        total += 0.5 * model.mass[model.species[m]] * v2
    for m in range(len(state.angular_momentum_body)):
        for k in range(3):
            total += 0.5 * state.angular_momentum_body[m, k] ** 2 * model.inverse_inertia[model.species[m], k]
    return total
