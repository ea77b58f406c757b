"""Thermostats: flows on the momenta that keep a temperature, each a pass of the step. NVE has none.

`apply_thermostat` acts where a scheme has the flow THERMOSTAT. The heat that a thermostat adds is
summed in `state.energy_ledger[HEAT]`, its own variables are in `state.extra_variables`. Its random
numbers are counted by the step, from `draw` on (see `noise`).
"""

from math import exp, expm1, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import (
    MOST_BLOCKS,
    Code,
    Pass,
    call_blocks,
    chosen_by_type,
    implements,
    kernel,
    load_arguments,
    pack_arguments,
    task,
)
from rigidmd.compile.simd import align_stack
from rigidmd.core.state import EXAMPLE, HEAT, NOW, ORIGIN, State
from rigidmd.dynamics.noise import BATCH, Key, chi_square, fill_normals, normals, uniforms
from rigidmd.dynamics.registers import Registers
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.mechanics.batches import LANES, apply_langevin_group, kinetic_energies, scale_group


class Ramp(NamedTuple):
    """A temperature or another number that changes linearly over the steps of a run segment."""

    first: float
    last: float
    steps: float  # of the segment


def constant_ramp(value: float) -> Ramp:
    return Ramp(value, value, 1.0)


@kernel(inline=True)
def ramp_value(ramp, state):
    """The value of a ramp in the current step."""
    return ramp.first + (ramp.last - ramp.first) * (
        (state.step[NOW] - state.step[ORIGIN] + 1) / ramp.steps
    )


class VelocityRescaling(NamedTuple):
    """Stochastic velocity rescaling (Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101)
    by two thermostats, one of translation and one of rotation: see the theory chapter
    `sampling`."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps; infinite: no effect
    freedom_translation: int
    freedom_rotation: int
    key: Key

    halved = False  # one flow after each step, not half of it before and half after


class Langevin(NamedTuple):
    """Friction and noise on every momentum, along axes that have inertia: the Ornstein-Uhlenbeck
    process, solved exactly (Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114).
    See the theory chapter `sampling`."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    friction_translation: float  # 1/ps
    friction_rotation: float  # 1/ps
    key: Key


class HybridMonteCarlo(NamedTuple):
    """New momenta, in whole or in part, before each trajectory of `dynamics.hybrid_monte_carlo`:
    the flow of Langevin's thermostat over one step, whose frictions are infinite for wholly new
    momenta."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    friction_translation: float  # 1/ps
    friction_rotation: float  # 1/ps
    key: Key


class Andersen(NamedTuple):
    """Random collisions, on average after `time_constant`, that redraw the momenta of one molecule
    (Andersen 1980)."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps
    key: Key


class NoseHoover(NamedTuple):
    """Two Nose-Hoover chains, one for translation and one for rotation, on two halves of
    `state.extra_variables`. Each half is eta (links,), then d eta/dt (links,). See the theory
    chapter `sampling` (Martyna, Tuckerman, Tobias & Klein 1996)."""

    thermal_energy: Ramp  # kB T, u Å²/ps²
    period: float  # ps
    links: int  # of each chain
    freedom_translation: int
    freedom_rotation: int

    @property
    def variables(self) -> int:
        """How many numbers it has in `state.extra_variables`."""
        return 4 * self.links


#: Name of a thermostat in `scene.couplings` -> the function that makes it for a stage, from kB T,
#: the degrees of freedom and the key of its random numbers.
THERMOSTATS = {
    "velocity_rescaling": lambda stage, thermal, freedom, key: VelocityRescaling(
        thermal, stage.thermostat_time, freedom.translation, freedom.rotation, key
    ),
    "langevin": lambda stage, thermal, freedom, key: Langevin(thermal, *stage.frictions, key),
    "nose_hoover": lambda stage, thermal, freedom, key: NoseHoover(
        thermal,
        stage.thermostat_time,
        stage.nose_hoover_links,
        freedom.translation,
        freedom.rotation,
    ),
    "andersen": lambda stage, thermal, freedom, key: Andersen(thermal, stage.thermostat_time, key),
    "hybrid_monte_carlo": lambda stage, thermal, freedom, key: HybridMonteCarlo(
        thermal, *(stage.refreshment_rate,) * 2, key
    ),
}


