"""`integrator = "auto"`: the integrator and the step of a stage."""

from importlib import import_module
from math import inf, sqrt

from rigidmd.assemble.time_step import fastest_of_scene
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import State
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.system import System
from rigidmd.run.pilot.choice import choose
from rigidmd.run.pilot.sampling import choose_for_averages
from rigidmd.run.trial_systems import SPAN_PS, molecular_trial_system
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
