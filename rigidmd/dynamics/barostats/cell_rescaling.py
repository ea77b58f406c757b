"""Stochastic cell rescaling: strains along the driving force with noise, each accepted or
rejected."""

from math import log, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, implements, kernel
from rigidmd.core.state import NOW
from rigidmd.dynamics.barostats import (
    COMPONENTS,
    COUPLINGS,
    LONGEST_DRIFT,
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
from rigidmd.dynamics.noise import Key, normals
from rigidmd.dynamics.registers import Timing
from rigidmd.dynamics.step_parts import StepParts
from rigidmd.dynamics.thermostats import Ramp, ramp_value
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import FORCES_ONLY
from rigidmd.scene.stage import Stage


class CellRescaling(NamedTuple):
    """Stochastic cell rescaling (Bernetti & Bussi 2020, J. Chem. Phys. 153, 114107; anisotropic
    cells: Del Tatto, Raiteri, Bernetti & Bussi 2022, Appl. Sci. 12, 1139), with an acceptance test:
    see the theory chapter `sampling`."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    pressure: Pressure
    rate: float  # compressibility over time constant, Å ps²/u/ps
    coordinate: tuple[int, int, int, int, int, int]  # of COUPLINGS
    # 1 for each axis along which the total momentum is kept at zero, else 0
    at_rest: tuple[float, float, float]
    tail: tuple[float, float]  # dispersion beyond the cutoff: energy times V, pressure times V²
    key: Key

    forces = FORCES_ONLY

    def rows(self, parts: StepParts, timing: Timing) -> list[Pass]:
        return rows_of_moves(self, parts, timing)


def barostat(stage: Stage, confinement: Confinement) -> CellRescaling:
    """The record of stochastic cell rescaling in a stage."""
    return CellRescaling(
        confinement.thermal_energy,
        confinement.pressure,
        confinement.compressibility / stage.barostat_time,
        COUPLINGS[stage.pressure_coupling],
        confinement.at_rest,
        confinement.tail,
        confinement.key,
    )


@implements(propose_strain, CellRescaling)
def propose_rescaling(barostat, model, state, workspace, h, draw):
    """Set the matrices of a random strain (6,) of the box in a time of h ps. Always a proposal."""
    drift(barostat, model, state, workspace, h, workspace.strain[1], workspace.strain[2])
    for c in range(6):
        xi, _ = normals(barostat.key, draw + c, 0, state.step[NOW])
        for k in range(6):
            if barostat.coordinate[k] == c:
                workspace.strain[0, k] = workspace.strain[1, k] + sqrt(workspace.strain[2, k]) * xi
    set_matrices(workspace)
    return True


@kernel
def drift(barostat, model, state, workspace, h, mean, variance):
    """Write mean and variance of the strain of a move, by component (6,), 0 for a component that
    does not move."""
    volume = volume_of(state.cell)
    thermal = ramp_value(barostat.thermal_energy, state)
    for k in range(6):
        mean[k] = variance[k] = 0.0
    for c in range(6):
        push, shared = 0.0, 0
        for k in range(6):
            if barostat.coordinate[k] == c:
                push += strain_force(barostat, model, state, workspace, k, volume, thermal)
                shared += 1
        for k in range(6):
            if barostat.coordinate[k] == c:
                variance[k] = 2 * thermal * barostat.rate * h / (3 * volume * shared)
                mean[k] = max(
                    -LONGEST_DRIFT, min(LONGEST_DRIFT, variance[k] / (2 * thermal) * push)
                )


@kernel
def strain_force(barostat, model, state, workspace, k, volume, thermal):
    """The generalised force on component k of the strain: minus the derivative of H + P0 V, u
    Å²/ps²."""
    i, j = COMPONENTS[k]
    total = workspace.tally[0, 1 + 3 * j + i] - volume * target_pressure(
        barostat.pressure, state, k
    )
    for m in range(len(state.velocity)):
        total += model.mass[model.species[m]] * state.velocity[m, i] * state.velocity[m, j]
    if k < 3:
        total += barostat.tail[1] / volume + barostat.at_rest[k] * thermal
    return total


@implements(rescale_velocities, CellRescaling)
def divide_velocities(barostat, state, workspace):
    """Transform velocities (n, 3) by the inverse of the strain."""
    inverse = workspace.matrices[1]
    for m in range(len(state.velocity)):
        x, y, z = state.velocity[m, 0], state.velocity[m, 1], state.velocity[m, 2]
        state.velocity[m, 0] = inverse[0, 0] * x
        state.velocity[m, 1] = inverse[1, 0] * x + inverse[1, 1] * y
        state.velocity[m, 2] = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z


@implements(log_acceptance, CellRescaling)
def log_acceptance_of_rescaling(barostat, model, state, workspace, h):
    """Logarithm of the ratio of probabilities of a move of the box and its reverse."""
    before, after = volume_of(workspace.cell), volume_of(state.cell)
    matrix, inverse = workspace.matrices[0], workspace.matrices[1]
    there = workspace.strain
    back = np.zeros((2, 6))
    drift(barostat, model, state, workspace, h, back[0], back[1])
    target = barostat.pressure
    x, y, z = (
        target_pressure(target, state, 0),
        target_pressure(target, state, 1),
        target_pressure(target, state, 2),
    )
    mean = (x + y + z) / 3
    work = energy_gained(barostat, model, state, workspace) + mean * (after - before)
    chance = log(after / before)
    used = -1
    for k in range(6):
        if barostat.coordinate[k] < 0:
            continue
        i, j = COMPONENTS[k]
        turn = there[0, k]
        turn_back = -turn if k < 3 else inverse[i, j]
        deviation = target_pressure(barostat.pressure, state, k) - (mean if k < 3 else 0.0)
        work += deviation * 0.5 * (before + after) * 0.5 * (turn - turn_back)
        if k < 3:
            chance += barostat.at_rest[k] * turn
        if (
            barostat.coordinate[k] > used
        ):  # coordinates are numbered in the order of their first component
            used = barostat.coordinate[k]
            chance += 0.5 * (turn - there[1, k]) ** 2 / there[2, k] + 0.5 * log(there[2, k])
            chance -= 0.5 * (turn_back - back[0, k]) ** 2 / back[1, k] + 0.5 * log(back[1, k])
    if barostat.coordinate[3] >= 0:
        # densities of T and of its inverse in the left invariant measure of lower triangular
        # matrices
        chance -= 2 * (log(matrix[1, 1]) + 2 * log(matrix[2, 2]))
    return chance - work / ramp_value(barostat.thermal_energy, state)
