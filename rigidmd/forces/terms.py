"""Force terms and their workspaces, and the dispatch over them.

A term is a frozen NamedTuple of numbers that describes a force. A workspace is made from a term by one engine: the
numbers of the term and, if needed, lists, grids, sums and machine code. A term that needs no workspace is used as its
workspace. `add_forces(workspace, state, load, tally)` is chosen by the type of the workspace at compile time, so only
what a scene has is compiled. A new force is one file with a NamedTuple and an `@implements(add_forces)`, a new pair
potential one with an `@implements(pair_loop.pair)`.
"""

# isort: skip_file
from typing import NamedTuple

import numpy as np
from numba import literal_unroll, types

from rigidmd.compile import (
    Code, NumbaStruct, call_address, chosen_by_type, implements, is_a, kernel, load_arguments, task,
)  # fmt: skip
from rigidmd.core.state import EXAMPLE, OK, TALLY_SIZE, Load, State


class Setup(NamedTuple):
    """What the workspaces of an engine depend on."""

    cell: np.ndarray  # (3, 3) at the start; later the cell of the state is used
    dtype: type  # of the arithmetic between sites: numpy.float64 or numpy.float32
    skin: float  # extra radius of neighbour lists, Å
    with_energies: np.ndarray  # (1,) of the table
    needs_virials: bool  # whether virials will be needed without energies


def workspace_of(term: NamedTuple, setup: Setup) -> NamedTuple:
    """The workspace of a term, with nothing compiled yet; the term itself if it needs none."""
    return term.workspace(setup) if hasattr(term, "workspace") else term


def with_code(workspace: NamedTuple) -> NamedTuple:
    return workspace.with_code() if hasattr(workspace, "with_code") else workspace


def with_capacity(workspace: NamedTuple, cell: np.ndarray) -> NamedTuple:
    """The workspace with the capacity that it needed, for a cell (3, 3). May raise SimulationError."""
    return workspace.with_capacity(cell) if hasattr(workspace, "with_capacity") else workspace


def with_common_scratch(workspaces: tuple[NamedTuple, ...]) -> tuple[NamedTuple, ...]:
    """The workspaces with one common scratch array, the largest of theirs, for use while forces are computed."""
    arrays = [workspace.scratch for workspace in workspaces if hasattr(workspace, "scratch")]
    if not arrays:
        return workspaces
    largest = max(arrays, key=np.size)
    return tuple(w.with_scratch(largest) if hasattr(w, "scratch") else w for w in workspaces)


def checkpoint_arrays(workspace: NamedTuple) -> dict[str, np.ndarray]:
    """Arrays on which the next forces depend besides the state, for `restored`; most workspaces have none."""
    return workspace.checkpoint_arrays() if hasattr(workspace, "checkpoint_arrays") else {}


def restored(workspace: NamedTuple, arrays: dict[str, np.ndarray], skin: float, now: float) -> NamedTuple:
    """The workspace, which has machine code, with its `checkpoint_arrays`. Raises ValueError if these do not fit. skin
    : of neighbour lists, as requested, Å. now : the present time, ps"""
    if bool(arrays) != hasattr(workspace, "checkpoint_arrays"):
        raise ValueError(f"{type(workspace).__name__} {'lacks' if not arrays else 'has no'} checkpoint arrays")
    return workspace.restore(arrays, skin, now) if arrays else workspace


def add_forces(term, state, load, tally):
    """Add the forces and torques of a term to `load`, its energy and virial to `tally` unless None; a status code."""
    raise TypeError(f"{type(term).__name__} is not a term, or this was called outside compiled code")


@kernel(inline=True)
def worse_status(status, other):
    """The worse of two status codes; the other may be None, which is OK."""
    return status if other is None else max(status, other)


@chosen_by_type
def power(term, state, velocity, omega):
    """Power of a term whose class has `time_dependent = True`; 0 for any other, since its energy includes its work.
    velocity (lab axes) and omega (body axes) : tuples, relative to the frame"""
    if not getattr(term.instance_class, "time_dependent", False):
        return lambda term, state, velocity, omega: 0.0


@chosen_by_type
def energy_rate(term, state):
    """dU/dt at fixed positions of a term of molecules whose class has `time_dependent = True`; 0 for any other."""
    if not getattr(term.instance_class, "time_dependent", False):
        return lambda term, state: 0.0


class NoForce(NamedTuple):
    """No forces; Numba cannot loop over an empty tuple of terms."""

    force: float = 0.0


@implements(add_forces, NoForce)
def _add_no_force(term, state, load, tally):
    return OK


#: What `compute_load` computes: forces; forces, energies and virials; forces into the other load; forces and virials,
#: and energies only where these take no extra time.
FORCES_ONLY, WITH_ENERGIES, INTO_OTHER_LOAD, WITH_VIRIALS = 0, 1, 2, 3


class TermTable(NamedTuple):
    """Force terms as addresses of machine code and of its arguments. Each term is compiled once, for all scenes that
    have it, and the step loop once for all terms of molecules. The table counts no references: see `TermDispatcher`."""

    force_address: np.ndarray  # (terms,) intp, of `_add_plain`; 0 for a body, whose terms are compiled into the loop
    tally_address: np.ndarray  # (terms,) of `_add_tallied`
    rate_address: np.ndarray | None  # (terms,) of `_add_rate`; None if no term is time-dependent
    arguments_address: np.ndarray  # (terms,) of the packed arguments
    tallies: np.ndarray  # (terms, 10) energies and virials
    with_energies: np.ndarray  # (1,) whether energies are needed in `tallies`
    tallies_valid: np.ndarray  # (1,) whether `tallies` belong to the last forces
    status: np.ndarray  # (1,) the worst status code
    power: np.ndarray  # (1,) sum of the rates


