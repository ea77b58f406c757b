"""The compiled loop: n steps of any row of flows, any terms, any bath, any box."""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import Bound, Code, call_blocks, implements, is_a, kernel, opened, packed, task
from rigidmd.core.integrators import BATH, BOX, DRIFT, KICK, STRETCH, Scheme
from rigidmd.core.state import EXAMPLE, NOW, OK, ORIGIN, TAKEN, WORK
from rigidmd.dynamics.barostats import load_for, move_box, stretch
from rigidmd.dynamics.force_gradient import add_gyration, displace, evaluate
from rigidmd.dynamics.observables import SUMS, Extent, Sums, add_up, find_largest, sums_of
from rigidmd.dynamics.thermostats import apply, bath_code
from rigidmd.forces.neighbors.sites import blocks_of, share_of
from rigidmd.forces.terms import PLAIN, TALLIED, is_driven, total_energy_rate
from rigidmd.mechanics.batches import TOGETHER, kick_group, turn_group
from rigidmd.mechanics.free_rotor import ExactRotor, NoRotor, SplitRotor, turn_along

#: Random numbers that a flow may draw for one molecule in a step.
DRAWS = 1 << 20
#: Times of two kicks, 0 of one that there is not: kicks by the present load that are still to be done.
NONE_WAITS = (0.0, 0.0)
#: Molecules that are kicked, moved and turned before the next ones: so many that a core keeps them at hand.
AT_HAND = 32 * TOGETHER


class Model(NamedTuple):
    """What never changes during a run of molecules."""

    species: np.ndarray  # (n,) species of each molecule
    mass: np.ndarray  # (species,) u
    inverse_mass: np.ndarray  # (species,) 0 of what is frozen: nothing moves it
    inertia: np.ndarray  # (species, 3) principal moments, u Å²; 0 where there is no rotation
    inverse_inertia: np.ndarray  # (species, 3); 0 where the moment is 0
    rotor: SplitRotor | ExactRotor | NoRotor
    keeps_momentum: np.ndarray = np.ones(3, bool)  # (3,) components of the total momentum that nothing changes


def code_of(model: NamedTuple, bath: tuple) -> Code | None:
    """The machine code that moves molecules; None of a single body, whose flows are compiled into the loop."""
    if not isinstance(model, Model):
        return None
    state, load = EXAMPLE
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    return Code(move=(_move, (*bodies, state, load, NONE_WAITS, 0.0, False)), **bath_code(bath, model))


class Row(NamedTuple):
    """The flows of a scheme as arrays, in their order."""

    kind: np.ndarray  # (flows,) KICK, DRIFT, BATH, REST, BOX or STRETCH
    fraction: np.ndarray  # (flows,) of the time step
    moment: np.ndarray  # (flows,) of the time step: when each ends, as drifts count
    every: np.ndarray  # (flows,) taken in every so many steps of a stretch
    gradient: np.ndarray | None  # (flows,) of dt²; None where no kick has one, and none is compiled
    last: int  # the last drift


def row_of(scheme: Scheme) -> Row:
    """The flows of a scheme."""
    kind = np.array([flow.kind for flow in scheme.flows])
    fraction = np.array([flow.fraction for flow in scheme.flows])
    moment = np.cumsum(np.where(kind == DRIFT, fraction, 0.0))
    last = int(np.flatnonzero(kind == DRIFT)[-1])
    moment[last:] = 1.0
    gradient = np.array([flow.gradient for flow in scheme.flows]) if scheme.has_gradient else None
    every = np.array([flow.every for flow in scheme.flows])
    return Row(kind, fraction, moment, every, gradient, last)


