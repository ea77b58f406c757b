"""Barostats: flows that change the cell at a pressure, each a pass of the step. A constant volume
has none.

See the theory chapter `sampling`. A lower triangular matrix T multiplies the cell (rows a, b, c)
and the centres of mass from the right. The virial is W_ij = sum F_i R_j in `tally[1:]`.
`apply_barostat` acts where a scheme has the flow BAROSTAT; `try_move` is the one by trial moves.
The energy added to the molecules is in `state.energy_ledger[WORK]`.
"""

from math import exp, log
from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.compile import Pass, chosen_by_type, kernel, load_arguments, task
from rigidmd.core.integrators import BAROSTAT
from rigidmd.core.state import NOW, OK, ORIGIN, TALLY_SIZE, WORK, Load, State, no_load
from rigidmd.dynamics.noise import Key, uniforms
from rigidmd.dynamics.registers import LOADED, TRIAL, Registers
from rigidmd.dynamics.thermostats import Ramp
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import WITH_ENERGIES, TermTable, compute_load, copy

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
    known: np.ndarray  # (1,) whether tally[0] belongs to `load`
    counts: np.ndarray  # (2,) moves tried, accepted


def barostat_workspace(state: State) -> BarostatWorkspace:
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


class Barostat(Protocol):
    """The record of a barostat, a NamedTuple."""

    @property
    def tallies(self) -> int:
        """What `compute_load` has to compute in a step in which it acts, WITH_VIRIALS or
        WITH_ENERGIES."""
        ...

    def passes(self, state: State, registers: Registers) -> dict[int, Pass]:
        """Kind of a flow -> its pass, for flows in addition to BAROSTAT."""
        ...


def needed_tallies(barostat: Barostat | None) -> int:
    """What `compute_load` has to compute in a step in which a barostat acts; 0: no more than in
    other steps."""
    return 0 if barostat is None else barostat.tallies


@kernel(inline=True)
def compute_step_load(terms, state, load, registers, flows, which):
    """Forces and torques at the current positions. A status code.

    which : FORCES_ONLY or WITH_ENERGIES (and virials). A step in which the barostat acts always
        computes virials, and energies if the move depends on them
    """
    registers.known[0] = 0
    if flows.tallies != 0:
        for k in range(len(flows.kind)):
            if (
                flows.kind[k] == BAROSTAT
                and (state.step[NOW] - state.step[ORIGIN] + 1) % flows.every[k] == 0
            ):
                needed = which if which == WITH_ENERGIES else flows.tallies
                return compute_load_and_virial(terms, state, load, registers, needed)
    return compute_load(terms, state, load, which)


@kernel(inline=True)
def compute_load_and_virial(terms, state, load, workspace, which):
    """Forces, torques and virial at the current positions, with WITH_ENERGIES also energies; a
    status code. which : WITH_ENERGIES or WITH_VIRIALS"""
    status = compute_load(terms, state, load, which)
    for k in range(TALLY_SIZE):
        workspace.tally[0, k] = 0.0
        for tally in terms.tallies:
            workspace.tally[0, k] += tally[k]
    workspace.known[0] = 1 if status == OK else 0
    return status


@chosen_by_type
def apply_barostat(barostat, model, terms, state, load, workspace, progress, h, draw):
    """The flow of a barostat over a time h, in place. A status code. progress : see `registers`."""
    return None


@task()
def _apply_barostat(arguments, block):
    barostat, model, terms, state, load, workspace, registers, status = load_arguments(arguments)
    h, draw = registers.h[0], registers.draw[0]
    status[0] = apply_barostat(
        barostat, model, terms, state, load, workspace, registers.progress, h, draw
    )


def barostat_passes(
    barostat: Barostat,
    model: NamedTuple,
    terms: TermTable,
    state: State,
    load: Load,
    workspace: BarostatWorkspace,
    registers: Registers,
    status: np.ndarray,
) -> dict[int, Pass]:
    """Kind of a flow -> its pass: `apply_barostat` over the time in the registers, and others."""
    arguments = (barostat, model, terms, state, load, workspace, registers, status)
    return {
        BAROSTAT: Pass("barostat", _apply_barostat, arguments),
        **barostat.passes(state, registers),
    }


def try_move(barostat, model, terms, state, load, workspace, progress, h, draw):
    """`apply_barostat` by a trial move: `propose_strain`, `rescale_velocities`, and the Metropolis
    test with `log_acceptance`."""
    if progress[TRIAL] == 0:
        if progress[LOADED] == 0 or workspace.known[0] == 0:
            progress[LOADED] = 0
            status = compute_load_and_virial(terms, state, load, workspace, WITH_ENERGIES)
            if status != OK:
                return status
        progress[LOADED] = 1
        if not propose_strain(barostat, model, state, workspace, h, draw):
            workspace.counts[0] += 1
            return OK
        copy_moved(state, load, workspace, workspace.load, workspace.tally[0], workspace.tally[1])
        apply_strain(barostat, state, workspace)
        progress[TRIAL] = 1
    status = compute_load_and_virial(terms, state, load, workspace, WITH_ENERGIES)
    if status != OK:
        return status
    progress[TRIAL] = 0
    chance = log_acceptance(barostat, model, state, workspace, h)
    u, _ = uniforms(barostat.key, draw + 8, 0, state.step[NOW])
    workspace.counts[0] += 1
    if log(u) < chance:
        workspace.counts[1] += 1
        state.energy_ledger[WORK] += energy_gained(barostat, model, state, workspace)
    else:
        copy_moved(workspace, workspace.load, state, load, workspace.tally[1], workspace.tally[0])
        terms.tallies_valid[0] = 0
    return OK


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
