"""The choice of `integrator = "auto"` for an error of energy or trajectory: the cheapest integrator
and step.

Cost is counted in force evaluations, not seconds, so a scene leads to the same choice on every
machine. An error of the energy has to hold over the whole run: short pilot runs measure the regular
error of each step, `measure_energy_walk` the random walk of the energy by truncated forces, and a
longer pilot run of the best step its slow regular error.
"""

from dataclasses import replace
from math import ceil, floor, inf, log10, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import SCHEMES, Scheme
from rigidmd.core.state import State
from rigidmd.core.statistics import ENERGY_ERROR
from rigidmd.engines.cpu.engine import BehindWallError
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.run import trials
from rigidmd.run.pilot.energy_walk import EnergyWalk, measure_energy_walk
from rigidmd.run.trials import Trial, TrialSystem, final_state, state_difference
from rigidmd.scene.validation import not_none

#: Tried in this order. A later one is abandoned at a step that is too long and costs more.
CANDIDATES = sorted(
    (name for name, scheme in SCHEMES.items() if scheme.auto), key=lambda name: SCHEMES[name].auto
)
#: Maximum number of trials of each candidate, maximum factor by which its longest step is
#: shortened, and minimum gain for another trial.
MAX_TRIALS, MAX_SHORTENING, MIN_GAIN = 16, 4096, 1.1
#: Fewest steps of the reference, and the maximum number of halvings of its step.
REFERENCE_STEPS, HALVINGS = 16, 12
#: An interpolated step is shortened by this factor, so that its error falls below the target.
MARGIN = 0.95
#: Expected error over a run longer than its pilot runs, in the target: one random walk in ten is
#: 1.5 times as large.
SAFETY = 0.65
#: Length of the pilot run of the best step: part of the run; least and most, in short pilot runs;
#: its repetitions.
LONG_PILOT_PART = 0.05
LONG_PILOT_MIN = 10.0
LONG_PILOT_MAX = 100.0
CORRECTIONS = 3
REMEDIES = (
    "truncation = 'smooth_switch', a longer cutoff_A or a shorter stage make the walk of the energy"
    " smaller"
)


class Choice(NamedTuple):
    """The cheapest integrator with its step, and the expected error."""

    integrator: str
    timestep: float  # in the unit of the `TrialSystem`
    error: float
    reason: str


