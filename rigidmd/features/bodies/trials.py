"""Trial systems of a body, for pilot runs and `rigidmd accuracy`, and the choice of its integrator
and step by pilot runs."""

import re
from collections.abc import Callable
from fractions import Fraction
from math import ceil, gcd

import numpy as np

from rigidmd.core.integrators import SCHEMES, Solver
from rigidmd.core.state import State
from rigidmd.errors import SceneError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.keys.body import SAMPLES, BodyScene
from rigidmd.features.bodies.motion import motion
from rigidmd.features.bodies.ode.rates import SMALLEST_SINE
from rigidmd.features.bodies.system import BodySystem, Pose
from rigidmd.run.pilot.choice import choose
from rigidmd.run.trial_systems import COMPARATORS
from rigidmd.run.trials import Method, TrialSystem

#: Samples and steps of the first run of a body, which only measures how fast it moves.
COARSE_SAMPLES, COARSE_STEPS = 200, 20_000
#: Minimum fraction of a chosen step to which it is shortened to fit the interval of samples.
MIN_STEP_FRACTION = 0.25


def body_trial_system(
    scene: BodyScene,
    span: float | None = None,
    applied: dict[str, Callable[[Pose], tuple]] | None = None,
) -> tuple[TrialSystem, float]:
    """A body for `span` s (default: its run, up to the first break), and its fastest rate of
    rotation (rad/s)."""
    fits, refused = _systems_of_methods(scene, applied)
    system = fits["velocity_verlet"]
    duration = min([span or scene.run.duration_s, *system.breaks()])
    columns = motion(system, _coarse_motion(system, duration))
    kinetic = float(np.abs(columns["kinetic"]).max()) or 1.0

    def energy(engine, state) -> float:
        now = motion(system, [state])
        return float(now["energy"][0] - now["work"][0])

    def conserved_errors(state) -> dict[str, float]:
        columns_of_two = motion(system, [system.state, state])
        return {
            name: float(columns_of_two[f"{name}_error"][-1])
            for name in columns_of_two.invariants
            if name != "energy"
        }

    methods = {}
    for name, fit in fits.items():
        scheme = (
            scene.schemes[name] if name in scene.schemes else fit.method._replace(duration=duration)
        )
        if not (isinstance(scheme, Solver) or scheme.exact_rotor):
            scheme = scheme.with_rotor(scene.run.rotor)
        methods[name] = Method(lambda _, fit=fit: fit.engine(), scheme)
    at_a_pole = system.rotates and np.hypot(*system.state.rotation[0, :2, 2]) <= SMALLEST_SINE
    reference = max(
        (name for name in fits if name in SCHEMES),
        key=lambda name: (SCHEMES[name].order, -SCHEMES[name].force_evaluations),
    )
    trial_system = TrialSystem(
        name=scene.name,
        state=system.state,
        methods=methods,
        energy=energy,
        energy_unit="times the largest kinetic energy",
        energy_note="",
        energy_size=kinetic,
        kinetic=kinetic,
        span=duration,
        time_unit="s",
        time_size=1.0,
        length_unit="m",
        reference=reference,
        conserved_errors=conserved_errors,
        can_continue=False,
        refused=refused,
        singular=tuple(
            name for name, (_, form) in COMPARATORS.items() if form == "euler_angles" and at_a_pole
        ),
    )
    speed = 0.0
    if system.rotates:  # of the body, and of the nutation by its wheels
        inertia, carried = system.moments(np.zeros(1))
        spin = max(float(np.abs(columns[f"omega_body_{k}"]).max()) for k in (1, 2, 3))
        speed = max(spin, float(np.abs(carried).max() / inertia.max()))
    return trial_system, speed


def _systems_of_methods(
    scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None
) -> tuple[dict[str, BodySystem], dict[str, str]]:
    """The systems of the methods that suit a scene, and why the others do not. Raises SceneError if
    none does."""
    plain = dict.fromkeys(
        (
            "rotor",
            "formulation",
            "relative_tolerance",
            "absolute_tolerance",
            "energy_error",
            "trajectory_error",
        )
    )
    fits, refused = {}, {}
    for name in (*scene.schemes, *COMPARATORS):
        solver, form = COMPARATORS.get(name, (name, "matrix"))
        formulation = None if form == "matrix" else form
        method = plain | {"integrator": solver, "formulation": formulation}
        try:
            changed = scene.run.model_copy(update=method)
            fits[name] = build_body(scene.model_copy(update={"run": changed}), applied)
        except SceneError as error:
            # without advice
            reasons = (
                re.split(r"[:.] [Uu]se ", re.sub(r"^(line \d+: )?run: ", "", text))[0]
                for text in error.errors
            )
            refused[name] = "; ".join(reasons).replace(solver, "it")
    if not fits:
        build_body(scene, applied)  # raises the error
    return fits, refused


def _coarse_motion(system: BodySystem, duration: float) -> list[State]:
    """A run that only measures how fast the body moves."""
    engine = system.engine()
    state = engine.begin(system.state, system.method)
    states = [system.state]
    every = COARSE_STEPS // COARSE_SAMPLES
    for step in range(every, COARSE_STEPS + every, every):
        engine.advance(state, system.method, duration / COARSE_STEPS, step)
        states.append(state.copy())
    return states


def choose_for_body(
    scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None
) -> tuple[BodyScene, str]:
    """A scene with the best integrator and step, and the reason. Raises SimulationError."""
    run = scene.run
    trial_system, _ = body_trial_system(scene, applied=applied)
    longest = {name: run.timestep_s for name in trial_system.methods if name in SCHEMES}
    choice = choose(trial_system, longest, run.energy_error, run.trajectory_error)
    timestep = fit_step(choice.timestep, run.duration_s, scene.output.interval_s)
    fitted = ""
    if timestep != choice.timestep:
        fitted = f", shortened to {timestep:g} s to fit duration and samples"
    changes = {"integrator": choice.integrator, "timestep_s": timestep}
    changed = run.model_copy(update=changes | {"energy_error": None, "trajectory_error": None})
    reason = f"{choice.integrator} at {choice.timestep:g} s chosen{fitted}: {choice.reason}"
    return scene.model_copy(update={"run": changed}), reason


def fit_step(timestep: float, duration: float, interval: float | None) -> float:
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
