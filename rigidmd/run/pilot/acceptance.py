"""Integrator, step and length of the trajectories of hybrid Monte Carlo with "auto", by short pilot runs."""

from dataclasses import replace
from math import sqrt

from rigidmd.assemble.build import integrator_of_stage
from rigidmd.assemble.time_step import stable_angle
from rigidmd.core.state import NOW, State
from rigidmd.dynamics.hybrid_monte_carlo import CHANCES, ENDED
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.run.pilot.choice import round_down
from rigidmd.run.pilot.shadow import mean_square_rate
from rigidmd.run.pilot.stable_step import stiffest_mode
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import FEMTOSECOND

#: Integrators that are tried, from the shortest step to the longest one.
TRIED = ("velocity_verlet", "two_stage", "srkn_4")
#: Steps that are tried, as fractions of the longest stable one, and trajectories with each.
FRACTIONS, TRAJECTORIES = (0.2, 0.28, 0.4, 0.56, 0.8), 16
#: Steps of the first trajectories, which leave the lattice of a start, whose forces are not those of a liquid.
WARMING_STEPS = 20
#: Length of a trajectory in radians of the rms frequency of all motions. For water it is 0.08 ps. The energies of 64
#: SPC/E were independent soonest with 0.06 to 0.11 ps; with 0.03 or 0.45 ps they took 1.6 and 2 times as long.
RADIANS = 1.0


def choose_for_sampling(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator, the step and, unless given, the length of the trajectories that accept most motion
    per force evaluation, and the reason. Pilot trajectories follow each other from a copy of a state on, so that they
    also approach equilibrium, first with the shortest step. Raises SimulationError."""
    stage = system.scene.stages[k]
    first = stage.with_integrator(TRIED[0], stage.timestep_fs).model_copy(update={"trajectory_steps": WARMING_STEPS})
    now, _ = _acceptance(system, state, k, first)
    found, rate, best = stiffest_mode(system, now), mean_square_rate(system, now, k), (0.0, stage, 0.0)
    if found is None or rate == 0:
        raise SimulationError(f"stages.{k}: nothing sets a step for integrator = 'auto'; name an integrator and a step")
    for integrator in TRIED:
        for fraction in FRACTIONS:
            scheme = stage.with_integrator(integrator, 1.0).scheme
            step = round_down(fraction * stable_angle(scheme) / found.rate / FEMTOSECOND)
            steps = stage.trajectory_steps or max(1, round(RADIANS / sqrt(rate) / (step * FEMTOSECOND)))
            decided = stage.with_integrator(integrator, step).model_copy(update={"trajectory_steps": steps})
            now, chance = _acceptance(system, now, k, decided)
            gain = chance * step * FEMTOSECOND / scheme.force_evaluations
            best = max(best, (gain, decided, chance), key=lambda one: one[0])
            if chance < 0.2:
                break
    gain, decided, chance = best
    if gain == 0:
        raise SimulationError(f"stages.{k}: no pilot trajectory was accepted; name an integrator and a shorter step")
    return decided.with_defaults, (
        f"the longest accepted motion per force evaluation of {', '.join(TRIED)}; {chance:.0%} of {TRAJECTORIES} pilot "
        f"trajectories of {decided.trajectory_steps} steps would be accepted"
    )


def _acceptance(system: System, state: State, k: int, stage: Stage) -> tuple[State, float]:
    """The state after pilot trajectories from a state on, and their mean probability of acceptance."""
    stages = tuple(stage if n == k else other for n, other in enumerate(system.scene.stages))
    pilot = replace(system, scene=system.scene.model_copy(update={"stages": stages}))
    engine, method = system.engine(), integrator_of_stage(pilot, k)
    now = engine.begin(state, method)
    now.begin_segment()
    try:
        steps = TRAJECTORIES * stage.steps_together
        engine.advance(now, method, stage.timestep_fs * FEMTOSECOND, int(now.step[NOW]) + steps)
    except SimulationError:  # a molecule was lost in a step that is too long
        return state, 0.0
    sums = not_none(engine.trajectories)
    return now, float(sums[CHANCES] / sums[ENDED])
