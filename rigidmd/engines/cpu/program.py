"""The program of a stage in words: what is done in a step and for its forces, in which order, on
how many blocks, when."""

import time
from statistics import median
from typing import NamedTuple

from rigidmd.compile import run_row
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import State, no_load
from rigidmd.dynamics.step_table import StepTable
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES


class Row(NamedTuple):
    """A row of a program."""

    text: str
    blocks: int
    when: str  # in words; empty if it acts always


def program_of_step(engine: CpuEngine, state: State, scheme: Scheme) -> list[Row]:
    """The rows of a step of molecules, in order. Nothing is compiled."""
    table = StepTable(scheme, engine.step_parts(scheme, state, no_load(state)))
    return [Row(one.text, one.blocks, table.words(one.when)) for one in table.passes]


def program_of_forces(engine: CpuEngine, state: State) -> list[Row]:
    """The rows of an evaluation of forces, in order. Nothing is compiled."""
    return [
        Row(f"{name}: {one.text}", one.blocks, _when(one.when))
        for name, passes in engine.passes(state).items()
        for one in passes
    ]


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
            run_row(rows, k)
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
        return ""
    return "without energies" if bits & FORCES_ONLY else "with energies"


def describe_program(rows: list[Row]) -> str:
    """A table of the rows of a program."""
    width = max(len(row.text) for row in rows)
    lines = [
        f"{k:>4}  {row.text:<{width}} {row.blocks:>6}  {row.when}".rstrip()
        for k, row in enumerate(rows, 1)
    ]
    return "\n".join([f"{'row':>4}  {'':<{width}} blocks  when", *lines])
