"""Subjects of error measurements: the start of a scene with every method that can move it.

Both `rigidmd precision` and `integrator = "auto"` use these.
"""

import re
from collections.abc import Callable
from fractions import Fraction
from math import ceil, gcd, inf, sqrt

import numpy as np

from rigidmd.assemble.body import build_body
from rigidmd.core.integrators import FORMULATIONS, SCHEMES, SOLVERS, Scheme
from rigidmd.core.state import State
from rigidmd.engines.body_motion import Motion, Snapshot, motion
from rigidmd.engines.body_system import BodySystem, Pose
from rigidmd.engines.observables import observe
from rigidmd.engines.ode import SMALLEST_SINE
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.run.pilot.choice import choose
from rigidmd.run.pilot.trials import Method, Subject
from rigidmd.scene import BodyScene
from rigidmd.scene.body import SAMPLES
from rigidmd.scene.stage import Stage
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: General ODE solvers for the textbook equations of a body, for comparison with the engine's schemes.
COMPARATORS = {
    solver if form == "matrix" else f"{solver}_{form}": (solver, form) for solver in SOLVERS for form in FORMULATIONS
}
SPAN_PS = 0.1
#: Step of velocity Verlet and span of a pilot run, in radians of the mean vibration or libration.
PILOT_STEP, PILOT_SPAN = 0.15, 10.0
#: For an error of the energy over a stage, a pilot takes this part of the stage, at least these radians.
PILOT_PART, LEAST_SPAN = 0.01, 3.0
#: Looks and steps of a body's first run, which only measures how fast it moves.
LOOKS, STEPS = 200, 20_000


def _on_rotor(name: str, rotor: str | None) -> Scheme:
    """The scheme with the rotor of the scene if it supports it."""
    scheme = SCHEMES[name]
    return scheme if scheme.exact_rotor else scheme.with_rotor(rotor)


def natural_time(system: System, state: State) -> float | None:
    """Time (ps) of one radian of the faster of vibration and libration; None at rest.

    Its inverse squared is <F²/m> / <m v²>, the mean square frequency of a harmonic motion in equilibrium; likewise for
    torques.
    """
    engine = system.engine()
    load, _ = engine.evaluate(state)
    mass, inverse = (system.model.mass[system.model.species], system.model.inverse_mass[system.model.species])
    rates = [_ratio((load.force**2).sum(axis=1) @ inverse, mass @ (state.velocity**2).sum(axis=1))]
    if len(load.torque_body):
        inverse = system.model.inverse_inertia[system.model.species]
        rates.append(_ratio((load.torque_body**2 * inverse).sum(), (state.angular_momentum_body**2 * inverse).sum()))
    return 1 / sqrt(max(rates)) if max(rates) > 0 else None


def _ratio(a: float, b: float) -> float:
    return float(a / b) if b > 0 else 0.0


def molecular_subject(system: System, start: State, rotor: str | None, span: float) -> Subject:
    """Molecules that start at a state and run for `span` ps."""
    state = start.copy()
    state.step[:] = 0
    state.begin_stretch(0.0)
    kinetic = observe(system, system.engine(), state).kinetic
    freedom = max(system.freedom.total, 1)
    thermal = 2 * kinetic / freedom
    mass = system.model.mass[system.model.species]
    boxed = system.space.volume < inf
    conserved = system.model.keeps_momentum

    def kept(now: State) -> dict[str, float]:
        """What is conserved of the total momentum and, with neither box nor fields, the total angular momentum; both
        relative to the sums of their sizes."""
        errors = {}
        if conserved.any():
            before, after = (mass[:, None] * velocity[:, conserved] for velocity in (state.velocity, now.velocity))
            errors["momentum"] = _change(before, after)
        if conserved.all() and not (boxed or system.external):
            errors["L"] = _change(_angular_momenta(state, mass), _angular_momenta(now, mass))
        return errors

    return Subject(
        name=system.scene.name,
        state=state,
        methods={name: Method(lambda: system.engine(), _on_rotor(name, rotor)) for name in SCHEMES},
        energy=lambda engine, now: observe(system, engine, now).energy - float(now.books.sum()),
        energy_unit="kT per degree of freedom",
        energy_note=f", at the {thermal / BOLTZMANN:.3g} K of the start",
        energy_size=freedom * thermal or 1.0,
        kinetic=kinetic or 1.0,
        span=span,
        time_unit="fs",
        time_size=FEMTOSECOND,
        length_unit="Å",
        reference="srkn_6",
        kept=kept,
        goes_on=True,
        refused={name: "it is for single bodies" for name in COMPARATORS},
        observe=(lambda engine, now, step: observe(system, engine, now, step)) if boxed else None,
        molecules=len(system.model.species),
        freedom=freedom,
    )


