"""`integrator = "auto"`: the integrator and the step of a stage, or of a single body."""

from collections.abc import Callable
from fractions import Fraction
from importlib import import_module
from math import ceil, gcd, inf, sqrt

from rigidmd.assemble.time_step import fastest_of_scene
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import State
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.system import System
from rigidmd.features.bodies.keys.body import SAMPLES
from rigidmd.features.bodies.system import Pose
from rigidmd.run.pilot.choice import choose
from rigidmd.run.pilot.sampling import choose_for_averages
from rigidmd.run.trial_systems import SPAN_PS, body_trial_system, molecular_trial_system
from rigidmd.scene import BodyScene
from rigidmd.scene.stage import Stage
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: Step of velocity Verlet and span of a pilot run, in radians of the mean vibration or libration.
PILOT_STEP, PILOT_SPAN = 0.15, 10.0
#: For an error of the energy over a stage a pilot run takes this part of the stage, at least these
#: radians.
PILOT_PART, LEAST_SPAN = 0.01, 3.0
#: Longest time for one radian of the mean motion in a liquid, in times of its fastest motion. In a
#: lattice forces nearly cancel: it is stiffer after some steps than at its start.
SLOWEST = 5.0
#: Minimum fraction of a chosen step to which it is shortened to fit the interval of samples.
MIN_STEP_FRACTION = 0.25


def choose_for_stage(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator and step that are best from this state, and the reason. Raises
    SimulationError."""
    stage = system.scene.stages[k]
    if module := stage.thermostat_method.pilot:
        return import_module(module).choose_for_stage(system, state, k)
    return (choose_for_averages if stage.bias_kT else choose_for_molecules)(system, state, k)


def natural_time(system: System, state: State) -> float | None:
    """Time (ps) for one radian of the faster motion, vibration or libration. None at rest. Its
    inverse squared is <F²/m> / <m v²>, the mean square frequency of harmonic motion. Likewise for
    torques. At most SLOWEST times the time of the fastest motion at the state's temperature."""
    sums = sums_of_state(system.model, state, system.engine().evaluate(state)[0])
    pairs = (sums.force, sums.translation), (sums.torque, sums.rotation)
    fastest = max(force / motion if motion > 0 else 0.0 for force, motion in pairs)
    temperature = (sums.translation + sums.rotation) / (BOLTZMANN * system.last_freedom.total)
    in_liquid = fastest_of_scene(system.scene, temperature)
    if in_liquid is not None and in_liquid.time < inf:
        fastest = max(fastest, (SLOWEST * in_liquid.time) ** -2)
    return 1 / sqrt(fastest) if fastest > 0 else None


def choose_for_molecules(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k with the integrator and step that are best from this state, and the reason. Raises
    SimulationError."""
    stage = system.scene.stages[k]
    natural = natural_time(system, state)
    step = PILOT_STEP * natural / FEMTOSECOND if natural else stage.step_fs
    span = PILOT_SPAN * natural if natural else SPAN_PS
    if stage.energy_error_kT:
        span = min(span, max(PILOT_PART * stage.duration, LEAST_SPAN / PILOT_SPAN * span))
    trial_system = molecular_trial_system(system, state, None, span)
    longest = {
        name: float(f"{4 * step * scheme.force_evaluations:.3g}")
        for name, scheme in SCHEMES.items()
        if scheme.exact_rotor
        or scheme.order == 2  # the others need more forces, and are for bodies without that rotor
    }
    choice = choose(
        trial_system, longest, stage.energy_error_kT, stage.trajectory_error, stage.duration
    )
    return stage.with_integrator(choice.integrator, choice.timestep), choice.reason


def choose_for_body(
    scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None
) -> tuple[BodyScene, str]:
    """A scene with the best integrator and step, and the reason. Raises SimulationError."""
    run = scene.run
    trial_system, _ = body_trial_system(scene, applied=applied)
    longest = {name: run.timestep_s for name in trial_system.methods if name in SCHEMES}
    choice = choose(trial_system, longest, run.energy_error, run.trajectory_error)
    timestep = _fit_step(choice.timestep, run.duration_s, scene.output.interval_s)
    fitted = ""
    if timestep != choice.timestep:
        fitted = f", shortened to {timestep:g} s to fit duration and samples"
    changes = {"integrator": choice.integrator, "timestep_s": timestep}
    changed = run.model_copy(update=changes | {"energy_error": None, "trajectory_error": None})
    reason = f"{choice.integrator} at {choice.timestep:g} s chosen{fitted}: {choice.reason}"
    return scene.model_copy(update={"run": changed}), reason


def _fit_step(timestep: float, duration: float, interval: float | None) -> float:
    """The longest step up to this one that divides the duration and the interval of samples, or the
    duration alone, if the interval or their common divisor would make it much shorter. Each step is
    then a sample."""
    if interval is not None and interval < MIN_STEP_FRACTION * timestep:
        interval = duration
    if interval is None:
        interval = duration / SAMPLES if duration / SAMPLES >= timestep else duration
    (a, b), (c, d) = (Fraction(repr(span)).as_integer_ratio() for span in (duration, interval))
    common = float(Fraction(gcd(a * d, c * b), b * d))
    longest = min(timestep, interval)
    span = common if common >= MIN_STEP_FRACTION * longest else duration
    return span / ceil(span / longest * (1 - 1e-9))