@kernel
def advance(model, code, state, load, terms, bath, box, row, probe, heat, room, dt, until, looked, cursor):
    """Step until `until` steps of dt have been taken, counted in state.step.

    code : see `code_of`
    terms : of a body its workspaces, of molecules a `Loader`
    probe : room for gradients; None compiles none
    heat, room : of a bath, of a box (`baths.heat_room`, `boxes.box_room`)
    looked : whether the forces at the end are computed with their energies and virials, if a kick needs them there
    cursor (3,) : flows done in this step; whether `load` is that of the present positions (1) or that with the gradient
        (2); whether a move of the box is made and not yet judged

    Forces are evaluated before a kick where positions have changed since, so the last evaluation of a step serves the
    next one. Kicks of molecules wait for the drift that follows, which does them on its way: the last of a step and the
    first of the next are done in one pass with the drift. A status code: when it is not OK, state and cursor are such
    that calling again continues without a trace.
    """
    waiting = NONE_WAITS
    while state.step[NOW] < until:
        while cursor[0] < len(row.kind):
            k = cursor[0]
            h = row.fraction[k] * dt
            if row.kind[k] == KICK:
                if probe is None:
                    if cursor[1] == 0:
                        last = looked and state.step[NOW] + 1 == until and k > row.last
                        status = load_for(box, terms, state, load, room, row, TALLIED if last else PLAIN)
                        if status != OK:
                            return status
                        cursor[1] = 1
                else:
                    while cursor[1] < (1 if row.gradient[k] == 0.0 else 2):
                        waiting = catch_up(model, code, state, load, waiting)
                        status = evaluate(model, state, load, terms, probe, row.gradient[k] * dt * dt, cursor[1] == 1)
                        if status != OK:
                            return status
                        cursor[1] += 1
                pay(model, terms, state, 0.5 * h)
                waiting = kick(model, code, state, load, waiting, h)
                pay(model, terms, state, 0.5 * h)
            elif row.kind[k] == DRIFT:
                drift(model, code, state, load, waiting, h)
                waiting = NONE_WAITS
                state.time[NOW] = state.time[ORIGIN] + (state.step[NOW] - state.step[ORIGIN] + row.moment[k]) * dt
                cursor[1] = 0
            elif (state.step[NOW] - state.step[ORIGIN] + 1) % row.every[k] == 0:
                waiting = catch_up(model, code, state, load, waiting)
                if row.kind[k] == BATH:
                    apply(bath, model, code, state, heat, h, DRAWS * k)
                elif row.kind[k] == BOX:
                    status = move_box(box, model, terms, state, load, room, cursor, h, DRAWS * k)
                    if status != OK:
                        return status
                elif row.kind[k] == STRETCH:
                    stretch(box, state, h)
                    cursor[1] = 0
                else:
                    rest(model, state)
            cursor[0] += 1
        cursor[0] = 0
        state.step[NOW] += 1
    catch_up(model, code, state, load, waiting)
    return OK


#: Numbers of `Advance`: what a call is told (`until`, `looked`), its status, and the three of the cursor.
UNTIL, LOOKED, STATUS, CURSOR = 0, 1, 2, 3


class Advance:
    """`advance` of molecules, for Python: bound to all of its arguments but dt, `until`, `looked` and the cursor.

    At the end it measures the state and its load while the cores still have them at hand.
    """

    def __init__(self, *arguments):
        self._dt, self._told = np.zeros(1), np.zeros(CURSOR + 3, np.int64)
        self._extent, self._sums = np.zeros(len(Extent._fields)), np.zeros(SUMS)
        self._call = Bound(_advance, (arguments, self._dt, self._told, self._extent, self._sums))

    def begin(self, dt: float, until: int, looked: bool, loaded: bool) -> None:
        """Say what the next calls do. loaded : whether the load is that of the present positions"""
        self._dt[0] = dt
        self._told[:] = until, looked, OK, 0, loaded, 0

    def __call__(self) -> int:
        """Go on; a status code."""
        self._call()
        return int(self._told[STATUS])

    @property
    def loaded(self) -> bool:
        """Whether the load is that of the present positions."""
        return self._told[CURSOR + 1] != 0

    @property
    def extent(self) -> Extent:
        """That of the state, and of the load as last computed."""
        return Extent(*self._extent.tolist())

    @property
    def sums(self) -> Sums | None:
        """The sums over the state and its load; None if the last call was not to be looked at."""
        return sums_of(self._sums) if self._told[LOOKED] else None


@kernel(outer=True)
def advance_body(model, state, load, terms, bath, box, row, probe, heat, room, dt, until, looked, cursor):
    """`advance` of a body, for Python."""
    return advance(model, None, state, load, terms, bath, box, row, probe, heat, room, dt, until, looked, cursor)


@task()
def _advance(parcel, block):
    (model, code, state, load, terms, bath, box, row, probe, heat, room), dt, told, extent, sums = opened(parcel)
    told[STATUS] = advance(
        model, code, state, load, terms, bath, box, row, probe, heat, room, dt[0], told[UNTIL], told[LOOKED] != 0,
        told[CURSOR:],
    )  # fmt: skip
    if told[STATUS] == OK:
        find_largest(
            state.position.ravel(), state.velocity.ravel(), state.rotation.ravel(),
            state.angular_momentum_body.ravel(), load.force.ravel(), load.torque_body.ravel(), extent,
        )  # fmt: skip
        if told[LOOKED] != 0:
            add_up(
                model.species, model.mass, model.inverse_mass, model.inverse_inertia, state.velocity, state.rotation,
                state.angular_momentum_body, load.force, load.torque_body, sums,
            )  # fmt: skip


