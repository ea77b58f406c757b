"""Trials of integrators: runs from the same start at several time steps, for pilot runs and
`rigidmd accuracy`.

The cost is seconds of computing and force evaluations for a span of time. Errors of the trajectory
are measured at the end, of conserved quantities on the way.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from statistics import median
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import State
from rigidmd.core.statistics import slope
from rigidmd.engines.protocol import Engine, NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.mechanics.rotation import orthogonality_error

#: Number of observations of the energy in a span.
OBSERVATIONS = 40
#: A run diverges if its energy error exceeds this fraction of the kinetic energy.
DIVERGED = 0.5


class Method(NamedTuple):
    """A way to move a system: an engine and an integrator."""

    engine: Callable[[float], Engine]  # for steps of this length, in the unit of the system
    scheme: Scheme | Solver

    @property
    def force_evaluations(self) -> int:
        """Evaluations in a step of given length."""
        return 4 if isinstance(self.scheme, Solver) else self.scheme.force_evaluations

    @property
    def order(self) -> int:
        """Order of the error in a given step."""
        return 4 if isinstance(self.scheme, Solver) else self.scheme.order


@dataclass
class TrialSystem:
    """A start, and how to measure errors on it. Functions have the arguments engine and state.

    energy : the conserved energy; energy_unit, energy_note : the unit of its reported error, as
        text
    energy_size : that unit in the units of `energy`; kinetic : kinetic energy that sets the limit
        of divergence
    reference : name of the method of the reference
    conserved_errors : relative errors of other conserved quantities, of a state
    can_continue : whether timing may continue beyond the span instead of starting again
    rejected : name -> reason, of methods that cannot move this system; singular : names of those
        singular at the start
    rounding : relative rms errors of forces and torques in mixed precision. None in double
    chooses_precision : whether each trial has the precision that suits the error of its step
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
    conserved_errors: Callable[[State], dict[str, float]]
    can_continue: bool
    refused: dict[str, str] = field(default_factory=dict)
    singular: tuple[str, ...] = ()
    freedom: int = 1
    rounding: tuple[float, float] | None = None
    chooses_precision: bool = False

    @property
    def span_unit(self) -> str:
        return "ps" if self.time_unit == "fs" else "s"


@dataclass
class Trial:
    """One integrator at one step."""

    integrator: str
    timestep: float  # in the unit of the system; the mean of steps that the method chooses
    steps: int
    forces: int  # evaluations in the span
    seconds: list[float] = field(default_factory=list)  # of computing in a span, for each repeat
    rotation_error: float = np.nan  # largest |Q - Q_ref| at the end
    position_error: float = np.nan  # largest |X - X_ref| at the end
    energy_rms: float = np.nan  # in the energy unit of the system
    energy_drift: float = np.nan  # per span
    energy_drift_error: float = np.nan
    orthogonality_error: float = np.nan
    #: Largest relative ones, of other quantities
    conserved_errors: dict[str, float] = field(default_factory=dict)
    tolerance: float | None = None  # of a method that chooses its steps
    failure: str = ""  # why it failed or diverged
    energies: list[float] = field(default_factory=list, repr=False)  # errors, from 0 at the start

    @property
    def diverged(self) -> bool:
        return bool(self.failure)

    @property
    def time(self) -> float:
        """Median of the seconds."""
        return median(self.seconds)

    @property
    def spread(self) -> float | None:
        """Range of the seconds over their median. None if timed once."""
        return (
            (max(self.seconds) - min(self.seconds)) / self.time if len(self.seconds) > 1 else None
        )

    @property
    def conservation_error(self) -> float:
        """The energy error, or the relative error of QᵀQ or another conserved quantity if it is
        larger."""
        others = [self.orthogonality_error, *self.conserved_errors.values()]
        return max(self.energy_rms, *(error for error in others if not np.isnan(error)), 0.0)

    @property
    def trajectory_error(self) -> float:
        """The error of the rotation, or of the position if nothing rotates."""
        return self.position_error if np.isnan(self.rotation_error) else self.rotation_error


def begin_trial(system: TrialSystem, trial: Trial) -> tuple[Engine, State, Callable[[int], None]]:
    """A new engine, a state at the start, and a function that advances it to a number of steps
    since the start."""
    method = system.methods[trial.integrator]
    engine = method.engine(trial.timestep)
    scheme = method.scheme
    dt = trial.timestep * system.time_size
    if trial.tolerance is not None:
        scheme = scheme._replace(
            relative_tolerance=trial.tolerance, absolute_tolerance=trial.tolerance
        )
        dt = system.span / trial.steps
    state = engine.begin(system.state, scheme)
    return engine, state, lambda steps: engine.advance(state, scheme, dt, steps)


def final_state(system: TrialSystem, steps: int) -> State:
    """The state at the end of the span after this many steps of the reference."""
    method = system.methods[system.reference]
    engine = method.engine(0.0)
    state = engine.begin(system.state, method.scheme)
    engine.advance(state, method.scheme, system.span / steps, steps)
    return state


def state_difference(a: State, b: State) -> tuple[float, float]:
    """Largest differences of rotations and positions. NaN if a state has none."""
    position = float(np.abs(a.position - b.position).max()) if len(a.position) else np.nan
    return (float(np.abs(a.rotation - b.rotation).max()) if len(a.rotation) else np.nan), position


def measure_errors(
    system: TrialSystem, trial: Trial, exact: State | None, observations: int = OBSERVATIONS
) -> None:
    """Run a trial and measure all its errors. Its end is compared with `exact`."""
    engine, state, advance_to = begin_trial(system, trial)
    first = system.energy(engine, state)
    times, energies = [0.0], [0.0]
    every = max(1, trial.steps // observations)
    done = 0
    while done < trial.steps:
        now = min(every, trial.steps - done)
        try:
            advance_to(done + now)
            energy = system.energy(engine, state) - first
        except NotFiniteError:
            energy = np.inf
        except SimulationError as error:
            trial.failure = str(error)
            return
        if not abs(energy) < DIVERGED * system.kinetic:
            trial.failure = "diverges"
            return
        done += now
        times.append(done / trial.steps)
        energies.append(energy / system.energy_size)
        for name, error in system.conserved_errors(state).items():
            trial.conserved_errors[name] = max(abs(error), trial.conserved_errors.get(name, 0.0))
    trial.energies = energies
    trial.energy_rms = float(np.sqrt(np.mean(np.square(energies[1:]))))
    line = slope(times, energies)
    trial.energy_drift, trial.energy_drift_error = float(line.value), float(line.error)
    if exact is not None:
        trial.rotation_error, trial.position_error = state_difference(state, exact)
    if len(state.rotation):
        trial.orthogonality_error = orthogonality_error(state.rotation)
    if (chosen := engine.chosen_steps) is not None:
        count, trial.forces = chosen
        trial.timestep = system.span / count / system.time_size
