"""Terms: what acts on the bodies, and the one dispatch over them.

A term is a NamedTuple of numbers and arrays. `add_forces(term, state, load, tally)` is chosen by the term's type at
compile time; a term that a scene does not have is never compiled. To add a law, write one file with such a NamedTuple
and an `@implements(add_forces)` (or, for a law between pairs of sites, an `@implements(pairs.pair)`).
"""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from rigidmd.jit import implements, is_a, kernel

# What a kernel reports; the worst one wins, Python acts on it (dynamics.engine).
OK = 0
ASK = 1  # a Python function has to be asked for its force: ask it and call again
LIST_FULL = 2  # the neighbour list needs more room: enlarge it and call again
NOT_FINITE = 3  # a position is not a number, or so large that it says nothing any more


class State(NamedTuple):
    """Everything that changes during a run, and nothing else. float64; n bodies; molecules in Å, ps, u, bodies in SI.

    A scene of points has rotation (0, 3, 3) and angular_momentum_body (0, 3): what does not turn is not stored. Nor is
    the position and velocity of a body that is pinned at a point: (0, 3).
    """

    position: np.ndarray  # (n, 3) centre of mass, lab frame, never wrapped
    velocity: np.ndarray  # (n, 3) lab frame
    rotation: np.ndarray  # (n, 3, 3) Q, body to lab
    angular_momentum_body: np.ndarray  # (n, 3)
    time: np.ndarray  # (1,)
    work: np.ndarray  # (1,) done on a body so far by what drives or brakes it; its energy less this is conserved

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return State(*(array.copy() for array in self))


class Load(NamedTuple):
    """What acts on the bodies at the present positions."""

    force: np.ndarray  # (n, 3) lab frame; (0, 3) for a pinned body
    torque_body: np.ndarray  # (n, 3) body frame; (0, 3) for points


#: What states and loads of molecules are: works are compiled for these types of arrays.
EXAMPLE = (
    State(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(1), np.zeros(1)),
    Load(np.zeros((0, 3)), np.zeros((0, 3))),
)


def no_load(state: State) -> Load:
    """Zero forces and torques for the bodies of a state."""
    return Load(np.zeros_like(state.velocity), np.zeros_like(state.angular_momentum_body))


# A tally is a float64 array (10,): energy, then the molecular virial tensor sum F (x) R in rows (u Å²/ps²).
# None in its place compiles the kernels without energies.
TALLY_SIZE = 10


def add_forces(term, state, load, tally):
    """Add a term's forces and torques to `load`, its energy and virial to `tally` unless None; a status code."""
    raise TypeError(f"{type(term).__name__} is no term, or this was called outside compiled code")


def power(term, state, velocity, omega):
    """Power of a term whose class says `drives = True` at a body's velocity and angular velocity (lab and body frame,
    tuples, relative to the frame); 0 of any other, whose energy says it all."""
    raise TypeError("compiled code only")


@implements(power)
def _no_power(term, state, velocity, omega):
    if not getattr(term.instance_class, "drives", False):
        return lambda term, state, velocity, omega: 0.0


class NoForce(NamedTuple):
    """Stands in for an empty tuple of terms, which Numba cannot loop over: free flight."""

    force: float = 0.0


@implements(add_forces)
def _add_no_force(term, state, load, tally):
    if is_a(term, NoForce):
        return lambda term, state, load, tally: OK


def with_room(term: NamedTuple) -> NamedTuple:
    """The term with its machine code and all the room that it asked for; a term that needs none as it is."""
    return term.with_room() if hasattr(term, "with_room") else term


def with_own_work(term: NamedTuple) -> NamedTuple:
    """The term with work arrays that it shares with no other; a term that has none as it is."""
    return term.with_own_work() if hasattr(term, "with_own_work") else term


@kernel(outer=True)
def add_term(term, state, load, tally):
    """`add_forces` of one term, to be called from Python."""
    return add_forces(term, state, load, tally)


@kernel(inline=True)
def load_bodies(terms, state, load):
    """Forces and torques of all terms (a tuple) at the present positions; the worst status code."""
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = max(status, add_forces(term, state, load, None))
    return status


@kernel
def total_power(terms, state, velocity, omega):
    """`power` of all terms."""
    total = 0.0
    for term in literal_unroll(terms):
        total += power(term, state, velocity, omega)
    return total
