"""The program of a stage in words: what is done in a step, in which order, on how many blocks."""

import time
from statistics import median
from typing import NamedTuple

from rigidmd.compile import kernel, run_row
from rigidmd.core.integrators import (
    BAROSTAT,
    BEGIN_TRAJECTORY,
    DRIFT,
    END_TRAJECTORY,
    KICK,
    REMOVE_MOMENTUM,
    SCALE_BOX,
    THERMOSTAT,
    Flow,
    Scheme,
)
from rigidmd.core.state import State
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.forces.neighbors.sites import blocks_of
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES

#: Kinds of flows in addition to kicks and drifts -> what they do.
FLOWS = {
    THERMOSTAT: "thermostat",
    BAROSTAT: "barostat",
    SCALE_BOX: "volume, by the inertia of the piston",
    REMOVE_MOMENTUM: "removal of the total momentum",
    BEGIN_TRAJECTORY: "start of a trajectory: new momenta",
    END_TRAJECTORY: "end of a trajectory: accepted, or returned to its start",
}
EVERY_STEP, FORCES, ENERGIES = "", "without energies", "with energies"


@kernel(from_python=True)
def run_single_row(rows, k):
    """`run_row` for Python, which measures the time of a pass."""
    return run_row(rows, k)


class Row(NamedTuple):
    """A row of a program."""

    text: str
    blocks: int
    when: str  # EVERY_STEP, FORCES or ENERGIES


def program_of(engine: CpuEngine, state: State, scheme: Scheme) -> list[Row]:
    """The rows of a step of molecules, in order. Nothing is compiled.

    Forces are evaluated before the first kick after a drift. The last evaluation of a step serves
    the next one.
    """
    blocks = blocks_of(len(state.position))
    forces = [
        Row(f"  {name}: {one.text}", one.blocks, _when(one.when))
        for name, passes in engine.passes(state).items()
        for one in passes
    ]
    rows: list[Row] = []
    positions_are_new = False
    for flow in scheme.flows:
        if flow.kind == KICK and positions_are_new:
            rows += [Row("forces at the new positions", 1, EVERY_STEP), *forces]
            positions_are_new = False
        rows.append(
            Row(_describe(flow, scheme), blocks if flow.kind != BAROSTAT else 1, EVERY_STEP)
        )
        positions_are_new |= flow.kind == DRIFT
    if positions_are_new:
        rows += [Row("forces, with the next step", 1, EVERY_STEP), *forces]
    return rows


#: Steps before a profile, and steps that it measures.
SETTLING, MEASURED = 20, 50


class Profile(NamedTuple):
    """Median times of a step and its rows, without energies."""

    step: float  # s
    #: Text and s of each row of the forces; the last one is the rest of the step
    rows: list[tuple[str, float]]


def profile_of(engine: CpuEngine, state: State, scheme: Scheme, dt: float) -> Profile:
    """Measure the rows of the forces over some steps from a state, which is copied. dt in ps.

    Each row is timed by itself, after steps that move the molecules, so that the list is updated as
    in a run. Raises SimulationError.
    """
    state = engine.begin(state, scheme)
    engine.advance(state, scheme, dt, SETTLING)
    rows = engine.rows_of_steps()
    texts = [
        f"{name}: {one.text}" for name, passes in engine.passes(state).items() for one in passes
    ]
    used = [k for k, when in enumerate(rows.when) if when & FORCES_ONLY]
    times: dict[int, list[float]] = {k: [] for k in used}
    steps: list[float] = []
    for n in range(MEASURED):
        began = time.perf_counter()
        engine.advance(state, scheme, dt, SETTLING + n + 1)
        steps.append(time.perf_counter() - began)
        for load in engine.load or ():
            load[:] = 0.0
        for k in used:
            began = time.perf_counter()
            run_single_row(rows, k)
            times[k].append(time.perf_counter() - began)
    step = median(steps)
    times_of_passes = [(texts[k], median(spent)) for k, spent in times.items()]
    remainder = step - scheme.force_evaluations * sum(spent for _, spent in times_of_passes)
    return Profile(step, [*times_of_passes, ("kicks, drifts, and all else", max(0.0, remainder))])


def describe_profile(profile: Profile) -> str:
    """A table with the rows of a profile and their fractions of a step."""
    width = max(len(text) for text, _ in profile.rows)
    lines = [
        f"  {text:<{width}} {1e6 * spent:>9.1f} {spent / profile.step:>6.1%}"
        for text, spent in profile.rows
    ]
    return "\n".join([f"  {'a step':<{width}} {1e6 * profile.step:>9.1f} µs", *lines])


def _when(bits: int) -> str:
    if bits & FORCES_ONLY and bits & WITH_ENERGIES:
        return EVERY_STEP
    return FORCES if bits & FORCES_ONLY else ENERGIES


def _describe(flow: Flow, scheme: Scheme) -> str:
    """A flow in words."""
    length = f"{flow.fraction:.4g} dt"
    if flow.kind == KICK:
        gradient = ", with the gradient of the force" if flow.gradient else ""
        return f"kick: momenta, by the forces over {length}{gradient}"
    if flow.kind == DRIFT:
        return f"drift: free flight and free rotation over {length}"
    acts_on = {THERMOSTAT: scheme.thermostat, BAROSTAT: scheme.barostat}.get(flow.kind)
    name = f" {type(acts_on).__name__}" if acts_on is not None else ""
    interval = f", in one of {flow.every} steps" if flow.every > 1 else ""
    return f"{FLOWS[flow.kind]}{name} over {length}{interval}"


def describe_program(rows: list[Row]) -> str:
    """A table of the rows of a program."""
    width = max(len(row.text) for row in rows)
    lines = [
        f"{k:>4}  {row.text:<{width}} {row.blocks:>6}  {row.when}".rstrip()
        for k, row in enumerate(rows, 1)
    ]
    return "\n".join([f"{'row':>4}  {'':<{width}} blocks  only", *lines])
