"""Error against run time: the same start moved by every integrator at several steps, each measured.

What is compared is what a user pays and gets: seconds of computing and force evaluations for a stretch of time, against
the error of the trajectory at its end, that of the energy and of all else that is conserved on the way, and, of liquids
on request, the bias of what they are simulated for: temperatures, potential energy, pressure.
"""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import numpy as np

from rigidmd.core.schemes import RK4, Scheme, Solver
from rigidmd.core.state import State
from rigidmd.engines import Engine
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.engines.textbook import OdeEngine
from rigidmd.errors import SimulationError
from rigidmd.measure.drift import slope
from rigidmd.measure.observables import Observation
from rigidmd.measure.summary import mean
from rigidmd.mechanics.rotation import orthogonality_error
from rigidmd.units import KJ_PER_MOL

#: Looks at the energy in a span.
LOOKS = 40
#: An energy that is wrong by this much of the kinetic energy is no result of a step that is merely inaccurate.
DIVERGED = 0.5
#: Averages are taken from looks this far apart, ps: about as long as the kinetic energy of water remembers itself.
LOOK_PS = 0.02
#: Steps that warm up an engine: its lists are built, its buffers grow, its memory is touched. The first 25 steps of
#: 216 waters took 40 ms, the next 25 20 ms.
WARM_UP = 10
#: Seconds of computing in a timing, at least.
TIMED = 0.2
#: Of general solvers that choose their own steps.
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
        """In a step, of what is given its steps."""
        return 4 if isinstance(self.how, Solver) else self.how.force_evaluations

    @property
    def order(self) -> int:
        """Of the error in the step, of what is given its steps."""
        return 4 if isinstance(self.how, Solver) else self.how.order


@dataclass
class Subject:
    """What is moved: a start, and how to measure it.

    methods : by name. energy(engine, state) : the conserved energy. energy_unit : one unit of the reported error of the
    energy, in words, with a note on it; energy_size : that unit in the units of `energy`. kinetic : a kinetic energy by
    which divergence is judged. kept(state) : relative errors of all else that is conserved. observe(engine, state,
    step) : of molecules in a box, what averages are taken of; None of others. reference : the method of the reference.
    goes_on : whether the motion may be followed beyond the span to time it; else it starts again. refused : why, by
    name, of what cannot move this subject. singular : names of methods whose variables do not exist at the start.
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
    rounding: tuple[float, float] | None = None


@dataclass
class Trial:
    """One integrator at one step."""

    integrator: str
    timestep: float  # in the subject's unit; the mean one of what chooses its steps
    steps: int
    forces: int  # evaluations in the span
    seconds: list[float] = field(default_factory=list)  # of computing in a span, one for each repeat
    rotation_error: float = np.nan  # largest |Q - Q_ref| at the end
    position_error: float = np.nan  # largest |X - X_ref| at the end
    energy_rms: float = np.nan  # in the subject's unit
    energy_drift: float = np.nan  # per span
    energy_drift_error: float = np.nan
    orthogonality: float = np.nan
    kept: dict[str, float] = field(default_factory=dict)  # largest relative errors of what else is conserved
    tolerance: float | None = None  # of what chooses its steps
    fault: str = ""  # why it did not get to the end, or to nothing that means anything
    averages: dict[str, tuple[float, float]] = field(default_factory=dict)  # name -> mean, standard error

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
        """Largest less smallest of the seconds over their median; None of what was timed once."""
        return (max(self.seconds) - min(self.seconds)) / self.time if len(self.seconds) > 1 else None

    @property
    def trajectory_error(self) -> float:
        """The error of the rotation, or of the position of what does not turn."""
        return self.position_error if np.isnan(self.rotation_error) else self.rotation_error


@dataclass
class Precision:
    """All trials of a subject, and how good the reference is that they were held against."""

    subject: Subject
    trials: list[Trial]
    reference_steps: int
    reference_error: float  # of the reference's own end, from half as many steps
    sampled: float | None = None  # ps of which averages were taken
    left_out: dict[str, str] = field(default_factory=dict)  # usual methods that were not tried -> why

    @property
    def most_exact(self) -> Trial:
        """The trial with the smallest energy error, against whose averages those of the others are held."""
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

    def time_for(self, integrator: str, error: str, target: float) -> tuple[float, float] | None:
        """(seconds, time step) at which an integrator reaches an error, between its trials.

        Its longest step where that is good enough; None where its shortest is not.
        """
        own = [t for t in self.trials if t.integrator == integrator and not t.diverged and getattr(t, error) > 0]
        own.sort(key=lambda t: -t.timestep)
        if own and getattr(own[0], error) <= target:
            return own[0].time, own[0].timestep
        for coarse, fine in pairwise(own):
            a, b = np.log(getattr(coarse, error)), np.log(getattr(fine, error))
            if b <= np.log(target) <= a:
                share = (np.log(target) - a) / (b - a)
                seconds = np.exp(np.log(coarse.time) + share * np.log(fine.time / coarse.time))
                step = np.exp(np.log(coarse.timestep) + share * np.log(fine.timestep / coarse.timestep))
                return float(seconds), float(step)
        return None


def measure(
    subject: Subject,
    trials: list[Trial],
    repeats: int,
    averages: float | None = None,
    say: Callable[[float], object] = lambda share: None,
) -> Precision:
    """Run all trials and the reference; time the trials `repeats` times, alternating; say(share done) in between.

    averages : ps over which every trial is sampled besides; none when not given
    """
    most = max((trial.forces for trial in trials), default=0) or LOOKS * LOOKS
    reference = subject.methods[subject.reference]
    steps = 2 * -(-2 * most // reference.force_evaluations)
    exact = end_of(subject, reference, steps)
    own_error = gap(exact, end_of(subject, reference, steps // 2))
    result = Precision(subject, trials, steps, max(gap for gap in own_error if not np.isnan(gap)), averages)
    for trial in trials:  # compiled, and looked at
        look(subject, trial, exact)
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


def timing(subject: Subject, trial: Trial) -> float:
    """Seconds of computing in a span, from spans that take `TIMED` together, of an engine that has made steps before.

    What a call of no steps costs is taken off: 15 µs, as much as 200 steps of a free body.
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
        except SimulationError:  # a step that is good for the span is not for ever
            if done == 0:
                raise
            start_again()
            continue
        calls, spans, done = calls + call, spans + 1, done + trial.steps
        if not subject.goes_on:
            start_again()
    return (computing - calls if computing > calls else computing) / spans