class _Search:
    """The longest steps of the candidates within a target for an error (an attribute of `Trial`)
    over a time."""

    def __init__(
        self,
        system: TrialSystem,
        target: float,
        error: str,
        longest: dict[str, float],
        exact: State | None,
    ):
        self.system, self.longest, self.exact = system, longest, exact
        self.target, self.error = target, error
        self.energy_walk: EnergyWalk | None = None
        self.time = system.span
        # regular error in a longer pilot run over that in the short one
        self.slow_factor: dict[str, float] = {}
        self.measured: dict[str, Trial] = {}  # the last one of each integrator that has an error
        self._tried: dict[tuple[str, float, float | None], Trial] = {}

    def best(self) -> Trial | None:
        """The trial with the fewest forces. None if no trial is within the target."""
        best = None
        cheapest = inf
        for name in CANDIDATES:
            trial = self._longest_step(name, cheapest) if name in self.longest else None
            if trial is not None and self.cost(trial) < cheapest:
                best = trial
                cheapest = self.cost(trial)
        return best

    def cost(self, trial: Trial) -> float:
        """Forces per unit of time of the span."""
        evaluations = self.system.methods[trial.integrator].force_evaluations
        return evaluations / (trial.timestep * self.system.time_size)

    def walk_square(self, name: str, timestep: float, time: float) -> float:
        scheme = self.system.methods[name].scheme
        if self.energy_walk is None or not isinstance(scheme, Scheme):
            return 0.0
        return self.energy_walk.square(scheme, timestep * self.system.time_size, time)

    def expected(self, trial: Trial, timestep: float | None = None) -> float:
        """Error over the time. At another step by the order of the integrator."""
        name = trial.integrator
        step = timestep or trial.timestep
        regular = self.slow_factor.get(name, 1.0) * getattr(trial, self.error)
        regular *= (step / trial.timestep) ** self.system.methods[name].order
        return sqrt(regular**2 + self.walk_square(name, step, self.time))

    def trial(self, name: str, timestep: float, span: float | None = None) -> Trial:
        """A trial of an integrator at a step. It ends exactly at the span if trajectories are
        compared."""
        system = self.system if span is None else replace(self.system, span=span)
        n = max(1, ceil(system.span / (timestep * system.time_size) * (1 - 1e-12)))
        if self.exact is not None:
            timestep = system.span / n / system.time_size
        if (name, timestep, span) not in self._tried:
            trial = Trial(name, timestep, n, n * system.methods[name].force_evaluations)
            trials.measure_errors(system, trial, self.exact)
            self._tried[name, timestep, span] = trial
        return self._tried[name, timestep, span]

    def step_for(self, trial: Trial) -> float:
        """The step at which the expected error is the target, by the order of the integrator."""
        low, high = 1e-6 * trial.timestep, 1e3 * trial.timestep
        while high > 1.01 * low:
            middle = sqrt(low * high)
            if self.expected(trial, middle) <= self.target:
                low = middle
            else:
                high = middle
        return low

    def _longest_step(self, name: str, cheapest: float) -> Trial | None:
        """The trial with the longest step within the target. None without one, or if all cost more
        than `cheapest`."""
        longest = step = self.longest[name]
        good = None
        bad = inf
        for _ in range(MAX_TRIALS):
            trial = self.trial(name, step)
            if not trial.diverged:
                self.measured[name] = trial
            if not trial.diverged and self.expected(trial) <= self.target:
                good = trial
            elif good is None and (self.cost(trial) > cheapest or step < longest / MAX_SHORTENING):
                return None  # a step that is too long costs more than another integrator
            else:
                bad = trial.timestep
            if good is None:
                if trial.diverged:
                    step = step / 2
                else:
                    step = max(round_down(MARGIN * self.step_for(trial)), step / 4)
                continue
            step = min(MARGIN * self.step_for(good), longest)
            step = round_down(step if step < bad else sqrt(good.timestep * bad))
            if step < MIN_GAIN * good.timestep:
                return good
        return good


def choose(
    system: TrialSystem,
    longest: dict[str, float],
    energy: float | None,
    trajectory: float | None = None,
    duration: float | None = None,
) -> Choice:
    """The integrator and step with the fewest forces that keep the error of the energy, or else of
    the trajectory, below a target.

    longest : the longest step to try of each integrator, in the unit of the system; duration : of
    the run over which an error of the energy has to hold, if not the span. Raises SimulationError.
    """
    if energy is not None:
        target = energy
        error = "energy_rms"
        exact = None
    else:
        target = not_none(trajectory)
        error = "trajectory_error"
        duration = None
        exact = _reference(system, target)
    search = _Search(system, target, error, longest, exact)
    first = search.best()
    if first is None:
        reached = [
            f"; {trial.integrator} reaches {getattr(trial, error):.1e} at {trial.timestep:.3g}"
            f" {system.time_unit}"
            for trial in sorted(search.measured.values(), key=lambda trial: getattr(trial, error))
        ]
        raise SimulationError(
            f"no integrator keeps its error below {target:g} with any step tried"
            + "".join(reached[:1])
        )
    best = first
    per = system.span_unit
    value = getattr(best, error)
    over = f"over {system.span:.3g} {per}"
    words = ""
    if duration is not None and duration > system.span:
        best, value, words = _best_for_duration(search, best, duration)
        over = f"over {duration:.4g} {per}"
    cost, before = search.cost(best), search.cost(first)
    kind = ENERGY_ERROR if error == "energy_rms" else "error of the trajectory"
    reason = (
        f"{kind} {value:.1e} {over} for a target of {target:g}{words}; {cost:.4g} forces per {per}"
    )
    common = search.measured.get("velocity_verlet")
    if common is not None and best.integrator != "velocity_verlet":
        step = min(search.step_for(common), longest["velocity_verlet"])
        fewer = search.cost(common) * common.timestep / step / cost
        reason += f", {fewer:.1f} times fewer than velocity_verlet at {step:.2g} {system.time_unit}"
    if value > target:
        reason += f". No step tried keeps the target over that time: {REMEDIES}"
    elif (
        cost > 1.5 * before
        and search.walk_square(best.integrator, best.timestep, search.time) > 0.1 * value**2
    ):
        reason += (
            f"; {cost / before:.1f} times as many as for {system.span:.3g} {per} only: {REMEDIES}"
        )
    return Choice(best.integrator, best.timestep, value, reason)


