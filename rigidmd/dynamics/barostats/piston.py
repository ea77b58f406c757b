"""A piston: a volume with inertia and without friction."""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, kernel, load_arguments, task
from rigidmd.core.state import WORK
from rigidmd.dynamics.barostats import Confinement, Pressure, keep_tally, target_pressure
from rigidmd.dynamics.registers import Timing
from rigidmd.dynamics.step_parts import StepParts
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
    forces = WITH_VIRIALS

    def rows(self, parts: StepParts, timing: Timing) -> list[Pass]:
        content = self, parts.core, parts.barostat, timing
        text = f"barostat Piston {timing.fraction:.4g} dt: kick of the volume"
        return [Pass(text, _kick_piston, content, when=timing.when)]

    def volume_row(self, parts: StepParts, timing: Timing) -> Pass:
        """The change of the volume by its inertia."""
        content = self, parts.core, timing
        text = f"drift of the volume {timing.fraction:.4g} dt"
        return Pass(text, _move_piston, content, when=timing.when)


def barostat(stage: Stage, confinement: Confinement) -> Piston:
    """The record of the piston in a stage."""
    moving = 3 * confinement.molecules - sum(confinement.at_rest)
    return Piston(
        confinement.pressure,
        confinement.compressibility * confinement.volume * (2 * np.pi / stage.barostat_time) ** 2,
        3 * confinement.molecules / (moving or inf),
        confinement.tail,
    )


@task()
def _kick_piston(arguments, block):
    barostat, core, workspace, timing = load_arguments(arguments)
    state = core.state
    keep_tally(core, workspace)
    h = timing.fraction * core.registers.dt[0]
    volume = volume_of(state.cell)
    virial = workspace.tally[0, 1] + workspace.tally[0, 5] + workspace.tally[0, 9]
    momenta = 2 * barostat.exponent * translational_energy(core.model, state)
    pressure = (momenta + virial) / (3 * volume) + barostat.tail[1] / volume**2
    before = state.extra_variables[-1]
    state.extra_variables[-1] += h * (pressure - target_pressure(barostat.pressure, state, 0))
    state.energy_ledger[WORK] -= (
        0.5 * barostat.inverse_mass * (state.extra_variables[-1] ** 2 - before**2)
    )


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
    barostat, core, timing = load_arguments(arguments)
    move_piston(barostat, core.state, timing.fraction * core.registers.dt[0])
    core.registers.known[0] = 0