def plan(subject: Subject, steps: dict[str, list[float]]) -> list[Trial]:
    """Trials of integrators at time steps (in the subject's unit), fitted a whole number of times into the span.

    What chooses its steps is given tolerances instead.
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
    """A new engine for a trial, and the start for it to move."""
    method = subject.methods[trial.integrator]
    engine = method.engine()
    return engine, engine.begin(subject.state, _how(method, trial))


def _how(method: Method, trial: Trial) -> Scheme | Solver:
    """What moves the subject, with the tolerance of a trial where it has one."""
    if not method.chooses_steps:
        return method.how
    return method.how._replace(relative_tolerance=trial.tolerance, absolute_tolerance=trial.tolerance)


def _advance(subject: Subject, engine: Engine, state: State, trial: Trial, steps: int, done: int = 0) -> None:
    method = subject.methods[trial.integrator]
    how = _how(method, trial)
    dt = subject.span / trial.steps if method.chooses_steps else trial.timestep * subject.time_size
    engine.advance(state, how, dt, done + steps)


def end_of(subject: Subject, method: Method, steps: int) -> State:
    """The end of the span in so many steps."""
    engine = method.engine()
    state = engine.begin(subject.state, method.how)
    engine.advance(state, method.how, subject.span / steps, steps)
    return state


def gap(a: State, b: State) -> tuple[float, float]:
    """Largest differences of rotations and positions; NaN of what a state does not have."""
    return _furthest(a.rotation, b.rotation), _furthest(a.position, b.position)


def _furthest(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.abs(x - y).max()) if len(x) else np.nan


def look(subject: Subject, trial: Trial, exact: State | None) -> None:
    """One run with looks at what is conserved; all of the trial but its seconds. Its end is held against `exact`."""
    engine, state = _begun(subject, trial)
    first = subject.energy(engine, state)
    times, energies = [0.0], [0.0]
    every, done = max(1, trial.steps // LOOKS), 0
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
    trial.energy_rms = float(np.sqrt(np.mean(np.square(energies[1:]))))
    line = slope(times, energies)
    trial.energy_drift, trial.energy_drift_error = float(line.value), float(line.error)
    if exact is not None:
        trial.rotation_error, trial.position_error = gap(state, exact)
    if len(state.rotation):
        trial.orthogonality = orthogonality_error(state.rotation)
    if isinstance(engine, OdeEngine) and trial.tolerance is not None:
        trial.forces = engine.evaluations
        trial.timestep = subject.span / engine.own_steps / subject.time_size


def _average(subject: Subject, trial: Trial, length: float) -> None:
    """Averages over a run of `length` ps from the start; temperatures on steps, between kicks, and without bias."""
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
        # the one on the steps and the one between them, of which the unbiased is (one + twice the other)/3
        found |= {name: on, f"{name} half-step": 1.5 * unbiased - 0.5 * on, f"{name} unbiased": unbiased}
    for kind in ("", " half-step", " unbiased"):
        found[f"T_rot - T_trans{kind}"] = found[f"T_rot{kind}"] - found[f"T_trans{kind}"]
    for name, values in found.items():
        average, error = mean(values)
        if average is not None and error is not None:
            trial.averages[name] = average, error
