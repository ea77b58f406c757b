"""Rows of a step of molecules: forces, kicks and drifts, work, removal of momentum."""

from collections.abc import Sequence
from typing import NamedTuple

from rigidmd.compile import Pass, call_row, implements, kernel, load_arguments, task
from rigidmd.core.integrators import Flow
from rigidmd.core.state import NOW, OK, ORIGIN, REMOVED, WORK
from rigidmd.dynamics.force_gradient import add_gyration, displace, evaluate
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import power_and_squares
from rigidmd.dynamics.step_parts import EVERY, WATCHED, StepParts
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.forces.terms import (
    FORCES_ONLY,
    INTO_OTHER_LOAD,
    WITH_ENERGIES,
    WITH_VIRIALS,
    compute_load,
    total_energy_rate,
)
from rigidmd.mechanics.batches import LANES, kick_group, rotate_group
from rigidmd.mechanics.free_rotor import restore_orthogonality, rotate_by_vector

#: Number of molecules that are kicked, moved and rotated together: few enough to stay in a core's
#: cache.
CACHE_GROUP = 32 * LANES
#: What an evaluation of forces computes -> what is known then, and its name.
COMPUTED = {
    FORCES_ONLY: (FORCES_ONLY, "forces"),
    WITH_VIRIALS: (FORCES_ONLY | WITH_VIRIALS, "forces and virials"),
    WITH_ENERGIES: (FORCES_ONLY | WITH_VIRIALS | WITH_ENERGIES, "forces, energies and virials"),
}


class Evaluation(NamedTuple):
    """A row of forces."""

    which: int  # what it computes: FORCES_ONLY, WITH_VIRIALS or WITH_ENERGIES
    enough: int  # bits of `Registers.known`: it does nothing if one of them is set
    known: int  # what is known after it


def forces_row(parts: StepParts, which: int, when: int, enough: int = 0) -> Pass:
    """Forces at the current positions, unless they are known.

    which : FORCES_ONLY, WITH_VIRIALS or WITH_ENERGIES
    enough : bits of `Registers.known` that make it needless, in addition to `which`
    """
    known, text = COMPUTED[which]
    content = parts.core, Evaluation(which, which | enough, known)
    return Pass(text, _compute_forces, content, when=when)


def is_forces_row(row: Pass) -> bool:
    """Whether a row runs the passes of the terms."""
    return row.task in (_compute_forces, _compute_gradient)


@task()
def _compute_forces(arguments, block):
    core, row = load_arguments(arguments)
    known, status = core.registers.known, core.status
    if known[0] & row.enough != 0:
        return
    known[0] = 0
    status[0] = compute_load(core.terms, core.state, core.load, row.which)
    if status[0] != OK and is_recovered(core):
        status[0] = compute_load(core.terms, core.state, core.load, row.which)
    if status[0] == OK:
        known[0] = row.known


@kernel
def is_recovered(core):
    """Run the rows after forces that failed. Returns whether the failure is none of the run."""
    for k in range(len(core.recovery.address)):
        call_row(core.recovery, core.recovery.arguments, k)
    return core.status[0] == OK


def gradient_row(parts: StepParts, flow: Flow) -> Pass:
    """Forces with their gradient for a kick, unless they are known."""
    content = parts.core, parts.gradient, flow.gradient
    text = f"gradient of the forces, {flow.gradient:.4g} dt²"
    return Pass(text, _compute_gradient, content, when=EVERY)


@task()
def _compute_gradient(arguments, block):
    core, gradient, fraction = load_arguments(arguments)
    dt, known, status = core.registers.dt[0], core.registers.known, core.status
    tau = fraction * dt * dt
    if known[0] & INTO_OTHER_LOAD != 0 and gradient.tau[0] == tau:
        return
    status[0] = evaluate(core.model, core.state, core.load, core.terms, gradient, tau, known=True)
    if status[0] == OK:
        known[0] |= INTO_OTHER_LOAD
    else:
        is_recovered(core)


class Move(NamedTuple):
    """Kicks, then a drift."""

    kicks: tuple[float, float]  # fractions of the time step; 0: none
    drift: float  # likewise
    moment: float  # the time after the drift, from the start of the step, in time steps


def move_row(
    parts: StepParts,
    kicks: Sequence[Flow],
    drift: Flow | None,
    moment: float,
    when: int,
) -> Pass:
    """At most two kicks by the same forces, then a drift, if there is one: each group of molecules
    passes through a core's cache once."""
    fractions = [flow.fraction for flow in kicks]
    first, second, *_ = (*fractions, 0.0, 0.0)
    has_gradient = any(flow.gradient for flow in kicks)
    load = parts.gradient.load if has_gradient and parts.gradient is not None else parts.core.load
    move = Move((first, second), 0.0 if drift is None else drift.fraction, moment)
    texts = [f"kick {flow.fraction:.4g} dt" for flow in kicks]
    texts += [] if drift is None else [f"drift {drift.fraction:.4g} dt"]
    blocks = blocks_of(len(parts.core.state.position))
    return Pass(", ".join(texts), _move, (parts.core, load, move), blocks, when)


