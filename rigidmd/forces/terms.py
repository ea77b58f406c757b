"""Force terms and their workspaces, and the dispatch over them.

A term is a frozen NamedTuple of numbers that describes a force. A workspace is made from a term by
one engine: the numbers of the term and, if needed, lists, grids, sums and machine code. A term that
needs no workspace is used as its workspace. `add_forces(workspace, state, load, tally)` is chosen
by the type of the workspace at compile time, so only what a scene has is compiled. A new force is
one file with a NamedTuple and an `@implements(add_forces)`, a new pair potential one with an
`@implements(pair_loop.pair)`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Literal, NamedTuple, overload

import numpy as np

from rigidmd.compile import (
    ALWAYS,
    JOINED,
    Pass,
    Program,
    Rows,
    chosen_by_type,
    implements,
    is_a,
    kernel,
    load_arguments,
    run_passes,
    task,
)
from rigidmd.core.state import EXAMPLE, OK, TALLY_SIZE, Load, State, no_load
from rigidmd.core.user_warnings import warn_renamed


class Setup(NamedTuple):
    """What the workspaces of an engine depend on."""

    cell: np.ndarray  # (3, 3) at the start; later the cell of the state is used
    dtype: type  # of the arithmetic between sites: numpy.float64 or numpy.float32
    skin: float  # extra radius of neighbour lists, Å
    needs_virials: bool  # whether virials will be needed without energies


class Term:
    """What a force term and its workspace may have, besides an implementation of `add_forces`.

    A term has what is given here unless it defines it. A named tuple cannot inherit: `trait` finds
    an attribute of either.
    """

    # of a term

    #: Components (3,) of the total momentum that it changes; None unless it is an external field.
    changes_momentum: np.ndarray | None = None
    #: Whether its energy depends on positions in the lab, which excludes a barostat.
    absolute_positions = False
    #: Whether it is an interaction of charges.
    acts_on_charges = False
    #: Whether its energy depends on time; then there is an implementation of `power` or
    #: `energy_rate` for it.
    time_dependent = False

    def workspace(self, setup: Setup):
        """Its workspace, with nothing compiled yet."""
        return self

    # of a workspace

    def with_code(self):
        """The workspace with its machine code."""
        return self

    def with_capacity(self, cell: np.ndarray):
        """The workspace with the capacity that it needed, for a cell (3, 3). May raise
        SimulationError."""
        return self

    def renew_list(self) -> None:
        """Have the next evaluation build its neighbour list as the first one did."""

    def checkpoint_arrays(self) -> dict[str, np.ndarray]:
        """Arrays on which the next forces depend in addition to the state."""
        return {}

    def restore(self, arrays: dict[str, np.ndarray], skin: float):
        """The workspace, which has machine code, with its `checkpoint_arrays`.

        skin : of neighbour lists, as requested, Å

        Raises ValueError if the arrays do not fit.
        """
        if arrays:
            raise ValueError(f"{type(self).__name__} has no checkpoint arrays")
        return self

    def passes(self, into: "Evaluation") -> "TermPasses":
        """Its passes: here one that calls `add_forces`."""
        state, load, tally, status = into
        plain = (self, state, load, status)
        tallied = (self, state, load, tally, status)
        return TermPasses(
            loads=[
                Pass("add forces", _add_plain, plain, when=FORCES_ONLY),
                Pass("add forces and energies", _add_tallied, tallied, when=TALLIED),
            ]
        )


@overload
def trait(
    term: object, name: Literal["absolute_positions", "acts_on_charges", "time_dependent"]
) -> bool: ...
@overload
def trait(term: object, name: Literal["changes_momentum"]) -> np.ndarray | None: ...
@overload
def trait(
    term: object,
    name: Literal["workspace", "with_code", "with_capacity", "restore"],
) -> Callable[..., NamedTuple]: ...
@overload
def trait(term: object, name: Literal["renew_list"]) -> Callable[[], None]: ...
@overload
def trait(
    term: object, name: Literal["checkpoint_arrays"]
) -> Callable[[], dict[str, np.ndarray]]: ...
@overload
def trait(term: object, name: Literal["passes"]) -> "Callable[[Evaluation], TermPasses]": ...
def trait(term: object, name: str) -> object:
    """An attribute of a term, its workspace or the class of either, else the attribute of
    `Term`."""
    if name == "absolute_positions" and hasattr(term, "tied_to_places"):
        warn_renamed(f"{type(term).__name__}.tied_to_places", name)
        return term.tied_to_places
    if hasattr(term, name):
        return getattr(term, name)
    default = getattr(Term, name)
    return partial(default, term) if callable(default) else default


def add_forces(term, state, load, tally):
    """Add the forces and torques of a term to `load`, its energy and virial to `tally` unless None.
    A status code."""
    raise TypeError(
        f"{type(term).__name__} is not a term, or this was called outside compiled code"
    )


@kernel(inline=True)
def worse_status(status, other):
    """The worse of two status codes. The other may be None, which is OK."""
    return status if other is None else max(status, other)


@chosen_by_type
def power(term, state, velocity, omega):
    """Power of a term whose class has `time_dependent = True`, 0 for any other, since its energy
    includes its work.

    velocity, omega : tuples, along the axes of the lab and of the body, relative to the frame
    """
    if not trait(term.instance_class, "time_dependent"):
        return lambda term, state, velocity, omega: 0.0


@chosen_by_type
def energy_rate(term, state):
    """dU/dt at fixed positions of a term of molecules whose class has `time_dependent = True`, 0
    for any other."""
    if not trait(term.instance_class, "time_dependent"):
        return lambda term, state: 0.0


class NoForce(NamedTuple):
    """No forces. Numba cannot loop over an empty tuple of terms."""

    force: float = 0.0


@implements(add_forces, NoForce)
def _add_no_force(term, state, load, tally):
    return OK


#: What `compute_load` computes, and when passes of terms act: forces; forces, energies and virials;
#: forces and virials, and energies only where these take no extra time.
FORCES_ONLY, WITH_ENERGIES, WITH_VIRIALS = 1, 2, 4
TALLIED = WITH_ENERGIES | WITH_VIRIALS
#: For `compute_load`: forces at the displaced positions of a force gradient, into a second load, as
#: the forces of the state are still needed.
INTO_OTHER_LOAD = 8


class Evaluation(NamedTuple):
    """What the passes of a term read and write."""

    state: State
    load: Load
    tally: np.ndarray  # (10,) of the term
    status: np.ndarray  # (1,) of the program


class TermPasses(NamedTuple):
    """The passes of a term, by what they may do. Those of one list follow one another.

    `positions` and `forces` run at the same time as those of other terms: they write only to arrays
    of the term, and none of their tasks calls blocks of others.
    """

    cell: Sequence[Pass] = ()  # follow the cell
    positions: Sequence[Pass] = ()  # of sites, in the order in which they are needed
    lists: Sequence[Pass] = ()  # renew what depends on positions
    forces: Sequence[Pass] = ()  # and energies, on sites
    # add to the load, or read it; several blocks are `blocks_of` the molecules
    loads: Sequence[Pass] = ()


def in_order(passes: Sequence[tuple[str, TermPasses]]) -> list[tuple[str, Pass]]:
    """The passes of terms (name, passes) in the order in which they run, with their names. The
    order does not depend on numbers of blocks.

    Chains that run at the same time are sorted by length, the longest first; of equal ones, the
    last term's first. The grid of PME has the most passes, which wait for one another, and blocks
    of pairs fill the time.
    """
    rows: list[tuple[str, Pass]] = []
    for job, field in enumerate(TermPasses._fields, 1):
        chains = [(name, getattr(of, field)) for name, of in passes]
        if field in ("positions", "forces"):
            chains = sorted(reversed(chains), key=_number_without_energies, reverse=True)
            has_blocks = any(one.blocks > 1 for _, chain in chains for one in chain)
            for k, (name, chain) in enumerate(chains):
                rows += [
                    (name, one._replace(job=job, chain=k) if has_blocks else one) for one in chain
                ]
        else:
            joins = field == "loads"
            rows += [
                (name, one._replace(job=job, chain=JOINED) if joins and one.blocks > 1 else one)
                for name, chain in chains
                for one in chain
            ]
    return rows


def _number_without_energies(chain: tuple[str, Sequence[Pass]]) -> int:
    return sum(one.when & FORCES_ONLY != 0 for one in chain[1])


@task()
def _add_plain(arguments, block):
    term, state, load, status = load_arguments(arguments)
    status[0] = worse_status(status[0], add_forces(term, state, load, None))


@task()
def _add_tallied(arguments, block):
    term, state, load, tally, status = load_arguments(arguments)
    status[0] = worse_status(status[0], add_forces(term, state, load, tally))


@task()
def _add_rate(arguments, block):
    term, state, power = load_arguments(arguments)
    power[0] += energy_rate(term, state)


class TermTable(NamedTuple):
    """The passes of all terms, and what they compute. Its type is the same for all terms."""

    rows: Rows
    elsewhere: np.ndarray  # (rows,) addresses of the arguments with the other load
    rates: Rows  # of time-dependent terms, which add to `power`
    tallies: np.ndarray  # (terms, 10) energies and virials
    tallies_valid: np.ndarray  # (1,) whether `tallies` belong to the last forces
    power: np.ndarray  # (1,) sum of the rates


class TermDispatcher:
    """The terms of an engine and their table.

    uses : bits of what is computed, see FORCES_ONLY
    with_rates : whether the work of time-dependent terms is needed
    """

    def __init__(self, workspaces: tuple[NamedTuple, ...], uses: int, with_rates: bool = False):
        self._tallies, self._power = np.zeros((len(workspaces), TALLY_SIZE)), np.zeros(1)
        self._status, valid = np.zeros((2, 1), np.int64)
        self._with_rates = with_rates
        self.program = Program(self._passes(workspaces, *EXAMPLE), uses, self._status)
        self._rates = Program(
            self._rate_passes(workspaces, EXAMPLE[0]), ALWAYS, np.zeros(1, np.int64)
        )
        rows = self.program.rows
        elsewhere = np.zeros_like(rows.arguments)
        self.table = TermTable(rows, elsewhere, self._rates.rows, self._tallies, valid, self._power)
        self._bound_to: tuple = ()
        self._copy_and_load: tuple[State, Load] | None = None

    def copy_and_load(self, state: State) -> tuple[State, Load]:
        """A copy of a state, and arrays for its forces. The next call returns the same arrays for
        the next state of this size: the table stays bound to them."""
        if self._copy_and_load is None or _shapes(self._copy_and_load[0]) != _shapes(state):
            self._copy_and_load = state.copy(), no_load(state)
        for target, source in zip(self._copy_and_load[0], state, strict=True):
            target[:] = source
        return self._copy_and_load

    def _passes(self, workspaces: tuple[NamedTuple, ...], state: State, load: Load) -> list[Pass]:
        """The passes of the terms, in the order in which they run."""
        passes = [
            ("", trait(workspace, "passes")(Evaluation(state, load, tally, self._status)))
            for workspace, tally in zip(workspaces, self._tallies, strict=True)
        ]
        return [one for _, one in in_order(passes)]

    def _rate_passes(self, workspaces: tuple[NamedTuple, ...], state: State) -> list[Pass]:
        dependent = [w for w in workspaces if trait(type(w), "time_dependent")]
        return [
            Pass("rate of the energy", _add_rate, (w, state, self._power))
            for w in dependent
            if self._with_rates
        ]

    def bind(
        self,
        workspaces: tuple[NamedTuple, ...],
        state: State,
        load: Load,
        other: Load | None = None,
    ) -> TermTable:
        """The table, bound to workspaces (of the same types as the first), a state and its loads.
        Numba takes milliseconds to determine the types of the arrays, so nothing is done if these
        are unchanged."""
        bound_to = (*workspaces, *state, *load, *(other or ()))
        if list(map(id, bound_to)) != list(map(id, self._bound_to)):
            self.program.bind(self._passes(workspaces, state, load))
            self._rates.bind(self._rate_passes(workspaces, state))
            if other is not None:
                self.program.bind(self._passes(workspaces, state, other), self.table.elsewhere)
            self._bound_to = bound_to
        return self.table


def _shapes(state: State) -> list[tuple[int, ...]]:
    return [array.shape for array in state]


@kernel(from_python=True)
def compute_load_with_energies(table, force, torque_body):
    """Write forces and torques of all terms, and energies and virials into the table. A status
    code. force, torque_body : the arrays of the load to which the table is bound"""
    return compute_load(table, None, Load(force, torque_body), WITH_ENERGIES)


@chosen_by_type
def compute_load(terms, state, load, which):
    """Write the forces and torques of all terms at the current positions. The worst status code.
    terms : a `TermTable`, which gets energies and virials. which : FORCES_ONLY, WITH_ENERGIES,
    INTO_OTHER_LOAD or WITH_VIRIALS. `load` must be the load that it means."""
    if not is_a(terms, TermTable):
        return None

    def load_by_passes(terms, state, load, which):
        clear(load.force)
        clear(load.torque_body)
        terms.tallies_valid[0] = 0
        if which & TALLIED != 0:
            terms.tallies[:] = 0.0
        if which == INTO_OTHER_LOAD:
            return run_passes(terms.rows, terms.elsewhere, FORCES_ONLY)
        status = run_passes(terms.rows, terms.rows.arguments, which)
        terms.tallies_valid[0] = which == WITH_ENERGIES and status == OK
        return status

    return load_by_passes


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


@kernel
def total_energy_rate(table):
    """The rate of change of the potential energy by forces that depend on time, u Å²/ps³."""
    table.power[0] = 0.0
    run_passes(table.rates, table.rates.arguments, ALWAYS)
    return table.power[0]
