"""Thermostats: flows on the momenta, chosen by type; NVE compiles none.

`apply(thermostat, model, state, h)` acts once a time step. Everything random comes from the thermostat's own generator.
"""

from math import exp, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.jit import implements, is_a, kernel


class NoThermostat(NamedTuple):
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
    generator: np.random.Generator
    heat: np.ndarray  # (1,) energy put in so far, u Å²/ps²; total energy - heat is conserved


def apply(thermostat, model, state, h):
    """The thermostat's flow over a time h (ps), in place."""
    raise TypeError("compiled code only")


@implements(apply)
def _apply_none(thermostat, model, state, h):
    if is_a(thermostat, NoThermostat):
        return lambda thermostat, model, state, h: None


@implements(apply)
def _apply_rescaling(thermostat, model, state, h):
    if not is_a(thermostat, VelocityRescaling):
        return None

    def rescale(thermostat, model, state, h):
        if thermostat.time_constant == inf:
            return
        kinetic = kinetic_energy(model, state)
        freedom = thermostat.degrees_of_freedom
        if kinetic == 0.0 or freedom == 0:
            return
        # eq. A7, with one Gaussian apart and the sum of the squares of the others from a Gamma distribution
        c = exp(-h / thermostat.time_constant)
        share = 0.5 * thermostat.thermal_energy * (1 - c) / kinetic
        gauss = thermostat.generator.standard_normal()
        others = 2 * thermostat.generator.standard_gamma(0.5 * (freedom - 1)) if freedom > 1 else 0.0
        scale2 = c + share * (gauss * gauss + others) + 2 * gauss * sqrt(c * share)
        thermostat.heat[0] += (scale2 - 1) * kinetic
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
