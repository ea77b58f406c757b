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
LIST_FULL = 1  # the neighbour list needs more room: enlarge it and call again
NOT_FINITE = 2  # a position is not a number, or so large that it says nothing any more


class State(NamedTuple):
    """Everything that changes during a run, and nothing else. float64; n molecules.

    A scene of points has rotation (0, 3, 3) and angular_momentum_body (0, 3): what does not turn is not stored.
    """

    position: np.ndarray  # (n, 3) centre of mass, lab frame, Å, never wrapped
    velocity: np.ndarray  # (n, 3) lab frame, Å/ps
    rotation: np.ndarray  # (n, 3, 3) Q, body to lab
    angular_momentum_body: np.ndarray  # (n, 3) u Å²/ps

    def copy(self) -> "State":
        """A state that shares nothing with this one."""
        return State(*(array.copy() for array in self))


class Load(NamedTuple):
    """What acts on the bodies at the present positions."""

    force: np.ndarray  # (n, 3) lab frame, u Å/ps²
    torque_body: np.ndarray  # (n, 3) body frame, u Å²/ps²; (0, 3) for points


# A tally is a float64 array (10,): energy, then the molecular virial tensor sum F (x) R in rows (u Å²/ps²).
# None in its place compiles the kernels without energies.
TALLY_SIZE = 10


def add_forces(term, state, load, tally):
    """Add a term's forces and torques to `load`, its energy and virial to `tally` unless None; a status code."""
    raise TypeError(f"{type(term).__name__} is no term, or this was called outside compiled code")


class NoForce(NamedTuple):
    """Stands in for an empty tuple of terms, which Numba cannot loop over: free flight."""

    force: float = 0.0


@implements(add_forces)
def _add_no_force(term, state, load, tally):
    if is_a(term, NoForce):
        return lambda term, state, load, tally: OK


@kernel
def add_term(term, state, load, tally):
    """`add_forces` of one term, to be called from Python."""
    return add_forces(term, state, load, tally)


@kernel
def load_bodies(terms, state, load):
    """Forces and torques of all terms (a tuple) at the present positions; the worst status code."""
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = max(status, add_forces(term, state, load, None))
    return status
