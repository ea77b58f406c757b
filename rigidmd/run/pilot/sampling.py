"""The choice of `integrator = "auto"` for sampling: by the bias of averages for bias_kT, by the
acceptance of trajectories for hybrid Monte Carlo. The bias by the time step follows from the shadow
Hamiltonian, see "The bias of averages" in the theory chapter `errors`."""

from dataclasses import replace
from math import inf, isfinite, sqrt

import numpy as np

from rigidmd.assemble.build import integrator_of_stage
from rigidmd.assemble.time_step import stable_angle
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NOW, State
from rigidmd.dynamics.hybrid_monte_carlo import CHANCES, ENDED
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.run.pilot.choice import round_down
from rigidmd.run.pilot.stable_step import stiffest_mode
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: Bias of U in kT per degree of freedom, in x.
BIAS = {"velocity_verlet": 1 / 8, "baoab": 1 / 24}
#: The heat capacity of water is twice that of harmonic motions, and then the bias of velocity
#: Verlet may be too.
ALLOWANCE = {"velocity_verlet": 2.0, "baoab": 1.0}
#: Phrases for the reason of a choice.
BASIS = {
    "velocity_verlet": "as twice the bias of harmonic motions",
    "baoab": "as one of two parts that cancel in harmonic motions",
}
#: Step and length of the pilot run, in radians of the faster mean motion, translation or rotation;
#: its samples.
PILOT_STEP, PILOT_RADIANS, PILOT_SAMPLES = 0.15, 50.0, 25
#: Longest step, as a fraction of the longest stable step: beyond it higher orders than dt² matter.
MAX_STABLE_FRACTION = 0.5


def sums_of_square_frequencies(
    system: System, engine: Engine, state: State, thermal: float
) -> tuple[float, float]:
    """Sums of w² (1/ps²) over the degrees of freedom of translation and rotation, at kT = `thermal`
    (u Å²/ps²). By equipartition <F²/m> = kT sum w², likewise for torques. Exact in the mean over
    the canonical distribution."""
    sums = sums_of_state(system.model, state, engine.evaluate(state)[0])
    return sums.force / thermal, sums.torque / thermal


def bias_of_potential(integrator: str, rate: float, timestep: float) -> float:
    """Estimated size of the bias of U, kT per degree of freedom; rate : mean w² of one, 1/ps²;
    timestep : ps."""
    return BIAS[integrator] * rate * timestep**2


