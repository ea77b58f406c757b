"""The cheapest integrator and time step for an accuracy, found by runs from the start.

Cost is counted in force evaluations, not seconds, so a scene leads to the same choice on every machine.
"""

from math import ceil, floor, inf, log10
from typing import NamedTuple

from rigidmd.core.state import State
from rigidmd.errors import SimulationError
from rigidmd.measure.trials import Subject, Trial, end_of, gap, look

#: Tried in this order. A later one that costs more at its first good step is not refined.
CANDIDATES = ("velocity_verlet", "two_stage", "pefrl", "srkn_4", "srkn_6", "suzuki_4", "kahan_li_6", "kahan_li_8")
HALVINGS = 12
#: An interpolated step is shortened by this factor, so that its error falls below the target.
MARGIN = 0.95


class Choice(NamedTuple):
    """The cheapest integrator with its step, and the measured error."""

    integrator: str
    timestep: float  # in the subject's unit
    error: float
    forces: float  # evaluations per unit of time of the span
    reason: str


def choose(subject: Subject, target: float, error: str, longest: dict[str, float]) -> Choice:
    """The integrator and step with the fewest forces that keep an error (an attribute of `Trial`) below a target.

    longest : the longest step to try of each integrator, in the subject's unit. Raises SimulationError.
    """
    exact = _reference(subject, target) if error == "trajectory_error" else None
    found: dict[str, Trial] = {}
    for name in CANDIDATES:
        if name in longest:
            cheapest = min((_cost(subject, trial) for trial in found.values()), default=inf)
            if trial := _longest_good(subject, name, target, error, longest[name], cheapest, exact):
                found[name] = trial
    if not found:
        raise SimulationError(f"no integrator keeps its error below {target:g} with any step tried")
    best = min(found.values(), key=lambda trial: _cost(subject, trial))
    per = "ps" if subject.time_unit == "fs" else "s"
    cost, value = _cost(subject, best), getattr(best, error)
    reason = f"error {value:.1e} over {subject.span:.3g} {per} for a target of {target:g}; {cost:.4g} forces per {per}"
    common = found.get("velocity_verlet")
    if common is not None and common is not best:
        reason += f", {_cost(subject, common) / cost:.1f} times fewer than velocity_verlet at {common.timestep:.3g} "
        reason += subject.time_unit
    return Choice(best.integrator, best.timestep, value, cost, reason)


def _cost(subject: Subject, trial: Trial) -> float:
    """Forces per unit of time of the span."""
    return subject.methods[trial.integrator].force_evaluations / (trial.timestep * subject.time_size)


def _longest_good(
    subject: Subject, name: str, target: float, error: str, longest: float, cheapest: float, exact: State | None
) -> Trial | None:
    """The longest step within the target: halve the step, then interpolate by the order. None if too expensive."""
    step, bad = longest, None
    for _ in range(HALVINGS):
        good = _trial(subject, name, step, exact)
        if not good.diverged and getattr(good, error) <= target:
            break
        bad, step = good, step / 2
        if subject.methods[name].force_evaluations / (2 * step * subject.time_size) > cheapest:
            return None  # already more expensive than another, at a step that is too long
    else:
        return None
    if bad is None or bad.diverged:  # no interpolation from a step that diverges
        return good
    order = subject.methods[name].order
    guess = bad.timestep * (target / getattr(bad, error)) ** (1 / order)
    for _ in range(4):
        guess = _rounded(MARGIN * guess)
        if guess <= good.timestep:
            return good
        better = _trial(subject, name, guess, exact)
        if not better.diverged and getattr(better, error) <= target:
            return better
    return good


def _trial(subject: Subject, name: str, timestep: float, exact: State | None) -> Trial:
    """A trial of an integrator at a step; it ends exactly at the span if trajectories are compared."""
    n = max(1, ceil(subject.span / (timestep * subject.time_size) * (1 - 1e-12)))
    if exact is not None:
        timestep = subject.span / n / subject.time_size
    trial = Trial(name, timestep, n, n * subject.methods[name].force_evaluations)
    look(subject, trial, exact)
    return trial


def _rounded(step: float) -> float:
    """Rounded down to three digits."""
    unit = 10.0 ** (floor(log10(step)) - 2)
    return floor(step / unit) * unit


def _reference(subject: Subject, target: float) -> State:
    """The state at the end of the span, exact to a tenth of the target. Raises SimulationError."""
    method = subject.methods[subject.reference]
    steps = 16
    before = end_of(subject, method, steps)
    for _ in range(HALVINGS):
        steps *= 2
        now = end_of(subject, method, steps)
        rotation, position = gap(now, before)
        if (position if rotation != rotation else rotation) <= 0.1 * target:
            return now
        before = now
    raise SimulationError(f"no reference is exact to a tenth of trajectory_error = {target:g}")
