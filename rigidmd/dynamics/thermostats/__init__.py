"""Thermostats: flows on the momenta that keep a temperature, each a row of the step. NVE has none.

`apply_thermostat` acts where a scheme has the flow THERMOSTAT. The heat that a thermostat adds is
summed in `state.energy_ledger[HEAT]`, its own variables are in `state.extra_variables`. Its random
numbers are counted by the step, from `draw` on (see `noise`).
"""

from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np

from rigidmd.compile import (
    MOST_BLOCKS,
    Code,
    CompiledTask,
    Pass,
    call_blocks,
    chosen_by_type,
    kernel,
    load_arguments,
    pack_arguments,
    task,
)
from rigidmd.core.state import EXAMPLE, HEAT, NOW, ORIGIN, State
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.registers import Timing
from rigidmd.dynamics.step_parts import StepParts
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.mechanics.batches import LANES, kinetic_energies, scale_group


class Ramp(NamedTuple):
    """A temperature or another number that changes linearly over the steps of a run segment."""

    first: float
    last: float
    steps: float  # of the segment


def constant_ramp(value: float) -> Ramp:
    """A set point that stays the same."""
    return Ramp(value, value, 1.0)


@kernel(inline=True)
def ramp_value(ramp, state):
    """The value of a ramp in the current step."""
    return ramp.first + (ramp.last - ramp.first) * (
        (state.step[NOW] - state.step[ORIGIN] + 1) / ramp.steps
    )


def thermostat_workspace() -> np.ndarray:
    """Array (MOST_BLOCKS, 2) for energies of each block of molecules."""
    return np.zeros((MOST_BLOCKS, 2))


#: Name of a task that acts on blocks of molecules -> the task and an example of its arguments.
Tasks = dict[str, tuple[CompiledTask, tuple]]


class Thermostat(Protocol):
    """The record of a thermostat, a NamedTuple."""

    def tasks(self, model: Model, state: State, workspace: np.ndarray) -> Tasks:
        """The tasks that `apply_thermostat` calls for blocks of molecules."""
        ...


class UserThermostat(Thermostat, Protocol):
    """The record of a user's thermostat."""

    @property
    def halved(self) -> bool:
        """As in `scene.ensemble_methods.Thermostat`."""
        ...


def thermostat_code(thermostat: Thermostat | None, model: Model) -> Code:
    """The tasks of a thermostat that act on blocks of molecules."""
    if thermostat is None:
        return Code()
    return Code(**thermostat.tasks(model, EXAMPLE[0], thermostat_workspace()))


def tasks_by_molecule(
    apply: CompiledTask,
    thermostat: Thermostat,
    model: Model,
    state: State,
    workspace: np.ndarray,
) -> Tasks:
    """The task of `apply_by_molecule`."""
    return {"molecules": (apply, (thermostat, model, state, workspace, 0.0, 0))}


def task_of_energies(model: Model, state: State, workspace: np.ndarray) -> Tasks:
    """The task of `kinetic_energies_of`."""
    return {"kinetic_energies": (_compute_kinetic_energies, (model, state, workspace))}


def tasks_of_scaling(model: Model, state: State, workspace: np.ndarray) -> Tasks:
    """The tasks of `kinetic_energies_of` and `scale_momenta`."""
    return task_of_energies(model, state, workspace) | {"scale": (_scale, (state, 0.0, 0.0))}


@chosen_by_type
def apply_thermostat(thermostat, model, code, state, workspace, h, draw):
    """The flow of a thermostat over a time h (ps), in place. draw : its first random draw in this
    step. workspace : see `thermostat_workspace`"""
    return None


@task()
def _apply_thermostat(arguments, block):
    thermostat, core, code, workspace, timing = load_arguments(arguments)
    h = timing.fraction * core.registers.dt[0]
    apply_thermostat(thermostat, core.model, code, core.state, workspace, h, timing.draw)


def thermostat_row(thermostat: NamedTuple, parts: StepParts, timing: Timing) -> Pass:
    """`apply_thermostat` in a step."""
    content = thermostat, parts.core, parts.code, parts.heat, timing
    text = f"thermostat {type(thermostat).__name__} {timing.fraction:.4g} dt"
    return Pass(text, _apply_thermostat, content, when=timing.when)


def apply_by_molecule(thermostat, model, code, state, workspace, h, draw):
    """`apply_thermostat` by the task of `tasks_by_molecule`, which writes the heat of a block to
    workspace[block, 0]."""
    blocks = blocks_of(len(state.velocity))
    call_blocks(
        code, "molecules", pack_arguments((thermostat, model, state, workspace, h, draw)), blocks
    )
    for block in range(blocks):
        state.energy_ledger[HEAT] += workspace[block, 0]


@kernel
def thermal_momenta(model, translation, rotation):
    """Thermal momenta (species, 4): sqrt(I kT) for the three axes of a body, sqrt(kT/m) for a
    velocity component.
    translation, rotation : their thermal energies"""
    sizes = np.empty((len(model.mass), 4))
    for kind in range(len(model.mass)):
        for k in range(3):
            sizes[kind, k] = sqrt(rotation * model.inertia[kind, k])
        sizes[kind, 3] = sqrt(translation * model.inverse_mass[kind])
    return sizes


# Sums over all molecules on one thread: for barostats, and for user thermostats, which have no
# tasks.


@kernel
def scale_array(values, scale):
    """Multiply an array (n, 3) by a number, in place."""
    scale_group(values, 0, len(values), scale)


@kernel
def translational_energy(model, state):
    """Translational kinetic energy of all molecules (u Å²/ps²)."""
    return _energies(model, state, 0, len(state.velocity))[0]


@kernel
def kinetic_energy(model, state):
    """Translational and rotational kinetic energy of all molecules (u Å²/ps²)."""
    moving, turning = _energies(model, state, 0, len(state.velocity))
    return moving + turning


@kernel
def _energies(model, state, first, end):
    velocity, momentum = state.velocity, state.angular_momentum_body
    return kinetic_energies(
        model.species, model.mass, model.inverse_inertia, velocity, momentum, first, end
    )


@kernel
def kinetic_energies_of(model, code, state, workspace):
    """Translational and rotational kinetic energy of all molecules (u Å²/ps²), summed in the order
    of blocks."""
    blocks = blocks_of(len(state.velocity))
    call_blocks(code, "kinetic_energies", pack_arguments((model, state, workspace)), blocks)
    moving = turning = 0.0
    for block in range(blocks):
        moving += workspace[block, 0]
        turning += workspace[block, 1]
    return moving, turning


@kernel
def scale_momenta(code, state, scale, scale_turning):
    """Multiply velocities by `scale` and angular momenta by `scale_turning`, in place."""
    call_blocks(
        code, "scale", pack_arguments((state, scale, scale_turning)), blocks_of(len(state.velocity))
    )


@task()
def _compute_kinetic_energies(arguments, block):
    model, state, workspace = load_arguments(arguments)
    first, end = molecules_of_block(len(state.velocity), block, LANES)
    workspace[block, 0], workspace[block, 1] = _energies(model, state, first, end)


@task()
def _scale(arguments, block):
    state, scale, scale_turning = load_arguments(arguments)
    first, end = molecules_of_block(len(state.velocity), block, LANES)
    scale_group(state.velocity, first, end, scale)
    if len(state.angular_momentum_body) > 0:
        scale_group(state.angular_momentum_body, first, end, scale_turning)
