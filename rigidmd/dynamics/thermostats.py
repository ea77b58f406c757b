"""Baths: flows on the momenta that keep a temperature, chosen by type; NVE compiles none.

`apply_thermostat(thermostat, model, code, state, workspace, h, draw)` acts where the row of a step says. What a thermostat puts in is in
`state.energy_ledger[HEAT]`, and what it evolves in `state.extra_variables`; its random numbers are counted by the step, from `draw` on,
see `noise`.
"""

from math import exp, expm1, inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import MOST_BLOCKS, call_blocks, implements, kernel, load_arguments, pack_arguments, task
from rigidmd.compile.simd import align_stack
from rigidmd.core.state import EXAMPLE, HEAT, NOW, ORIGIN
from rigidmd.dynamics.noise import BATCH, Key, chi_square, fill_normals, normals, uniforms
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.mechanics.batches import LANES, apply_langevin_group, kinetic_energies, scale_group


class Ramp(NamedTuple):
    """From one value to another, evenly over the steps of a stretch; a constant where the two are equal."""

    first: float
    last: float
    steps: float  # of the stretch


def constant_ramp(value: float) -> Ramp:
    """The ramp that stays at a value."""
    return Ramp(value, value, 1.0)


@kernel(inline=True)
def ramp_value(ramp, state):
    """The value of a ramp in the step that is being taken."""
    return ramp.first + (ramp.last - ramp.first) * ((state.step[NOW] - state.step[ORIGIN] + 1) / ramp.steps)


class NoThermostat(NamedTuple):
    """NVE."""

    rate: float = 0.0


class VelocityRescaling(NamedTuple):
    """Stochastic velocity rescaling (Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101).

    All momenta, translational and rotational together, are scaled by one factor such that the kinetic energy follows
    its own exactly solved stochastic equation; the canonical distribution is sampled, total momentum keeps its
    direction, and the time scale of single molecules is hardly touched.
    """

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps; if infinite it does nothing
    degrees_of_freedom: int
    key: Key


class Langevin(NamedTuple):
    """Friction and noise on every momentum: the Ornstein-Uhlenbeck process, solved exactly.

    p <- c p + sqrt(m kT (1 - c²)) xi with c = exp(-friction h), and the same for each component of the angular momentum
    along an axis that has inertia (Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114). Total momentum
    is not conserved.
    """

    thermal_energy: Ramp  # kB T, u Å²/ps²
    friction_translation: float  # 1/ps
    friction_rotation: float  # 1/ps
    key: Key


class Andersen(NamedTuple):
    """Collisions with a gas (Andersen 1980, J. Chem. Phys. 72, 2384): now and then a molecule gets new momenta.

    Each molecule is hit independently, after `time_constant` on average. Total momentum is not conserved.
    """

    thermal_energy: Ramp  # kB T, u Å²/ps²
    time_constant: float  # ps
    key: Key


class NoseHoover(NamedTuple):
    """Two Nose-Hoover chains, one of translation and one of rotation, on two halves of `state.extra_variables`.

    Each half is eta (links,), then d eta/dt (links,). With masses Q_1 = g kT tau²/(2 pi)² and Q_j = kT tau²/(2 pi)² the
    kinetic energy of each swings with the period tau. Conserved: the energy of molecules and of both chains,
    sum Q_j v_j²/2 + g kT eta_1 + kT sum of the other eta (Martyna, Tuckerman, Tobias & Klein 1996, Mol. Phys. 87,
    1117); what a chain gains is what `energy_ledger[HEAT]` loses. A flow is solved by the factors of Suzuki and Yoshida.
    """

    thermal_energy: Ramp  # kB T, u Å²/ps²
    period: float  # ps
    links: int  # of each chain
    freedom_translation: int
    freedom_rotation: int

    @property
    def variables(self) -> int:
        """Numbers in `state.extra_variables`."""
        return 4 * self.links


def thermostat_workspace() -> np.ndarray:
    """Room (MOST_BLOCKS, 2) for energies of each block of molecules."""
    return np.zeros((MOST_BLOCKS, 2))


def thermostat_code(thermostat: NamedTuple, model: NamedTuple) -> dict[str, tuple]:
    """The tasks of a thermostat that act on molecules in blocks, see `compile.Code`; none of others."""
    state, workspace = EXAMPLE[0], thermostat_workspace()
    if isinstance(thermostat, Langevin | Andersen):
        return {
            "molecules": (
                _apply_langevin if isinstance(thermostat, Langevin) else _apply_andersen,
                (thermostat, model, state, workspace, 0.0, 0),
            )
        }
    if isinstance(thermostat, VelocityRescaling | NoseHoover):
        return {
            "kinetic_energies": (_compute_kinetic_energies, (model, state, workspace)),
            "scale": (_scale, (state, 0.0, 0.0)),
        }
    return {}


def apply_thermostat(thermostat, model, code, state, workspace, h, draw):
    """The flow of a thermostat over a time h (ps), in place; `draw` is its first draw in this step; workspace: see `thermostat_workspace`."""
    raise TypeError("compiled code only")


@implements(apply_thermostat, NoThermostat)
def _apply_none(thermostat, model, code, state, workspace, h, draw):
    return None


