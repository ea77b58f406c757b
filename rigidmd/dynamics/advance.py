"""The compiled loop: n steps of any scheme, any terms, any thermostat."""

from typing import NamedTuple

import numpy as np

from rigidmd.dynamics.gradient import add_gyration, displace, evaluate
from rigidmd.dynamics.thermostats import apply
from rigidmd.forces.sites import SERIAL
from rigidmd.forces.terms import EXAMPLE, OK, load_bodies
from rigidmd.jit import BLOCKS, call_blocks, implements, is_a, kernel, opened, packed, work
from rigidmd.mechanics.groups import GROUP, turn_group
from rigidmd.mechanics.rotor import ExactRotor, NoRotor, SplitRotor, turn_along


class Parts(NamedTuple):
    """Addresses of the works that move molecules; 0 until they are needed."""

    kick: int = 0
    drift: int = 0


class Model(NamedTuple):
    """What never changes during a run of molecules."""

    species: np.ndarray  # (n,) species of each molecule
    mass: np.ndarray  # (species,) u
    inverse_mass: np.ndarray  # (species,) 0 of what is frozen: nothing moves it
    inertia: np.ndarray  # (species, 3) principal moments, u Å²; 0 where there is no rotation
    inverse_inertia: np.ndarray  # (species, 3); 0 where the moment is 0
    rotor: SplitRotor | ExactRotor | NoRotor
    parts: Parts = Parts()

    def with_code(self) -> "Model":
        """The model with the machine code that moves its molecules."""
        state, load = EXAMPLE
        kicked = (self.species, self.inverse_mass, self.inverse_inertia, state, load, 0.0)
        return self._replace(parts=Parts(_kick.address(kicked), _drift.address((self.rotor, self.species, state, 0.0))))


class Progress(NamedTuple):
    """How far `advance` has come, so that it can stop for more memory and go on at the same place."""

    cursor: np.ndarray  # (3,) steps done; stages done in this step; whether `load` is that of the present positions (1)
    # or that with the gradient (2)


def new_progress(steps: int, fresh: bool) -> Progress:
    """At the beginning of a step; steps taken since the origin of time, whether the load is known."""
    return Progress(np.array([steps, 0, fresh], np.int64))


@kernel(outer=True)
def advance(model, state, load, terms, thermostat, scheme, probe, dt, origin, steps, progress):
    """Step until `steps` steps of dt have been taken since time `origin`, counted in progress.cursor[0].

    scheme : kicks, drifts, the moments (fractions of dt) at which the kicks act, and their gradients (fractions of
    dt²). probe : room for gradients; None compiles none.

    The scheme is walked as kick, drift, kick, ..., kick; forces are evaluated before a kick where positions have
    changed since, so the last evaluation of a step serves the next one. A status code: when it is not OK, state and
    progress are such that calling again continues without a trace.
    """
    kicks, drifts, moments, gradients = scheme
    cursor = progress.cursor
    while cursor[0] < steps:
        while cursor[1] < len(kicks):
            k = cursor[1]
            if kicks[k] != 0.0:
                if probe is None:
                    if cursor[2] == 0:
                        status = load_bodies(terms, state, load)
                        if status != OK:
                            return status
                        cursor[2] = 1
                else:
                    while cursor[2] < (1 if gradients[k] == 0.0 else 2):
                        status = evaluate(model, state, load, terms, probe, gradients[k] * dt * dt, cursor[2] == 1)
                        if status != OK:
                            return status
                        cursor[2] += 1
                pay(model, terms, state, 0.5 * kicks[k] * dt)
                kick(model, state, load, kicks[k] * dt)
                pay(model, terms, state, 0.5 * kicks[k] * dt)
            if k < len(drifts):
                drift(model, state, drifts[k] * dt)
                state.time[0] = origin + (cursor[0] + moments[k + 1]) * dt
                cursor[2] = 0
            cursor[1] += 1
        apply(thermostat, model, state, dt)
        cursor[1] = 0
        cursor[0] += 1
    return OK


