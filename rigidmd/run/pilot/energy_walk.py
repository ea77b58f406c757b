"""The random walk of the energy that truncated forces cause, measured by two pilot runs."""

from functools import cache
from math import log
from typing import NamedTuple, cast

import numpy as np

from rigidmd.core.integrators import DRIFT, KICK, Scheme
from rigidmd.run import trials
from rigidmd.run.trials import Trial, TrialSystem

#: The integrator of the pilot runs: its regular error is small compared with the walk.
PILOT_INTEGRATOR = "srkn_6"
#: Steps of the first pilot run; the second takes twice as many of half the length.
STEPS = 32
#: Steps between energies that are compared. Short lags have most values, but include a regular
#: error.
LAGS = (1, 2, 4, 8)
JUMPS = (-1.0, -0.5, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


class EnergyWalk(NamedTuple):
    """The random walk of the energy that truncated forces cause, for any integrator and step. See
    "Energy drift and its error" in the theory chapter `errors`: D = scale w dt^(2k+2), with a scale
    of the scene that no integrator changes. D is in squares of the energy unit of a `TrialSystem`
    per unit of time of its span."""

    scale: float
    jump: float  # the derivative of the force that jumps
    freedom: int  # degrees of freedom; the energy unit is kT of one of them

    def rate(self, scheme: Scheme, dt: float) -> float:
        return self.scale * weight(scheme, self.jump) * dt ** (2 * self.jump + 2)

    def square(self, scheme: Scheme, dt: float, time: float) -> float:
        """Expected mean square of the walk over a run: D t/2 from its scatter, and the square of
        its mean."""
        half = self.rate(scheme, dt) * time / 2
        return half + (self.freedom * half) ** 2 / 3


@cache
def weight(scheme: Scheme, jump: float) -> float:
    """w of an integrator. The sum of b² for a jump below 0, where the errors of kicks are
    independent."""
    at = 0.0
    kicks = []
    n = np.arange(1.0, 1000.0)
    for flow in scheme.flows:
        at += flow.fraction if flow.kind == DRIFT else 0.0
        kicks += [(flow.fraction, at)] if flow.kind == KICK else []
    if jump < 0:
        return 1.0 if jump == -1 else sum(b * b for b, _ in kicks)
    total = sum(b * np.exp(2j * np.pi * n * c) for b, c in kicks)
    return float(np.sum(np.abs(total) ** 2 / n ** (2 * jump + 2)))


def measure_energy_walk(system: TrialSystem, timestep: float) -> EnergyWalk:
    """The walk, from two pilot runs at about this step (in the unit of the system) and at half of
    it."""
    scheme = cast(Scheme, system.methods[PILOT_INTEGRATOR].scheme)
    rates = []
    for _ in range(3):
        rates = [_rate(system, timestep / part, part * STEPS) for part in (1, 2)]
        if None not in rates:
            break
        timestep /= 2
    fast, slow = rates
    if not fast or not slow:
        return EnergyWalk(0.0, JUMPS[-1], system.freedom)
    jump = min(JUMPS, key=lambda k: abs(log(fast / slow) - (2 * k + 2) * log(2)))
    dt = timestep * system.time_size
    unit = EnergyWalk(1.0, jump, system.freedom)
    return unit._replace(
        scale=(fast / unit.rate(scheme, dt) + slow / unit.rate(scheme, dt / 2)) / 2
    )


def _rate(system: TrialSystem, timestep: float, steps: int) -> float | None:
    """D in a run: the least of all lags, as a regular error adds to short ones. None if the run
    diverges."""
    trial = Trial(PILOT_INTEGRATOR, timestep, steps, 0)
    trials.measure_errors(system, trial, None, STEPS)
    if trial.diverged:
        return None
    energy = np.array(trial.energies)
    spacing = steps / STEPS * timestep * system.time_size
    return min(float(np.mean((energy[m:] - energy[:-m]) ** 2)) / (m * spacing) for m in LAGS)
