"""The compiled loop over steps of molecules, for any sequence of flows, any forces, any thermostat
and any barostat.

The loop is compiled once: forces, thermostat, barostat and trajectories are passes, which it calls
by address.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import (
    ALWAYS,
    BoundTask,
    Code,
    Pass,
    Program,
    call_blocks,
    implements,
    kernel,
    load_arguments,
    pack_arguments,
    run_row,
    task,
)
from rigidmd.core.integrators import (
    BAROSTAT,
    DRIFT,
    KICK,
    REMOVE_MOMENTUM,
    THERMOSTAT,
    Scheme,
)
from rigidmd.core.state import EXAMPLE, NOW, OK, ORIGIN, REMOVED, WORK, Load, State
from rigidmd.dynamics.barostats import (
    BarostatWorkspace,
    barostat_passes,
    compute_step_load,
    needed_tallies,
)
from rigidmd.dynamics.flows import ORTHOGONALITY_INTERVAL, flow_arrays
from rigidmd.dynamics.force_gradient import (
    GradientWorkspace,
    add_gyration,
    displace,
    evaluate,
    load_of_kick,
    needs_forces,
)
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import (
    SUM_COUNT,
    LargestValues,
    StateSums,
    fill_sums,
    find_largest,
    unpack_sums,
)
from rigidmd.dynamics.registers import (
    AFTER_BAROSTAT,
    DONE,
    FAILED,
    LOADED,
    Registers,
    begin_call,
    new_registers,
)
from rigidmd.dynamics.thermostats import thermostat_code, thermostat_pass
from rigidmd.features.monte_carlo.trajectories import TrajectoryWorkspace, trajectory_passes
from rigidmd.forces.neighbors.sites import blocks_of, molecules_of_block
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES, TermTable, total_energy_rate
from rigidmd.mechanics.batches import LANES, kick_group, rotate_group
from rigidmd.mechanics.free_rotor import restore_orthogonality, rotate_by_vector

#: Random numbers that a flow may draw for one molecule in a step.
DRAWS = 1 << 20
#: The times of two pending kicks by the current load; 0 stands for no kick.
NO_PENDING_KICKS = (0.0, 0.0)
#: Number of molecules that are kicked, moved and rotated together: few enough to stay in a core's
#: cache.
CACHE_GROUP = 32 * LANES


def move_code(model: Model) -> Code:
    """The machine code of kicks and drifts of molecules."""
    state, load = EXAMPLE
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    return Code(move=(_move, (*bodies, state, load, NO_PENDING_KICKS, 0.0, False)))


class CouplingWorkspaces(NamedTuple):
    """What the flows of a scheme besides kicks and drifts remember. None of what it has not."""

    heat: np.ndarray  # see `thermostat_workspace`
    box: BarostatWorkspace | None
    trajectory: TrajectoryWorkspace | None


def coupling_passes(
    scheme: Scheme,
    model: Model,
    terms: TermTable,
    state: State,
    load: Load,
    workspaces: CouplingWorkspaces,
    registers: Registers,
    status: np.ndarray,
) -> dict[int, Pass]:
    """Kind of a flow of a scheme -> its pass, for all flows in addition to kicks and drifts."""
    heat, box, trajectory = workspaces
    kinds = {flow.kind for flow in scheme.flows}
    thermostat, barostat = scheme.thermostat, scheme.barostat
    code = thermostat_code(thermostat, model)
    passes = {REMOVE_MOMENTUM: Pass("removal of momentum", _remove_momentum, (model, state))}
    if thermostat is not None:
        passes[THERMOSTAT] = thermostat_pass(thermostat, model, code, state, heat, registers)
    if box is not None:
        passes |= barostat_passes(barostat, model, terms, state, load, box, registers, status)
    if trajectory is not None:
        kinds |= {FAILED} | ({AFTER_BAROSTAT} if box is not None else set())
        passes |= trajectory_passes(
            thermostat, model, code, terms, state, load, heat, trajectory, registers, status
        )
    return {kind: one for kind, one in passes.items() if kind in kinds}


@kernel
def advance(
    model,
    code,
    state,
    load,
    terms,
    couplings,
    flows,
    registers,
    gradient_workspace,
    dt,
    until,
    observed,
):
    """Take steps of dt of molecules until state.step is `until`. Returns a status code.

    code : see `move_code`
    terms : `TermTable`; couplings : `Rows` of thermostat, barostat and trajectories; flows : see
        `FlowArrays`
    gradient_workspace : None compiles no kicks with gradients
    observed : whether energies and virials are computed with the last forces, if a kick needs these

    Forces are evaluated before a kick if positions have changed since, so the last evaluation of a
    step serves the next step. Kicks are pending until the next drift: the last kick of a step and
    the first of the next are done in one pass with the drift. If the status is not OK, state and
    registers are such that another call continues exactly where this one stopped.
    """
    pending, pushing = NO_PENDING_KICKS, load
    progress = registers.progress
    while state.step[NOW] < until:
        while progress[DONE] < len(flows.kind):
            k = progress[DONE]
            h = flows.fraction[k] * dt
            moved = 0.0 if registers.resting[0] != 0 else h
            if flows.kind[k] == KICK:
                tau = 0.0
                if gradient_workspace is not None:
                    pending = apply_pending_kicks(model, code, state, pushing, pending)
                    tau = flows.gradient[k] * dt * dt
                while needs_forces(progress, gradient_workspace, tau):
                    if progress[LOADED] == 0:
                        now = state.step[NOW] + 1
                        needed = (observed and now == until) or is_tested(
                            flows, now - state.step[ORIGIN]
                        )
                        which = WITH_ENERGIES if needed and k > flows.last else FORCES_ONLY
                        status = compute_step_load(terms, state, load, registers, flows, which)
                        progress[LOADED] = 1 if status == OK else 0
                    elif gradient_workspace is not None:
                        status = evaluate(model, state, load, terms, gradient_workspace, tau, True)
                        progress[LOADED] = 2 if status == OK else 1
                    status = after_forces(couplings, flows, registers, status)
                    if status != OK:
                        return status
                pushing = load_of_kick(load, gradient_workspace, tau)
                moved = 0.0 if registers.resting[0] != 0 else h
                state.energy_ledger[WORK] += 0.5 * moved * total_energy_rate(terms)
                pending = kick(model, code, state, pushing, pending, moved)
                state.energy_ledger[WORK] += 0.5 * moved * total_energy_rate(terms)
            elif flows.kind[k] == DRIFT:
                _move_all(model, code, state, pushing, pending, moved, True)
                pending = NO_PENDING_KICKS
                state.time[NOW] = (
                    state.time[ORIGIN]
                    + (state.step[NOW] - state.step[ORIGIN] + flows.moment[k]) * dt
                )
                progress[LOADED] = 0
                if k == flows.last and (state.step[NOW] + 1) % ORTHOGONALITY_INTERVAL == 0:
                    restore_orthogonality(state.rotation, state.angular_momentum_body)
            elif (state.step[NOW] - state.step[ORIGIN] + flows.phase[k]) % flows.every[k] == 0:
                pending = apply_pending_kicks(model, code, state, pushing, pending)
                registers.h[0], registers.draw[0] = h, DRAWS * k
                status = run_row(couplings, flows.row[k])
                if status == OK and flows.kind[k] == BAROSTAT and flows.after_barostat >= 0:
                    status = run_row(couplings, flows.after_barostat)
                if status != OK:
                    return status
            progress[DONE] += 1
        progress[DONE] = 0
        state.step[NOW] += 1
    apply_pending_kicks(model, code, state, pushing, pending)
    return OK


@kernel
def after_forces(couplings, flows, registers, status):
    """The status code after an evaluation of forces: what failed in a trajectory may be no failure
    of the run."""
    if status == OK or flows.failed < 0:
        return status
    registers.failure[0] = status
    run_row(couplings, flows.failed)
    return registers.failure[0]


@kernel(inline=True)
def is_tested(flows, step):
    """Whether a trajectory of hybrid Monte Carlo ends with a step of the segment, counted from
    1."""
    return flows.trajectory > 0 and step % flows.trajectory == 0


class Advance:
    """`advance` of molecules, for Python: bound to all that it works on. At the end it also sums
    over the state and its load, while these are in the caches of the cores.

    terms : the `TermTable`, bound to the state and the load
    """

    def __init__(
        self,
        scheme: Scheme,
        model: Model,
        state: State,
        load: Load,
        terms: TermTable,
        workspaces: CouplingWorkspaces,
        gradient: GradientWorkspace | None,
    ):
        self.gradient = gradient
        self._registers = registers = registers_of(workspaces)
        status = np.zeros(1, np.int64)
        passes = coupling_passes(scheme, model, terms, state, load, workspaces, registers, status)
        self._couplings = Program(list(passes.values()), ALWAYS, status)
        self._couplings.bind(list(passes.values()))
        flows = flow_arrays(
            scheme,
            {kind: row for row, kind in enumerate(passes)},
            needed_tallies(scheme.barostat),
        )
        bound = (
            model,
            move_code(model),
            state,
            load,
            terms,
            self._couplings.rows,
            flows,
            registers,
            gradient,
        )
        self._dt, self._integers = np.zeros(1), np.zeros(3, np.int64)
        self._extent, self._sums = np.zeros(len(LargestValues._fields)), np.zeros(SUM_COUNT)
        self._call = BoundTask(
            _advance, (bound, self._dt, self._integers, self._extent, self._sums)
        )

    def begin(self, dt: float, until: int, observed: bool, loaded: bool) -> None:
        """Set what the next calls do. loaded : whether the load belongs to the current positions"""
        self._dt[0] = dt
        self._integers[:] = until, observed, OK
        begin_call(self._registers.progress, is_current=loaded)

    def __call__(self) -> int:
        """Start or continue. A status code."""
        self._call()
        return int(self._integers[STATUS])

    @property
    def loaded(self) -> bool:
        """Whether the load belongs to the current positions."""
        return self._registers.progress[LOADED] != 0

    @property
    def extent(self) -> LargestValues:
        """The largest values of the state, and of the load as last computed."""
        return LargestValues(*self._extent.tolist())

    @property
    def sums(self) -> StateSums | None:
        """The sums over the state and its load. None if the last call was not `observed`."""
        return unpack_sums(self._sums) if self._integers[OBSERVED] else None


def registers_of(workspaces: CouplingWorkspaces) -> Registers:
    """New registers, which share what a barostat and trajectories remember."""
    registers = new_registers()
    if workspaces.box is not None:
        registers = registers._replace(tally=workspaces.box.tally, known=workspaces.box.known)
    if workspaces.trajectory is not None:
        registers = registers._replace(resting=workspaces.trajectory.diverged)
    return registers


#: Indices of `Advance._integers`: `until` and `observed` of `advance`, and its status.
UNTIL, OBSERVED, STATUS = 0, 1, 2


@task()
def _advance(arguments, block):
    bound, dt, integers, extent, sums = load_arguments(arguments)
    model, _, state, load = bound[:4]
    integers[STATUS] = advance(*bound, dt[0], integers[UNTIL], integers[OBSERVED] != 0)
    if integers[STATUS] == OK:
        find_largest(
            state.position.ravel(),
            state.velocity.ravel(),
            state.rotation.ravel(),
            state.angular_momentum_body.ravel(),
            load.force.ravel(),
            load.torque_body.ravel(),
            extent,
        )
        if integers[OBSERVED] != 0:
            fill_sums(
                model.species,
                model.mass,
                model.inverse_mass,
                model.inverse_inertia,
                state.velocity,
                state.rotation,
                state.angular_momentum_body,
                load.force,
                load.torque_body,
                sums,
            )


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


@kernel
def kick(model, code, state, load, pending, h):
    """Exact flow of the potential: V += h F/m, L += h n_body, added to the pending kicks. Returns
    these."""
    if pending[0] == 0.0:
        return h, 0.0
    if pending[1] == 0.0:
        return pending[0], h
    apply_pending_kicks(model, code, state, load, pending)
    return h, 0.0


@kernel
def apply_pending_kicks(model, code, state, load, pending):
    """Do the pending kicks, in place. Returns NO_PENDING_KICKS."""
    if pending[0] != 0.0:
        _move_all(model, code, state, load, pending, 0.0, False)
    return NO_PENDING_KICKS


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


@kernel
def _move_all(model, code, state, load, pending, h, drifts):
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    arguments = pack_arguments((*bodies, state, load, pending, h, drifts))
    call_blocks(code, "move", arguments, blocks_of(len(state.position)))


@task()
def _move(arguments, block):
    """The pending kicks. Then, if there is a drift, free flight and free rotation."""
    rotor, species, inverse_mass, inverse_inertia, state, load, pending, h, drifts = load_arguments(
        arguments
    )
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
            rotate_group(
                rotor, species, state.rotation, state.angular_momentum_body, start, stop, h
            )
