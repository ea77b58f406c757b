"""A piston: a volume with inertia and without friction."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, implements, kernel, load_arguments, task
from rigidmd.core.integrators import SCALE_BOX
from rigidmd.core.state import OK, WORK, State
from rigidmd.dynamics.barostats import (
    Confinement,
    Pressure,
    apply_barostat,
    compute_load_and_virial,
    target_pressure,
)
from rigidmd.dynamics.registers import LOADED, Registers
from rigidmd.dynamics.thermostats import scale_array, translational_energy
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import WITH_VIRIALS
from rigidmd.scene.stage import Stage


class Piston(NamedTuple):
    """Isotropic volume with inertia and no noise (Andersen 1980, J. Chem. Phys. 72, 2384): constant
    enthalpy.

    Pi is the last number of `state.extra_variables`. BAROSTAT is a kick of Pi, SCALE_BOX a change
    of V, each exact. What P0 V and the piston gain is subtracted from `energy_ledger[WORK]`. See
    the theory chapter `sampling`.
    """

    pressure: Pressure
    inverse_mass: float  # 1/M, Å⁴/u
    # a: velocities follow V^(-a/3). 1, or 3 N over the translational degrees of freedom, so that
    # the kinetic part of the pressure contains a total momentum that is kept at zero
    exponent: float
    tail: tuple[float, float]

    variables = 1  # how many numbers it has in `state.extra_variables`
    tallies = WITH_VIRIALS

    def passes(self, state: State, registers: Registers) -> dict[int, Pass]:
        return {SCALE_BOX: Pass("volume", _move_piston, (self, state, registers))}


def barostat(stage: Stage, confinement: Confinement) -> Piston:
    moving = 3 * confinement.molecules - sum(confinement.at_rest)
    return Piston(
        confinement.pressure,
        confinement.compressibility * confinement.volume * (2 * np.pi / stage.barostat_time) ** 2,
        3 * confinement.molecules / (moving or inf),
        confinement.tail,
    )


@implements(apply_barostat, Piston)
def _kick_piston(barostat, model, terms, state, load, workspace, progress, h, draw):
    if progress[LOADED] == 0 or workspace.known[0] == 0:
        status = compute_load_and_virial(terms, state, load, workspace, WITH_VIRIALS)
        if status != OK:
            return status
        progress[LOADED] = 1
    volume = volume_of(state.cell)
    virial = workspace.tally[0, 1] + workspace.tally[0, 5] + workspace.tally[0, 9]
    momenta = 2 * barostat.exponent * translational_energy(model, state)
    pressure = (momenta + virial) / (3 * volume) + barostat.tail[1] / volume**2
    before = state.extra_variables[-1]
    state.extra_variables[-1] += h * (pressure - target_pressure(barostat.pressure, state, 0))
    state.energy_ledger[WORK] -= (
        0.5 * barostat.inverse_mass * (state.extra_variables[-1] ** 2 - before**2)
    )
    return OK


@kernel
def move_piston(barostat, state, h):
    """The flow of the volume by the inertia of a piston, in place."""
    volume = volume_of(state.cell)
    after = volume + h * barostat.inverse_mass * state.extra_variables[-1]
    scale = (after / volume) ** (1 / 3)
    scale_array(state.position, scale)
    scale_array(state.velocity, scale**-barostat.exponent)
    scale_array(state.cell, scale)
    state.energy_ledger[WORK] -= target_pressure(barostat.pressure, state, 0) * (after - volume)


@task()
def _move_piston(arguments, block):
    barostat, state, registers = load_arguments(arguments)
    move_piston(barostat, state, registers.h[0])
    registers.progress[LOADED] = 0