@task()
def _add_plain(arguments, block):
    term, state, load, other, _, status, _ = load_arguments(arguments)
    status[0] = worse_status(status[0], add_forces(term, state, other if block == INTO_OTHER_LOAD else load, None))


@task()
def _add_tallied(arguments, block):
    term, state, load, _, tally, status, _ = load_arguments(arguments)
    status[0] = worse_status(status[0], add_forces(term, state, load, tally))


@task()
def _add_rate(arguments, block):
    term, state, _, _, _, _, power = load_arguments(arguments)
    power[0] += energy_rate(term, state)


class TermDispatcher:
    """The terms of an engine and their table; keeps alive what the table refers to. called : whether the step loop
    calls the terms by address. with_energies : see `Setup`"""

    def __init__(self, workspaces: tuple[NamedTuple, ...], called: bool, with_energies: np.ndarray):
        tasks = {"tallied": _add_tallied} | ({"plain": _add_plain} if called else {})
        if called and any(getattr(type(workspace), "time_dependent", False) for workspace in workspaces):
            tasks["rate"] = _add_rate
        plain, tallied, rate, arguments = np.zeros((4, len(workspaces)), np.intp)
        tallies, (valid, status) = np.zeros((len(workspaces), TALLY_SIZE)), np.zeros((2, 1), np.int64)
        rates, power = rate if "rate" in tasks else None, np.zeros(1)
        self.table = TermTable(plain, tallied, rates, arguments, tallies, with_energies, valid, status, power)
        self._codes: list[Code] = []
        self._structs: list[NumbaStruct] = []
        self._bound_to: tuple = ()
        for k, workspace in enumerate(workspaces):
            content = (workspace, *EXAMPLE, EXAMPLE[1], tallies[0], status, power)
            self._codes.append(Code(**{name: (task, content) for name, task in tasks.items()}))
            for name, addresses in (("plain", plain), ("tallied", tallied), ("rate", rate)):
                addresses[k] = self._codes[k].address(name) if name in tasks else 0

    def bind(
        self, workspaces: tuple[NamedTuple, ...], state: State, load: Load, other: Load | None = None
    ) -> TermTable:
        """The table, bound to workspaces (of the same types as the first), a state and its loads. Numba takes
        milliseconds to determine the types of the arrays, so nothing is done if these are unchanged."""
        table, loads = self.table, (load, other or load)
        bound_to = (*workspaces, *state, *loads[0], *loads[1])
        if list(map(id, bound_to)) == list(map(id, self._bound_to)):
            return table
        self._structs = [
            code.to_struct((workspace, state, *loads, table.tallies[k], table.status, table.power))
            for k, (workspace, code) in enumerate(zip(workspaces, self._codes, strict=True))
        ]
        table.arguments_address[:] = [struct.address for struct in self._structs]
        self._bound_to = bound_to
        return table


@kernel(from_python=True)
def compute_load_with_energies(table, force, torque_body):
    """Write forces and torques of all terms, and energies and virials into the table; a status code. force, torque_body
    : the arrays of the load to which the table is bound"""
    return compute_load(table, None, Load(force, torque_body), WITH_ENERGIES)


def has_time_dependent_terms(table: types.Type) -> bool:
    """Whether the type of a table has addresses of the rates of time-dependent terms."""
    return is_a(table, TermTable) and table.types[TermTable._fields.index("rate_address")] is not types.none


@chosen_by_type
def compute_load(terms, state, load, which):
    """Write the forces and torques of all terms at the present positions; the worst status code. terms : a tuple of
    terms, which gives forces only, or a `TermTable`, which gets energies and virials. which : FORCES_ONLY,
    WITH_ENERGIES, INTO_OTHER_LOAD or WITH_VIRIALS; `load` must be the load that it means."""
    if not is_a(terms, TermTable):
        return lambda terms, state, load, which: compute_body_load(terms, state, load)

    def load_by_address(terms, state, load, which):
        clear(load.force)
        clear(load.torque_body)
        terms.status[0] = OK
        terms.tallies_valid[0] = 0
        tallied = which in (WITH_ENERGIES, WITH_VIRIALS)
        if tallied:
            terms.tallies[:] = 0.0
            terms.with_energies[0] = which == WITH_ENERGIES
        for k in range(len(terms.arguments_address)):
            address = terms.tally_address[k] if tallied else terms.force_address[k]
            call_address(address, terms.arguments_address[k], which)
            if terms.status[0] != OK:  # the next call begins with the first term again
                return terms.status[0]
        terms.tallies_valid[0] = which == WITH_ENERGIES
        return OK

    return load_by_address


@kernel
def clear(values):
    """values[:] = 0 for an array (n, 3), as a loop, which compiles ten times faster."""
    for m in range(len(values)):
        for k in range(3):
            values[m, k] = 0.0


@kernel
def copy(source, target):
    """target[:] = source, likewise."""
    for n, value in enumerate(source.flat):
        target.flat[n] = value


@kernel(inline=True)
def compute_body_load(terms, state, load):
    """Write the forces and torques of all terms (a tuple) at the present positions; the worst status code."""
    load.force[:] = 0.0
    load.torque_body[:] = 0.0
    status = OK
    for term in literal_unroll(terms):
        status = worse_status(status, add_forces(term, state, load, None))
    return status


@kernel
def total_power(terms, state, velocity, omega):
    total = 0.0
    for term in literal_unroll(terms):
        total += power(term, state, velocity, omega)
    return total


@kernel
def total_energy_rate(table):
    table.power[0] = 0.0
    for k in range(len(table.arguments_address)):
        call_address(table.rate_address[k], table.arguments_address[k], FORCES_ONLY)
    return table.power[0]