def _change(before: np.ndarray, after: np.ndarray) -> float:
    """Change of the sum over molecules of vectors (n, 3), relative to the sum of their lengths."""
    size = float(np.linalg.norm(before, axis=1).sum())
    return float(np.linalg.norm((after - before).sum(axis=0))) / (size or 1.0)


def _angular_momenta(state: State, mass: np.ndarray) -> np.ndarray:
    """Of each molecule (n, 3), about the origin, lab frame."""
    whole = np.cross(state.position, mass[:, None] * state.velocity)
    if len(state.rotation):
        whole += np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body)
    return whole


def body_subject(
    scene: BodyScene, span: float | None = None, applied: dict[str, Callable[[Pose], tuple]] | None = None
) -> tuple[Subject, float]:
    """A body for `span` s (default: its run, up to the first break), and its fastest rate of rotation (rad/s)."""
    run = scene.run
    keys = ("rotor", "formulation", "relative_tolerance", "absolute_tolerance", "energy_error", "trajectory_error")
    plain = dict.fromkeys(keys)
    fits, refused = {}, {}
    for name in (*SCHEMES, *COMPARATORS):
        solver, form = COMPARATORS.get(name, (name, "matrix"))
        told = None if form == "matrix" else form
        try:
            changed = run.model_copy(update=plain | {"integrator": solver, "formulation": told})
            fits[name] = build_body(scene.model_copy(update={"run": changed}), applied)
        except SceneError as error:
            refused[name] = "; ".join(_why(fault, solver) for fault in error.faults)
    if not fits:
        build_body(scene, applied)  # raises the error
    system = fits["velocity_verlet"]
    whole = min([span or run.duration_s, *system.breaks()])
    seen = _first_look(system, whole)
    kinetic = float(np.abs(seen["kinetic"]).max()) or 1.0

    def energy(engine, state) -> float:
        now = motion(system, [Snapshot(float(state.time[0]), state)])
        return float(now["energy"][0] - now["work"][0])

    start = Snapshot(0.0, system.state)

    def kept(state) -> dict[str, float]:
        seen = motion(system, [start, Snapshot(float(state.time[0]), state)])
        return {name: float(seen[f"{name}_error"][-1]) for name in seen.invariants if name != "energy"}

    methods = {
        name: Method(
            own.engine, own.method._replace(duration=whole) if name in COMPARATORS else _on_rotor(name, run.rotor)
        )
        for name, own in fits.items()
    }
    schemes = [name for name in fits if name in SCHEMES]
    at_a_pole = system.turns and np.hypot(*system.state.rotation[0, :2, 2]) <= SMALLEST_SINE
    reference = max(schemes, key=lambda name: (SCHEMES[name].order, -SCHEMES[name].force_evaluations))
    subject = Subject(
        name=scene.name,
        state=system.state,
        methods=methods,
        energy=energy,
        energy_unit="times the largest kinetic energy",
        energy_note="",
        energy_size=kinetic,
        kinetic=kinetic,
        span=whole,
        time_unit="s",
        time_size=1.0,
        length_unit="m",
        reference=reference,
        kept=kept,
        goes_on=False,
        refused=refused,
        singular=tuple(name for name, (_, form) in COMPARATORS.items() if form == "euler_angles" and at_a_pole),
    )
    speed = 0.0
    if system.turns:  # of the body, and of the nutation that its wheels would give it
        inertia, carried = system.moments(np.zeros(1))
        spin = max(float(np.abs(seen[f"omega_body_{k}"]).max()) for k in (1, 2, 3))
        speed = max(spin, float(np.abs(carried).max() / inertia.max()))
    return subject, speed


