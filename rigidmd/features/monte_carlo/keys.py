"""Hybrid Monte Carlo in scenes."""

from typing import Annotated

from pydantic import Field, Strict

from rigidmd.core.integrators import Scheme
from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values
from rigidmd.scene.validation import Section, number_of_steps

#: Length of a trajectory, ps.
TRAJECTORY_PS = 0.1


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
    columns = ("acceptance", "abs_dH_kT", "exp_minus_dH")

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
