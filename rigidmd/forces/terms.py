"""Terms and workspaces: what acts on the bodies, how it is computed, and the dispatch over them.

A term is a frozen NamedTuple of numbers: it says what acts. A workspace is made from a term by one engine and belongs
to it: the term's numbers and, if needed, lists, grids, sums and machine code. `add_forces(workspace, state, load,
tally)` is chosen by the workspace's type at compile time; what a scene does not have is never compiled. To add a law,
write one file with a NamedTuple and an `@implements(add_forces)` (or, for a law between pairs of sites, an
`@implements(pairs.pair)`). A term that needs no workspace serves as its own.
"""

from typing import NamedTuple

import numpy as np
from numba import literal_unroll, types

from rigidmd.compile import (
    Code,
    Laid,
    implements,
    is_a,
    jump_to,
    kernel,
    opened,
    task,
)
from rigidmd.core.state import EXAMPLE, OK, TALLY_SIZE, Load, State


class Setup(NamedTuple):
    """What the workspaces of an engine depend on."""

    cell: np.ndarray  # (3, 3) at the start; workspaces follow the cell of the state
    dtype: type  # of the arithmetic between sites: numpy.float64 or numpy.float32
    skin: float  # extra radius of neighbour lists, Å
    with_energies: np.ndarray  # (1,) of the loader
    presses: bool  # whether virials without energies will be asked for


def workspace_of(term: NamedTuple, setup: Setup) -> NamedTuple:
    """The workspace of a term, with nothing compiled yet; the term itself if it needs none."""
    return term.workspace(setup) if hasattr(term, "workspace") else term


def with_code(workspace: NamedTuple) -> NamedTuple:
    """The workspace with its machine code."""
    return workspace.with_code() if hasattr(workspace, "with_code") else workspace


def with_room(workspace: NamedTuple, cell: np.ndarray) -> NamedTuple:
    """The workspace with the room that it needed, for a cell (3, 3). May raise SimulationError."""
    return workspace.with_room(cell) if hasattr(workspace, "with_room") else workspace


def in_common(workspaces: tuple[NamedTuple, ...]) -> tuple[NamedTuple, ...]:
    """The workspaces with one array, the largest of theirs, for what each needs only while its forces are computed."""
    passing = [workspace.passing for workspace in workspaces if hasattr(workspace, "passing")]
    if not passing:
        return workspaces
    largest = max(passing, key=np.size)
    return tuple(own.with_passing(largest) if hasattr(own, "passing") else own for own in workspaces)


def memory_of(workspace: NamedTuple) -> dict[str, np.ndarray]:
    """Arrays on which the next forces depend besides the state, for `recalled`; none of most workspaces."""
    return workspace.memory() if hasattr(workspace, "memory") else {}


def recalled(workspace: NamedTuple, memory: dict[str, np.ndarray], skin: float, now: float) -> NamedTuple:
    """The workspace, which has machine code, with what `memory_of` gave. Raises ValueError if that does not fit.

    skin : of neighbour lists, as asked for, Å. now : the present time, ps
    """
    if bool(memory) != hasattr(workspace, "memory"):
        raise ValueError(
            f"{type(workspace).__name__} {'lacks what it remembers' if not memory else 'remembers nothing'}"
        )
    return workspace.recall(memory, skin, now) if memory else workspace


def add_forces(term, state, load, tally):
    """Add a term's forces and torques to `load`, its energy and virial to `tally` unless None; a status code."""
    raise TypeError(f"{type(term).__name__} is not a term, or this was called outside compiled code")


def worse(status, other):
    """The worse of two status codes; the other may be None, which is OK."""
    raise TypeError("compiled code only")


@implements(worse, inline=True)
def _worse(status, other):
    if other is types.none:
        return lambda status, other: status
    return lambda status, other: max(status, other)


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


@implements(add_forces, NoForce)
def _add_no_force(term, state, load, tally):
    return OK


#: What is asked of `load_now`: forces; forces with energies and virials; forces into the other load; forces with
#: virials, and with energies only where they cost nothing.
PLAIN, TALLIED, OTHER, PRESSED = 0, 1, 2, 3


class Loader(NamedTuple):
    """Terms as addresses of machine code and of what it works on.

    So each term is compiled once, for all scenes that have it, and the loop over steps once for all terms of molecules.
    A loader counts no references: see `Loading`.
    """

    plain: np.ndarray  # (terms,) intp, of `_add_plain`; 0 of a body, whose terms are compiled into its loop
    tallied: np.ndarray  # (terms,) of `_add_tallied`
    rate: np.ndarray | None  # (terms,) of `_add_rate`; None where no term drives
    content: np.ndarray  # (terms,)
    tallies: np.ndarray  # (terms, 10) energy and virial of each
    with_energies: np.ndarray  # (1,) whether tallies have to have the energies
    known: np.ndarray  # (1,) whether `tallies` are those of the last forces
    status: np.ndarray  # (1,) the worst status code
    power: np.ndarray  # (1,) sum of the rates


def loader_for(terms: int, drives: bool, with_energies: np.ndarray) -> Loader:
    """An empty loader for so many terms."""
    plain, tallied, rate, content = np.zeros((4, terms), np.intp)
    known, status = np.zeros((2, 1), np.int64)
    tallies = np.zeros((terms, TALLY_SIZE))
    rates = rate if drives else None
    return Loader(plain, tallied, rates, content, tallies, with_energies, known, status, np.zeros(1))


