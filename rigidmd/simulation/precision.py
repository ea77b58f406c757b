"""What `rigidmd precision` measures: the start of a scene as a subject, and sensible integrators and steps for it."""

from collections.abc import Callable
from math import inf

import numpy as np

from rigidmd.build.body import build_body
from rigidmd.build.momenta import mobile
from rigidmd.dynamics.engine import Engine
from rigidmd.dynamics.odes import FORMULATIONS
from rigidmd.dynamics.schemes import SCHEMES, Scheme
from rigidmd.errors import SceneError
from rigidmd.forces.terms import State
from rigidmd.measure.motion import Snapshot, motion
from rigidmd.measure.observables import observe
from rigidmd.measure.precision import Method, Precision, Subject, measure, plan
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.simulation.body import BodySimulation
from rigidmd.simulation.molecules import MolecularSimulation
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: Tried when no others are asked for: the common one, and the best of each kind.
USUAL = (
    "velocity_verlet", "two_stage", "suzuki_4", "pefrl", "chin_4a", "srkn_4", "kahan_li_6", "srkn_6", "kahan_li_8",
    "rk4", "dop853",
)  # fmt: skip
#: General solvers of the textbook's equations, beside which the engine's own ways with a body can be seen.
COMPARATORS = {
    solver if form == "matrix" else f"{solver}_{form}": (solver, form)
    for solver in ("rk4", "dop853")
    for form in FORMULATIONS
}
#: Time steps per force evaluation, in those of the scene.
LADDER = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
SPAN_PS = 0.1
#: What a spinning body turns in a force evaluation on the middle of the ladder.
RADIANS = 0.1
#: The same of what does not turn, in steps of its scene, which are taken to be fine.
AT_REST = 8.0


def precision(
    scene: Scene,
    integrators: list[str] | None = None,
    timesteps: list[float] | None = None,
    span: float | None = None,
    repeats: int = 3,
    averages: float | None = None,
    say: Callable[[float], None] = lambda share: None,
) -> Precision:
    """Error against run time of integrators at time steps, on the start of a scene.

    integrators : names; those that make sense for the scene when not given. timesteps : fs for molecules, s for a body,
    the same for all; when not given, steps that cost the same number of forces, around the scene's own. span : ps or s.
    averages : ps of which molecules' temperatures, energy and pressure are averaged besides. Molecules start where the
    last stage starts, the earlier stages run before; no thermostat acts.
    """
    known = (*SCHEMES, *COMPARATORS)
    if unknown := [name for name in integrators or [] if name not in known]:
        raise SceneError("--integrators", [f"there is no {name}; known: {', '.join(known)}" for name in unknown])
    lengths = [*(timesteps or []), *(length for length in (span, averages) if length is not None)]
    if not all(length > 0 for length in lengths) or repeats < 1:
        raise SceneError("precision", ["time steps, span, averages and repeats must be greater than 0"])
    subject, base = _of_body(scene, span) if isinstance(scene, BodyScene) else _of_molecules(scene, span)
    if averages and subject.observe is None:
        raise SceneError(scene.source, ["--averages is for molecules in a box"])
    if refused := [name for name in integrators or [] if name not in subject.methods]:
        why = "is for single bodies" if isinstance(scene, MolecularScene) else "would not have its order on this scene"
        raise SceneError(scene.source, [f"{name} {why}" for name in refused])
    chosen = integrators or [name for name in USUAL if name in subject.methods]
    steps = {
        name: timesteps or [base * rung * subject.methods[name].force_evaluations for rung in LADDER] for name in chosen
    }
    return measure(subject, plan(subject, steps), repeats, averages, say)


def _on_rotor(name: str, rotor: str | None) -> Scheme:
    """The scheme on the rotor that the scene asks for, where it can have that."""
    scheme = SCHEMES[name]
    return scheme if scheme.exact_rotor else scheme.with_rotor(rotor)


