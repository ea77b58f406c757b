"""The compiled loop over steps, for any sequence of flows, any force terms, any thermostat and any barostat."""

# isort: skip_file
from typing import NamedTuple

import numpy as np

from rigidmd.compile import (
    BoundTask, Code, call_blocks, chosen_by_type, implements, is_a, kernel, load_arguments, pack_arguments, task,
)  # fmt: skip
from rigidmd.core.integrators import (
    BAROSTAT, BEGIN_TRAJECTORY, DRIFT, END_TRAJECTORY, KICK, SCALE_BOX, THERMOSTAT, Scheme,
)  # fmt: skip
from rigidmd.core.state import EXAMPLE, NOW, OK, ORIGIN, REMOVED, WORK
from rigidmd.dynamics.barostats import apply_barostat, compute_step_load, scale_box
from rigidmd.dynamics.force_gradient import add_gyration, displace, evaluate
from rigidmd.dynamics.hybrid_monte_carlo import (
    know_potential, rest_if_diverged, start_or_test_trajectory, time_moved,
)  # fmt: skip
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import SUM_COUNT, LargestValues, StateSums, fill_sums, find_largest, unpack_sums
from rigidmd.dynamics.thermostats import apply_thermostat, thermostat_code
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES, total_energy_rate
from rigidmd.mechanics.batches import LANES, kick_group, rotate_group
from rigidmd.mechanics.free_rotor import restore_orthogonality, rotate_by_vector

#: Random numbers that a flow may draw for one molecule in a step.
DRAWS = 1 << 20
#: The times of two pending kicks by the present load; 0 stands for no kick.
NO_PENDING_KICKS = (0.0, 0.0)
#: Steps between two corrections of the rounding errors of QᵀQ. They would grow, and with them the error of the total
#: torque: a step of two waters had one of 5e-14 of the forces after 1e3 steps and 1e-12 after 5e5 steps, and their
#: angular momentum drifted faster than a random walk.
ORTHOGONALITY_INTERVAL = 256
#: Number of molecules that are kicked, moved and rotated together: few enough to stay in a core's cache.
CACHE_GROUP = 32 * LANES


def molecule_code(model: NamedTuple, thermostat: tuple) -> Code | None:
    """The machine code that moves molecules; None of a single body, whose flows are compiled into the loop."""
    if not isinstance(model, Model):
        return None
    state, load = EXAMPLE
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    move = (_move, (*bodies, state, load, NO_PENDING_KICKS, 0.0, False))
    return Code(move=move, **thermostat_code(thermostat, model))


class FlowArrays(NamedTuple):
    """The flows of a scheme as arrays, in their order."""

    kind: np.ndarray  # (flows,) KICK, DRIFT, ..., see core.integrators
    fraction: np.ndarray  # (flows,) of the time step
    moment: np.ndarray  # (flows,) the sum of the fractions of the drifts up to each flow
    every: np.ndarray  # (flows,) the interval in steps at which the flow acts,
    phase: np.ndarray  # (flows,) at its begin, 0, or at its end, 1
    gradient: np.ndarray | None  # (flows,) of dt²; None (not compiled) where no kick has a gradient
    last: int  # index of the last drift
    trajectory: int  # steps of a trajectory of hybrid Monte Carlo, or 0


def flow_arrays(scheme: Scheme) -> FlowArrays:
    kind = np.array([flow.kind for flow in scheme.flows])
    fraction = np.array([flow.fraction for flow in scheme.flows])
    moment = np.cumsum(np.where(kind == DRIFT, fraction, 0.0))
    last = int(np.flatnonzero(kind == DRIFT)[-1])
    moment[last:] = 1.0
    gradient = np.array([flow.gradient for flow in scheme.flows]) if scheme.has_gradient else None
    every, phase = (np.array([getattr(flow, name) for flow in scheme.flows]) for name in ("every", "phase"))
    return FlowArrays(kind, fraction, moment, every, phase, gradient, last, scheme.trajectory_steps)


