"""Error against run time: every integrator moves the same start at several time steps.

The cost is seconds of computing and force evaluations for a span of time. The errors are those of the trajectory at its
end, of the energy and of other conserved quantities on the way and, for liquids on request, the bias of temperatures,
potential energy and pressure.
"""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from rigidmd.core.drift import slope
from rigidmd.core.integrators import RK4, Scheme, Solver
from rigidmd.core.state import State
from rigidmd.core.statistics import mean
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.engines.observables import Observation
from rigidmd.engines.ode import OdeEngine
from rigidmd.engines.protocol import Engine
from rigidmd.errors import SimulationError
from rigidmd.mechanics.rotation import orthogonality_error
from rigidmd.units import KJ_PER_MOL

#: Number of looks at the energy in a span.
LOOKS = 40
#: A run diverges if its energy error exceeds this fraction of the kinetic energy.
DIVERGED = 0.5
#: Time between looks for averages, ps: about the correlation time of the kinetic energy of water.
LOOK_PS = 0.02
#: Part of an integrator's longest stable step that is recommended, where a longer one diverges.
STABLE_SHARE = 0.8
#: Least steps in a span of a trial that extends a ladder.
FEWEST = 4
#: Steps that warm up an engine: they build lists, grow buffers and touch memory. The first 25 steps of 216 waters took
#: 40 ms, the next 25 took 20 ms.
WARM_UP = 10
#: Least seconds of computing in a timing.
TIMED = 0.2
#: For general solvers that choose their own steps.
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)


class Method(NamedTuple):
    """A way to move the subject."""

    engine: Callable[[], Engine]
    how: Scheme | Solver

    @property
    def chooses_steps(self) -> bool:
        """Whether it is given a tolerance, not a time step."""
        return isinstance(self.how, Solver) and self.how.name != RK4

    @property
    def force_evaluations(self) -> int:
        """In a step of given length."""
        return 4 if isinstance(self.how, Solver) else self.how.force_evaluations

    @property
    def order(self) -> int:
        """Order of the error in a given step."""
        return 4 if isinstance(self.how, Solver) else self.how.order


@dataclass
class Subject:
    """A start, and how to measure errors on it.

    methods : by name. energy(engine, state) : the conserved energy. energy_unit : the unit of the reported energy
    error, in words, with a note; energy_size : that unit in the units of `energy`. kinetic : the kinetic energy that
    sets the limit of divergence. kept(state) : relative errors of other conserved quantities. observe(engine, state,
    step) : the averaged observables of molecules in a box; None for others. reference : the method of the reference.
    goes_on : whether timing may continue beyond the span; else it starts again. refused : name -> reason for methods
    that cannot move this subject. singular : names of methods whose variables do not exist at the start.
    rounding : relative rms errors of forces and torques in mixed precision; None in double.
    """

    name: str
    state: State
    methods: dict[str, Method]
    energy: Callable[[Engine, State], float]
    energy_unit: str
    energy_note: str
    energy_size: float
    kinetic: float
    span: float
    time_unit: str  # fs or s, of time steps
    time_size: float  # of that unit, in the units of the span
    length_unit: str
    reference: str
    kept: Callable[[State], dict[str, float]]
    goes_on: bool
    refused: dict[str, str] = field(default_factory=dict)
    singular: tuple[str, ...] = ()
    observe: Callable[[Engine, State, float], Observation] | None = None
    molecules: int = 1
    freedom: int = 1
    rounding: tuple[float, float] | None = None


