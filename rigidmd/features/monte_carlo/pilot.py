"""The choice of `integrator = "auto"` for hybrid Monte Carlo, by the acceptance of trajectories."""

from math import sqrt
from typing import cast

from rigidmd.assemble.harmonic import stable_angle
from rigidmd.core.state import NOW, State
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.features.monte_carlo.keys import CHANCES, ENDED, HybridMonteCarloKeys
from rigidmd.run.pilot.choice import round_down
from rigidmd.run.pilot.sampling import begun, mean_square_rate
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import FEMTOSECOND

#: Integrators that are tried, from the shortest step to the longest one.
TRIED = ("velocity_verlet", "two_stage", "srkn_4")
#: Steps that are tried, as fractions of the longest stable one, and trajectories with each.
FRACTIONS = (0.2, 0.28, 0.4, 0.56, 0.8)
TRAJECTORIES = 16
#: Minimum acceptance with which longer steps are tried.
LEAST_ACCEPTANCE = 0.2
#: Steps of the first trajectories, which leave the lattice of a start, whose forces are not those
#: of a liquid.
WARMING_STEPS = 20
#: Length of a trajectory in radians of the rms frequency of all motions. For water it is 0.08 ps.
#: The energies of 64 SPC/E were independent soonest with 0.06 to 0.11 ps; with 0.03 or 0.45 ps they
#: took 1.6 and 2 times as long.
RADIANS = 1.0


def choose_for_stage(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator, the step and, unless given, the length of the trajectories that
    accept most motion per force evaluation, and the reason. Pilot trajectories follow each other
    from a copy of a state on, so that they also approach equilibrium, first with the shortest step.
    Raises SimulationError."""
    stage = system.scene.stages[k]

    def with_steps(integrator: str, timestep_fs: float, steps: int) -> Stage:
        decided = stage.with_integrator(integrator, timestep_fs)
        return decided.model_copy(update={"trajectory_steps": steps})

    now, _ = _acceptance(system, state, k, with_steps(TRIED[0], stage.step_fs, WARMING_STEPS))
    stiffest = stiffest_mode(system, now)
    rate = mean_square_rate(system, now, k)
    if stiffest is None or rate == 0:
        raise SimulationError(
            f"stages.{k}: nothing sets a step for integrator = 'auto'. Name an integrator and a"
            " step"
        )
    steps_set = cast(HybridMonteCarloKeys, stage).trajectory_steps
    best = (0.0, 0.0, stage)
    for integrator in TRIED:
        scheme = stage.with_integrator(integrator, 1.0).scheme
        for fraction in FRACTIONS:
            step = round_down(fraction * stable_angle(scheme) / stiffest.rate / FEMTOSECOND)
            steps = max(1, round(RADIANS / sqrt(rate) / (step * FEMTOSECOND)))
            decided = with_steps(integrator, step, steps_set or steps)
            now, chance = _acceptance(system, now, k, decided)
            motion = chance * step / scheme.force_evaluations
            best = max(best, (motion, chance, decided), key=lambda tried: tried[0])
            if chance < LEAST_ACCEPTANCE:
                break
    motion, chance, decided = best
    if motion == 0:
        raise SimulationError(
            f"stages.{k}: no pilot trajectory was accepted. Name an integrator and a shorter step"
        )
    return decided.with_defaults, (
        f"the longest accepted motion per force evaluation of {', '.join(TRIED)}; {chance:.0%}"
        f" of {TRAJECTORIES} pilot trajectories of {decided.steps_together} steps would be"
        " accepted"
    )


def _acceptance(system: System, state: State, k: int, stage: Stage) -> tuple[State, float]:
    """The state after pilot trajectories from a state on, and their mean probability of
    acceptance."""
    engine = system.engine()
    now, scheme = begun(system, state, k, stage, engine)
    now.begin_segment()
    until = int(now.step[NOW]) + TRAJECTORIES * stage.steps_together
    try:
        engine.advance(now, scheme, stage.step, until)
    except SimulationError:  # a molecule was lost in a step that is too long
        return state, 0.0
    sums = not_none(engine.extension_sums)
    return now, float(sums[CHANCES] / sums[ENDED])