@kernel
def advance(
    model, code, state, load, terms, thermostat, barostat, flows, gradient_workspace, thermostat_workspace,
    barostat_workspace, trajectory_workspace, dt, until, observed, progress
):  # fmt: skip
    """Take steps of dt until state.step is `until`. Returns a status code.

    code : see `molecule_code`
    terms : the workspaces of a body, or the `TermTable` of molecules
    flows : see `FlowArrays`. gradient_workspace : None compiles no kicks with gradients
    observed : whether energies and virials are computed with the last forces, if a kick needs these
    progress (3,) : flows done in this step; whether `load` belongs to the present positions (1), with the gradient
        added (2); whether a barostat move has been made and is not yet accepted or rejected

    Forces are evaluated before a kick if positions have changed since, so the last evaluation of a step serves the next
    step. Kicks of molecules are pending until the next drift: the last kick of a step and the first of the next are
    done in one pass with the drift. If the status is not OK, state and progress are such that another call continues
    exactly where this one stopped.
    """
    pending = NO_PENDING_KICKS
    while state.step[NOW] < until:
        while progress[0] < len(flows.kind):
            k = progress[0]
            h = flows.fraction[k] * dt
            if flows.kind[k] == KICK:
                if gradient_workspace is None:
                    while progress[1] == 0:
                        now = state.step[NOW] + 1
                        needed = (observed and now == until) or is_tested(flows, now - state.step[ORIGIN])
                        which = WITH_ENERGIES if needed and k > flows.last else FORCES_ONLY
                        status = compute_step_load(barostat, terms, state, load, barostat_workspace, flows, which)
                        progress[1] = 1 if status == OK else 0
                        status = rest_if_diverged(trajectory_workspace, state, load, progress, status)
                        if status != OK:
                            return status
                else:
                    while progress[1] < (1 if flows.gradient[k] == 0.0 else 2):
                        pending = apply_pending_kicks(model, code, state, load, pending)
                        tau, known = flows.gradient[k] * dt * dt, progress[1] == 1
                        status = evaluate(model, state, load, terms, gradient_workspace, tau, known)
                        progress[1] += status == OK
                        status = rest_if_diverged(trajectory_workspace, state, load, progress, status)
                        if status != OK:
                            return status
                h = time_moved(trajectory_workspace, h)
                accumulate_work(model, terms, state, 0.5 * h)
                pending = kick(model, code, state, load, pending, h)
                accumulate_work(model, terms, state, 0.5 * h)
            elif flows.kind[k] == DRIFT:
                drift(model, code, state, load, pending, time_moved(trajectory_workspace, h))
                pending = NO_PENDING_KICKS
                state.time[NOW] = state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN] + flows.moment[k]) * dt
                progress[1] = 0
                if k == flows.last and (state.step[NOW] + 1) % ORTHOGONALITY_INTERVAL == 0:
                    restore_orthogonality(state.rotation, state.angular_momentum_body)
            elif (state.step[NOW] - state.step[ORIGIN] + flows.phase[k]) % flows.every[k] == 0:
                pending = apply_pending_kicks(model, code, state, load, pending)
                if flows.kind[k] == THERMOSTAT:
                    apply_thermostat(thermostat, model, code, state, thermostat_workspace, h, DRAWS * k)
                elif flows.kind[k] == BAROSTAT:
                    status = apply_barostat(
                        barostat, model, terms, state, load, barostat_workspace, progress, h, DRAWS * k
                    )
                    if status != OK:
                        return status
                    know_potential(thermostat, trajectory_workspace, barostat_workspace)
                elif flows.kind[k] == BEGIN_TRAJECTORY or flows.kind[k] == END_TRAJECTORY:
                    starts = flows.kind[k] == BEGIN_TRAJECTORY
                    status = start_or_test_trajectory(
                        thermostat, model, code, terms, state, load, thermostat_workspace, trajectory_workspace,
                        barostat_workspace, progress, starts, DRAWS * k
                    )  # fmt: skip
                    if status != OK:
                        return status
                elif flows.kind[k] == SCALE_BOX:
                    scale_box(barostat, state, h)
                    progress[1] = 0
                else:
                    remove_momentum_flow(model, state)
            progress[0] += 1
        progress[0] = 0
        state.step[NOW] += 1
    apply_pending_kicks(model, code, state, load, pending)
    return OK


@kernel(inline=True)
def is_tested(flows, step):
    """Whether a trajectory of hybrid Monte Carlo ends with a step of the segment, counted from 1."""
    return flows.trajectory > 0 and step % flows.trajectory == 0


#: Indices of `Advance._integers`: `until` and `observed` of `advance`, its status, and the three numbers of `progress`.
UNTIL, OBSERVED, STATUS, PROGRESS = 0, 1, 2, 3


class Advance:
    """`advance` of molecules, for Python: bound to all of its arguments but dt, `until`, `observed` and `progress`. At
    the end it also sums over the state and its load, while these are in the caches of the cores."""

    def __init__(self, *arguments):
        self._dt, self._integers = np.zeros(1), np.zeros(PROGRESS + 3, np.int64)
        self._extent, self._sums = np.zeros(len(LargestValues._fields)), np.zeros(SUM_COUNT)
        self._call = BoundTask(_advance, (arguments, self._dt, self._integers, self._extent, self._sums))

    def begin(self, dt: float, until: int, observed: bool, loaded: bool) -> None:
        """Set what the next calls do. loaded : whether the load belongs to the present positions"""
        self._dt[0] = dt
        self._integers[:] = until, observed, OK, 0, loaded, 0

    def __call__(self) -> int:
        """Start or continue; a status code."""
        self._call()
        return int(self._integers[STATUS])

    @property
    def loaded(self) -> bool:
        """Whether the load belongs to the present positions."""
        return self._integers[PROGRESS + 1] != 0

    @property
    def extent(self) -> LargestValues:
        """The largest values of the state, and of the load as last computed."""
        return LargestValues(*self._extent.tolist())

    @property
    def sums(self) -> StateSums | None:
        """The sums over the state and its load; None if the last call was not `observed`."""
        return unpack_sums(self._sums) if self._integers[OBSERVED] else None


