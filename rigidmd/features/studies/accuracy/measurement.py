"""Error against run time of integrators: trials at several time steps, timed alternately, and what
they show."""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import RK4, Solver
from rigidmd.core.state import State
from rigidmd.errors import SimulationError
from rigidmd.run.trials import (
    OBSERVATIONS,
    Trial,
    TrialSystem,
    begin_trial,
    final_state,
    measure_errors,
    state_difference,
)

#: Spread of repeated timings that causes a warning.
DOUBTFUL = 0.2
#: Fraction of an integrator's longest stable step that is recommended, where a longer one diverges.
STABLE_FRACTION = 0.8
#: Minimum steps in a span of a trial that extends the steps of an integrator.
MIN_STEPS = 4
#: Steps that warm up an engine (lists, buffers, memory): the first 25 steps of 216 waters took 40
#: ms, the next 20 ms.
WARM_UP = 10
#: Minimum seconds of computing in the timing of a span.
TIMING_SECONDS = 0.2
#: Tolerances of general solvers that choose their steps.
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


@dataclass
class IntegratorAccuracy:
    """All trials of a subject, and the error of their reference."""

    trial_system: TrialSystem
    trials: list[Trial]
    reference_steps: int
    reference_error: float  # of the reference, from a run with half as many steps
    #: Usual methods that were not tried -> reason
    left_out: dict[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Precision of {self.trial_system.name}: {len(self.trials)} trials>"

    @property
    def integrators(self) -> list[str]:
        return list(dict.fromkeys(trial.integrator for trial in self.trials))

    @property
    def rotates(self) -> bool:
        return any(not np.isnan(trial.rotation_error) for trial in self.trials)

    @property
    def is_timed(self) -> bool:
        """Whether timings rank the trials: half of their spreads are at most `DOUBTFUL`. Otherwise
        force evaluations do."""
        spreads = [t.spread for t in self.trials if not t.diverged and t.spread is not None]
        return not spreads or float(np.median(spreads)) <= DOUBTFUL

    def cost(self, trial: "Trial | ReachedError") -> float:
        """Seconds of computing in a span, or force evaluations if timings scatter too much."""
        return trial.time if self.is_timed else trial.forces

    def bounded(self, integrator: str, error: str = "timestep") -> list[Trial]:
        """The trials of an integrator that have not diverged and have an error (an attribute of
        `Trial`) above 0, with the longest step first."""
        trials = [
            trial
            for trial in self.trials
            if trial.integrator == integrator and not trial.diverged and getattr(trial, error) > 0
        ]
        return sorted(trials, key=lambda trial: -trial.timestep)

    def front(self, error: str) -> list[Trial]:
        """Trials that no other beats in both cost and error (an attribute of `Trial`), cheapest
        first."""
        fastest: list[Trial] = []
        for trial in sorted((t for t in self.trials if not t.diverged), key=self.cost):
            if not fastest or getattr(trial, error) < getattr(fastest[-1], error):
                fastest.append(trial)
        return fastest

    def time_for(self, integrator: str, error: str, target: float) -> "ReachedError | None":
        """Where an integrator reaches an error, between its trials. None if its shortest step is
        not exact enough. At most its longest step, or `STABLE_FRACTION` of it where a longer one
        diverges."""
        tried = self.bounded(integrator, error)
        if not tried:
            return None
        unstable = any(t.diverged for t in self.trials if t.integrator == integrator)
        step = tried[0].timestep if getattr(tried[0], error) <= target else None
        for coarse, fine in pairwise(tried):
            a, b = np.log(getattr(coarse, error)), np.log(getattr(fine, error))
            if step is None and b <= np.log(target) <= a:
                fraction = (np.log(target) - a) / (b - a)
                step = coarse.timestep * (fine.timestep / coarse.timestep) ** fraction
        if step is None:
            return None
        longest = max(
            (STABLE_FRACTION if unstable else 1.0) * tried[0].timestep, tried[-1].timestep
        )
        if step < longest:
            limit = ""
        elif unstable:
            limit = "kept from its longest stable step"
        else:
            limit = "its longest step tried"
        step = float(min(step, longest))
        up = tried[::-1]
        steps = np.log([t.timestep for t in up])
        costs = ([t.time for t in up], [t.forces for t in up])
        time, forces = (float(np.exp(np.interp(np.log(step), steps, np.log(x)))) for x in costs)
        near = min(tried, key=lambda t: abs(np.log(t.timestep / step)))
        return ReachedError(time, forces, step, near.spread or 0.0, limit)


class ReachedError(NamedTuple):
    """Where an integrator reaches an error."""

    time: float  # seconds of computing in a span
    forces: float  # evaluations in a span
    step: float  # in the unit of the system
    spread: float  # range of the nearest trial's seconds over their median
    limit: str  # text, where stability or the steps tried, and not the error, set the step


def measure(
    system: TrialSystem,
    trials: list[Trial],
    repeats: int,
    progress: Callable[[float], object] = lambda fraction: None,
    extend: bool = False,
) -> IntegratorAccuracy:
    """Run all trials and the reference. Time the trials alternately `repeats` times.

    progress : called with the fraction done
    extend : whether longer steps than the longest one of each integrator are tried, doubled until
        one fails
    """
    most_forces = max((trial.forces for trial in trials), default=0) or OBSERVATIONS * OBSERVATIONS
    steps = 2 * -(-2 * most_forces // system.methods[system.reference].force_evaluations)
    exact = final_state(system, steps)
    differences = state_difference(exact, final_state(system, steps // 2))
    result = IntegratorAccuracy(
        system, trials, steps, max(x for x in differences if not np.isnan(x))
    )
    for trial in trials:  # compile and measure errors
        measure_errors(system, trial, exact)
    if extend:
        result.trials = trials = _extended(system, trials, exact)
    good = [trial for trial in trials if not trial.diverged]
    done = 0.0
    total = len(good) * repeats
    for _ in range(repeats):
        for trial in good:
            trial.seconds.append(time_span(system, trial))
            done += 1
            progress(done / total)
    return result


def _extended(system: TrialSystem, trials: list[Trial], exact: State) -> list[Trial]:
    """The trials, and before those of each integrator trials with longer steps, doubled until one
    fails."""
    extended = []
    for name, group in groupby(trials, key=lambda trial: trial.integrator):
        ladder = list(group)
        longest = max(ladder, key=lambda trial: trial.timestep)
        while not longest.diverged and longest.tolerance is None and longest.steps >= 2 * MIN_STEPS:
            longest = trial_of(system, name, longest.steps // 2)
            measure_errors(system, longest, exact)
            ladder.insert(0, longest)
        extended += ladder
    return extended


def time_span(system: TrialSystem, trial: Trial) -> float:
    """Seconds of computing in a span, from spans of `TIMING_SECONDS` in total, with a warm engine.

    The cost of a call without steps is subtracted: 15 µs, as much as 200 steps of a free body.
    """
    engine, state, advance_to = begin_trial(system, trial)
    begun = state.copy()
    done = 0

    def seconds_of(steps: int) -> float:
        began = clock.perf_counter()
        advance_to(done + steps)
        return clock.perf_counter() - began

    def start_again() -> None:
        nonlocal done
        done = 0
        for array, first in zip(state, begun, strict=True):
            array[...] = first
        engine.forget()
        seconds_of(0)

    for _ in range(0, WARM_UP, trial.steps):
        seconds_of(min(WARM_UP, trial.steps))
        start_again()
    computing, calls, spans = 0.0, 0.0, 0
    while computing < TIMING_SECONDS:
        call = seconds_of(0)
        try:
            computing += seconds_of(trial.steps)
        except SimulationError:  # a step that is stable over the span may fail later
            if done == 0:
                raise
            start_again()
            continue
        calls = calls + call
        spans = spans + 1
        done = done + trial.steps
        if not system.can_continue:
            start_again()
    return (computing - calls if computing > calls else computing) / spans


def plan(system: TrialSystem, steps: dict[str, list[float]]) -> list[Trial]:
    """Trials of integrators at time steps (in the unit of the system), adjusted to a whole number
    in the span. Methods that choose their steps get tolerances instead."""
    trials = {}
    for integrator, timesteps in steps.items():
        scheme = system.methods[integrator].scheme
        if isinstance(scheme, Solver) and scheme.name != RK4:
            step = system.span / OBSERVATIONS / system.time_size
            for tolerance in TOLERANCES:
                trials[integrator, tolerance] = Trial(
                    integrator, step, OBSERVATIONS, 0, tolerance=tolerance
                )
            continue
        for timestep in timesteps:
            n = max(1, round(system.span / (timestep * system.time_size)))
            trials[integrator, n] = trial_of(system, integrator, n)
    return list(trials.values())


def trial_of(system: TrialSystem, integrator: str, steps: int) -> Trial:
    """A trial of this many steps in the span."""
    timestep = system.span / steps / system.time_size
    return Trial(integrator, timestep, steps, steps * system.methods[integrator].force_evaluations)