def _why(fault: str, name: str) -> str:
    """A fault of an integrator as a reason, without the advice."""
    return re.split("[:;] use ", fault.removeprefix("run: "))[0].replace(name, "it")


def _first_look(system: BodySystem, whole: float) -> Motion:
    """The motion in this time, roughly."""
    engine = system.engine()
    state = engine.begin(system.state, system.method)
    snapshots, every = [Snapshot(0.0, state.copy())], STEPS // LOOKS
    for k in range(LOOKS):
        engine.advance(state, system.method, whole / STEPS, (k + 1) * every)
        snapshots.append(Snapshot(float(state.time[0]), state.copy()))
    return motion(system, snapshots)


def choose_for_molecules(system: System, state: State, k: int) -> tuple[Stage, str]:
    """Stage k, which starts at a state and leaves integrator and step open, with both, and the reason in words.

    Raises SimulationError.
    """
    stage = system.scene.stages[k]
    natural = natural_time(system, state)
    step = PILOT_STEP * natural / FEMTOSECOND if natural else stage.timestep_fs
    span = PILOT_SPAN * natural if natural else SPAN_PS
    if stage.energy_error_kT:
        span = min(span, max(PILOT_PART * stage.duration, LEAST_SPAN / PILOT_SPAN * span))
    subject = molecular_subject(system, state, None, span)
    longest = {
        name: float(f"{4 * step * scheme.force_evaluations:.3g}")
        for name, scheme in SCHEMES.items()
        if scheme.exact_rotor or scheme.order == 2  # the others take more forces, and suit bodies without that rotor
    }
    asked = stage.energy_error_kT, stage.trajectory_error
    integrator, timestep, reason = _chosen(subject, longest, *asked, stage.duration)
    return stage.decided(integrator, timestep), reason


#: Least share of a chosen step that is left where steps are fitted to the interval of samples.
SHORTEST = 0.25


def decided_for_body(scene: BodyScene, applied: dict[str, Callable[[Pose], tuple]] | None) -> tuple[BodyScene, str]:
    """A scene with integrator and step chosen, and the reason in words. Raises SimulationError."""
    run = scene.run
    subject, _ = body_subject(scene, applied=applied)
    longest = {name: run.timestep_s for name in subject.methods if name in SCHEMES}
    integrator, timestep, reason = _chosen(subject, longest, run.energy_error, run.trajectory_error)
    chosen, timestep = timestep, _fitted(timestep, run.duration_s, scene.output.interval_s)
    fitted = "" if timestep == chosen else f", shortened to {timestep:g} s to fit duration and samples"
    none = {"energy_error": None, "trajectory_error": None}
    changed = run.model_copy(update={"integrator": integrator, "timestep_s": timestep} | none)
    return scene.model_copy(update={"run": changed}), f"{integrator} at {chosen:g} s chosen{fitted}: {reason}"


def _fitted(timestep: float, duration: float, interval: float | None) -> float:
    """A step no longer than this one, of which the duration and the interval of samples are whole numbers; of the
    duration alone where the interval or their common measure would make it much shorter; each step is then a sample."""
    if interval is not None and interval < SHORTEST * timestep:
        interval = duration
    if interval is None:
        interval = duration / SAMPLES if duration / SAMPLES >= timestep else duration
    (a, b), (c, d) = (Fraction(repr(span)).as_integer_ratio() for span in (duration, interval))
    common, longest = float(Fraction(gcd(a * d, c * b), b * d)), min(timestep, interval)
    span = common if common >= SHORTEST * longest else duration
    return span / ceil(span / longest * (1 - 1e-9))


def _chosen(
    subject: Subject,
    longest: dict[str, float],
    energy: float | None,
    trajectory: float | None,
    duration: float | None = None,
) -> tuple[str, float, str]:
    if energy is not None:
        found = choose(subject, energy, "energy_rms", longest, duration)
    elif trajectory is not None:
        found = choose(subject, trajectory, "trajectory_error", longest)
    else:
        raise ValueError("no error is asked for")
    return found.integrator, found.timestep, found.reason
