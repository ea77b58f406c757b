"""Barostats: flows that change the cell at a pressure, as rows of the step. A constant volume
has none.

See the theory chapter `sampling`. A lower triangular matrix T multiplies the cell (rows a, b, c)
and the centres of mass from the right. The virial is W_ij = sum F_i R_j in `tally[1:]`.
Its rows act where a scheme has the flow BAROSTAT; `rows_of_moves` are those of trial moves. The
energy added to the molecules is in `state.energy_ledger[WORK]`.
"""

from math import exp, log
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, kernel, load_arguments, task
from rigidmd.core.state import NOW, ORIGIN, TALLY_SIZE, WORK, Load, State, no_load
from rigidmd.dynamics.noise import Key, uniforms
from rigidmd.dynamics.registers import KEPT_BY_BAROSTAT, Timing
from rigidmd.dynamics.step_parts import StepParts
from rigidmd.dynamics.step_rows import forces_row
from rigidmd.dynamics.thermostats import Ramp
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES, copy

#: Components of strains and pressures, in this order: (row, column) of the lower triangle.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))
#: The strain coordinate of each component (-1: none).
COUPLINGS = {
    "isotropic": (0, 0, 0, -1, -1, -1),
    "semi_isotropic": (0, 0, 1, -1, -1, -1),
    "anisotropic": (0, 1, 2, -1, -1, -1),
    "flexible": (0, 1, 2, 3, 4, 5),
    "normal": (-1, -1, 0, -1, -1, -1),
    "lateral": (0, 0, -1, -1, -1, -1),
}
#: Largest drift of a move, as a strain; noise is added to it. It limits the effect of a bad start
#: in one move.
LONGEST_DRIFT = 0.01


class Pressure(NamedTuple):
    """The target pressure, by component. It changes linearly over a run segment. u/(Å ps²)."""

    first: tuple[float, float, float, float, float, float]
    last: tuple[float, float, float, float, float, float]
    steps: float


class Confinement(NamedTuple):
    """What a barostat is made from, in addition to the keys of its stage."""

    thermal_energy: Ramp
    pressure: Pressure
    compressibility: float  # Å ps²/u
    volume: float  # at the start, Å³
    molecules: float  # number of molecules that are not frozen
    # 1 for each axis along which the total momentum is kept at zero, else 0
    at_rest: tuple[float, float, float]
    tail: tuple[float, float]  # dispersion beyond the cutoff: energy times V, pressure times V²
    key: Key


class BarostatWorkspace(NamedTuple):
    """Arrays to make a move and to undo it if it is rejected."""

    # (2, 10) energies and virials: now, before the move; virials only for a piston
    tally: np.ndarray
    strain: np.ndarray  # (3, 6) strain of the move, its drift, its variance
    matrices: np.ndarray  # (2, 3, 3) T and its inverse
    position: np.ndarray  # as in State
    velocity: np.ndarray
    cell: np.ndarray
    load: Load
    is_moved: np.ndarray  # (1,) int64, whether a trial move has been made
    counts: np.ndarray  # (2,) moves tried, accepted


def barostat_workspace(state: State) -> BarostatWorkspace:
    """Arrays for the moves of the box of a state."""
    return BarostatWorkspace(
        np.zeros((2, TALLY_SIZE)),
        np.zeros((3, 6)),
        np.zeros((2, 3, 3)),
        state.position.copy(),
        state.velocity.copy(),
        state.cell.copy(),
        no_load(state),
        np.zeros(1, np.int64),
        np.zeros(2, np.int64),
    )


@kernel(inline=True)
def keep_tally(core, workspace):
    """Sum energies and virials of the current positions into tally[0], unless they are there."""
    known = core.registers.known
    if known[0] & KEPT_BY_BAROSTAT == 0:
        for k in range(TALLY_SIZE):
            workspace.tally[0, k] = 0.0
            for tally in core.terms.tallies:
                workspace.tally[0, k] += tally[k]
        known[0] |= KEPT_BY_BAROSTAT


def rows_of_moves(barostat: NamedTuple, parts: StepParts, timing: Timing) -> list[Pass]:
    """Trial moves, by `propose_strain` and `rescale_velocities`, and their Metropolis test with
    `log_acceptance`."""
    content, when = (barostat, parts.core, parts.barostat, timing), timing.when
    name = f"barostat {type(barostat).__name__} {timing.fraction:.4g} dt"
    return [
        Pass(f"{name}: trial move of the box", _try_move, content, when=when),
        forces_row(parts, WITH_ENERGIES, when),
        Pass("accept it, or move the box back", _test_move, content, when=when),
    ]


