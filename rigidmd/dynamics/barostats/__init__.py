"""Barostats: flows that change the cell at a pressure, each a pass of the step. A constant volume
has none.

See the theory chapter `sampling`. A lower triangular matrix T multiplies the cell (rows a, b, c)
and the centres of mass from the right. The virial is W_ij = sum F_i R_j in `tally[1:]`.
`apply_barostat` acts where a scheme has the flow BAROSTAT, `move_piston` where it has SCALE_BOX.
The energy added to the molecules is in `state.energy_ledger[WORK]`.
"""

from math import exp, inf, log, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass, chosen_by_type, implements, is_a, kernel, load_arguments, task
from rigidmd.core.integrators import BAROSTAT
from rigidmd.core.state import NOW, OK, ORIGIN, TALLY_SIZE, WORK, Load, State, no_load
from rigidmd.dynamics.noise import Key, normals, uniforms
from rigidmd.dynamics.registers import LOADED, TRIAL, Registers
from rigidmd.dynamics.thermostats import Ramp, ramp_value, scale_array, translational_energy
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import WITH_ENERGIES, WITH_VIRIALS, TermTable, compute_load, copy

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
#: Largest change of the volume in a Monte Carlo move, in standard deviations of its fluctuations.
WIDTH = 2.0
#: Largest factor of the volume in a Monte Carlo move, and of its inverse. Boxes of one or two
#: molecules draw larger ones.
LARGEST_FACTOR = 10.0
#: Largest drift of a move, as a strain; noise is added to it. It limits the effect of a bad start
#: in one move.
LONGEST_DRIFT = 0.01


class Pressure(NamedTuple):
    """The target pressure, by component. It changes linearly over a run segment. u/(Å ps²)."""

    first: tuple[float, float, float, float, float, float]
    last: tuple[float, float, float, float, float, float]
    steps: float


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


class VolumeMoves(NamedTuple):
    """Monte Carlo barostat (Åqvist et al. 2004, Chem. Phys. Lett. 384, 288), see the theory chapter
    `sampling`."""

    thermal_energy: Ramp
    pressure: Pressure
    width: float  # largest change of the volume, Å³
    molecules: float  # number of molecules that are not frozen
    tail: tuple[float, float]
    key: Key


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


class Confinement(NamedTuple):
    """What a barostat is made from, in addition to the keys of its stage."""

    thermal_energy: Ramp
    pressure: Pressure
    compressibility: float  # Å ps²/u
    volume: float  # at the start, Å³
    molecules: float  # see `VolumeMoves`
    at_rest: tuple[float, float, float]  # see `CellRescaling`
    tail: tuple[float, float]
    key: Key


#: Name of a barostat in `scene.couplings` -> the function that makes it for a stage from a
#: `Confinement`.
BAROSTATS = {
    "cell_rescaling": lambda stage, given: CellRescaling(
        given.thermal_energy,
        given.pressure,
        given.compressibility / stage.barostat_time,
        COUPLINGS[stage.pressure_coupling],
        given.at_rest,
        given.tail,
        given.key,
    ),
    "monte_carlo": lambda stage, given: VolumeMoves(
        given.thermal_energy,
        given.pressure,
        WIDTH * sqrt(max(given.thermal_energy[:2]) * given.compressibility * given.volume),
        given.molecules,
        given.tail,
        given.key,
    ),
    "piston": lambda stage, given: Piston(
        given.pressure,
        given.compressibility * given.volume * (2 * np.pi / stage.barostat_time) ** 2,
        3 * given.molecules / (3 * given.molecules - sum(given.at_rest) or inf),
        given.tail,
    ),
}


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


def needed_tallies(barostat: tuple | None) -> int:
    """What `compute_load` has to compute in a step in which a barostat acts: WITH_VIRIALS or
    WITH_ENERGIES; 0: no more than in other steps."""
    if barostat is None:
        return 0
    return WITH_VIRIALS if isinstance(barostat, Piston) else WITH_ENERGIES


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


@chosen_by_type
def apply_barostat(barostat, model, terms, state, load, workspace, progress, h, draw):
    """The flow of a barostat over a time h, in place. A status code. progress : see `registers`."""
    return _kick_piston if is_a(barostat, Piston) else _try_move


@task()
def _apply_barostat(arguments, block):
    barostat, model, terms, state, load, workspace, registers, status = load_arguments(arguments)
    h, draw = registers.h[0], registers.draw[0]
    status[0] = apply_barostat(
        barostat, model, terms, state, load, workspace, registers.progress, h, draw
    )


@task()
def _move_piston(arguments, block):
    barostat, state, registers = load_arguments(arguments)
    move_piston(barostat, state, registers.h[0])
    registers.progress[LOADED] = 0


def barostat_pass(
    barostat: NamedTuple,
    model: NamedTuple,
    terms: TermTable,
    state: State,
    load: Load,
    workspace: BarostatWorkspace,
    registers: Registers,
    status: np.ndarray,
) -> Pass:
    """`apply_barostat` over the time in the registers."""
    return Pass(
        "barostat",
        _apply_barostat,
        (barostat, model, terms, state, load, workspace, registers, status),
    )


def piston_pass(barostat: Piston, state: State, registers: Registers) -> Pass:
    """`move_piston` over the time in the registers."""
    return Pass("volume", _move_piston, (barostat, state, registers))


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


def _try_move(barostat, model, terms, state, load, workspace, progress, h, draw):
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


@implements(propose_strain, VolumeMoves)
def propose_volume(barostat, model, state, workspace, h, draw):
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


@implements(propose_strain, CellRescaling)
def propose_rescaling(barostat, model, state, workspace, h, draw):
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


@chosen_by_type
def rescale_velocities(barostat, state, workspace):
    """Change the velocities with the strain, unless the barostat keeps them."""
    if not is_a(barostat, CellRescaling):
        return lambda barostat, state, workspace: None

    def divide_velocities(barostat, state, workspace):
        inverse = workspace.matrices[1]
        for m in range(len(state.velocity)):
            x, y, z = state.velocity[m, 0], state.velocity[m, 1], state.velocity[m, 2]
            state.velocity[m, 0] = inverse[0, 0] * x
            state.velocity[m, 1] = inverse[1, 0] * x + inverse[1, 1] * y
            state.velocity[m, 2] = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z

    return divide_velocities


def log_acceptance(barostat, model, state, workspace, h):
    """The logarithm of the acceptance probability of a move that has been made."""
    raise TypeError("compiled code only")


@implements(log_acceptance, VolumeMoves)
def log_acceptance_of_volume(barostat, model, state, workspace, h):
    before, after = volume_of(workspace.cell), volume_of(state.cell)
    work = target_pressure(barostat.pressure, state, 0) * (after - before)
    work = energy_gained(barostat, model, state, workspace) + work
    return barostat.molecules * log(after / before) - work / ramp_value(
        barostat.thermal_energy, state
    )


@implements(log_acceptance, CellRescaling)
def log_acceptance_of_rescaling(barostat, model, state, workspace, h):
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
