"""Trajectories of hybrid Monte Carlo: their start, and the Metropolis test of their end.

A trajectory is some steps of any scheme. Its momenta are drawn again, in whole or in part, and its
end is accepted with the probability min(1, exp(-dH/kT)). Otherwise positions and orientations
return to its start, momenta with the opposite sign. The scheme is reversible and keeps volumes in
phase space, so exp(-H/kT) is sampled exactly, whatever the step is (Duane, Kennedy, Pendleton &
Roweth 1987, Phys. Lett. B 195, 216). See the theory chapter `sampling`.
"""

from math import exp, inf, isnan, log
from typing import NamedTuple

import numpy as np

from rigidmd.compile import Code, Pass, kernel, load_arguments, task
from rigidmd.core.integrators import BEGIN_TRAJECTORY, END_TRAJECTORY
from rigidmd.core.state import BEHIND_WALL, HEAT, NOT_FINITE, NOW, OK, Load, State, no_load
from rigidmd.dynamics.noise import uniforms
from rigidmd.dynamics.registers import AFTER_BAROSTAT, FAILED, LOADED, Registers
from rigidmd.dynamics.thermostats import kinetic_energies_of, ramp_value
from rigidmd.forces.terms import WITH_ENERGIES, TermTable, compute_load, copy

#: Columns of `TrajectoryWorkspace.sums`: trajectories ended and accepted; sums of abs(dH)/kT, of
#: min(1, exp(-dH/kT)), and of exp(-dH/kT), whose mean is 1 in equilibrium.
ENDED, ACCEPTED, SIZES, CHANCES, WEIGHTS = range(5)
#: Largest abs(dH)/kT in `SIZES` and -dH/kT in `WEIGHTS`, so that sums stay finite where a
#: trajectory diverges and where energies fall from a bad start.
LARGEST = 600.0


class TrajectoryWorkspace(NamedTuple):
    """The start of a trajectory."""

    position: np.ndarray  # as in State
    velocity: np.ndarray
    rotation: np.ndarray
    angular_momentum_body: np.ndarray
    load: Load
    energies: np.ndarray  # (2,) potential, without constants, and kinetic, u Å²/ps²
    known: np.ndarray  # (1,) whether the potential energy belongs to the current positions
    # (1,) whether the current trajectory has diverged, so that it rests at its start
    diverged: np.ndarray
    sums: np.ndarray  # (5,) see ENDED


def trajectory_workspace(state: State) -> TrajectoryWorkspace:
    arrays = (array.copy() for array in state[:4])
    known, diverged = np.zeros((2, 1), np.int64)
    return TrajectoryWorkspace(*arrays, no_load(state), np.zeros(2), known, diverged, np.zeros(5))


@kernel
def potential_energy(terms, state, load, progress):
    """Status code and potential energy of the current positions, with forces if these are unknown.
    progress : see `dynamics.step_loop.advance`"""
    if progress[LOADED] == 0 or terms.tallies_valid[0] == 0:
        progress[LOADED] = 0
        status = compute_load(terms, state, load, WITH_ENERGIES)
        if status != OK:
            return status, 0.0
        progress[LOADED] = 1
    total = 0.0
    for tally in terms.tallies:
        total += tally[0]
    return OK, total


