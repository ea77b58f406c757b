"""The flows of a single body: one of everything, each chosen by its type, so what a scene lacks is not compiled."""

from typing import NamedTuple

from rigidmd.dynamics.advance import drift, kick, lose
from rigidmd.forces.frame import Inertial, Turning, follow
from rigidmd.forces.resistance import NoResistance, Resistance, resist
from rigidmd.jit import implements, is_a
from rigidmd.mechanics.flight import Free, Immersed, Pinned, carry
from rigidmd.mechanics.rotor import DrivenRotor, NoRotor, SplitRotor, moments


class Body(NamedTuple):
    """What never changes during a run of a single body; SI units. `Model` is the like for molecules."""

    flight: Free | Pinned | Immersed
    rotor: SplitRotor | DrivenRotor | NoRotor
    frame: Inertial | Turning = Inertial()
    resistance: NoResistance | Resistance = NoResistance()


@implements(kick, inline=True)
def _kick_body(model, state, load, h):
    if not is_a(model, Body):
        return None

    def kick_body(model, state, load, h):
        for m in range(len(load.force)):
            for k in range(3):
                state.velocity[m, k] += h / model.flight.mass * load.force[m, k]
        for m in range(len(load.torque_body)):
            for k in range(3):
                if moments(model.rotor, state.time[0], k)[0] > 0:  # no momentum gathers on an axis without inertia
                    state.angular_momentum_body[m, k] += h * load.torque_body[m, k]

    return kick_body


@implements(drift, inline=True)
def _drift_body(model, state, h):
    if not is_a(model, Body):
        return None

    def drift_body(model, state, h):
        time = state.time[0]
        carry(model.flight, model.rotor, state, time, h)
        follow(model.frame, state, time, h)

    return drift_body


@implements(lose, inline=True)
def _lose_body(model, state, h):
    if not is_a(model, Body):
        return None

    def lose_body(model, state, h):
        resist(model.resistance, model.flight, model.rotor, model.frame, state, state.time[0], h)

    return lose_body
