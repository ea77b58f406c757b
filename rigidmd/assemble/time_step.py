"""Estimates for time steps without compiled code: the fastest motions in a liquid, steps that are
too long for them, and the precision of forces that suits the error of a step.

A motion of angular frequency w has the rms amplitude sqrt(kT/m)/w at a temperature T. The fastest
molecular motions in liquids have similar amplitudes, so w follows from masses, moments of inertia
and temperature.
"""

from collections.abc import Callable, Iterator
from functools import cache
from math import inf, sqrt
from operator import attrgetter
from typing import Literal, NamedTuple

import numpy as np

from rigidmd.assemble.harmonic import INACCURATE, round_steps, stable_angle, step_error
from rigidmd.assemble.species import species_of
from rigidmd.core.integrators import WITH_THERMOSTAT, Scheme
from rigidmd.errors import SceneError
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.scene.stage import USUAL_STEP, Stage
from rigidmd.units import BOLTZMANN, COULOMB, FEMTOSECOND

#: Rms amplitudes of the fastest motions of a liquid at its temperature, as angles and in diameters.
#: Measured by `stiffest_mode` after 3 ps: 0.11 rad in SPC/E, 0.10 in TIP4P/2005, 0.12 in methanol,
#: 0.09 in nitrogen, 0.05 in CO2 and benzene; 0.019 diameters in argon, 0.020 in benzene, 0.017 in
#: CO2, 0.006 in water.
SWING_RAD, SWING_DIAMETERS = 0.12, 0.02
#: Rms error of forces in mixed precision, relative to the rms force. Measured for a liquid with a
#: cutoff of 9 Å: 3.2e-6 for 512 SPC/E with PME, 3.3e-6 for 216 TIP4P/2005 with a reaction field,
#: 1.4e-6 for 500 argon; the largest 1e-5.
MIXED_ERROR = 3e-6
#: Minimum error of Ewald sums that grids in single precision allow, e²/Å².
MIXED_EWALD_ERROR = 3e-6
#: Bias of U per error of a step, and its largest value at a default step, kT per degree of freedom:
#: of a thermostat that reads the momenta at the ends of steps (measured for SPC/E with velocity
#: Verlet: 0.007 at 2 fs, 0.026 at 4 fs), and in the middle of the drift (SPC/E at 4 fs: 0.0019(5)
#: and 0.004(1) in two series).
BIAS_AT_ENDS, BIAS_IN_MIDDLE = (0.6, 0.002), (0.1, 0.005)
#: Largest error of a default step without a thermostat, or of tested trajectories: 2 fs for water.
DEFAULT_ERROR = 0.0125
#: Default steps are at most this long, fs. At 20 fs the bias of U in liquids without hydrogen is at
#: most 0.0014 kT per degree of freedom, but the conserved energy of CO2, benzene and acetonitrile
#: drifts by 0.4 to 1.2 kT/ns per degree of freedom.
LONGEST_DEFAULT = 10.0
#: A step that is this many times shorter than the longest stable one is probably in another unit.
NEEDLESS = 1000
#: precision = "auto" is mixed where the time-step error is at least this many times that of
#: mixed precision. The limits of a minimisation in mixed precision are, too.
MARGIN = 30


def error_of_step(
    species: list[Molecule], temperature: float, scheme: Scheme, timestep_fs: float
) -> float:
    """`step_error` for the fastest motion of these molecules at a temperature, K, 0 without one."""
    fastest = fastest_motion(species, temperature)
    return 0.0 if fastest is None else step_error(scheme, timestep_fs * FEMTOSECOND / fastest.time)


class FastMotion(NamedTuple):
    """A fast motion of a molecule in a liquid."""

    time: float  # for its amplitude at the thermal speed, 1/w, ps
    amplitude: float
    unit: str
    molecule: str
    does: str  # "moves" or "rotates ..."

    def longest_step(self, stage: Stage) -> float:
        """The longest stable step of a stage for this motion, ps."""
        return stable_angle(stage.scheme) * self.time