def thermostat_workspace() -> np.ndarray:
    """Array (MOST_BLOCKS, 2) for energies of each block of molecules."""
    return np.zeros((MOST_BLOCKS, 2))


def thermostat_code(thermostat: NamedTuple, model: NamedTuple) -> Code:
    """The tasks of a thermostat that act on blocks of molecules."""
    state = EXAMPLE[0]
    workspace = thermostat_workspace()
    tasks: dict[str, tuple] = {}
    if isinstance(thermostat, Langevin | Andersen | HybridMonteCarlo):
        apply = _apply_andersen if isinstance(thermostat, Andersen) else _apply_langevin
        tasks["molecules"] = apply, (thermostat, model, state, workspace, 0.0, 0)
    if isinstance(thermostat, VelocityRescaling | NoseHoover | HybridMonteCarlo):
        tasks["kinetic_energies"] = _compute_kinetic_energies, (model, state, workspace)
    if isinstance(thermostat, VelocityRescaling | NoseHoover):
        tasks["scale"] = _scale, (state, 0.0, 0.0)
    return Code(**tasks)


@chosen_by_type
def apply_thermostat(thermostat, model, code, state, workspace, h, draw):
    """The flow of a thermostat over a time h (ps), in place. draw : its first random draw in this
    step. workspace : see `thermostat_workspace`"""
    return None


@task()
def _apply_thermostat(arguments, block):
    thermostat, model, code, state, workspace, registers = load_arguments(arguments)
    apply_thermostat(thermostat, model, code, state, workspace, registers.h[0], registers.draw[0])


def thermostat_pass(
    thermostat: NamedTuple,
    model: NamedTuple,
    code: Code,
    state: State,
    workspace: np.ndarray,
    registers: Registers,
) -> Pass:
    """`apply_thermostat` over the time in the registers. code : with `thermostat_code`"""
    return Pass(
        "thermostat", _apply_thermostat, (thermostat, model, code, state, workspace, registers)
    )


@implements(apply_thermostat, VelocityRescaling)
def _apply_rescaling(thermostat, model, code, state, workspace, h, draw):
    if thermostat.time_constant == inf:
        return
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    factors = np.ones(2)
    step = state.step[NOW]
    c = exp(-h / thermostat.time_constant)
    thermal = 0.5 * ramp_value(thermostat.thermal_energy, state) * (1 - c)
    energies = (moving, turning)
    freedoms = (thermostat.freedom_translation, thermostat.freedom_rotation)
    for k in range(2):
        kinetic, freedom = energies[k], freedoms[k]
        if kinetic == 0.0 or freedom == 0:
            continue
        # eq. A7: one Gaussian, and the sum of the squares of the others as one number
        noise = thermal / kinetic
        gauss, _ = normals(thermostat.key, draw, k, step)
        others = chi_square(thermostat.key, draw + 1, k, step, freedom - 1)
        square = c + noise * (gauss * gauss + others) + 2 * gauss * sqrt(c * noise)
        state.energy_ledger[HEAT] += (square - 1) * kinetic
        factors[k] = sqrt(square)
    scale_momenta(code, state, factors[0], factors[1])


@implements(apply_thermostat, (Langevin, Andersen, HybridMonteCarlo))
def _apply_by_molecule(thermostat, model, code, state, workspace, h, draw):
    blocks = blocks_of(len(state.velocity))
    call_blocks(
        code, "molecules", pack_arguments((thermostat, model, state, workspace, h, draw)), blocks
    )
    for block in range(blocks):
        state.energy_ledger[HEAT] += workspace[block, 0]