@kernel(from_python=True)
def advance_body(*arguments):
    """`advance` of a body, for Python."""
    return advance(*arguments)


@task()
def _advance(arguments, block):
    bound, dt, integers, extent, sums = load_arguments(arguments)
    model, _, state, load = bound[:4]
    integers[STATUS] = advance(*bound, dt[0], integers[UNTIL], integers[OBSERVED] != 0, integers[PROGRESS:])
    if integers[STATUS] == OK:
        find_largest(
            state.position.ravel(), state.velocity.ravel(), state.rotation.ravel(),
            state.angular_momentum_body.ravel(), load.force.ravel(), load.torque_body.ravel(), extent
        )  # fmt: skip
        if integers[OBSERVED] != 0:
            fill_sums(
                model.species, model.mass, model.inverse_mass, model.inverse_inertia, state.velocity, state.rotation,
                state.angular_momentum_body, load.force, load.torque_body, sums
            )  # fmt: skip


def kick(model, code, state, load, pending, h):
    """Exact flow of the potential, in place: V += h F/m, L += h n_body. Returns the pending kicks. A body is kicked at
    once. The kick of a molecule is added to the pending kicks."""
    raise TypeError("compiled code only")


def drift(model, code, state, load, pending, h):
    """The pending kicks, then the flow of the kinetic energy, in place: free flight and free rotation."""
    raise TypeError("compiled code only")


@chosen_by_type
def remove_momentum_flow(model, state):
    """Remove the conserved components of the total momentum, in place: the same velocity from all molecules. The energy
    that this removes is entered in the energy ledger."""
    if not is_a(model, Model):
        return lambda model, state: None

    def remove_momentum_of_molecules(model, state):
        mass, px, py, pz = 0.0, 0.0, 0.0, 0.0
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

    return remove_momentum_of_molecules


@implements(kick, Model)
def _kick_molecules(model, code, state, load, pending, h):
    if pending[0] == 0.0:
        return h, 0.0
    if pending[1] == 0.0:
        return pending[0], h
    apply_pending_kicks(model, code, state, load, pending)
    return h, 0.0


@implements(drift, Model)
def _drift_molecules(model, code, state, load, pending, h):
    _move_all(model, code, state, load, pending, h, True)


@chosen_by_type
def apply_pending_kicks(model, code, state, load, pending):
    """Do the pending kicks, in place. Returns NO_PENDING_KICKS."""
    if not is_a(model, Model):
        return lambda model, code, state, load, pending: pending

    def apply_pending_kicks_of_molecules(model, code, state, load, pending):
        if pending[0] != 0.0:
            _move_all(model, code, state, load, pending, 0.0, False)
        return NO_PENDING_KICKS

    return apply_pending_kicks_of_molecules


@implements(displace, Model)
def _displace_molecules(model, state, load, tau):
    for m in range(len(state.position)):
        tau_per_mass = tau * model.inverse_mass[model.species[m]]
        for k in range(3):
            state.position[m, k] += tau_per_mass * load.force[m, k]
    for m in range(len(state.rotation)):
        inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
        rotate_by_vector(state.rotation[m], tau * inverse[0] * n[0], tau * inverse[1] * n[1], tau * inverse[2] * n[2])


@implements(add_gyration, Model)
def _add_gyration_of_molecules(model, load, tau, gain):
    for m in range(len(load.torque_body)):
        inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            gain.torque_body[m, k] += tau * (inverse[i] - inverse[j]) * n[i] * n[j]


@chosen_by_type
def accumulate_work(model, terms, state, h):
    """Add the work of time-dependent terms over h to the energy ledger; half before a kick, half after it. The work on
    a body is the power of its terms at the present velocity. The work on molecules is the rate at which their potential
    energy changes at fixed positions."""
    if not is_a(model, Model):
        return None

    def accumulate_work_of_molecules(model, terms, state, h):
        state.energy_ledger[WORK] += h * total_energy_rate(terms)

    return accumulate_work_of_molecules


@kernel
def _move_all(model, code, state, load, pending, h, drifts):
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    arguments = pack_arguments((*bodies, state, load, pending, h, drifts))
    call_blocks(code, "move", arguments, blocks_of(len(state.position)))


@task()
def _move(arguments, block):
    """The pending kicks; then, if there is a drift, free flight and free rotation."""
    rotor, species, inverse_mass, inverse_inertia, state, load, pending, h, drifts = load_arguments(arguments)
    first, end = molecules_of_block(len(state.position), block, LANES)
    for start in range(first, end, CACHE_GROUP):
        stop = min(end, start + CACHE_GROUP)
        for kick in pending:
            if kick != 0.0:
                kick_group(species, inverse_mass, inverse_inertia, state, load, start, stop, kick)
        if drifts:
            for m in range(start, stop):
                for k in range(3):
                    state.position[m, k] += h * state.velocity[m, k]
            rotate_group(rotor, species, state.rotation, state.angular_momentum_body, start, stop, h)
