"""The program of a stage in words: what is done in a step and for its forces, in which order, on
how many blocks, when."""

import time
from typing import NamedTuple

import numpy as np

from rigidmd.compile import ALONE, JOINED, Pass
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import State, no_load
from rigidmd.dynamics.step_table import StepTable
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.forces.terms import FORCES_ONLY, WITH_ENERGIES


class Row(NamedTuple):
    """A row of a program."""

    text: str
    blocks: int
    job: str  # in words; empty if it runs alone
    when: str  # in words; empty if it acts always


def program_of_step(engine: CpuEngine, state: State, scheme: Scheme) -> list[Row]:
    """The rows of a step of molecules, in order. Nothing is compiled."""
    table = StepTable(scheme, engine.step_parts(scheme, state, no_load(state)))
    return [Row(one.text, one.blocks, "", table.words(one.when)) for one in table.passes]


def program_of_forces(engine: CpuEngine, state: State) -> list[Row]:
    """The rows of an evaluation of forces, in order. Nothing is compiled."""
    return [
        Row(f"{name}: {one.text}", one.blocks, _job(one), _when(one.when))
        for name, one in engine.passes(state)
    ]


#: Steps before the first measurement, before each, and of each: a multiple of the usual intervals
#: of barostats. Measurements for each number of threads.
BEGIN, SETTLING, MEASURED, ROUNDS = 20, 4, 100, 2


class Profile(NamedTuple):
    """Mean times of a step and its rows on numbers of threads, the first of which is 1; s."""

    threads: tuple[int, ...]
    steps: tuple[float, ...]
    #: text and times of each row; the last one is the rest of the step
    rows: list[tuple[str, tuple[float, ...]]]
    idle: float  # fraction of the time of all threads in which they have no blocks to run


def profile_of(engine: CpuEngine, state: State, scheme: Scheme, dt: float) -> Profile:
    """Measure the rows of steps from a state, which is copied, on one thread and on as many as the
    engine uses. dt in ps.

    The time of a row in a job, or of several blocks, is the sum over its blocks divided by the
    number of threads, since rows of a job run at the same time. The engine measures all later steps
    too. Raises SimulationError.
    """
    asked = engine.threads
    numbers = tuple(dict.fromkeys((1, usable_threads(asked))))
    state = engine.begin(state, scheme)
    engine.advance(state, scheme, dt, BEGIN)
    rows = engine.measure(state)
    steps = np.zeros(len(numbers))
    sums = np.zeros((len(numbers), len(rows)))
    try:
        for k in ROUNDS * list(range(len(numbers))):
            engine.threads = numbers[k]
            until = int(state.step[0]) + SETTLING
            engine.advance(state, scheme, dt, until)
            before = np.array([spent.sum() for _, spent in rows])
            began = time.perf_counter()
            engine.advance(state, scheme, dt, until + MEASURED)
            steps[k] += time.perf_counter() - began
            sums[k] += 1e-9 * (np.array([spent.sum() for _, spent in rows]) - before)
    finally:
        engine.threads = asked
    measured = ROUNDS * MEASURED
    return profile_from([one for one, _ in rows], numbers, steps / measured, sums / measured)


def profile_from(
    rows: list[Pass], numbers: tuple[int, ...], steps: np.ndarray, sums: np.ndarray
) -> Profile:
    """The profile of rows from times of a step (numbers of threads,) and of all blocks of each row
    (numbers of threads, rows), s."""
    is_single = np.array([one.blocks == 1 and one.job == ALONE for one in rows])
    times = np.where(is_single, sums, sums / np.array(numbers)[:, None])
    # a single block may call blocks of others on all threads, as when a list is built
    most, alone = numbers[-1] * sums[-1], np.maximum(sums[0], sums[-1])
    work = np.where(is_single, np.minimum(alone, most), sums[-1])
    lines = [
        (one.text, tuple(of)) for one, of in zip(rows, times.T.tolist(), strict=True) if any(of)
    ]
    rest = tuple((steps - times.sum(axis=1)).tolist())
    idle = max(0.0, 1 - float(work.sum()) / (numbers[-1] * float(steps[-1])))
    return Profile(numbers, tuple(steps.tolist()), [*lines, ("waiting, and all else", rest)], idle)


def describe_profile(profile: Profile) -> str:
    """A table with the rows of a profile: times, gain by threads, fraction of a step."""
    numbers, steps, rows, idle = profile
    width = max(len(text) for text, _ in rows)
    several = len(numbers) > 1
    heads = [f"{count} thread{'s' * (count > 1)}" for count in numbers]
    heads = [f"{head:>11}" for head in [*heads, *(["gain"] if several else []), "of a step"]]
    lines = [f"  {'time, µs':<{width}} {''.join(heads)}"]
    for text, times in [*rows, ("a step", steps)]:
        cells = [f"{1e6 * spent:>11.1f}" for spent in times]
        gain = f"{times[0] / times[-1]:.2f}" if min(times) > 0 and text != rows[-1][0] else ""
        cells += [f"{gain:>11}"] if several else []
        lines.append(f"  {text:<{width}} {''.join(cells)}{times[-1] / steps[-1]:>11.1%}")
    if several:
        lines.append(f"  idle: {idle:.1%} of the time of {numbers[-1]} threads")
    return "\n".join(lines)


def _job(one: Pass) -> str:
    if one.job == ALONE:
        return ""
    return (
        f"{one.job}, blocks joined" if one.chain == JOINED else f"{one.job}, chain {one.chain + 1}"
    )


def _when(bits: int) -> str:
    if bits & FORCES_ONLY and bits & WITH_ENERGIES:
        return ""
    return "without energies" if bits & FORCES_ONLY else "with energies"


def describe_program(rows: list[Row]) -> str:
    """A table of the rows of a program. Chains of one job run at the same time."""
    width, job_width = (
        max(map(len, texts)) for texts in zip(*[(r.text, r.job) for r in rows], strict=True)
    )
    lines = [
        f"{k:>4}  {row.text:<{width}} {row.blocks:>6}  {row.job:<{job_width}}  {row.when}".rstrip()
        for k, row in enumerate(rows, 1)
    ]
    return "\n".join([f"{'row':>4}  {'':<{width}} blocks  {'job':<{job_width}}  when", *lines])
