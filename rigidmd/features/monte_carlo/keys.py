"""Hybrid Monte Carlo in scenes."""

from functools import partial
from math import nan
from typing import Annotated

from pydantic import Field, Strict

from rigidmd.core.integrators import Scheme
from rigidmd.core.quantities import Mean, Quantity
from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values
from rigidmd.scene.validation import Section, number_of_steps

#: Length of a trajectory, ps.
TRAJECTORY_PS = 0.1
#: Columns of `TrajectoryWorkspace.sums`: trajectories ended and accepted; sums of abs(dH)/kT, of
#: min(1, exp(-dH/kT)), and of exp(-dH/kT), whose mean is 1 in equilibrium.
ENDED, ACCEPTED, SIZES, CHANCES, WEIGHTS = range(5)
SINCE = "the trajectories of hybrid Monte Carlo since the line before"


def _per_trajectory(k: int, observation) -> float:
    sums = observation.extension_sums
    return float(sums[k] / sums[ENDED]) if sums is not None and sums[ENDED] else nan


class HybridMonteCarloKeys(Section):
    trajectory_steps: Annotated[int, Strict(), Field(ge=1, le=100_000)] | None = None
    """Number of steps of a hybrid_monte_carlo trajectory, which is then accepted or rejected.
    Default: the number of steps in 0.1 ps"""
    momentum_refreshment: Annotated[float, Field(gt=0, le=1)] = 1.0
    """Fraction of the variance of each momentum that hybrid_monte_carlo draws again before a
    trajectory. 1: all of it"""


class HybridMonteCarlo(Thermostat):
    name = "hybrid_monte_carlo"
    summary = (
        "trajectories from new momenta, accepted or rejected: averages without a time-step error"
    )
    source = "Duane, Kennedy, Pendleton & Roweth 1987, Phys. Lett. B 195, 216"
    keys = HybridMonteCarloKeys
    on_molecules = True
    steps_key = "trajectory_steps"
    pilot = "rigidmd.features.monte_carlo.pilot"
    no_motion = "samples by hybrid Monte Carlo"
    quantities = (
        Quantity(
            "acceptance",
            "Acceptance",
            "1",
            f"fraction of {SINCE} that was accepted",
            partial(_per_trajectory, ACCEPTED),
            mean=Mean("acceptance{}_mean"),
        ),
        Quantity(
            "abs_dH",
            "abs(dH)",
            "kT",
            f"mean size of the change of the energy in {SINCE}",
            partial(_per_trajectory, SIZES),
            mean=Mean("abs_dH_kT{}_mean"),
            former="abs_dH_kT",
        ),
        Quantity(
            "exp_minus_dH",
            "exp(-dH/kT)",
            "1",
            f"mean over {SINCE}. In equilibrium 1 on average",
            partial(_per_trajectory, WEIGHTS),
            mean=Mean("exp_minus_dH{}_mean"),
        ),
    )

    @property
    def flow(self) -> str:
        return "rigidmd.features.monte_carlo.momenta"

    def defaults(self, stage: StageKeys) -> Values:
        return {
            "trajectory_steps": number_of_steps(TRAJECTORY_PS, stage.step),
            "momentum_refreshment": 1.0,
        }

    def time(self, values: Values) -> float:
        return 0.0

    def describe(self, values: Values) -> str:
        steps, new = values.values()
        drawn = "" if new == 1 else f", {new:g} of each momentum's variance drawn again"
        return f"trajectories of {steps:g} step{'s' if steps > 1 else ''}{drawn}"

    def joined(self, scheme: Scheme, thermostat: tuple, stage: StageKeys) -> Scheme:
        return scheme.with_groups(thermostat, stage.steps_together)


METHOD = HybridMonteCarlo()