@kernel
def start_or_test_trajectory(
    thermostat, model, code, terms, state, load, blocks, workspace, registers, starts, draw
):
    """Keep the current state as the start of a trajectory, or accept it as its end, or return to
    the start. A status
    code. blocks : see `thermostat_workspace`"""
    progress = registers.progress
    potential = workspace.energies[0]
    if not starts or workspace.known[0] == 0 or progress[LOADED] == 0:
        status, potential = potential_energy(terms, state, load, progress)
        if not starts and diverges(workspace, status):
            rest_at_start(workspace, state, load)
        elif status != OK:
            return status
    moving, turning = kinetic_energies_of(model, code, state, blocks)
    kinetic = moving + turning
    if starts:
        workspace.energies[0], workspace.energies[1] = potential, kinetic
        copy_start(state, load, workspace, workspace.load)
        return OK
    gained = potential - workspace.energies[0] + (kinetic - workspace.energies[1])
    loss = gained / ramp_value(thermostat.thermal_energy, state)
    if isnan(loss) or workspace.diverged[0] != 0:
        loss = inf
    u, _ = uniforms(thermostat.key, draw, 0, state.step[NOW])
    sums = workspace.sums
    sums[ENDED] += 1
    sums[SIZES] += min(LARGEST, abs(loss))
    sums[CHANCES] += exp(min(0.0, -loss))
    sums[WEIGHTS] += exp(min(LARGEST, -loss))
    workspace.known[0], workspace.diverged[0] = 1, 0
    if log(u) < -loss:
        sums[ACCEPTED] += 1
        workspace.energies[0] = potential
        state.energy_ledger[HEAT] += gained
    else:
        copy_start(workspace, workspace.load, state, load)
        progress[LOADED] = min(1, progress[LOADED])
        negate(state.velocity)
        negate(state.angular_momentum_body)
        terms.tallies_valid[0] = 0
        registers.known[0] = 0
    return OK


@kernel
def diverges(workspace, status):
    """Whether a status code is the first sign that a trajectory has diverged."""
    return status in (NOT_FINITE, BEHIND_WALL) and workspace.diverged[0] == 0


@kernel
def rest_at_start(workspace, state, load):
    workspace.diverged[0] = 1
    copy_start(workspace, workspace.load, state, load)


@task()
def _start_or_test(arguments, block):
    everything, registers, status, starts = load_arguments(arguments)
    status[0] = start_or_test_trajectory(*everything, registers, starts, registers.draw[0])


@task()
def _rest(arguments, block):
    """After forces that failed. If a trajectory diverges, it rests at its start, where the forces
    are unknown, until it is rejected. The status becomes OK."""
    workspace, state, load, registers = load_arguments(arguments)
    if diverges(workspace, registers.failure[0]):
        rest_at_start(workspace, state, load)
        registers.progress[LOADED] = 0
        registers.failure[0] = OK


@task()
def _know_potential(arguments, block):
    """Take the potential energy from a move of the box that has just been accepted or rejected."""
    workspace, registers = load_arguments(arguments)
    workspace.energies[0] = registers.tally[0, 0]


def trajectory_passes(
    thermostat: NamedTuple,
    model: NamedTuple,
    code: Code,
    terms: TermTable,
    state: State,
    load: Load,
    blocks: np.ndarray,
    workspace: TrajectoryWorkspace,
    registers: Registers,
    status: np.ndarray,
) -> dict[int, Pass]:
    """Kind of a flow -> its pass: the start and the test of a trajectory. What follows a move of
    the box, and, as FAILED, what follows forces that failed."""
    everything = (thermostat, model, code, terms, state, load, blocks, workspace)
    return {
        BEGIN_TRAJECTORY: Pass(
            "start of a trajectory", _start_or_test, (everything, registers, status, True)
        ),
        END_TRAJECTORY: Pass(
            "test of a trajectory", _start_or_test, (everything, registers, status, False)
        ),
        AFTER_BAROSTAT: Pass(
            "potential energy of the box", _know_potential, (workspace, registers)
        ),
        FAILED: Pass("rest at the start", _rest, (workspace, state, load, registers)),
    }


@kernel
def copy_start(source, load, target, load_there):
    """Copy what a trajectory changes, from `source` to `target`: a state and a workspace, each with
    a load."""
    copy(source.position, target.position)
    copy(source.velocity, target.velocity)
    copy(source.rotation, target.rotation)
    copy(source.angular_momentum_body, target.angular_momentum_body)
    copy(load.force, load_there.force)
    copy(load.torque_body, load_there.torque_body)


@kernel
def negate(values):
    """values[:] *= -1 for an array (n, 3), in place."""
    for m in range(len(values)):
        for k in range(3):
            values[m, k] = -values[m, k]
