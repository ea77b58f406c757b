"""Error against run time: the same start moved by every integrator at several steps, each measured.

What is compared is what a user pays and gets: seconds of computing and force evaluations for a stretch of time, against
the error of the trajectory at its end and that of the energy on the way.
"""

import time as clock
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from statistics import median

import numpy as np

from rigidmd.dynamics.engine import Engine, NotFiniteError
from rigidmd.dynamics.schemes import SCHEMES, Scheme
from rigidmd.dynamics.thermostats import NoThermostat
from rigidmd.forces.terms import State
from rigidmd.measure.drift import slope

#: Looks at the energy in a span.
LOOKS = 40
#: An energy that is wrong by this much of the kinetic energy is no result of a step that is merely inaccurate.
DIVERGED = 0.5


@dataclass
class Subject:
    """What is moved: a start, and how to measure it.

    energy(engine, state) : the conserved energy. energy_unit : one unit of the reported energy error, in words, with a
    note on it; energy_size : that unit in the units of `energy`. kinetic : a kinetic energy by which
    divergence is judged. rotor : what the scene asks for.
    """

    name: str
    state: State
    engine: Callable[[], Engine]
    energy: Callable[[Engine, State], float]
    energy_unit: str
    energy_note: str
    energy_size: float
    kinetic: float
    span: float
    time_unit: str  # fs or s, of time steps
    time_size: float  # of that unit, in the units of the span
    length_unit: str
    rotor: str | None
    integrators: list[str]
    reference: str  # the integrator of the reference


@dataclass
class Trial:
    """One integrator at one step."""

    integrator: str
    timestep: float  # in the subject's unit
    steps: int
    forces: int  # evaluations in the span
    seconds: list[float] = field(default_factory=list)  # of computing in the span, one for each repeat
    rotation_error: float = np.nan  # largest |Q - Q_ref| at the end
    position_error: float = np.nan  # largest |X - X_ref| at the end
    energy_rms: float = np.nan  # in the subject's unit
    energy_drift: float = np.nan  # per span
    energy_drift_error: float = np.nan
    orthogonality: float = np.nan
    diverged: bool = False

    @property
    def time(self) -> float:
        """Median of the seconds."""
        return median(self.seconds)

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


def scheme_of(subject: Subject, integrator: str) -> Scheme:
    """The scheme on the rotor that the scene asks for, where it can have that."""
    scheme = SCHEMES[integrator]
    return scheme if scheme.exact_rotor else scheme.with_rotor(subject.rotor)


def measure(
    subject: Subject, trials: list[Trial], repeats: int, say: Callable[[float], None] = lambda share: None
) -> Precision:
    """Run all trials `repeats` times, alternating, and the reference; say(share done) in between."""
    most = max(trial.forces for trial in trials)
    scheme = SCHEMES[subject.reference]
    steps = 2 * -(-2 * most // scheme.force_evaluations)
    exact = _end(subject, scheme, steps)
    own_error = _gap(exact, _end(subject, scheme, steps // 2))
    result = Precision(subject, trials, steps, max(gap for gap in own_error if not np.isnan(gap)))
    for trial in trials:  # compiled, and looked at
        _observe(subject, trial, exact)
    share, whole = 0, sum(trial.forces for trial in trials if not trial.diverged) * repeats
    for _ in range(repeats):
        for trial in trials:
            if not trial.diverged:
                engine, state = subject.engine(), subject.state.copy()
                _advance(subject, engine, state, trial, 0)
                began = clock.perf_counter()
                _advance(subject, engine, state, trial, trial.steps)
                trial.seconds.append(clock.perf_counter() - began)
                share += trial.forces
                say(share / whole)
    return result


def plan(subject: Subject, steps: dict[str, list[float]]) -> list[Trial]:
    """Trials of integrators at time steps (in the subject's unit), fitted a whole number of times into the span."""
    trials = {}
    for integrator, timesteps in steps.items():
        evaluations = SCHEMES[integrator].force_evaluations
        for timestep in timesteps:
            n = max(1, round(subject.span / (timestep * subject.time_size)))
            trials[integrator, n] = Trial(integrator, subject.span / n / subject.time_size, n, n * evaluations)
    return list(trials.values())


def _advance(subject: Subject, engine: Engine, state: State, trial: Trial, steps: int, done: int = 0) -> None:
    dt = trial.timestep * subject.time_size
    engine.advance(state, scheme_of(subject, trial.integrator), dt, steps, NoThermostat(), done)


def _end(subject: Subject, scheme: Scheme, steps: int) -> State:
    engine, state = subject.engine(), subject.state.copy()
    engine.advance(state, scheme, subject.span / steps, steps, NoThermostat())
    return state


def _gap(a: State, b: State) -> tuple[float, float]:
    """Largest differences of rotations and positions; NaN of what a state does not have."""
    pairs = ((a.rotation, b.rotation), (a.position, b.position))
    return tuple(float(np.abs(x - y).max()) if len(x) else np.nan for x, y in pairs)


def _observe(subject: Subject, trial: Trial, exact: State) -> None:
    """One run with looks at the energy; all of the trial but its seconds."""
    engine, state = subject.engine(), subject.state.copy()
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
        if not abs(energy) < DIVERGED * subject.kinetic:
            trial.diverged = True
            return
        done += now
        times.append(done / trial.steps)
        energies.append(energy / subject.energy_size)
    trial.energy_rms = float(np.sqrt(np.mean(np.square(energies[1:]))))
    line = slope(times, energies)
    trial.energy_drift, trial.energy_drift_error = float(line.value), float(line.error)
    trial.rotation_error, trial.position_error = _gap(state, exact)
    if len(state.rotation):
        gap = np.swapaxes(state.rotation, -1, -2) @ state.rotation - np.eye(3)
        trial.orthogonality = float(np.abs(gap).max())