def term_code(term: NamedTuple, loader: Loader, called: bool) -> Code:
    """The machine code of a term for a loader. called : whether the loop over steps calls it by address."""
    content = (term, *EXAMPLE, EXAMPLE[1], loader.tallies[0], loader.status, loader.power)
    tasks = {"tallied": (_add_tallied, content)}
    if called:
        tasks["plain"] = (_add_plain, content)
    if called and loader.rate is not None:
        tasks["rate"] = (_add_rate, content)
    return Code(**tasks)


@task()
def _add_plain(parcel, block):
    term, state, load, other, _, status, _ = opened(parcel)
    status[0] = worse(status[0], add_forces(term, state, other if block == OTHER else load, None))


@task()
def _add_tallied(parcel, block):
    term, state, load, _, tally, status, _ = opened(parcel)
    status[0] = worse(status[0], add_forces(term, state, load, tally))


@task()
def _add_rate(parcel, block):
    term, state, _, _, _, _, power = opened(parcel)
    power[0] += energy_rate(term, state)


class Loading:
    """The terms of an engine behind their loader; keeps alive what it refers to.

    called : whether the loop over steps calls the terms by address. with_energies : that of the `Setup`
    """

    def __init__(self, workspaces: tuple[NamedTuple, ...], called: bool, with_energies: np.ndarray):
        drives = any(getattr(type(own), "drives", False) for own in workspaces)
        self.loader = loader_for(len(workspaces), called and drives, with_energies)
        self._codes = [term_code(own, self.loader, called) for own in workspaces]
        self._laid: list[Laid] = []
        self._given: tuple = (None,) * 4
        self._kept: tuple = ()
        for k, code in enumerate(self._codes):
            self.loader.tallied[k] = code.address("tallied")
            self.loader.plain[k] = code.address("plain") if called else 0
            if self.loader.rate is not None:
                self.loader.rate[k] = code.address("rate")

    def bind(self, workspaces: tuple[NamedTuple, ...], state: State, load: Load, other: Load | None = None) -> Loader:
        """The loader of these workspaces, of the same types as the first, for a state and its loads.

        Numba takes milliseconds to find the types of so many arrays; nothing is done where they are those of last time.
        """
        given = (workspaces, state, load, other)
        if all(now is then for now, then in zip(given, self._given, strict=True)):
            return self.loader
        kept = (*workspaces, *state, *load, *(other or load))
        if len(kept) == len(self._kept) and all(now is then for now, then in zip(kept, self._kept, strict=True)):
            self._given = given
            return self.loader
        loader, loads = self.loader, (load, other or load)
        self._laid = [
            code.lay_down((own, state, *loads, loader.tallies[k], loader.status, loader.power))
            for k, (own, code) in enumerate(zip(workspaces, self._codes, strict=True))
        ]
        loader.content[:] = [laid.address for laid in self._laid]
        self._given, self._kept = given, kept
        return self.loader


@kernel(outer=True)
def tally_now(loader, force, torque_body):
    """Write the forces and torques of all terms, and energies and virials in the loader; a status code.

    force, torque_body : the arrays of the load to which the loader is bound
    """
    return load_now(loader, None, Load(force, torque_body), TALLIED)


def is_driven(loader: types.Type) -> bool:
    """Whether the type of a loader has the rates of terms that drive."""
    return is_a(loader, Loader) and loader.types[Loader._fields.index("rate")] is not types.none


def load_now(terms, state, load, which):
    """Write the forces and torques of all terms at the present positions; the worst status code.

    terms : a tuple of terms, or a `Loader`. which : PLAIN, TALLIED, OTHER or PRESSED. A loader knows its loads, and
    `load` must be the one asked for; energies and virials go into its tallies. Of a tuple there are only forces.
    """
    raise TypeError("compiled code only")


@implements(load_now)
def _load_now(terms, state, load, which):
    if not is_a(terms, Loader):
        return lambda terms, state, load, which: load_bodies(terms, state, load, None)

    def load_by_address(terms, state, load, which):
        clear(load.force)
        clear(load.torque_body)
        terms.status[0] = OK
        terms.known[0] = 0
        tallied = which in (TALLIED, PRESSED)
        if tallied:
            terms.tallies[:] = 0.0
            terms.with_energies[0] = which == TALLIED
        for k in range(len(terms.content)):
            address = terms.tallied[k] if tallied else terms.plain[k]
            jump_to(address, terms.content[k], which)
            if terms.status[0] != OK:  # asked again, all terms begin again: no need to go on
                return terms.status[0]
        terms.known[0] = which == TALLIED
        return OK

    return load_by_address


@kernel
def clear(values):
    """values[:] = 0 of an array (n, 3), as a loop, which compiles ten times faster."""
    for m in range(len(values)):
        for k in range(3):
            values[m, k] = 0.0


@kernel(inline=True)
def load_bodies(terms, state, load, tally):
    """Write the forces and torques of all terms (a tuple) at the present positions; the worst status code.

    Energies and virials add up in `tally`; None compiles none.
    """
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = worse(status, add_forces(term, state, load, tally))
    return status


@kernel
def total_power(terms, state, velocity, omega):
    """`power` of all terms."""
    total = 0.0
    for term in literal_unroll(terms):
        total += power(term, state, velocity, omega)
    return total


@kernel
def total_energy_rate(loader):
    """`energy_rate` of all terms."""
    loader.power[0] = 0.0
    for k in range(len(loader.content)):
        jump_to(loader.rate[k], loader.content[k], PLAIN)
    return loader.power[0]