def choose_for_averages(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator and step that keep its bias_kT with the fewest forces, and the
    reason.

    If the stage names a thermostat: velocity Verlet with it, or, if it is Langevin's, also BAOAB.
    Otherwise: velocity Verlet with velocity rescaling, or BAOAB with Langevin's. Raises
    SimulationError.
    """
    stage = system.scene.stages[k]
    target, steps = not_none(stage.bias_kT), {}
    stiffest, rate = stiffest_mode(system, state), mean_square_rate(system, state, k)
    for integrator in BIAS:
        if integrator == "baoab" and not (
            stage.thermostat_is_open or stage.thermostat == "langevin"
        ):
            continue
        decided = _decided(stage, integrator, stage.timestep_fs)
        stable = (
            MAX_STABLE_FRACTION * stable_angle(decided.scheme) / stiffest.rate if stiffest else inf
        )
        good = sqrt(target / (ALLOWANCE[integrator] * BIAS[integrator] * rate)) if rate > 0 else inf
        step = min(good, stable, stage.duration)
        steps[integrator] = round_down(step / FEMTOSECOND) if rate > 0 else stage.timestep_fs
    best = max(steps, key=lambda name: (steps[name], -BIAS[name]))
    step = steps[best] * FEMTOSECOND
    bias = ALLOWANCE[best] * bias_of_potential(best, rate, step)
    return (
        _decided(stage, best, steps[best]),
        (
            f"bias of U below about {bias:.1e} kT per degree of freedom, where {target:g} was"
            f" requested: estimated from {sqrt(rate):.3g} rad/ps, the rms frequency of the motions,"
            f" {BASIS[best]}, not sampled; {1 / step:.4g} forces per ps"
        ),
    )


def _decided(stage: Stage, integrator: str, timestep_fs: float) -> Stage:
    thermostat = {"thermostat": "langevin"} if integrator == "baoab" else {}
    return (
        stage.with_integrator(integrator, timestep_fs).model_copy(update=thermostat).with_defaults
    )


def mean_square_rate(system: System, state: State, k: int) -> float:
    """Mean w² of a degree of freedom (1/ps²) in stage k, over the second half of a pilot run from a
    state on."""
    stage = system.scene.stages[k]
    thermal = BOLTZMANN * max(stage.temperatures)
    engine, freedom = system.engine(), system.freedom_in(k)
    first = sums_of_square_frequencies(system, engine, state, thermal)
    fastest = (
        max(sum_ / n for sum_, n in zip(first, freedom, strict=True) if n) if freedom.total else 0.0
    )
    if fastest == 0 and (stiffest := stiffest_mode(system, state)) is not None:
        fastest = stiffest.rate**2  # the start is a minimum, where forces are 0
    if not isfinite(fastest) or fastest <= 0:
        return 0.0
    dt = PILOT_STEP / sqrt(fastest)
    # Langevin's thermostat at a fifth of that rate brings any start to the temperature in the first
    # half of the run
    heat = {
        "thermostat": "langevin",
        "thermostat_time_ps": None,
        "friction_translation_per_ps": sqrt(fastest) / 5,
    }
    heated = stage.with_integrator("baoab", dt / FEMTOSECOND)
    scheme = _integrator(
        system, k, heated.model_copy(update=heat | {"friction_rotation_per_ps": None})
    )
    now = engine.begin(state, scheme)
    now.step[:] = 0
    now.begin_segment(0.0)
    every = round(PILOT_RADIANS / PILOT_STEP / PILOT_SAMPLES)
    sums = []
    for sample in range(1, PILOT_SAMPLES + 1):
        engine.advance(now, scheme, dt, sample * every)
        sums.append(sum(sums_of_square_frequencies(system, engine, now, thermal)))
    rate = float(np.mean(sums[PILOT_SAMPLES // 2 :])) / freedom.total
    if not isfinite(rate):
        raise SimulationError(
            "the pilot run that measures frequencies for bias_kT has no finite forces"
        )
    return rate


def _integrator(system: System, k: int, stage: Stage) -> Scheme:
    """The integrator of a pilot run, with `stage` instead of stage k."""
    stages = system.scene.stages
    scene = system.scene.model_copy(update={"stages": (*stages[:k], stage, *stages[k + 1 :])})
    return integrator_of_stage(replace(system, scene=scene), k)


#: Integrators that are tried for hybrid Monte Carlo, from the shortest step to the longest one.
TRIED = ("velocity_verlet", "two_stage", "srkn_4")
#: Steps that are tried, as fractions of the longest stable one, and trajectories with each.
FRACTIONS, TRAJECTORIES = (0.2, 0.28, 0.4, 0.56, 0.8), 16
#: Steps of the first trajectories, which leave the lattice of a start, whose forces are not those
#: of a liquid.
WARMING_STEPS = 20
#: Length of a trajectory in radians of the rms frequency of all motions. For water it is 0.08 ps.
#: The energies of 64 SPC/E were independent soonest with 0.06 to 0.11 ps; with 0.03 or 0.45 ps they
#: took 1.6 and 2 times as long.
RADIANS = 1.0


def choose_for_sampling(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator, the step and, unless given, the length of the trajectories that
    accept most motion per force evaluation, and the reason. Pilot trajectories follow each other
    from a copy of a state on, so that they also approach equilibrium, first with the shortest step.
    Raises SimulationError."""
    stage = system.scene.stages[k]
    first = stage.with_integrator(TRIED[0], stage.timestep_fs).model_copy(
        update={"trajectory_steps": WARMING_STEPS}
    )
    now, _ = _acceptance(system, state, k, first)
    stiffest = stiffest_mode(system, now)
    rate = mean_square_rate(system, now, k)
    best = (0.0, stage, 0.0)
    if stiffest is None or rate == 0:
        raise SimulationError(
            f"stages.{k}: nothing sets a step for integrator = 'auto'; name an integrator and a"
            " step"
        )
    for integrator in TRIED:
        for fraction in FRACTIONS:
            scheme = stage.with_integrator(integrator, 1.0).scheme
            step = round_down(fraction * stable_angle(scheme) / stiffest.rate / FEMTOSECOND)
            steps = stage.trajectory_steps or max(
                1, round(RADIANS / sqrt(rate) / (step * FEMTOSECOND))
            )
            decided = stage.with_integrator(integrator, step).model_copy(
                update={"trajectory_steps": steps}
            )
            now, chance = _acceptance(system, now, k, decided)
            gain = chance * step * FEMTOSECOND / scheme.force_evaluations
            best = max(best, (gain, decided, chance), key=lambda one: one[0])
            if chance < 0.2:
                break
    gain, decided, chance = best
    if gain == 0:
        raise SimulationError(
            f"stages.{k}: no pilot trajectory was accepted; name an integrator and a shorter step"
        )
    return (
        decided.with_defaults,
        (
            f"the longest accepted motion per force evaluation of {', '.join(TRIED)}; {chance:.0%}"
            f" of {TRAJECTORIES} pilot trajectories of {decided.trajectory_steps} steps would be"
            " accepted"
        ),
    )


def _acceptance(system: System, state: State, k: int, stage: Stage) -> tuple[State, float]:
    """The state after pilot trajectories from a state on, and their mean probability of
    acceptance."""
    engine, method = system.engine(), _integrator(system, k, stage)
    now = engine.begin(state, method)
    now.begin_segment()
    try:
        steps = TRAJECTORIES * stage.steps_together
        engine.advance(now, method, stage.timestep_fs * FEMTOSECOND, int(now.step[NOW]) + steps)
    except SimulationError:  # a molecule was lost in a step that is too long
        return state, 0.0
    sums = not_none(engine.trajectories)
    return now, float(sums[CHANCES] / sums[ENDED])