@task()
def _apply_langevin(arguments, block):
    """Langevin friction and noise for the molecules of a block. The heat is written to
    workspace[block, 0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    align_stack()
    first, end = molecules_of_block(len(state.velocity), block, LANES)
    thermal = ramp_value(thermostat.thermal_energy, state)
    passed, turned = thermostat.friction_translation * h, thermostat.friction_rotation * h
    keep, keep_turning = exp(-passed), exp(-turned)
    new = thermal_momenta(model, -thermal * expm1(-2 * passed), -thermal * expm1(-2 * turned))
    words = np.empty((2, 4, BATCH), np.uint64)
    numbers = np.empty(6 * BATCH)
    heat = 0.0
    for start in range(first, end, BATCH):
        fill_normals(numbers, words, thermostat.key, draw, start, state.step[NOW])
        heat += apply_langevin_group(
            model, state, keep, keep_turning, new, numbers, start, min(end, start + BATCH)
        )
    workspace[block, 0] = heat


@task()
def _apply_andersen(arguments, block):
    """Andersen collisions with the molecules of a block. The heat is written to workspace[block,
    0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    velocity, momentum = state.velocity, state.angular_momentum_body
    first, end = molecules_of_block(len(velocity), block, LANES)
    step = state.step[NOW]
    missed = exp(-h / thermostat.time_constant)
    thermal = ramp_value(thermostat.thermal_energy, state)
    new = thermal_momenta(model, thermal, thermal)
    heat = 0.0
    for m in range(first, end):
        chance, _ = uniforms(thermostat.key, draw, m, step)
        if chance <= missed:
            continue
        kind = model.species[m]
        for k in range(3):
            of_velocity, of_momentum = normals(thermostat.key, draw + 1 + k, m, step)
            after = new[kind, 3] * of_velocity
            heat += 0.5 * model.mass[kind] * (after * after - velocity[m, k] ** 2)
            velocity[m, k] = after
            if len(momentum) > 0:
                after = new[kind, k] * of_momentum
                heat += 0.5 * model.inverse_inertia[kind, k] * (after * after - momentum[m, k] ** 2)
                momentum[m, k] = after
    workspace[block, 0] = heat


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


#: Suzuki-Yoshida factors: fractions of a flow of the chains.
YOSHIDA = (1 / (2 - 2 ** (1 / 3)), 1 - 2 / (2 - 2 ** (1 / 3)), 1 / (2 - 2 ** (1 / 3)))


@implements(apply_thermostat, NoseHoover)
def _apply_nose_hoover(thermostat, model, code, state, workspace, h, draw):
    thermal = ramp_value(thermostat.thermal_energy, state)
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    variables = state.extra_variables
    links = 2 * thermostat.links
    scale, heat = move_chain(
        thermostat, variables[:links], thermal, moving, thermostat.freedom_translation, h
    )
    scale_turning, heat_turning = move_chain(
        thermostat, variables[links:], thermal, turning, thermostat.freedom_rotation, h
    )
    scale_momenta(code, state, scale, scale_turning)
    state.energy_ledger[HEAT] += heat + heat_turning


@kernel
def move_chain(thermostat, chain, thermal, kinetic, freedom, h):
    """Propagate a chain over h, in place. Returns the factor of the momenta and the energy lost (u
    Å²/ps²)."""
    if freedom == 0:
        return 1.0, 0.0
    links = thermostat.links
    eta = chain[:links]
    rate = chain[links:]
    before = chain_energy(thermostat, chain, thermal, freedom)
    scale = 1.0
    for factor in YOSHIDA:
        d = factor * h
        _kick_links(
            thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, links - 1, -1, -1
        )
        scale *= exp(-d * rate[0])
        for j in range(links):
            eta[j] += d * rate[j]
        _kick_links(thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, 0, links, 1)
    return scale, before - chain_energy(thermostat, chain, thermal, freedom)


@kernel
def _kick_links(thermostat, rate, thermal, twice_kinetic, freedom, d, first, end, by):
    """Half a step of the rates of the links, from link `first` to the one before `end`."""
    links = thermostat.links
    unit = thermal * (thermostat.period / (2 * np.pi)) ** 2
    for j in range(first, end, by):
        if j == 0:
            pull = (twice_kinetic - freedom * thermal) / (freedom * unit)
        else:
            mass = freedom * unit if j == 1 else unit
            pull = (mass * rate[j - 1] * rate[j - 1] - thermal) / unit
        drag = exp(-0.25 * d * rate[j + 1]) if j + 1 < links else 1.0
        rate[j] = (rate[j] * drag + 0.5 * d * pull) * drag


@kernel
def chain_energy(thermostat, chain, thermal, freedom):
    """Energy of a chain (u Å²/ps²)."""
    unit = thermal * (thermostat.period / (2 * np.pi)) ** 2
    total = 0.0
    for j in range(thermostat.links):
        of_one = freedom if j == 0 else 1
        rate = chain[thermostat.links + j]
        total += of_one * (0.5 * unit * rate * rate + thermal * chain[j])
    return total


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