@dataclass
class Trial:
    """One integrator at one step."""

    integrator: str
    timestep: float  # in the subject's unit; the mean of steps that the method chooses
    steps: int
    forces: int  # evaluations in the span
    seconds: list[float] = field(default_factory=list)  # of computing in a span, for each repeat
    rotation_error: float = np.nan  # largest |Q - Q_ref| at the end
    position_error: float = np.nan  # largest |X - X_ref| at the end
    energy_rms: float = np.nan  # in the subject's unit
    energy_drift: float = np.nan  # per span
    energy_drift_error: float = np.nan
    orthogonality_error: float = np.nan
    kept: dict[str, float] = field(default_factory=dict)  # largest relative errors of other conserved quantities
    tolerance: float | None = None  # of a method that chooses its steps
    fault: str = ""  # why it failed or diverged
    averages: dict[str, tuple[float, float]] = field(default_factory=dict)  # name -> mean, standard error
    energies: list[float] = field(default_factory=list, repr=False)  # errors in the subject's unit, from 0 at the start

    @property
    def diverged(self) -> bool:
        """Whether it has no results."""
        return bool(self.fault)

    @property
    def time(self) -> float:
        """Median of the seconds."""
        return median(self.seconds)

    @property
    def spread(self) -> float | None:
        """Range of the seconds over their median; None if timed once."""
        return (max(self.seconds) - min(self.seconds)) / self.time if len(self.seconds) > 1 else None

    @property
    def trajectory_error(self) -> float:
        """The error of the rotation; of the position if nothing turns."""
        return self.position_error if np.isnan(self.rotation_error) else self.rotation_error


@dataclass
class Precision:
    """All trials of a subject, and the error of their reference."""

    subject: Subject
    trials: list[Trial]
    reference_steps: int
    reference_error: float  # of the reference, from a run with half as many steps
    sampled: float | None = None  # ps of averaging
    left_out: dict[str, str] = field(default_factory=dict)  # usual methods that were not tried -> reason

    def __repr__(self) -> str:
        return f"<Precision of {self.subject.name}: {len(self.trials)} trials>"

    @property
    def most_exact(self) -> Trial:
        """The trial with the smallest energy error, whose averages are the reference of the others."""
        return min((t for t in self.trials if t.averages), key=lambda t: t.energy_rms)

    def stable_step(self, integrator: str) -> float | None:
        """The longest step tried that did not diverge."""
        steps = [trial.timestep for trial in self.trials if trial.integrator == integrator and not trial.diverged]
        return max(steps, default=None)

    def front(self, error: str) -> list[Trial]:
        """Trials that no other beats in both time and error (an attribute of `Trial`), fastest first."""
        found: list[Trial] = []
        for trial in sorted((t for t in self.trials if not t.diverged), key=lambda t: t.time):
            if not found or getattr(trial, error) < getattr(found[-1], error):
                found.append(trial)
        return found

    def time_for(self, integrator: str, error: str, target: float) -> "Reached | None":
        """Where an integrator reaches an error, between its trials; None if its shortest step is not exact enough.

        At most its longest step, or `STABLE_SHARE` of it where a longer one diverges.
        """
        own = [t for t in self.trials if t.integrator == integrator and not t.diverged and getattr(t, error) > 0]
        own.sort(key=lambda t: -t.timestep)
        if not own:
            return None
        unstable = any(t.diverged for t in self.trials if t.integrator == integrator)
        step = own[0].timestep if getattr(own[0], error) <= target else None
        for coarse, fine in pairwise(own):
            a, b = np.log(getattr(coarse, error)), np.log(getattr(fine, error))
            if step is None and b <= np.log(target) <= a:
                share = (np.log(target) - a) / (b - a)
                step = coarse.timestep * (fine.timestep / coarse.timestep) ** share
        if step is None:
            return None
        longest = max((STABLE_SHARE if unstable else 1.0) * own[0].timestep, own[-1].timestep)
        limit = "" if step < longest else "kept from its longest stable step" if unstable else "its longest step tried"
        step, up = float(min(step, longest)), own[::-1]
        seconds = np.exp(np.interp(np.log(step), np.log([t.timestep for t in up]), np.log([t.time for t in up])))
        near = min(own, key=lambda t: abs(np.log(t.timestep / step)))
        return Reached(float(seconds), step, near.spread or 0.0, limit)


class Reached(NamedTuple):
    """Where an integrator reaches an error."""

    seconds: float  # of computing in a span
    step: float  # in the subject's unit
    spread: float  # range of the nearest trial's seconds over their median
    limit: str  # in words, where stability or the steps tried, and not the error, set the step


