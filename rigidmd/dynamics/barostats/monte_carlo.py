"""Monte Carlo changes of the volume."""

from math import log, sqrt
from typing import NamedTuple

from rigidmd.compile import Pass, implements
from rigidmd.core.state import NOW
from rigidmd.dynamics.barostats import (
    Confinement,
    Pressure,
    energy_gained,
    log_acceptance,
    propose_strain,
    rescale_velocities,
    rows_of_moves,
    set_matrices,
    target_pressure,
)
from rigidmd.dynamics.noise import Key, uniforms
from rigidmd.dynamics.registers import Timing
from rigidmd.dynamics.step_parts import StepParts
from rigidmd.dynamics.thermostats import Ramp, ramp_value
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import FORCES_ONLY
from rigidmd.scene.stage import Stage

#: Largest change of the volume in a Monte Carlo move, in standard deviations of its fluctuations.
WIDTH = 2.0
#: Largest factor of the volume in a Monte Carlo move, and of its inverse. Boxes of one or two
#: molecules draw larger ones.
LARGEST_FACTOR = 10.0


class VolumeMoves(NamedTuple):
    """Monte Carlo barostat (Åqvist et al. 2004, Chem. Phys. Lett. 384, 288), see the theory chapter
    `sampling`."""

    thermal_energy: Ramp
    pressure: Pressure
    width: float  # largest change of the volume, Å³
    molecules: float  # number of molecules that are not frozen
    tail: tuple[float, float]
    key: Key

    forces = FORCES_ONLY

    def rows(self, parts: StepParts, timing: Timing) -> list[Pass]:
        return rows_of_moves(self, parts, timing)


def barostat(stage: Stage, confinement: Confinement) -> VolumeMoves:
    """The record of Monte Carlo moves of the volume in a stage."""
    thermal_energy = max(confinement.thermal_energy[:2])
    return VolumeMoves(
        confinement.thermal_energy,
        confinement.pressure,
        WIDTH * sqrt(thermal_energy * confinement.compressibility * confinement.volume),
        confinement.molecules,
        confinement.tail,
        confinement.key,
    )


@implements(propose_strain, VolumeMoves)
def propose_volume(barostat, model, state, workspace, h, draw):
    """Set the matrices of a random change of the volume. Returns False if the move is too large."""
    u, _ = uniforms(barostat.key, draw, 0, state.step[NOW])
    factor = 1 + (2 * u - 1) * barostat.width / volume_of(state.cell)
    # Also for the reverse move: a volume that one move reaches has to be as easy to leave by one.
    if not 1 / LARGEST_FACTOR <= factor <= LARGEST_FACTOR:
        return False
    workspace.strain[0] = 0.0
    for k in range(3):
        workspace.strain[0, k] = log(factor) / 3
    set_matrices(workspace)
    return True


@implements(rescale_velocities, VolumeMoves)
def keep_velocities(barostat, state, workspace):
    """Velocities do not change with the volume."""
    return None


@implements(log_acceptance, VolumeMoves)
def log_acceptance_of_volume(barostat, model, state, workspace, h):
    """Logarithm of the ratio of probabilities of two volumes."""
    before, after = volume_of(workspace.cell), volume_of(state.cell)
    work = target_pressure(barostat.pressure, state, 0) * (after - before)
    work = energy_gained(barostat, model, state, workspace) + work
    return barostat.molecules * log(after / before) - work / ramp_value(
        barostat.thermal_energy, state
    )
