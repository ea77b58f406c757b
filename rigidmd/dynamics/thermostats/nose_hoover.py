"""Nose-Hoover chains: one for translation and one for rotation."""

from math import exp
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, kernel
from rigidmd.core.state import HEAT, State
from rigidmd.dynamics.model import DegreesOfFreedom, Model
from rigidmd.dynamics.noise import Key
from rigidmd.dynamics.thermostats import (
    Ramp,
    Tasks,
    apply_thermostat,
    kinetic_energies_of,
    ramp_value,
    scale_momenta,
    tasks_of_scaling,
)
from rigidmd.scene.stage import Stage


class NoseHoover(NamedTuple):
    """Two Nose-Hoover chains, one for translation and one for rotation, on two halves of
    `state.extra_variables`. Each half is eta (links,), then d eta/dt (links,). See the theory
    chapter `sampling` (Martyna, Tuckerman, Tobias & Klein 1996)."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    period: float  # ps
    links: int  # of each chain
    freedom_translation: int
    freedom_rotation: int

    @property
    def variables(self) -> int:
        """How many numbers it has in `state.extra_variables`."""
        return 4 * self.links

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        return tasks_of_scaling(model, state, workspace)


def thermostat(
    stage: Stage, thermal_energy: Ramp, freedom: DegreesOfFreedom, key: Key
) -> NoseHoover:
    """The record of the Nosé-Hoover chains of a stage."""
    return NoseHoover(
        thermal_energy,
        stage.thermostat_time,
        int(stage.thermostat_values["nose_hoover_links"]),
        freedom.translation,
        freedom.rotation,
    )


#: Suzuki-Yoshida factors: fractions of a flow of the chains.
YOSHIDA = (1 / (2 - 2 ** (1 / 3)), 1 - 2 / (2 - 2 ** (1 / 3)), 1 / (2 - 2 ** (1 / 3)))


@implements(apply_thermostat, NoseHoover)
def _apply_nose_hoover(thermostat, model, code, state, workspace, h, draw):
    thermal = ramp_value(thermostat.thermal_energy, state)
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    variables = state.extra_variables
    links = 2 * thermostat.links
    scale, heat = move_chain(
        thermostat, variables[:links], thermal, moving, thermostat.freedom_translation, h
    )
    scale_turning, heat_turning = move_chain(
        thermostat, variables[links:], thermal, turning, thermostat.freedom_rotation, h
    )
    scale_momenta(code, state, scale, scale_turning)
    state.energy_ledger[HEAT] += heat + heat_turning


@kernel
def move_chain(thermostat, chain, thermal, kinetic, freedom, h):
    """Propagate a chain over h, in place. Returns the factor of the momenta and the energy lost (u
    Å²/ps²)."""
    if freedom == 0:
        return 1.0, 0.0
    links = thermostat.links
    eta = chain[:links]
    rate = chain[links:]
    before = chain_energy(thermostat, chain, thermal, freedom)
    scale = 1.0
    for factor in YOSHIDA:
        d = factor * h
        _kick_links(
            thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, links - 1, -1, -1
        )
        scale *= exp(-d * rate[0])
        for j in range(links):
            eta[j] += d * rate[j]
        _kick_links(thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, 0, links, 1)
    return scale, before - chain_energy(thermostat, chain, thermal, freedom)


@kernel
def _kick_links(thermostat, rate, thermal, twice_kinetic, freedom, d, first, end, by):
    """Half a step of the rates of the links, from link `first` to the one before `end`."""
    links = thermostat.links
    unit = thermal * (thermostat.period / (2 * np.pi)) ** 2
    for j in range(first, end, by):
        if j == 0:
            pull = (twice_kinetic - freedom * thermal) / (freedom * unit)
        else:
            mass = freedom * unit if j == 1 else unit
            pull = (mass * rate[j - 1] * rate[j - 1] - thermal) / unit
        drag = exp(-0.25 * d * rate[j + 1]) if j + 1 < links else 1.0
        rate[j] = (rate[j] * drag + 0.5 * d * pull) * drag


@kernel
def chain_energy(thermostat, chain, thermal, freedom):
    """Energy of a chain (u Å²/ps²)."""
    unit = thermal * (thermostat.period / (2 * np.pi)) ** 2
    total = 0.0
    for j in range(thermostat.links):
        of_one = freedom if j == 0 else 1
        rate = chain[thermostat.links + j]
        total += of_one * (0.5 * unit * rate * rate + thermal * chain[j])
    return total