def measure(
    subject: Subject,
    trials: list[Trial],
    repeats: int,
    averages: float | None = None,
    say: Callable[[float], object] = lambda share: None,
    extend: bool = False,
) -> Precision:
    """Run all trials and the reference; time the trials alternately `repeats` times; report progress by say(share).

    averages : ps over which every trial is also averaged; None for no averages. extend : whether longer steps follow
    the longest one of each integrator, doubled until one fails
    """
    most = max((trial.forces for trial in trials), default=0) or LOOKS * LOOKS
    reference = subject.methods[subject.reference]
    steps = 2 * -(-2 * most // reference.force_evaluations)
    exact = end_of(subject, reference, steps)
    own_error = gap(exact, end_of(subject, reference, steps // 2))
    result = Precision(subject, trials, steps, max(gap for gap in own_error if not np.isnan(gap)), averages)
    for trial in trials:  # compile and measure errors
        look(subject, trial, exact)
    if extend:
        result.trials = trials = _extended(subject, trials, exact)
    good = [trial for trial in trials if not trial.diverged]
    done, whole = 0.0, len(good) * (repeats + (averages or 0.0) / subject.span)
    for _ in range(repeats):
        for trial in good:
            trial.seconds.append(timing(subject, trial))
            done += 1
            say(done / whole)
    if averages:
        for trial in good:
            _average(subject, trial, averages)
            done += averages / subject.span
            say(done / whole)
    return result


def _extended(subject: Subject, trials: list[Trial], exact: State) -> list[Trial]:
    """Trials with longer steps before those of each integrator, doubled until one fails."""
    found = []
    for name, own in groupby(trials, key=lambda trial: trial.integrator):
        ladder = list(own)
        longest = max(ladder, key=lambda trial: trial.timestep)
        while not longest.diverged and longest.tolerance is None and longest.steps >= 2 * FEWEST:
            n = longest.steps // 2
            per_step = subject.methods[name].force_evaluations
            longest = Trial(name, subject.span / n / subject.time_size, n, n * per_step)
            look(subject, longest, exact)
            ladder.insert(0, longest)
        found += ladder
    return found


def timing(subject: Subject, trial: Trial) -> float:
    """Seconds of computing in a span, from spans of `TIMED` seconds in all, with a warm engine.

    The cost of a call without steps is subtracted: 15 µs, as much as 200 steps of a free body.
    """
    engine, state = _begun(subject, trial)
    begun, done = state.copy(), 0

    def seconds_of(steps: int) -> float:
        began = clock.perf_counter()
        _advance(subject, engine, state, trial, steps, done)
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
    while computing < TIMED:
        call = seconds_of(0)
        try:
            computing += seconds_of(trial.steps)
        except SimulationError:  # a step that is stable over the span may fail later
            if done == 0:
                raise
            start_again()
            continue
        calls, spans, done = calls + call, spans + 1, done + trial.steps
        if not subject.goes_on:
            start_again()
    return (computing - calls if computing > calls else computing) / spans


def plan(subject: Subject, steps: dict[str, list[float]]) -> list[Trial]:
    """Trials of integrators at time steps (in the subject's unit), adjusted to a whole number in the span.

    Methods that choose their steps get tolerances instead.
    """
    trials = {}
    for integrator, timesteps in steps.items():
        method = subject.methods[integrator]
        if method.chooses_steps:
            for tolerance in TOLERANCES:
                step = subject.span / LOOKS / subject.time_size
                trials[integrator, tolerance] = Trial(integrator, step, LOOKS, 0, tolerance=tolerance)
            continue
        for timestep in timesteps:
            n = max(1, round(subject.span / (timestep * subject.time_size)))
            step = subject.span / n / subject.time_size
            trials[integrator, n] = Trial(integrator, step, n, n * method.force_evaluations)
    return list(trials.values())


def _begun(subject: Subject, trial: Trial) -> tuple[Engine, State]:
    """A new engine for a trial, and a state at the start."""
    method = subject.methods[trial.integrator]
    engine = method.engine()
    return engine, engine.begin(subject.state, _how(method, trial))


def _how(method: Method, trial: Trial) -> Scheme | Solver:
    """The method's scheme or solver, with the tolerance of a trial if it has one."""
    if not method.chooses_steps:
        return method.how
    return method.how._replace(relative_tolerance=trial.tolerance, absolute_tolerance=trial.tolerance)


def _advance(subject: Subject, engine: Engine, state: State, trial: Trial, steps: int, done: int = 0) -> None:
    method = subject.methods[trial.integrator]
    how = _how(method, trial)
    dt = subject.span / trial.steps if method.chooses_steps else trial.timestep * subject.time_size
    engine.advance(state, how, dt, done + steps)


def end_of(subject: Subject, method: Method, steps: int) -> State:
    """The state at the end of the span after this many steps."""
    engine = method.engine()
    state = engine.begin(subject.state, method.how)
    engine.advance(state, method.how, subject.span / steps, steps)
    return state


def gap(a: State, b: State) -> tuple[float, float]:
    """Largest differences of rotations and positions; NaN if a state has none."""
    return _furthest(a.rotation, b.rotation), _furthest(a.position, b.position)


def _furthest(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.abs(x - y).max()) if len(x) else np.nan


def look(subject: Subject, trial: Trial, exact: State | None, looks: int = LOOKS) -> None:
    """One run that measures all errors of a trial. Its end is compared with `exact`."""
    engine, state = _begun(subject, trial)
    first = subject.energy(engine, state)
    times, energies = [0.0], [0.0]
    every, done = max(1, trial.steps // looks), 0
    while done < trial.steps:
        now = min(every, trial.steps - done)
        try:
            _advance(subject, engine, state, trial, now, done)
            energy = subject.energy(engine, state) - first
        except NotFiniteError:
            energy = np.inf
        except SimulationError as error:
            trial.fault = str(error)
            return
        if not abs(energy) < DIVERGED * subject.kinetic:
            trial.fault = "diverges"
            return
        done += now
        times.append(done / trial.steps)
        energies.append(energy / subject.energy_size)
        for name, error in subject.kept(state).items():
            trial.kept[name] = max(abs(error), trial.kept.get(name, 0.0))
    trial.energies = energies
    trial.energy_rms = float(np.sqrt(np.mean(np.square(energies[1:]))))
    line = slope(times, energies)
    trial.energy_drift, trial.energy_drift_error = float(line.value), float(line.error)
    if exact is not None:
        trial.rotation_error, trial.position_error = gap(state, exact)
    if len(state.rotation):
        trial.orthogonality_error = orthogonality_error(state.rotation)
    if isinstance(engine, OdeEngine) and trial.tolerance is not None:
        trial.forces = engine.evaluations
        trial.timestep = subject.span / engine.own_steps / subject.time_size


def _average(subject: Subject, trial: Trial, length: float) -> None:
    """Averages over a run of `length` ps from the start; temperatures on steps, between kicks, and unbiased."""
    observe = subject.observe
    if observe is None:
        raise ValueError("averages are for molecules in a box")
    engine, state = _begun(subject, trial)
    dt = trial.timestep * subject.time_size
    verlet_step = dt if trial.integrator == "velocity_verlet" else np.nan
    every = max(1, round(LOOK_PS / dt))
    seen: list[Observation] = []
    for k in range(max(2, round(length / dt / every))):
        try:
            _advance(subject, engine, state, trial, every, k * every)
        except SimulationError:
            return
        seen.append(observe(engine, state, verlet_step))

    def series(name: str) -> np.ndarray:
        return np.array([getattr(observation, name) for observation in seen])

    found = {"potential": series("potential") / KJ_PER_MOL / subject.molecules, "pressure": series("pressure_bar")}
    for name, key in (("T_trans", "translation"), ("T_rot", "rotation")):
        on, unbiased = series(f"temperature_{key}"), series(f"temperature_{key}_unbiased")
        # unbiased = (on the steps + twice between the kicks)/3
        found |= {name: on, f"{name} half-step": 1.5 * unbiased - 0.5 * on, f"{name} unbiased": unbiased}
    for kind in ("", " half-step", " unbiased"):
        found[f"T_rot - T_trans{kind}"] = found[f"T_rot{kind}"] - found[f"T_trans{kind}"]
    for name, values in found.items():
        average, error = mean(values)
        if average is not None:
            trial.averages[name] = average, np.nan if error is None else error