def _of_molecules(scene: MolecularScene, span: float | None) -> tuple[Subject, float]:
    """The subject, and the time step of the scene for one force evaluation (fs)."""
    last = scene.stages[-1]
    simulation = MolecularSimulation(scene)
    if len(scene.stages) > 1:
        quiet = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": 1e9})
        earlier = MolecularSimulation(scene.model_copy(update={"stages": scene.stages[:-1], "output": quiet}))
        state = earlier.run().state
    else:
        simulation.start()
        state = simulation.state
    state = state.copy()
    state.time[0] = 0.0
    system = simulation.system
    kinetic = observe(system, simulation.engine, state).kinetic
    freedom = max(system.freedom.total, 1)
    thermal = 2 * kinetic / freedom
    mass = system.model.mass[system.model.species]
    boxed = system.space.volume < inf
    held = not mobile(system.model).all()

    def kept(now: State) -> dict[str, float]:
        """Total momentum and, without a box, total angular momentum, relative to the sums of their sizes."""
        if held:
            return {}
        impulse = mass[:, None] * now.velocity
        errors = {"momentum": _change(mass[:, None] * state.velocity, impulse)}
        if not boxed:
            errors["L"] = _change(_angular_momenta(state, mass), _angular_momenta(now, mass))
        return errors

    subject = Subject(
        name=scene.name,
        state=state,
        methods={
            name: Method(lambda: Engine(system.model, system.terms), _on_rotor(name, last.rotor)) for name in SCHEMES
        },
        energy=lambda engine, now: observe(system, engine, now).energy,
        energy_unit="kT per degree of freedom",
        energy_note=f", at the {thermal / BOLTZMANN:.3g} K of the start",
        energy_size=freedom * thermal or 1.0,
        kinetic=kinetic or 1.0,
        span=span or SPAN_PS,
        time_unit="fs",
        time_size=FEMTOSECOND,
        length_unit="Å",
        reference="srkn_6",
        kept=kept,
        observe=(lambda engine, now, step: observe(system, engine, now, step)) if boxed else None,
        molecules=len(system.model.species),
    )
    return subject, last.timestep_fs / SCHEMES[last.integrator].force_evaluations


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


def _of_body(scene: BodyScene, span: float | None) -> tuple[Subject, float]:
    """As `_of_molecules`, in s."""
    run = scene.run
    plain = {"rotor": None, "formulation": None, "relative_tolerance": None, "absolute_tolerance": None}
    fits = {}
    for name in (*SCHEMES, *COMPARATORS):
        solver, form = COMPARATORS.get(name, (name, None))
        try:
            changed = run.model_copy(update=plain | {"integrator": solver, "formulation": form})
            fits[name] = build_body(scene.model_copy(update={"run": changed}))
        except SceneError:
            continue
    if not fits:
        build_body(scene)  # says what is wrong with it
    system = fits["velocity_verlet"]
    if not system.turns:
        fits = {name: own for name, own in fits.items() if COMPARATORS.get(name, (name, "matrix"))[1] == "matrix"}
    whole = min([span or run.duration_s, *system.breaks()])
    # the scene as it is, to know how fast it moves
    once = scene.model_copy(
        update={
            "run": run.model_copy(update={"duration_s": whole}),
            "output": scene.output.model_copy(update={"interval_s": None, "trajectory": False}),
        }
    )
    seen = BodySimulation(once).run().samples
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
    )
    speed = 0.0
    if system.turns:  # of the body, and of the nutation that its wheels would give it
        inertia, carried = system.moments(np.zeros(1))
        spin = max(float(np.abs(seen[f"omega_body_{k}"]).max()) for k in (1, 2, 3))
        speed = max(spin, float(np.abs(carried).max() / inertia.max()))
    own = SCHEMES[run.integrator].force_evaluations if run.integrator in SCHEMES else 1
    return subject, RADIANS / speed if speed else AT_REST * run.timestep_s / own
