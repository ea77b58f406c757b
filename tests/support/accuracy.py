"""Trials whose numbers are made up."""

from rigidmd.features.bodies.trials import body_trial_system
from rigidmd.features.studies.accuracy.measurement import IntegratorAccuracy
from rigidmd.run.trials import Trial
from rigidmd.scene import Scene
from support.common import ROOT

TOP = ROOT / "systems" / "heavy_top_3.toml"


def trials(found, name):
    return [trial for trial in found.trials if trial.integrator == name]


def made(*rows, span=0.1):
    """A body's trials (integrator, step, seconds of three timings or a reason to fail, energy and Q
    error)."""
    trial_system, _ = body_trial_system(Scene.read(TOP), span)
    trials = []
    for name, step, seconds, error in rows:
        n = round(span / step)
        trial = Trial(name, step, n, n, rotation_error=error, energy_rms=error)
        if isinstance(seconds, str):
            trial.failure = seconds
        else:
            trial.seconds = list(seconds)
        trials.append(trial)
    return IntegratorAccuracy(trial_system, trials, 1000, 1e-14)


def changed(**run):
    """The heavy top with other keys of its run."""
    return Scene.read(TOP, {f"run.{key}": value for key, value in run.items()})


#: Errors of a scheme of order 4 at steps that halve: 0.3 h^4 with h = 1, 1/2, ...
FOURTH = [0.3 * 16.0**-k for k in range(9)]
