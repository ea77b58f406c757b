"""Conditions that analyses need, such as a box or a constant temperature.

An analysis declares its conditions where it is registered, `built_in(..., needs=(box,
equilibrium))`. They are checked before it runs. A condition is a function of runs that returns what
they lack, as the end of the sentence "viscosity needs ...", or an empty text.
"""

from collections.abc import Callable, Iterable

from rigidmd.errors import OutputError
from rigidmd.features.analysis.runs import Runs
from rigidmd.forces.terms import trait
from rigidmd.formats import written
from rigidmd.scene.stage import Stage

Condition = Callable[[Runs], str]
#: Keys of a stage that are equal where conditions are constant.
SET_POINTS = ("ensemble", "temperature_K", "pressure_bar")


def check_conditions(name: str, runs: Runs, conditions: Iterable[Condition]) -> None:
    """Raise OutputError for the first condition that runs do not meet. name : of the analysis"""
    for condition in conditions:
        if missing := condition(runs):
            raise OutputError(f"{name} needs {missing}")


def trajectory(runs: Runs) -> str:
    for run in runs.members:
        if len(run) < 2:
            return f"the frames of a trajectory: {run.why_no_frames or 'there are fewer than two'}"
    return ""


def velocities(runs: Runs) -> str:
    if all(run.velocities is not None and run.L is not None for run in runs.members):
        return ""
    kinds = " or ".join(written(lambda form: form.velocities))
    return f"velocities in the frames: a trajectory file of type {kinds} has them"


def box(runs: Runs) -> str:
    return "" if runs.has_box else "a box, and the run has none (box.periodic = false)"


def constant_conditions(runs: Runs) -> str:
    """The same set points of temperature and pressure in all frames."""
    need = "constant conditions"
    for run in runs.members:
        for stage in run.stages:
            if stage.ramps:
                return f"{need}: in the stage {stage.label} {_ramp_of(stage)}"
            if key := _difference(stage, run.stage):
                return (
                    f"{need}: {key} differs in the stages {stage.label} and {run.stage.label}. Use"
                    f" frames from {run.begin_of_stage:g} ps on"
                )
        if key := _difference(run.stage, runs.first.stage):
            return f"{need}: {key} differs between the runs"
    return ""


def static(runs: Runs) -> str:
    """Forces that do not depend on time."""
    driven = [name for name, term in runs.system.terms.items() if trait(term, "time_dependent")]
    return f"static forces, and these depend on time: {', '.join(driven)}" if driven else ""


def equilibrium(runs: Runs) -> str:
    return static(runs) or constant_conditions(runs)


def motion(runs: Runs) -> str:
    """A path in time, at constant conditions."""
    for stage in (stage for run in runs.members for stage in run.stages):
        if reason := stage.thermostat_method.no_motion:
            return f"motion in time, and the stage {stage.label} {reason}"
    return constant_conditions(runs)


def _ramp_of(stage: Stage) -> str:
    begin, end = stage.temperatures
    if begin != end:
        return f"the temperature changes from {begin:g} to {end:g} K"
    return "the pressure changes"


def _difference(stage: Stage, other: Stage) -> str:
    """The first set point in which stages differ, or an empty text."""
    return next((key for key in SET_POINTS if getattr(stage, key) != getattr(other, key)), "")
