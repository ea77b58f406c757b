"""The table of a step of molecules: its rows in their order, each with the steps in which it acts.

Neighbouring kicks and drifts are one row. The last kick of a step and the first one of the next are
one row too, with the drift that follows, unless the call ends or something else acts in between:
the table has such a kick as a first, a repeated and a last one.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import Pass
from rigidmd.core.integrators import (
    BAROSTAT,
    BEGIN,
    DRIFT,
    END,
    KICK,
    REMOVE_MOMENTUM,
    SCALE_BOX,
    THERMOSTAT,
    Flow,
    Scheme,
)
from rigidmd.dynamics.registers import KEPT_BY_BAROSTAT, KEPT_BY_EXTENSION, Timing
from rigidmd.dynamics.step_parts import (
    ENERGIES,
    EVERY,
    FIRST,
    INTERVAL,
    LAST,
    PLAIN,
    REPEATED,
    WATCHED,
    StepParts,
    extension_of,
)
from rigidmd.dynamics.step_rows import (
    forces_row,
    gradient_row,
    move_row,
    orthogonality_row,
    power_row,
    removal_row,
    work_row,
)
from rigidmd.dynamics.thermostats import thermostat_row
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES, WITH_VIRIALS
from rigidmd.mechanics.free_rotor import ORTHOGONALITY_INTERVAL

#: The steps in which a row acts, in words.
WORDS = {EVERY: "", LAST: "last", FIRST: "first", REPEATED: "repeated"}
WORDS |= {PLAIN: "without energies", ENERGIES: "with energies", WATCHED: "before a sample"}
#: Random numbers that a flow may draw for one molecule in a step.
DRAWS = 1 << 20


class Intervals(NamedTuple):
    """Intervals of steps as arrays, and the bits that are set in their steps."""

    every: np.ndarray  # (intervals,)
    phase: np.ndarray  # 0: in the first of `every` steps; 1: in the last one
    in_segment: np.ndarray  # 1: of the steps of a segment; 0: of all steps
    bits: np.ndarray


Group = list[tuple[int, Flow]]  # neighbouring kicks and drifts, or another flow, with their numbers


class StepTable:
    """The rows of a scheme, in their order in `passes`."""

    def __init__(self, scheme: Scheme, parts: StepParts):
        self._scheme, self._parts = scheme, parts
        self._extension = extension_of(scheme)
        self._bits: dict[tuple[int, int, int], int] = {}  # fields of `Intervals` -> bits
        self._words = dict(WORDS)
        # which forces kicks need, and whether forces and energies are known where a row is added
        self._which = FORCES_ONLY if scheme.barostat is None else scheme.barostat.forces
        self._has_forces = self._has_energies = False
        self._drifts = [k for k, flow in enumerate(scheme.flows) if flow.kind == DRIFT]
        self._kicks = [k for k, flow in enumerate(scheme.flows) if flow.kind == KICK]
        self.passes = self._rows()

    def _rows(self) -> list[Pass]:
        scheme, parts = self._scheme, self._parts
        groups = neighbouring_moves(scheme.flows)
        opening, closing = kick_between_steps(groups)
        rows: list[Pass] = []
        for group in groups:
            k, flow = group[0]
            when = self._when(flow)
            timing = Timing(flow.fraction, DRAWS * k, when)
            if flow.kind in (KICK, DRIFT):
                rows += self._forces_of_kicks(group)
                if k == self._kicks[0] < self._drifts[0] and self._has_curvature:
                    rows.append(power_row(parts))
                if group is opening:
                    rows += [self._move(group, FIRST), self._move([*closing, *group], REPEATED)]
                else:
                    rows.append(self._move(group, LAST if group is closing else EVERY))
                rows += self._after_drift(group)
            elif flow.kind == THERMOSTAT:
                rows.append(thermostat_row(scheme.thermostat, parts, timing))
            elif flow.kind == BAROSTAT:
                rows += self._forces_of_barostat(k, when)
                rows += scheme.barostat.rows(parts, timing)
                rows += self._extension.after_barostat(parts, timing)
            elif flow.kind == SCALE_BOX:
                rows.append(scheme.barostat.volume_row(parts, timing))
                self._has_forces = self._has_energies = False
            elif flow.kind == BEGIN:
                rows.append(forces_row(parts, WITH_ENERGIES, when, KEPT_BY_EXTENSION))
                rows += self._extension.begin(parts, timing)
            elif flow.kind == END:
                rows += self._energies(when, 0)
                rows += self._extension.end(parts, timing)
                self._has_energies = False
            elif flow.kind == REMOVE_MOMENTUM:
                rows.append(removal_row(parts, when))
        return rows

    @property
    def _has_curvature(self) -> bool:
        """Whether a sample may need the curvature: averages of ensembles do, but not those of
        trajectories that are accepted or rejected."""
        return self._scheme.has_thermostat and not self._scheme.has_groups

    def _when(self, flow: Flow) -> int:
        """The steps in which a flow acts."""
        if flow.kind in (KICK, DRIFT):
            return EVERY
        if flow.kind == END or (flow.kind == BAROSTAT and self._which == FORCES_ONLY):
            self._set(flow.every, flow.phase, ENERGIES)
        if flow.every == 1:
            return EVERY
        self._set(flow.every, 1, LAST)
        place = "first" if flow.phase == 0 else "last"
        return self._interval_bit(flow.every, flow.phase, f"{place} of {flow.every} steps")

    def _set(self, every: int, phase: int, bits: int, in_segment: int = 1) -> None:
        """Set bits in the steps of an interval."""
        key = every, phase, in_segment
        self._bits[key] = self._bits.get(key, 0) | bits

    def _interval_bit(self, every: int, phase: int, words: str, in_segment: int = 1) -> int:
        """The bit of the steps of an interval."""
        bit = next((bit for bit, text in self._words.items() if text == words), 0)
        bit = bit or INTERVAL << (len(self._words) - len(WORDS))
        self._words[bit] = words
        self._set(every, phase, bit, in_segment)
        return bit

    def _forces_of_kicks(self, group: Group) -> list[Pass]:
        """The forces, their gradient and the work of time-dependent terms before kicks."""
        parts, kicks = self._parts, [(k, flow) for k, flow in group if flow.kind == KICK]
        rows = self._forces(kicks[0][0]) if kicks else []
        rows += [gradient_row(parts, flow) for _, flow in kicks if flow.gradient]
        rows += [work_row(parts, flow) for _, flow in kicks if parts.has_rates]
        return rows

    def _forces_of_barostat(self, k: int, when: int) -> list[Pass]:
        if self._which == WITH_VIRIALS:
            return self._forces(k)
        return self._energies(when, KEPT_BY_BAROSTAT)

    def _forces(self, k: int) -> list[Pass]:
        """Forces before flow k. Only the last ones of a step may need energies."""
        if self._has_forces:
            return []
        self._has_forces = True
        which, parts = self._which, self._parts
        kept = KEPT_BY_BAROSTAT if which == WITH_VIRIALS else 0
        if k > self._drifts[-1]:
            self._has_energies = True
            plain = forces_row(parts, which, PLAIN, kept)
            return [plain, forces_row(parts, WITH_ENERGIES, ENERGIES)]
        # forces of the step before are known, unless positions have changed since
        starts = k < self._drifts[0] and self._kicks[-1] > self._drifts[-1]
        return [forces_row(parts, which, FIRST if starts else EVERY, kept)]

    def _energies(self, when: int, kept: int) -> list[Pass]:
        """Forces and energies at an interval, unless the last forces of its steps have them."""
        if self._has_energies:
            return []
        return [forces_row(self._parts, WITH_ENERGIES, when, kept)]

    def _move(self, group: Group, when: int) -> Pass:
        """Neighbouring kicks and drifts."""
        kicks = [flow for _, flow in group if flow.kind == KICK]
        k, drift = group[-1]
        if drift.kind == KICK:
            return move_row(self._parts, kicks, None, 0.0, when)
        # the fractions of the drifts so far; the last one ends with the step
        before = [self._scheme.flows[n].fraction for n in self._drifts if n <= k]
        moment = 1.0 if k == self._drifts[-1] else sum(before)
        return move_row(self._parts, kicks, drift, moment, when)

    def _after_drift(self, group: Group) -> list[Pass]:
        k, flow = group[-1]
        if flow.kind != DRIFT:
            return []
        self._has_forces = self._has_energies = False
        if k != self._drifts[-1] or not len(self._parts.core.state.rotation):
            return []
        every = ORTHOGONALITY_INTERVAL
        return [
            orthogonality_row(self._parts, self._interval_bit(every, 1, f"1 of {every} steps", 0))
        ]

    def words(self, when: int) -> str:
        """When a row acts, in words."""
        return self._words[when]

    @property
    def intervals(self) -> Intervals:
        """The intervals at which some rows act."""
        columns = np.array([[*key, bits] for key, bits in self._bits.items()], np.int64)
        return Intervals(*np.ascontiguousarray(columns.reshape(-1, 4).T))


def neighbouring_moves(flows: tuple[Flow, ...]) -> list[Group]:
    """Flows in groups: at most two kicks by the same forces and a drift; every other flow by
    itself."""
    groups: list[Group] = []
    for k, flow in enumerate(flows):
        group = groups[-1] if groups else []
        if _continues(flow, [before for _, before in group]):
            group.append((k, flow))
        else:
            groups.append([(k, flow)])
    return groups


def _continues(flow: Flow, before: list[Flow]) -> bool:
    """Whether a flow is done in one row with the ones before it."""
    if not before or before[-1].kind != KICK:
        return False
    plain = len(before) == 1 and not flow.gradient and not before[0].gradient
    return flow.kind == DRIFT or (flow.kind == KICK and plain)


def kick_between_steps(groups: list[Group]) -> tuple[Group, Group]:
    """The groups with the first kick of a step and the last one, if they can be done in one row:
    nothing acts between them in every step. Otherwise empty groups."""
    moves = [n for n, group in enumerate(groups) if group[0][1].kind in (KICK, DRIFT)]
    opening, closing = groups[moves[0]], groups[moves[-1]]
    between = [*groups[: moves[0]], *groups[moves[-1] + 1 :]]
    kinds = [[flow.kind for _, flow in group] for group in (opening, closing)]
    acts_always = any(flow.every == 1 for group in between for _, flow in group)
    has_gradient = any(flow.gradient for group in (opening, closing) for _, flow in group)
    if acts_always or has_gradient or kinds[0].count(KICK) != 1 or kinds[1] != [KICK]:
        return [], []
    return (opening, closing) if opening is not closing else ([], [])
