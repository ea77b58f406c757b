"""The random walk of the energy that truncated forces cause, for any integrator and step, from two pilot runs.

The kicks of a step are a quadrature, with weights b_i at the times c_i dt, of force times velocity. Where a pair
crosses a distance at which the k-th derivative of its force jumps, at a random time s dt of a step, they miss the
integral by

    dE ~ dt^(k+1) sum_i b_i B_(k+1)({c_i - s})/(k+1)!        (Euler-Maclaurin; B: Bernoulli polynomials)

whose mean over s is 0. So the variance of the energy grows as D t, by the Fourier series of B,

    D = scale w dt^(2k+2),    w = sum_n |sum_i b_i exp(2 pi i n c_i)|² / n^(2k+2)

with a scale of the scene that no integrator changes. `switch` has k = 2, `smooth_switch` 5, `shift` 0; single precision
of the forces acts as k = -1/2. In 27 SPC/E waters D of srkn_4 at 8, 4 and 2 fs was 2e-7, 1.7e-9 and 2.3e-11 kT²/ps per
degree of freedom with `switch`; D of srkn_4 over D of srkn_6 at 4 fs was 34 with `switch` (here 41) and 970 with
`smooth_switch` (885).

A step conserves phase-space volume, so <exp(-dE/kT)> = 1 and the walk has the mean <dE> = <dE²>/2kT.
"""

from functools import cache
from math import log
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import DRIFT, KICK, Scheme
from rigidmd.run.pilot.trials import Trial, TrialSystem, measure_errors

#: The integrator of the pilot runs: its regular error is small compared with the walk.
PILOT_INTEGRATOR = "srkn_6"
#: Steps of the first pilot run; the second takes twice as many of half the length.
STEPS = 32
#: Steps between energies that are compared. Short lags have most values, but include a regular error.
LAGS = (1, 2, 4, 8)
JUMPS = (-1.0, -0.5, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


class EnergyWalk(NamedTuple):
    """D = scale w dt^(2 jump + 2), in squares of the energy unit of a `TrialSystem` per unit of time of its span."""

    scale: float
    jump: float  # the derivative of the force that jumps
    freedom: int  # degrees of freedom; the energy unit is kT of one of them

    def rate(self, scheme: Scheme, dt: float) -> float:
        return self.scale * weight(scheme, self.jump) * dt ** (2 * self.jump + 2)

    def square(self, scheme: Scheme, dt: float, time: float) -> float:
        """Expected mean square of the walk over a run: D t/2 from its scatter, and the square of its mean."""
        half = self.rate(scheme, dt) * time / 2
        return half + (self.freedom * half) ** 2 / 3


@cache
def weight(scheme: Scheme, jump: float) -> float:
    """w of an integrator; the sum of b² for a jump below 0, where the errors of kicks are independent."""
    at, kicks, n = 0.0, [], np.arange(1.0, 1000.0)
    for flow in scheme.flows:
        at += flow.fraction if flow.kind == DRIFT else 0.0
        kicks += [(flow.fraction, at)] if flow.kind == KICK else []
    if jump < 0:
        return 1.0 if jump == -1 else sum(b * b for b, _ in kicks)
    total = sum(b * np.exp(2j * np.pi * n * c) for b, c in kicks)
    return float(np.sum(np.abs(total) ** 2 / n ** (2 * jump + 2)))


def measure_energy_walk(system: TrialSystem, timestep: float) -> EnergyWalk:
    """The walk, from runs at about this step (in the unit of the system) and at half of it."""
    scheme, rates = system.methods[PILOT_INTEGRATOR].scheme, []
    if not isinstance(scheme, Scheme):
        raise TypeError(f"{PILOT_INTEGRATOR} is not a scheme of this system")
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
    scale = (fast / unit.rate(scheme, dt) + slow / unit.rate(scheme, dt / 2)) / 2
    return unit._replace(scale=scale)


def _rate(system: TrialSystem, timestep: float, steps: int) -> float | None:
    """D in a run: the least of all lags, as a regular error adds to short ones; None if the run diverges."""
    trial = Trial(PILOT_INTEGRATOR, timestep, steps, 0)
    measure_errors(system, trial, None, STEPS)
    if trial.diverged:
        return None
    energy, spacing = np.array(trial.energies), steps / STEPS * timestep * system.time_size
    return min(float(np.mean((energy[m:] - energy[:-m]) ** 2)) / (m * spacing) for m in LAGS)
