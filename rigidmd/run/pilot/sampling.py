"""The choice of `integrator = "auto"` for averages, by their bias. It follows from the shadow
Hamiltonian, see "The bias of averages" in the theory chapter `errors`."""

from dataclasses import replace
from math import inf, isfinite, sqrt

import numpy as np

from rigidmd.assemble.build import integrator_of_stage
from rigidmd.assemble.harmonic import stable_angle
from rigidmd.assemble.time_step import fastest_motion
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import State
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.run.pilot.choice import round_down
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: The integrator for averages, and its largest bias of U, in kT per degree of freedom and in (w
#: dt)²: one of two parts, which cancel in harmonic motions.
UNBIASED = "baoab"
BIAS = 1 / 24
#: Step and length of the pilot run, in radians of the faster mean motion, translation or rotation;
#: its samples.
PILOT_STEP, PILOT_RADIANS, PILOT_SAMPLES = 0.15, 50.0, 25
#: Where the mean (w t)² of the fastest motion of a liquid, of time t, is below this, molecules
#: collide rarely: the stiffest motion is then the one in a collision, as fast as in a liquid.
GAS = 0.01
#: Longest step, as a fraction of the longest stable step: beyond it higher orders than dt² matter.
MAX_STABLE_FRACTION = 0.5


def bias_of_potential(rate: float, timestep: float) -> float:
    """Largest bias of U of `UNBIASED`, kT per degree of freedom; rate : mean w² of one, 1/ps²;
    timestep : ps."""
    return BIAS * rate * timestep**2


def choose_for_averages(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with `UNBIASED` and the longest step that keeps its bias_kT, and the reason. Raises
    SimulationError."""
    stage = system.scene.stages[k]
    target = not_none(stage.bias_kT)
    stiffest = stiffest_mode(system, state)
    rate = mean_square_rate(system, state, k)
    decided = stage.with_integrator(UNBIASED, stage.step_fs)
    if rate > 0:
        stable = stable_angle(decided.scheme) / stiffest.rate if stiffest else inf
        fastest = fastest_motion(system.species, max(stage.temperatures))
        if fastest is not None and rate * fastest.time**2 < GAS:
            stable = min(stable, fastest.longest_step(decided))
        longest = min(sqrt(target / (BIAS * rate)), MAX_STABLE_FRACTION * stable, stage.duration)
        decided = stage.with_integrator(UNBIASED, round_down(longest / FEMTOSECOND))
    return decided.with_defaults, (
        f"bias of U below about {bias_of_potential(rate, decided.step):.1e} kT per degree of"
        f" freedom, where {target:g} was requested: estimated from {sqrt(rate):.3g} rad/ps, the rms"
        " frequency of the motions, as one of two parts that cancel in harmonic motions, not"
        f" sampled; {1 / decided.step:.4g} forces per ps"
    )


def mean_square_rate(system: System, state: State, k: int) -> float:
    """Mean w² of a degree of freedom (1/ps²) in stage k, over the second half of a pilot run from a
    state on."""
    stage = system.scene.stages[k]
    freedom = system.freedom_in(k)
    engine = system.engine()
    thermal = BOLTZMANN * max(stage.temperatures)

    def square_rates(now: State) -> np.ndarray:
        """Sums of w² over translation and rotation. By equipartition <F²/m> = kT sum w², likewise
        for torques. Exact in the mean over the canonical distribution."""
        sums = sums_of_state(system.model, now, engine.evaluate(now)[0])
        return np.array([sums.force, sums.torque]) / thermal

    pairs = zip(square_rates(state).tolist(), freedom, strict=True)
    fastest = max((rates / n for rates, n in pairs if n), default=0.0)
    if fastest == 0 and (stiffest := stiffest_mode(system, state)) is not None:
        fastest = stiffest.rate**2  # the start is a minimum, where forces are 0
    if not isfinite(fastest) or fastest <= 0:
        return 0.0
    dt = PILOT_STEP / sqrt(fastest)
    if (motion := fastest_motion(system.species, max(stage.temperatures))) is not None:
        dt = min(dt, motion.time)  # molecules beyond their cutoff may collide later
    # Langevin's thermostat at a fifth of that rate brings any start to the temperature in the first
    # half of the run
    heat = {
        "thermostat": "langevin",
        "thermostat_time_ps": None,
        "friction_translation_per_ps": sqrt(fastest) / 5,
        "friction_rotation_per_ps": None,
    }
    heated = stage.with_integrator("baoab", dt / FEMTOSECOND).model_copy(update=heat)
    now, scheme = begun(system, state, k, heated, engine)
    now.step[:] = 0
    now.begin_segment(0.0)
    every = round(PILOT_RADIANS / PILOT_STEP / PILOT_SAMPLES)
    sums = []
    for sample in range(1, PILOT_SAMPLES + 1):
        engine.advance(now, scheme, dt, sample * every)
        sums.append(square_rates(now).sum())
    rate = float(np.mean(sums[PILOT_SAMPLES // 2 :])) / freedom.total
    if not isfinite(rate):
        raise SimulationError(
            "the pilot run that measures frequencies for bias_kT has no finite forces"
        )
    return rate


def begun(
    system: System, state: State, k: int, stage: Stage, engine: Engine
) -> tuple[State, Scheme]:
    """A state at the start of a pilot run with `stage` instead of stage k, and its integrator."""
    stages = system.scene.stages
    scene = system.scene.model_copy(update={"stages": (*stages[:k], stage, *stages[k + 1 :])})
    scheme = integrator_of_stage(replace(system, scene=scene), k)
    return engine.begin(state, scheme), scheme