@task()
def _try_move(arguments, block):
    """Keep the state, and make a trial move of the box if it is possible."""
    barostat, core, workspace, timing = load_arguments(arguments)
    model, state, load, registers = core.model, core.state, core.load, core.registers
    keep_tally(core, workspace)
    h = timing.fraction * registers.dt[0]
    workspace.is_moved[0] = propose_strain(barostat, model, state, workspace, h, timing.draw)
    if workspace.is_moved[0] != 0:
        copy_moved(state, load, workspace, workspace.load, workspace.tally[0], workspace.tally[1])
        apply_strain(barostat, state, workspace)
        registers.known[0] = 0


@task()
def _test_move(arguments, block):
    """Accept a trial move, or return to the state before it."""
    barostat, core, workspace, timing = load_arguments(arguments)
    model, state, load, registers = core.model, core.state, core.load, core.registers
    workspace.counts[0] += 1
    if workspace.is_moved[0] == 0:
        return
    keep_tally(core, workspace)
    chance = log_acceptance(barostat, model, state, workspace, timing.fraction * registers.dt[0])
    u, _ = uniforms(barostat.key, timing.draw + 8, 0, state.step[NOW])
    if log(u) < chance:
        workspace.counts[1] += 1
        state.energy_ledger[WORK] += energy_gained(barostat, model, state, workspace)
    else:
        copy_moved(workspace, workspace.load, state, load, workspace.tally[1], workspace.tally[0])
        core.terms.tallies_valid[0] = 0
        registers.known[0] = FORCES_ONLY | KEPT_BY_BAROSTAT


@kernel(inline=True)
def target_pressure(pressure, state, k):
    """Component k of the target pressure in the current step."""
    fraction = (state.step[NOW] - state.step[ORIGIN] + 1) / pressure.steps
    return pressure.first[k] + (pressure.last[k] - pressure.first[k]) * fraction


def propose_strain(barostat, model, state, workspace, h, draw):
    """Draw the strain of a move into workspace.strain, with its drift and variance, and set T and
    its inverse. Returns whether the move is possible. One that is not counts as rejected."""
    raise TypeError("compiled code only")


def rescale_velocities(barostat, state, workspace):
    """Change the velocities with the strain, unless the barostat keeps them."""
    raise TypeError("compiled code only")


def log_acceptance(barostat, model, state, workspace, h):
    """The logarithm of the acceptance probability of a move that has been made."""
    raise TypeError("compiled code only")


@kernel
def copy_moved(source, load, target, load_there, tally, tally_there):
    """Copy what a move changes, from `source` to `target`: a state and a workspace, each with a
    load and a tally."""
    copy(source.position, target.position)
    copy(source.velocity, target.velocity)
    copy(source.cell, target.cell)
    copy(load.force, load_there.force)
    copy(load.torque_body, load_there.torque_body)
    copy(tally, tally_there)


@kernel
def set_matrices(workspace):
    """Set T and its inverse: T is the strain, with exp of its diagonal."""
    matrix, inverse, strain = workspace.matrices[0], workspace.matrices[1], workspace.strain[0]
    matrix[:] = 0.0
    inverse[:] = 0.0
    for k in range(3):
        matrix[k, k] = exp(strain[k])
        inverse[k, k] = exp(-strain[k])
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = strain[3], strain[4], strain[5]
    inverse[1, 0] = -matrix[1, 0] * inverse[0, 0] * inverse[1, 1]
    inverse[2, 1] = -matrix[2, 1] * inverse[1, 1] * inverse[2, 2]
    inverse[2, 0] = (
        (matrix[1, 0] * matrix[2, 1] * inverse[1, 1] - matrix[2, 0]) * inverse[0, 0] * inverse[2, 2]
    )


@kernel
def apply_strain(barostat, state, workspace):
    """Multiply centres and cell by T. Momenta, if the barostat changes them, by its inverse."""
    matrix = workspace.matrices[0]
    multiply_rows(state.position, matrix)
    multiply_rows(state.cell, matrix)
    rescale_velocities(barostat, state, workspace)


@kernel(inline=True)
def multiply_rows(rows, matrix):
    """Multiply vectors (n, 3), rows, from the right by a lower triangular matrix, in place."""
    for m in range(len(rows)):
        x, y, z = rows[m, 0], rows[m, 1], rows[m, 2]
        rows[m, 0] = x * matrix[0, 0] + y * matrix[1, 0] + z * matrix[2, 0]
        rows[m, 1] = y * matrix[1, 1] + z * matrix[2, 1]
        rows[m, 2] = z * matrix[2, 2]


@kernel
def energy_gained(barostat, model, state, workspace):
    """Change of potential and kinetic energy by the move (u Å²/ps²), with dispersion beyond the
    cutoff."""
    gained = workspace.tally[0, 0] - workspace.tally[1, 0]
    gained += barostat.tail[0] * (1 / volume_of(state.cell) - 1 / volume_of(workspace.cell))
    for m in range(len(state.velocity)):
        for k in range(3):
            squares = state.velocity[m, k] ** 2 - workspace.velocity[m, k] ** 2
            gained += 0.5 * model.mass[model.species[m]] * squares
    return gained