def fastest_motion(species: list[Molecule], temperature: float) -> FastMotion | None:
    """The fastest motion at a temperature, K. None without molecules or temperature."""
    motions = []
    thermal = BOLTZMANN * temperature
    for m in species if thermal > 0 else ():
        diameter = max(
            (sigma for sigma, depth in zip(m.sigma, m.epsilon, strict=True) if depth > 0),
            default=inf,
        )
        lightest = min((moment for moment in m.inertia if moment > 0), default=inf)
        moving = diameter * sqrt(m.mass / thermal)
        rotating = sqrt(lightest / thermal)
        motions += [
            FastMotion(SWING_DIAMETERS * moving, SWING_DIAMETERS, "diameters", m.name, "moves"),
            FastMotion(
                SWING_RAD * rotating, SWING_RAD, "rad", m.name, "rotates about its lightest axis"
            ),
        ]
    return min(motions, key=attrgetter("time"), default=None)


@cache
def _longest_angle(scheme: Scheme, error: float) -> float:
    """Largest w dt, up to half of the longest stable one, at which the error of a step is this."""
    angles = stable_angle(scheme) / 2 * 0.98 ** np.arange(500)
    return next((x for x in angles.tolist() if step_error(scheme, x) <= error), 0.0)


def _bias_of(stage: Stage) -> tuple[float, float]:
    """Bias of U per time-step error in a stage with a thermostat, and its largest value at a
    default step, kT per degree of freedom."""
    return BIAS_IN_MIDDLE if stage.integrator in WITH_THERMOSTAT else BIAS_AT_ENDS


def _default_step(scene: MolecularScene, stage: Stage, fastest: FastMotion | None) -> float:
    """The default time step of a stage, fs: a round number that divides its intervals, if there is
    one between the longest allowed step and half of it."""
    if fastest is None or scene.forces.added or scene.from_python:
        return USUAL_STEP
    error = DEFAULT_ERROR
    if stage.has_thermostat and not (stage.in_trajectories or scene.engine.is_external):
        per_error, largest = _bias_of(stage)
        error = largest / per_error
    longest = _longest_angle(stage.scheme, error) * fastest.time / FEMTOSECOND
    longest = min(longest, LONGEST_DEFAULT, stage.duration / FEMTOSECOND)
    if longest == 0:
        return USUAL_STEP
    allowed = round_steps(longest)
    output = scene.output
    intervals = [stage.duration, output.log_interval_ps]
    if output.trajectory:
        intervals.append(output.trajectory_interval_ps)
    return next((step for step in allowed if _divides(step, intervals)), allowed[0])


def _divides(step: float, intervals: list[float]) -> bool:
    """Whether a step (fs) divides all intervals (ps), up to rounding."""
    ratios = [interval / (step * FEMTOSECOND) for interval in intervals]
    return all(abs(ratio - round(ratio)) <= 1e-9 * ratio for ratio in ratios)


def with_time_steps(
    scene: MolecularScene, species: list[Molecule], temperature: float
) -> MolecularScene:
    """A scene with a time step in every stage that needs one. Raises SceneError.

    temperature : of velocities from a file, K
    """
    moving = _moving(scene, species)
    stages = list(scene.stages)
    for k, stage, of_stage in _given_steps(scene):
        if stage.timestep_fs is None:
            fastest = fastest_motion(moving, of_stage or temperature)
            step = _default_step(scene, stage, fastest)
            stages[k] = stage.model_copy(update={"timestep_fs": step})
    complete = scene.model_copy(update={"stages": tuple(stages)})
    if errors := complete.errors_of_steps():
        raise SceneError(scene.source, errors)
    return complete