def _best_for_duration(search: _Search, first: Trial, duration: float) -> tuple[Trial, float, str]:
    """The best trial for a run that is longer than its pilots, its expected error, and a phrase
    about the pilot run. Raises SimulationError if none survives its pilot run."""
    span = search.system.span
    target = search.target
    search.energy_walk, search.time = measure_energy_walk(search.system, first.timestep), duration
    search.target = SAFETY * target
    length = max(LONG_PILOT_MIN * span, LONG_PILOT_PART * duration)
    length = min(duration, LONG_PILOT_MAX * span, length)
    best = first
    value = search.expected(first)
    pilot_trial = first
    for _ in range(CORRECTIONS):
        if (candidate := search.best()) is None:
            break
        name, step = candidate.integrator, candidate.timestep
        trial = search.trial(name, step, length)
        if trial.diverged:
            search.longest[name] = step / 2
            continue
        best, pilot_trial = candidate, trial
        of_pilot = search.walk_square(name, step, length)
        # the error may not be 0 at the start
        square = max(pilot_trial.energy_rms**2, 2 * float(np.var(pilot_trial.energies)))
        value = sqrt(square + search.walk_square(name, step, duration) - of_pilot)
        if value <= (1 + SAFETY) / 2 * target:
            break
        regular = sqrt(max(square - of_pilot, best.energy_rms**2))
        slow = regular / (best.energy_rms or regular or 1.0)
        search.slow_factor[name] = max(1.2 * search.slow_factor.get(name, 1.0), slow)
    if best.timestep > search.longest[best.integrator]:
        raise SimulationError(
            f"{best.integrator} at {best.timestep:.3g} {search.system.time_unit} keeps its error"
            f" for {span:.3g} but diverges within {length:.3g}: give an integrator and a time step"
        )
    pilot = pilot_trial.steps * pilot_trial.timestep * search.system.time_size
    pilot_error = f"{pilot_trial.energy_rms:.1e} in a pilot of {pilot:.3g} ps"
    return best, value, f" (expected, from {pilot_error})"


def round_down(step: float) -> float:
    """A step rounded down to three digits."""
    unit = 10.0 ** (floor(log10(step)) - 2)
    return float(f"{floor(step / unit) * unit:.3g}")


def _reference(system: TrialSystem, target: float) -> State:
    """The state at the end of the span, exact to a tenth of the target. Raises SimulationError."""
    before = None
    for k in range(HALVINGS + 1):
        try:
            now = final_state(system, REFERENCE_STEPS * 2**k)
        except (NotFiniteError, BehindWallError):  # its step is too long
            before = None
            continue
        if before is not None:
            rotation, position = state_difference(now, before)
            if (position if rotation != rotation else rotation) <= 0.1 * target:
                return now
        before = now
    most = REFERENCE_STEPS * 2**HALVINGS
    diverges = f": it diverges with up to {most} steps" if before is None else ""
    raise SimulationError(
        f"no reference is exact to a tenth of trajectory_error = {target:g}{diverges}"
    )