@implements(apply_thermostat, VelocityRescaling)
def _apply_rescaling(thermostat, model, code, state, workspace, h, draw):
    if thermostat.time_constant == inf:
        return
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    kinetic = moving + turning
    freedom = thermostat.degrees_of_freedom
    if kinetic == 0.0 or freedom == 0:
        return
    # eq. A7, with one Gaussian apart and the sum of the squares of the others at once
    c = exp(-h / thermostat.time_constant)
    share = 0.5 * ramp_value(thermostat.thermal_energy, state) * (1 - c) / kinetic
    gauss, _ = normals(thermostat.key, draw, 0, state.step[NOW])
    others = chi_square(thermostat.key, draw + 1, 0, state.step[NOW], freedom - 1)
    scale2 = c + share * (gauss * gauss + others) + 2 * gauss * sqrt(c * share)
    state.energy_ledger[HEAT] += (scale2 - 1) * kinetic
    scale_momenta(code, state, sqrt(scale2), sqrt(scale2))


@implements(apply_thermostat, (Langevin, Andersen))
def _apply_by_molecule(thermostat, model, code, state, workspace, h, draw):
    blocks = blocks_of(len(state.velocity))
    call_blocks(code, "molecules", pack_arguments((thermostat, model, state, workspace, h, draw)), blocks)
    for block in range(blocks):
        state.energy_ledger[HEAT] += workspace[block, 0]


@task()
def _apply_langevin(arguments, block):
    """Langevin's friction and noise for the molecules of a block; their heat into workspace[block, 0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    align_stack()
    first, end = molecules_of_block(len(state.velocity), block, LANES)
    thermal = ramp_value(thermostat.thermal_energy, state)
    passed, turned = thermostat.friction_translation * h, thermostat.friction_rotation * h
    keep, keep_turning = exp(-passed), exp(-turned)
    new = thermal_momenta(model, -thermal * expm1(-2 * passed), -thermal * expm1(-2 * turned))
    words, numbers = np.empty((2, 4, BATCH), np.uint64), np.empty(6 * BATCH)
    heat = 0.0
    for start in range(first, end, BATCH):
        fill_normals(numbers, words, thermostat.key, draw, start, state.step[NOW])
        heat += apply_langevin_group(model, state, keep, keep_turning, new, numbers, start, min(end, start + BATCH))
    workspace[block, 0] = heat


@task()
def _apply_andersen(arguments, block):
    """Andersen's collisions with the molecules of a block; their heat into workspace[block, 0]."""
    thermostat, model, state, workspace, h, draw = load_arguments(arguments)
    velocity, momentum = state.velocity, state.angular_momentum_body
    first, end = molecules_of_block(len(velocity), block, LANES)
    step, missed = state.step[NOW], exp(-h / thermostat.time_constant)
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
def thermal_momenta(model, moving, turning):
    """Sizes (species, 4) of the angular momenta along the axes of a body, and of a component of its velocity, at
    thermal energies of both motions."""
    sizes = np.empty((len(model.mass), 4))
    for kind in range(len(model.mass)):
        for k in range(3):
            sizes[kind, k] = sqrt(turning * model.inertia[kind, k])
        sizes[kind, 3] = sqrt(moving * model.inverse_mass[kind])
    return sizes


#: Fractions of a flow of the chains, Suzuki & Yoshida.
YOSHIDA = (1 / (2 - 2 ** (1 / 3)), 1 - 2 / (2 - 2 ** (1 / 3)), 1 / (2 - 2 ** (1 / 3)))


@implements(apply_thermostat, NoseHoover)
def _apply_nose_hoover(thermostat, model, code, state, workspace, h, draw):
    thermal = ramp_value(thermostat.thermal_energy, state)
    half = 2 * thermostat.links
    moving, turning = kinetic_energies_of(model, code, state, workspace)
    scale, heat = move_chain(
        thermostat, state.extra_variables[:half], thermal, moving, thermostat.freedom_translation, h
    )
    scale_turning, heat_turning = move_chain(
        thermostat, state.extra_variables[half:], thermal, turning, thermostat.freedom_rotation, h
    )
    scale_momenta(code, state, scale, scale_turning)
    state.energy_ledger[HEAT] += heat + heat_turning


@kernel
def move_chain(thermostat, chain, thermal, kinetic, freedom, h):
    """Move a chain over h, in place: by which factor momenta scale, and what the chain has lost (u Å²/ps²)."""
    if freedom == 0:
        return 1.0, 0.0
    links = thermostat.links
    eta, rate = chain[:links], chain[links:]
    before = chain_energy(thermostat, chain, thermal, freedom)
    scale = 1.0
    for share in YOSHIDA:
        d = share * h
        _kick_links(thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, links - 1, -1, -1)
        scale *= exp(-d * rate[0])
        for j in range(links):
            eta[j] += d * rate[j]
        _kick_links(thermostat, rate, thermal, 2 * scale * scale * kinetic, freedom, d, 0, links, 1)
    return scale, before - chain_energy(thermostat, chain, thermal, freedom)


@kernel
def _kick_links(thermostat, rate, thermal, twice_kinetic, freedom, d, first, end, by):
    """Half a step of the rates of the links, from the last link to the first or back."""
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


# Sums over all molecules on one thread: for boxes, and for thermostats of one's own, which have no tasks.


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
    return kinetic_energies(model.species, model.mass, model.inverse_inertia, velocity, momentum, first, end)


@kernel
def kinetic_energies_of(model, code, state, workspace):
    """Translational and rotational kinetic energy of all molecules (u Å²/ps²), by blocks and in their order."""
    blocks = blocks_of(len(state.velocity))
    call_blocks(code, "kinetic_energies", pack_arguments((model, state, workspace)), blocks)
    moving = turning = 0.0
    for block in range(blocks):
        moving += workspace[block, 0]
        turning += workspace[block, 1]
    return moving, turning


@kernel
def scale_momenta(code, state, scale, scale_turning):
    """Multiply velocities and angular momenta by a number each, in place."""
    call_blocks(code, "scale", pack_arguments((state, scale, scale_turning)), blocks_of(len(state.velocity)))


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