def describe_step(scene: MolecularScene, species: list[Molecule], k: int) -> str:
    """The motion that limits the step of stage k, and the bias that is expected. Empty if there is
    no such motion."""
    given = {index: (stage, temperature) for index, stage, temperature in _given_steps(scene)}
    if k not in given:
        return ""
    stage, temperature = given[k]
    fastest = fastest_motion(_moving(scene, species), temperature)
    if fastest is None or scene.engine.is_external:
        return ""
    error = step_error(stage.scheme, stage.step / fastest.time)
    if error == inf:
        return "time-step error: unstable"
    text = (
        f"time-step error: {fastest.molecule} {fastest.does} as if forces were wrong by"
        f" {_one_digit(100 * error)} %"
    )
    if stage.in_trajectories:
        return f"{text}. Averages have none"
    if stage.has_thermostat:
        bias = _bias_of(stage)[0] * error
        text += f". Bias of U about {_one_digit(bias)} kT per degree of freedom"
    return text


def _moving(scene: MolecularScene, species: list[Molecule]) -> list[Molecule]:
    """The species that are not frozen."""
    entries = zip(species, scene.molecules, strict=False)
    return [m for m, entry in entries if entry.frozen is not True]


def fastest_of_scene(scene: MolecularScene, temperature: float) -> FastMotion | None:
    """`fastest_motion` of the molecules of a scene that are not frozen."""
    return fastest_motion(_moving(scene, species_of(scene)), temperature)


def _given_steps(scene: MolecularScene) -> Iterator[tuple[int, Stage, float]]:
    """The stages other than minimisations with a given step: index, stage and temperature, K, 0 if
    it is not known."""
    temperature = scene.start.temperature_K or 0.0
    for k, stage in enumerate(scene.stages):
        temperature = max(stage.temperatures) or temperature
        if not (stage.is_auto or stage.is_minimisation):
            yield k, stage, temperature


def step_warnings(scene: MolecularScene) -> list[str]:
    """Warnings of time steps that are inaccurate or needlessly short for these molecules in a
    liquid, and of orders that truncated forces do not allow. See `step_errors`."""
    warnings = []
    forces = scene.forces
    ends = forces.cutoff_A is not None or scene.box.periodic
    jumps = ends and forces.lennard_jones and forces.truncation in ("plain", "shift")
    for k, stage, _ in _given_steps(scene):
        if (order := stage.scheme.order) > 2 and jumps:
            lost = (
                "lost where forces jump to 0 at the cutoff, as with forces.truncation ="
                f" {forces.truncation!r}"
            )
            advice = "Use truncation = 'smooth_switch'"
            warnings.append(f"stages.{k}: {stage.integrator} has order {order}, {lost}. {advice}")
    return [*warnings, *sentences_on_steps(scene, _step_warning)]


def sentences_on_steps(
    scene: MolecularScene, about: Callable[[Stage, FastMotion, float], str]
) -> Iterator[str]:
    """What a function writes on the step of each stage, if the scene watches steps."""
    species = _moving(scene, species_of(scene))
    for k, stage, temperature in _given_steps(scene):
        fastest = fastest_motion(species, temperature)
        if fastest is None or not scene.watch.stable_step:
            continue
        if sentence := about(stage, fastest, temperature):
            yield f"stages.{k}: timestep_fs = {stage.step_fs:g} {sentence}"


def step_errors(scene: MolecularScene) -> list[str]:
    """Errors of time steps that are unstable for these molecules in a liquid: in which a molecule
    at its thermal speed moves or rotates by more than `stable_angle` amplitudes."""
    return list(sentences_on_steps(scene, _instability))


def _instability(stage: Stage, fastest: FastMotion, temperature: float) -> str:
    """How the step of a stage is unstable for a motion at a temperature, K. Empty if it is not."""
    time, size, unit, name, does = fastest
    longest = fastest.longest_step(stage)
    if stage.step <= longest:
        return ""
    limit = longest / FEMTOSECOND
    return (
        f"is unstable for {name} at {temperature:g} K: in a step it {does} by"
        f" {stage.step / time * size:.2g} {unit} (rms). In a liquid {stage.integrator} is stable up"
        f" to {limit:.3g} fs. Use {round_steps(limit)[0]:g} fs or less"
    )


