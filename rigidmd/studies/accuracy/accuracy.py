"""`rigidmd accuracy`: the errors and run times of integrators at several time steps, from the start of a scene."""

from collections.abc import Callable
from math import inf

from rigidmd.core.integrators import RADAU, SCHEMES, SOLVERS
from rigidmd.errors import SceneError
from rigidmd.run.force_errors import single_precision_errors
from rigidmd.run.pilot.trial_systems import COMPARATORS, SPAN_PS, body_trial_system, molecular_trial_system
from rigidmd.run.pilot.trials import IntegratorAccuracy, TrialSystem, measure, plan
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.validation import did_you_mean
from rigidmd.studies.accuracy.averages import check_engine_is_rigidmd, start_of_last_stage

#: Default integrators besides those of [[integrators]]: velocity Verlet, the best of each kind, and for a body the
#: textbook solvers.
DEFAULT_INTEGRATORS = (
    *(name for name, scheme in SCHEMES.items() if scheme.is_default),
    *(name for name, (solver, _) in COMPARATORS.items() if solver != RADAU),
)
#: Time steps per force evaluation, relative to the scene's; longer ones follow until one fails.
LADDER = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
RADIANS = 0.1  # rotation of a spinning body per force evaluation in the middle of the ladder, rad
AT_REST = 8.0  # step of a body that does not rotate, in the step of its scene, which is assumed to be suitable
AT_A_POLE = "the start has theta = 0 or 180 degrees, where Euler angles are singular"


def measure_accuracy(
    scene: MolecularScene | BodyScene, integrators: list[str] | None = None, timesteps: list[float] | None = None,
    span: float | None = None, repeats: int = 3,
    progress: Callable[[float], object] = lambda fraction: None,
) -> IntegratorAccuracy:  # fmt: skip
    """Error against run time of integrators at time steps, on the start of a scene. Raises SceneError.

    integrators : names; default: the scene's and those that suit it; the others are in `left_out`. rk4, dop853 and
        radau use the scene's formulation, or matrix; a suffix _matrix, _quaternion or _euler_angles sets another
    timesteps : fs for molecules, s for a body, the same for all; default: steps of equal cost around the scene's
    span : ps or s
    progress : called with the fraction that is done; at 0, after all arguments have been checked

    Molecules start where the last stage starts, after the earlier stages have run; no thermostat acts.
    """
    check_engine_is_rigidmd(scene)
    known = (*scene.schemes, *COMPARATORS)
    integrators = list(dict.fromkeys(_method_name(name, scene) for name in integrators or []))
    if unknown := [name for name in integrators if name not in known]:
        of_all = f"(known: {', '.join(known)})"
        errors = [f"unknown integrator {name}{did_you_mean(name, known)} {of_all}" for name in unknown]
        raise SceneError("--integrators", errors)
    lengths = [*(timesteps or []), *([] if span is None else [span])]
    if not all(0 < length < inf for length in lengths) or repeats < 1:
        raise SceneError("accuracy", ["time steps, span and repeats must be finite and greater than 0"])
    if isinstance(scene, MolecularScene) and (refused := [name for name in integrators if name in COMPARATORS]):
        reasons = [f"{name} does not suit this scene: it is for single bodies" for name in refused]
        raise SceneError(scene.source, reasons)
    progress(0.0)
    is_body = isinstance(scene, BodyScene)
    if is_body:
        trial_system, speed = body_trial_system(scene, span)
        evaluations = scene.run.row.force_evaluations if scene.run.has_scheme else 1
        base = RADIANS / speed if speed else AT_REST * scene.run.timestep_s / evaluations
    else:
        trial_system, base = _of_molecules(scene, span)
    if refused := [name for name in integrators if name not in trial_system.methods]:
        reasons = [f"{name} does not suit this scene: {trial_system.refused[name]}" for name in refused]
        raise SceneError(scene.source, reasons)
    left_out = {}
    if not integrators:
        defaults = [name for name in DEFAULT_INTEGRATORS if is_body or name in SCHEMES]
        defaults += [row.name for row in scene.integrators]
        left_out = {name: why for name, why in trial_system.refused.items() if name in defaults}
        left_out |= {name: AT_A_POLE for name in trial_system.singular if name in defaults}
        of_scene = _method_name(scene.run.integrator if is_body else scene.stages[-1].integrator, scene)
        candidates = dict.fromkeys((*defaults, of_scene))
        integrators = [name for name in candidates if name in trial_system.methods and name not in left_out]
    steps = {
        name: timesteps or [base * rung * trial_system.methods[name].force_evaluations for rung in LADDER]
        for name in integrators
    }
    trials = plan(trial_system, steps)
    found = measure(trial_system, trials, repeats, progress=progress, extend=not timesteps)
    found.left_out = left_out
    return found


def _method_name(name: str, scene: MolecularScene | BodyScene) -> str:
    """The full name of a method: for solvers with the formulation of the scene, unless it is the matrix."""
    solver, _, form = name.partition("_")
    if solver in SOLVERS and isinstance(scene, BodyScene):
        form = form or scene.run.formulation
        return solver if form in (None, "matrix") else f"{solver}_{form}"
    return name


def _of_molecules(scene: MolecularScene, span: float | None) -> tuple[TrialSystem, float]:
    """The system, and the scene's time step per force evaluation (fs)."""
    last = scene.stages[-1]
    if last.is_minimisation:
        raise SceneError(scene.source, ["the last stage is a minimisation: accuracy needs one in which time passes"])
    simulation, state = start_of_last_stage(scene)
    trial_system = molecular_trial_system(simulation.system, state, last.rotor, span or SPAN_PS)
    trial_system.rounding = single_precision_errors(simulation.system, state)
    return trial_system, last.timestep_fs / (last.row.force_evaluations if last.has_scheme else 1)
