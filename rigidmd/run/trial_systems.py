"""Systems for pilot runs and for `rigidmd accuracy`: the start of a scene with every method that
can move it."""

import re
from collections.abc import Callable
from functools import partial
from math import inf

import numpy as np

from rigidmd.assemble.time_step import error_of_step, precision_for
from rigidmd.core.integrators import FORMULATIONS, SCHEMES, SOLVERS, Scheme, Solver
from rigidmd.core.state import State
from rigidmd.engines.observables import observe
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.motion import Snapshot, motion
from rigidmd.features.bodies.ode.rates import SMALLEST_SINE
from rigidmd.features.bodies.system import Pose
from rigidmd.run.trials import Method, TrialSystem
from rigidmd.scene import BodyScene
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: General ODE solvers for the textbook equations of a body, for comparison with the engine's
#: schemes.
COMPARATORS = {
    solver if form == "matrix" else f"{solver}_{form}": (solver, form)
    for solver in SOLVERS
    for form in FORMULATIONS
}
SPAN_PS = 0.1
#: Samples and steps of the first run of a body, which only measures how fast it moves.
COARSE_SAMPLES, COARSE_STEPS = 200, 20_000


def molecular_trial_system(
    system: System, start: State, rotor: str | None, span: float
) -> TrialSystem:
    """Molecules that start at a state and run for `span` ps."""
    state = start.copy()
    state.step[:] = 0
    state.begin_segment(0.0)
    kinetic = observe(system, system.engine(), state, energy_unit=1.0).kinetic
    freedom = max(system.freedom.total, 1)
    thermal = 2 * kinetic / freedom
    mass = system.model.mass[system.model.species]
    boxed = system.space.volume < inf
    conserved = system.model.keeps_momentum

    def engine(scheme: Scheme, timestep_fs: float) -> Engine:
        """With precision = "auto" each trial has the precision of a run with its step."""
        if not system.precision_reason:
            return system.engine()
        error = error_of_step(system.species, thermal / BOLTZMANN, scheme, timestep_fs)
        return system.engine_of(system.terms, precision_for(error))

    def conserved_errors(now: State) -> dict[str, float]:
        """Errors of the conserved components of the total momentum and, with neither box nor
        fields, of the angular momentum, relative to the sums of their sizes."""
        errors = {}
        if conserved.any():
            before, after = (
                mass[:, None] * velocity[:, conserved]
                for velocity in (state.velocity, now.velocity)
            )
            errors["momentum"] = _change(before, after)
        if conserved.all() and not (boxed or system.external):
            errors["L"] = _change(_angular_momenta(state, mass), _angular_momenta(now, mass))
        return errors

    return TrialSystem(
        name=system.scene.name,
        state=state,
        methods={
            name: Method(
                partial(engine, scheme), scheme if scheme.exact_rotor else scheme.with_rotor(rotor)
            )
            for name, scheme in system.scene.schemes.items()
        },
        energy=lambda engine, now: observe(system, engine, now, energy_unit=1.0).conserved,
        energy_unit="kT per degree of freedom",
        energy_note=f", at the {thermal / BOLTZMANN:.3g} K of the start",
        energy_size=freedom * thermal or 1.0,
        kinetic=kinetic or 1.0,
        span=span,
        time_unit="fs",
        time_size=FEMTOSECOND,
        length_unit="Å",
        reference="srkn_6",
        conserved_errors=conserved_errors,
        can_continue=True,
        refused={name: "it is for single bodies" for name in COMPARATORS},
        freedom=freedom,
        chooses_precision=bool(system.precision_reason),
    )


def _change(before: np.ndarray, after: np.ndarray) -> float:
    """Change of a vector sum over molecules (n, 3), relative to the sum of the lengths."""
    return float(
        np.linalg.norm((after - before).sum(axis=0)) / (np.linalg.norm(before, axis=1).sum() or 1.0)
    )


def _angular_momenta(state: State, mass: np.ndarray) -> np.ndarray:
    """Angular momenta (n, 3) of molecules about the origin, lab frame."""
    momenta = np.cross(state.position, mass[:, None] * state.velocity)
    if len(state.rotation):
        momenta += np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body)
    return momenta


def body_trial_system(
    scene: BodyScene,
    span: float | None = None,
    applied: dict[str, Callable[[Pose], tuple]] | None = None,
) -> tuple[TrialSystem, float]:
    """A body for `span` s (default: its run, up to the first break), and its fastest rate of
    rotation (rad/s)."""
    run = scene.run
    keys = (
        "rotor",
        "formulation",
        "relative_tolerance",
        "absolute_tolerance",
        "energy_error",
        "trajectory_error",
    )
    plain = dict.fromkeys(keys)
    fits, refused = {}, {}
    for name in (*scene.schemes, *COMPARATORS):
        solver, form = COMPARATORS.get(name, (name, "matrix"))
        formulation = None if form == "matrix" else form
        try:
            changed = run.model_copy(
                update=plain | {"integrator": solver, "formulation": formulation}
            )
            fits[name] = build_body(scene.model_copy(update={"run": changed}), applied)
        except SceneError as error:
            # without advice
            reasons = (
                re.split(r"[:.] [Uu]se ", text.removeprefix("run: "))[0] for text in error.errors
            )
            refused[name] = "; ".join(reasons).replace(solver, "it")
    if not fits:
        build_body(scene, applied)  # raises the error
    system = fits["velocity_verlet"]
    duration = min([span or run.duration_s, *system.breaks()])
    engine = system.engine()
    snapshots = [Snapshot(0.0, system.state)]
    state = engine.begin(system.state, system.method)
    for step in range(0, COARSE_STEPS, COARSE_STEPS // COARSE_SAMPLES):
        engine.advance(
            state, system.method, duration / COARSE_STEPS, step + COARSE_STEPS // COARSE_SAMPLES
        )
        snapshots.append(Snapshot(float(state.time[0]), state.copy()))
    columns = motion(system, snapshots)
    kinetic = float(np.abs(columns["kinetic"]).max()) or 1.0

    def energy(engine, state) -> float:
        now = motion(system, [Snapshot(float(state.time[0]), state)])
        return float(now["energy"][0] - now["work"][0])

    def conserved_errors(state) -> dict[str, float]:
        columns_of_two = motion(system, [snapshots[0], Snapshot(float(state.time[0]), state)])
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
            scheme = scheme.with_rotor(run.rotor)
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