@task()
def _move(arguments, block):
    """Kicks: V += h F/m, L += h n_body, the exact flow of the potential. Then, if there is a drift,
    free flight and free rotation."""
    core, load, move = load_arguments(arguments)
    model, state, registers = core.model, core.state, core.registers
    if block == 0 and move.drift != 0.0:
        steps = state.step[NOW] - state.step[ORIGIN] + move.moment
        state.time[NOW] = state.time[ORIGIN] + steps * registers.dt[0]
        registers.known[0] = 0
    dt = 0.0 if registers.resting[0] != 0 else registers.dt[0]
    h = move.drift * dt
    species, inverse_mass, inverse_inertia = (
        model.species,
        model.inverse_mass,
        model.inverse_inertia,
    )
    first, end = molecules_of_block(len(state.position), block, LANES)
    for start in range(first, end, CACHE_GROUP):
        stop = min(end, start + CACHE_GROUP)
        for fraction in move.kicks:
            kick = fraction * dt
            if kick != 0.0:
                kick_group(species, inverse_mass, inverse_inertia, state, load, start, stop, kick)
        if move.drift != 0.0:
            for m in range(start, stop):
                for k in range(3):
                    state.position[m, k] += h * state.velocity[m, k]
            rotate_group(
                model.rotor, species, state.rotation, state.angular_momentum_body, start, stop, h
            )


def orthogonality_row(parts: StepParts, when: int) -> Pass:
    """Correct the rounding errors of QᵀQ."""
    content = (parts.core.state,)
    return Pass("orthogonality of rotations", _restore_orthogonality, content, when=when)


@task()
def _restore_orthogonality(arguments, block):
    (state,) = load_arguments(arguments)
    restore_orthogonality(state.rotation, state.angular_momentum_body)


def work_row(parts: StepParts, flow: Flow) -> Pass:
    """The work of time-dependent terms during a kick."""
    content = parts.core, flow.fraction
    return Pass("work of time-dependent fields", _add_work, content, when=EVERY)


@task()
def _add_work(arguments, block):
    core, fraction = load_arguments(arguments)
    h = 0.0 if core.registers.resting[0] != 0 else fraction * core.registers.dt[0]
    work = 0.5 * h * total_energy_rate(core.terms)  # before the kick and after it
    core.state.energy_ledger[WORK] += work
    core.state.energy_ledger[WORK] += work


def power_row(parts: StepParts) -> Pass:
    """Power and squares of the forces before the last step, from which the curvature follows."""
    return Pass("power of the forces", _keep_power, (parts.core,), when=WATCHED)


@task()
def _keep_power(arguments, block):
    (core,) = load_arguments(arguments)
    before = core.registers.before
    before[0], before[1] = power_and_squares(core.model, core.state, core.load)


def removal_row(parts: StepParts, when: int) -> Pass:
    """Remove the conserved components of the total momentum."""
    content = parts.core.model, parts.core.state
    return Pass("removal of the total momentum", _remove_momentum, content, when=when)


@task()
def _remove_momentum(arguments, block):
    """Remove the conserved components of the total momentum, in place: the same velocity from all
    molecules. The energy that this removes is entered in the energy ledger."""
    model, state = load_arguments(arguments)
    mass = 0.0
    px = 0.0
    py = 0.0
    pz = 0.0
    for m in range(len(state.velocity)):
        m_i = model.mass[model.species[m]]
        mass += m_i
        px += m_i * state.velocity[m, 0]
        py += m_i * state.velocity[m, 1]
        pz += m_i * state.velocity[m, 2]
    kept = model.keeps_momentum
    px, py, pz = kept[0] * px, kept[1] * py, kept[2] * pz
    for m in range(len(state.velocity)):
        state.velocity[m, 0] -= px / mass
        state.velocity[m, 1] -= py / mass
        state.velocity[m, 2] -= pz / mass
    state.energy_ledger[REMOVED] -= (px * px + py * py + pz * pz) / (2 * mass)


@implements(displace, Model)
def _displace_molecules(model, state, load, tau):
    for m in range(len(state.position)):
        tau_per_mass = tau * model.inverse_mass[model.species[m]]
        for k in range(3):
            state.position[m, k] += tau_per_mass * load.force[m, k]
    for m in range(len(state.rotation)):
        inverse = model.inverse_inertia[model.species[m]]
        n = load.torque_body[m]
        rotate_by_vector(
            state.rotation[m],
            tau * inverse[0] * n[0],
            tau * inverse[1] * n[1],
            tau * inverse[2] * n[2],
        )


@implements(add_gyration, Model)
def _add_gyration_of_molecules(model, load, tau, gain):
    for m in range(len(load.torque_body)):
        inverse = model.inverse_inertia[model.species[m]]
        n = load.torque_body[m]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            gain.torque_body[m, k] += tau * (inverse[i] - inverse[j]) * n[i] * n[j]
