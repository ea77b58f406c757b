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

from rigidmd.compile import Pass, kernel, load_arguments, task
from rigidmd.core.state import (
    BEHIND_WALL,
    HEAT,
    NOT_FINITE,
    NOW,
    OK,
    Load,
    State,
    copy_into,
    no_load,
)
from rigidmd.dynamics.noise import uniforms
from rigidmd.dynamics.registers import KEPT_BY_EXTENSION, Timing
from rigidmd.dynamics.step_parts import StepExtension, StepParts
from rigidmd.dynamics.thermostats import kinetic_energies_of, ramp_value
from rigidmd.features.monte_carlo.keys import ACCEPTED, CHANCES, ENDED, SIZES, WEIGHTS
from rigidmd.forces.terms import FORCES_ONLY, copy

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
    is_under_way: np.ndarray  # (1,) whether a trajectory has started and not ended
    sums: np.ndarray  # (5,) see ENDED


def trajectory_workspace(state: State) -> TrajectoryWorkspace:
    """Arrays for the start of a trajectory from a state."""
    arrays = (array.copy() for array in state[:4])
    known, is_under_way = np.zeros((2, 1), np.int64)
    return TrajectoryWorkspace(
        *arrays, no_load(state), np.zeros(2), known, is_under_way, np.zeros(5)
    )


class Trajectories(StepExtension[TrajectoryWorkspace]):
    """The rows of trajectories, for the thermostat that draws their momenta."""

    def __init__(self, thermostat: NamedTuple):
        self.thermostat = thermostat

    def workspace(self, state: State) -> TrajectoryWorkspace:
        return trajectory_workspace(state)

    def begin(self, parts: StepParts, timing: Timing) -> list[Pass]:
        content = parts.core, parts.code, parts.heat, parts.extension
        return [Pass("start of a trajectory", _start, content, when=timing.when)]

    def end(self, parts: StepParts, timing: Timing) -> list[Pass]:
        content = (
            self.thermostat,
            parts.core,
            parts.code,
            parts.heat,
            parts.extension,
            timing,
        )
        text = "accept the trajectory, or return to its start"
        return [Pass(text, _test, content, when=timing.when)]

    def after_barostat(self, parts: StepParts, timing: Timing) -> list[Pass]:
        content = parts.extension, parts.barostat, parts.core.registers
        return [Pass("potential energy in the box", _know_potential, content, when=timing.when)]

    def after_failure(self, parts: StepParts) -> list[Pass]:
        _, state, load, registers, status, *_ = parts.core
        content = parts.extension, state, load, registers, status
        return [Pass("rest at the start of the trajectory", _rest, content)]

    def forget(self, workspace: TrajectoryWorkspace) -> None:
        workspace.known[0] = 0

    def arrays(self, workspace: TrajectoryWorkspace) -> dict[str, np.ndarray]:
        return {key: getattr(workspace, key) for key in ("energies", "known", "sums")}

    def restored(self, state: State, arrays: dict[str, np.ndarray]) -> TrajectoryWorkspace:
        workspace = trajectory_workspace(state)
        copy_into(workspace, arrays)
        return workspace

    def sums(self, workspace: TrajectoryWorkspace) -> np.ndarray:
        return workspace.sums.copy()

    def keeps_energy(self, workspace: TrajectoryWorkspace) -> bool:
        return bool(workspace.known[0])


@task()
def _start(arguments, block):
    """Keep the current state as the start of a trajectory."""
    core, code, blocks, workspace = load_arguments(arguments)
    state, load, known = core.state, core.load, core.registers.known
    if known[0] & KEPT_BY_EXTENSION == 0:
        workspace.energies[0] = potential_energy(core.terms)
    moving, turning = kinetic_energies_of(core.model, code, state, blocks)
    workspace.energies[1] = moving + turning
    copy_start(state, load, workspace, workspace.load)
    workspace.is_under_way[0] = 1


@task()
def _test(arguments, block):
    """Accept the current state as the end of a trajectory, or return to its start."""
    thermostat, core, code, blocks, workspace, timing = load_arguments(arguments)
    state, load, known = core.state, core.load, core.registers.known
    potential = potential_energy(core.terms)
    moving, turning = kinetic_energies_of(core.model, code, state, blocks)
    gained = potential - workspace.energies[0] + (moving + turning - workspace.energies[1])
    loss = gained / ramp_value(thermostat.thermal_energy, state)
    if isnan(loss) or core.registers.resting[0] != 0:
        loss = inf
    u, _ = uniforms(thermostat.key, timing.draw, 0, state.step[NOW])
    sums = workspace.sums
    sums[ENDED] += 1
    sums[SIZES] += min(LARGEST, abs(loss))
    sums[CHANCES] += exp(min(0.0, -loss))
    sums[WEIGHTS] += exp(min(LARGEST, -loss))
    workspace.known[0], workspace.is_under_way[0], core.registers.resting[0] = 1, 0, 0
    if log(u) < -loss:
        sums[ACCEPTED] += 1
        workspace.energies[0] = potential
        state.energy_ledger[HEAT] += gained
    else:
        copy_start(workspace, workspace.load, state, load)
        negate(state.velocity)
        negate(state.angular_momentum_body)
        core.terms.tallies_valid[0] = 0
        known[0] = FORCES_ONLY
    known[0] |= KEPT_BY_EXTENSION


@kernel
def potential_energy(terms):
    """Potential energy of the last forces, which have energies."""
    total = 0.0
    for tally in terms.tallies:
        total += tally[0]
    return total


@task()
def _rest(arguments, block):
    """After forces that failed. If a trajectory diverges, it rests at its start until it is
    rejected. The status becomes OK."""
    workspace, state, load, registers, status = load_arguments(arguments)
    diverges = status[0] in (NOT_FINITE, BEHIND_WALL) and workspace.is_under_way[0] != 0
    if diverges and registers.resting[0] == 0:
        registers.resting[0], registers.known[0] = 1, 0
        copy_start(workspace, workspace.load, state, load)
        status[0] = OK


@task()
def _know_potential(arguments, block):
    """Take the potential energy from a move of the box that has just been accepted or rejected."""
    workspace, barostat, registers = load_arguments(arguments)
    workspace.energies[0] = barostat.tally[0, 0]
    registers.known[0] |= KEPT_BY_EXTENSION


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
