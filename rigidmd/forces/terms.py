"""Terms and workspaces: what acts on the bodies, how it is computed, and the dispatch over them.

A term is a frozen NamedTuple of numbers: it says what acts. A workspace is made from a term by one engine and belongs
to it: the term's numbers and, if needed, lists, grids, sums and machine code. `add_forces(workspace, state, load,
tally)` is chosen by the workspace's type at compile time; what a scene does not have is never compiled. To add a law,
write one file with a NamedTuple and an `@implements(add_forces)` (or, for a law between pairs of sites, an
`@implements(pairs.pair)`). A term that needs no workspace serves as its own.
"""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll

from rigidmd.compile import implements, is_a, kernel
from rigidmd.core.state import OK


class Setup(NamedTuple):
    """What the workspaces of an engine depend on."""

    cell: np.ndarray  # (3, 3) at the start; workspaces follow the cell of the state
    dtype: type  # of the arithmetic between sites: numpy.float64 or numpy.float32
    skin: float  # extra radius of neighbour lists, Å


def workspace_of(term: NamedTuple, setup: Setup) -> NamedTuple:
    """The workspace of a term, with nothing compiled yet; the term itself if it needs none."""
    return term.workspace(setup) if hasattr(term, "workspace") else term


def with_code(workspace: NamedTuple) -> NamedTuple:
    """The workspace with its machine code."""
    return workspace.with_code() if hasattr(workspace, "with_code") else workspace


def with_room(workspace: NamedTuple, cell: np.ndarray) -> NamedTuple:
    """The workspace with the room that it needed, for a cell (3, 3). May raise SimulationError."""
    return workspace.with_room(cell) if hasattr(workspace, "with_room") else workspace


def add_forces(term, state, load, tally):
    """Add a term's forces and torques to `load`, its energy and virial to `tally` unless None; a status code."""
    raise TypeError(f"{type(term).__name__} is not a term, or this was called outside compiled code")


def power(term, state, velocity, omega):
    """Power of a term whose class has `drives = True`; 0 for any other term, because its energy includes its work.

    velocity (lab axes) and omega (body axes) : tuples, relative to the frame
    """
    raise TypeError("compiled code only")


@implements(power)
def _no_power(term, state, velocity, omega):
    if not getattr(term.instance_class, "drives", False):
        return lambda term, state, velocity, omega: 0.0


def energy_rate(term, state):
    """dU/dt of a term of molecules whose class says `drives = True` while nothing moves; 0 of any other."""
    raise TypeError("compiled code only")


@implements(energy_rate)
def _no_energy_rate(term, state):
    if not getattr(term.instance_class, "drives", False):
        return lambda term, state: 0.0


class NoForce(NamedTuple):
    """Replaces an empty tuple of terms, over which Numba cannot loop: free flight."""

    force: float = 0.0


@implements(add_forces)
def _add_no_force(term, state, load, tally):
    if is_a(term, NoForce):
        return lambda term, state, load, tally: OK


@kernel(outer=True)
def add_term(term, state, load, tally):
    """`add_forces` of one term, for calls from Python."""
    return add_forces(term, state, load, tally)


@kernel(inline=True)
def load_bodies(terms, state, load, tally):
    """Write the forces and torques of all terms (a tuple) at the present positions; the worst status code.

    Energies and virials add up in `tally`; None compiles none.
    """
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = max(status, add_forces(term, state, load, tally))
    return status


@kernel
def total_power(terms, state, velocity, omega):
    """`power` of all terms."""
    total = 0.0
    for term in literal_unroll(terms):
        total += power(term, state, velocity, omega)
    return total


@kernel
def total_energy_rate(terms, state):
    """`energy_rate` of all terms."""
    total = 0.0
    for term in literal_unroll(terms):
        total += energy_rate(term, state)
    return total