def kick(model, state, load, h):
    """Exact flow of the potential, in place: V += h F/m, L += h n_body."""
    raise TypeError("compiled code only")


def drift(model, state, h):
    """Flow of the kinetic energy, in place: free flight and free rotation."""
    raise TypeError("compiled code only")


def pay(model, terms, state, h):
    """Add to `state.work` what driving terms do at the present velocity over h; half before a kick, half after."""
    raise TypeError("compiled code only")


@implements(kick)
def _kick_molecules(model, state, load, h):
    if not is_a(model, Model):
        return None

    def kick_molecules(model, state, load, h):
        parcel = packed((model.species, model.inverse_mass, model.inverse_inertia, state, load, h))
        call_blocks(model.parts.kick, parcel, _blocks(state))

    return kick_molecules


@implements(drift)
def _drift_molecules(model, state, h):
    if not is_a(model, Model):
        return None

    def drift_molecules(model, state, h):
        call_blocks(model.parts.drift, packed((model.rotor, model.species, state, h)), _blocks(state))

    return drift_molecules


@implements(displace)
def _displace_molecules(model, state, load, tau):
    if not is_a(model, Model):
        return None

    def displace_molecules(model, state, load, tau):
        for m in range(len(state.position)):
            share = tau * model.inverse_mass[model.species[m]]
            for k in range(3):
                state.position[m, k] += share * load.force[m, k]
        for m in range(len(state.rotation)):
            inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
            turn_along(state.rotation[m], tau * inverse[0] * n[0], tau * inverse[1] * n[1], tau * inverse[2] * n[2])

    return displace_molecules


@implements(add_gyration)
def _add_gyration_of_molecules(model, load, tau, gain):
    if not is_a(model, Model):
        return None

    def add_gyration_of_molecules(model, load, tau, gain):
        for m in range(len(load.torque_body)):
            inverse, n = model.inverse_inertia[model.species[m]], load.torque_body[m]
            for k in range(3):
                i, j = (k + 1) % 3, (k + 2) % 3
                gain.torque_body[m, k] += tau * (inverse[i] - inverse[j]) * n[i] * n[j]

    return add_gyration_of_molecules


@implements(pay)
def _pay_nothing(model, terms, state, h):
    if is_a(model, Model):
        return lambda model, terms, state, h: None


@kernel
def _blocks(state):
    """Blocks that molecules are moved in: one, on this thread, where there are few."""
    return BLOCKS if len(state.position) > SERIAL else 1


@kernel(inline=True)
def _groups_of(state, block):
    """The first molecule of a block, and the first that is no more in it; whole groups."""
    n, blocks = len(state.position), _blocks(state)
    groups = (n + GROUP - 1) // GROUP
    return GROUP * (groups * block // blocks), min(n, GROUP * (groups * (block + 1) // blocks))


@work()
def _kick(parcel, block):
    species, inverse_mass, inverse_inertia, state, load, h = opened(parcel)
    first, end = _groups_of(state, block)
    for m in range(first, end):
        kind = species[m]
        share = h * inverse_mass[kind]
        for k in range(3):
            state.velocity[m, k] += share * load.force[m, k]
        if m < len(state.angular_momentum_body):
            for k in range(3):
                if inverse_inertia[kind, k] > 0:  # no momentum gathers on an axis without inertia
                    state.angular_momentum_body[m, k] += h * load.torque_body[m, k]


@work()
def _drift(parcel, block):
    rotor, species, state, h = opened(parcel)
    first, end = _groups_of(state, block)
    for start in range(first, end, GROUP):
        stop = min(start + GROUP, end)
        for m in range(start, stop):
            for k in range(3):
                state.position[m, k] += h * state.velocity[m, k]
        turn_group(rotor, species, state.rotation, state.angular_momentum_body, start, stop, h)