def _step_warning(stage: Stage, fastest: FastMotion, temperature: float) -> str:
    """What is wrong with a stable step of a stage for a motion at a temperature, K. Empty if
    nothing is."""
    longest = fastest.longest_step(stage)
    if sentence := accuracy_warning(stage, fastest, temperature):
        return sentence
    if longest < inf and stage.step * NEEDLESS < longest:
        in_ps = stage.step * 1000 * NEEDLESS >= longest
        return (
            f"is {longest / stage.step:.0f} times shorter than {stage.integrator} needs for"
            f" {fastest.molecule}, {longest / FEMTOSECOND:.3g} fs:"
            f" {'is it in ps?' if in_ps else 'is it in another unit?'}"
        )
    return ""


def accuracy_warning(stage: Stage, fastest: FastMotion, temperature: float) -> str:
    """Like `_step_warning`, of steps that are stable and have large errors."""
    dt = stage.step
    limit = fastest.longest_step(stage)
    error = step_error(stage.scheme, dt / fastest.time)
    # a test of trajectories corrects the error of their steps
    if dt > limit or error <= INACCURATE or stage.in_trajectories:
        return ""
    better = dt
    while step_error(stage.scheme, better / fastest.time) > INACCURATE / 2:
        better *= 0.95
    return (
        f"is inaccurate for {fastest.molecule} at {temperature:g} K: it {fastest.does} as if forces"
        f" were wrong by {error:.0%}, which shifts temperatures and averages. At"
        f" {better / FEMTOSECOND:.2g} fs it is {INACCURATE / 2:.0%}"
    )


def _one_digit(value: float) -> str:
    """A number with one significant digit: 40, not 4e+01."""
    return f"{float(f'{value:.1g}'):g}"


def precision_for(error: float) -> Literal["double", "mixed"]:
    """The precision of forces that suits a time-step error."""
    return "mixed" if error >= MARGIN * MIXED_ERROR else "double"


def with_precision(
    scene: MolecularScene, species: list[Molecule], temperature: float, force_error: float | None
) -> tuple[MolecularScene, str]:
    """A scene with its precision and, for "auto", the reason: mixed if the time-step error
    hides that of single precision in every stage, else double.

    species : those that are not frozen; temperature : of velocities from a file, K. force_error :
    of an Ewald sum, of the force on a site, u Å/ps²
    """
    if scene.precision != "auto":
        return scene, ""
    errors = {
        k: error_of_step(species, stage_temperature or temperature, stage.scheme, stage.step_fs)
        for k, stage, stage_temperature in _given_steps(scene)
    }
    seeks = [
        k
        for k, stage in enumerate(scene.stages)
        if stage.is_auto and not (stage.bias_kT or stage.in_trajectories)
    ]
    precision, why = "double", "no stage has a given time step"
    if scene.engine.is_external:
        why = f"{scene.engine.title} computes the forces of the run"
    elif force_error is not None and force_error < MIXED_EWALD_ERROR * COULOMB:
        why = (
            f"the Ewald sum is good to {force_error / COULOMB:.1e} e²/Å², finer than single"
            " precision"
        )
    elif seeks:
        why = f"stages.{seeks[0]} chooses its step for a small error"
    elif errors:
        k = min(errors, key=lambda k: errors[k])
        precision = precision_for(errors[k])
        stage = scene.stages[k]
        step = f"{stage.integrator} at {stage.step_fs:g} fs"
        ratio = errors[k] / MIXED_ERROR
        times = f"{ratio:,.0f}" if ratio > 9 else f"{ratio:.1g}"
        single = f"that of single precision, {MIXED_ERROR:.0e}"
        why = f"the error of {step}, about {errors[k]:.0e} of the forces, is {times} times {single}"
        why += "" if precision == "mixed" else f", and not {MARGIN} times"
        if ratio == inf:
            why = (
                f"{step} is unstable for motions of these molecules, which hides the error of"
                " single precision"
            )
        elif ratio == 0:
            why = "the fastest motion of these molecules is not known"
    return scene.model_copy(update={"precision": precision}), why