def kick(model, code, state, load, waiting, h):
    """Exact flow of the potential, in place: V += h F/m, L += h n_body. Returns the kicks that wait: of molecules, with
    those that have waited before, the kick itself; a body is kicked at once."""
    raise TypeError("compiled code only")


def drift(model, code, state, load, waiting, h):
    """The kicks that wait, and the flow of the kinetic energy, in place: free flight and free rotation."""
    raise TypeError("compiled code only")


def catch_up(model, code, state, load, waiting):
    """Do the kicks that wait, in place; returns that none waits."""
    raise TypeError("compiled code only")


def pay(model, terms, state, h):
    """Add to the books what driving terms do over h; half before a kick, half after. On a body by their power at the
    present velocity; on molecules by the rate at which their energy changes where nothing moves."""
    raise TypeError("compiled code only")


def rest(model, state):
    """Take out the components of the total momentum that nothing changes, in place: the same velocity from all
    molecules; its energy goes into the books."""
    raise TypeError("compiled code only")


@implements(rest)
def _rest_molecules(model, state):
    if not is_a(model, Model):
        return lambda model, state: None

    def rest_molecules(model, state):
        mass, px, py, pz = 0.0, 0.0, 0.0, 0.0
        for m in range(len(state.velocity)):
            own = model.mass[model.species[m]]
            mass += own
            px += own * state.velocity[m, 0]
            py += own * state.velocity[m, 1]
            pz += own * state.velocity[m, 2]
        kept = model.keeps_momentum
        px, py, pz = kept[0] * px, kept[1] * py, kept[2] * pz
        for m in range(len(state.velocity)):
            state.velocity[m, 0] -= px / mass
            state.velocity[m, 1] -= py / mass
            state.velocity[m, 2] -= pz / mass
        state.books[TAKEN] -= (px * px + py * py + pz * pz) / (2 * mass)

    return rest_molecules


@implements(kick, Model)
def _kick_molecules(model, code, state, load, waiting, h):
    if waiting[0] == 0.0:
        return h, 0.0
    if waiting[1] == 0.0:
        return waiting[0], h
    catch_up(model, code, state, load, waiting)
    return h, 0.0


@implements(drift, Model)
def _drift_molecules(model, code, state, load, waiting, h):
    _move_all(model, code, state, load, waiting, h, True)


@implements(catch_up)
def _catch_up(model, code, state, load, waiting):
    if not is_a(model, Model):
        return lambda model, code, state, load, waiting: waiting

    def catch_up_molecules(model, code, state, load, waiting):
        if waiting[0] != 0.0:
            _move_all(model, code, state, load, waiting, 0.0, False)
        return NONE_WAITS

    return catch_up_molecules


@implements(displace, Model)
def _displace_molecules(model, state, load, tau):
    for m in range(len(state.position)):
        share = tau * model.inverse_mass[model.species[m]]
        for k in range(3):
            state.position[m, k] += share * load.force[m, k]
    for m in range(len(state.rotation)):
        inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
        turn_along(state.rotation[m], tau * inverse[0] * n[0], tau * inverse[1] * n[1], tau * inverse[2] * n[2])


@implements(add_gyration, Model)
def _add_gyration_of_molecules(model, load, tau, gain):
    for m in range(len(load.torque_body)):
        inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            gain.torque_body[m, k] += tau * (inverse[i] - inverse[j]) * n[i] * n[j]


@implements(pay)
def _pay_for_molecules(model, terms, state, h):
    if not is_a(model, Model):
        return None
    if not is_driven(terms):
        return lambda model, terms, state, h: None

    def pay_for_molecules(model, terms, state, h):
        state.books[WORK] += h * total_energy_rate(terms)

    return pay_for_molecules


@kernel
def _move_all(model, code, state, load, waiting, h, drifts):
    bodies = (model.rotor, model.species, model.inverse_mass, model.inverse_inertia)
    call_blocks(code, "move", packed((*bodies, state, load, waiting, h, drifts)), blocks_of(len(state.position)))


@task()
def _move(parcel, block):
    """The kicks that wait; and then, if there is a drift, free flight and free rotation."""
    rotor, species, inverse_mass, inverse_inertia, state, load, waiting, h, drifts = opened(parcel)
    first, end = share_of(len(state.position), block, TOGETHER)
    for start in range(first, end, AT_HAND):
        stop = min(end, start + AT_HAND)
        for kick in waiting:
            if kick != 0.0:
                kick_group(species, inverse_mass, inverse_inertia, state, load, start, stop, kick)
        if drifts:
            for m in range(start, stop):
                for k in range(3):
                    state.position[m, k] += h * state.velocity[m, k]
            turn_group(rotor, species, state.rotation, state.angular_momentum_body, start, stop, h)
