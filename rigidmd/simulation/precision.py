"""What `rigidmd precision` measures: the start of a scene as a subject, and sensible integrators and steps for it."""

from collections.abc import Callable

import numpy as np

from rigidmd.build.body import build_body
from rigidmd.dynamics.engine import Engine
from rigidmd.dynamics.schemes import SCHEMES
from rigidmd.errors import SceneError
from rigidmd.measure.motion import Snapshot, motion
from rigidmd.measure.observables import observe
from rigidmd.measure.precision import Precision, Subject, measure, plan
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.simulation.body import BodySimulation
from rigidmd.simulation.molecules import MolecularSimulation
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: Tried when no others are asked for: the common one, and the best of each kind.
USUAL = ("velocity_verlet", "two_stage", "suzuki_4", "pefrl", "srkn_4", "kahan_li_6", "srkn_6", "kahan_li_8")
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
    say: Callable[[float], None] = lambda share: None,
) -> Precision:
    """Error against run time of integrators at time steps, on the start of a scene.

    integrators : names; those that make sense for the scene when not given. timesteps : fs for molecules, s for a body,
    the same for all; when not given, steps that cost the same number of forces, around the scene's own. span : ps or s.
    Molecules start where the last stage starts, the earlier stages run before; no thermostat acts.
    """
    if unknown := [name for name in integrators or [] if name not in SCHEMES]:
        raise SceneError("--integrators", [f"there is no {name}; known: {', '.join(SCHEMES)}" for name in unknown])
    if (timesteps and min(timesteps) <= 0) or (span is not None and not span > 0) or repeats < 1:
        raise SceneError("precision", ["time steps, span and repeats must be greater than 0"])
    subject, base = _of_body(scene, span) if isinstance(scene, BodyScene) else _of_molecules(scene, span)
    if refused := [name for name in integrators or [] if name not in subject.integrators]:
        raise SceneError(scene.source, [f"{name} would not have its order on this scene" for name in refused])
    chosen = integrators or [name for name in USUAL if name in subject.integrators]
    steps = {name: timesteps or [base * rung * SCHEMES[name].force_evaluations for rung in LADDER] for name in chosen}
    return measure(subject, plan(subject, steps), repeats, say)


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
    subject = Subject(
        name=scene.name,
        state=state,
        engine=lambda: Engine(system.model, system.terms),
        energy=lambda engine, now: observe(system, engine, now).energy,
        energy_unit="kT per degree of freedom",
        energy_note=f", at the {thermal / BOLTZMANN:.3g} K of the start",
        energy_size=freedom * thermal or 1.0,
        kinetic=kinetic or 1.0,
        span=span or SPAN_PS,
        time_unit="fs",
        time_size=FEMTOSECOND,
        length_unit="Å",
        rotor=last.rotor,
        integrators=list(SCHEMES),
        reference="srkn_6",
    )
    return subject, last.timestep_fs / SCHEMES[last.integrator].force_evaluations


def _of_body(scene: BodyScene, span: float | None) -> tuple[Subject, float]:
    """As `_of_molecules`, in s."""
    run = scene.run
    plain = {"rotor": None, "formulation": None, "relative_tolerance": None, "absolute_tolerance": None}
    fits = {}
    for name in SCHEMES:
        try:
            changed = scene.model_copy(update={"run": run.model_copy(update={"integrator": name} | plain)})
            fits[name] = build_body(changed)
        except SceneError:
            continue
    if not fits:
        build_body(scene)  # says what is wrong with it
    system = fits["velocity_verlet"]
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

    reference = max(fits, key=lambda name: (SCHEMES[name].order, -SCHEMES[name].force_evaluations))
    subject = Subject(
        name=scene.name,
        state=system.state,
        engine=system.engine,
        energy=energy,
        energy_unit="times the largest kinetic energy",
        energy_note="",
        energy_size=kinetic,
        kinetic=kinetic,
        span=whole,
        time_unit="s",
        time_size=1.0,
        length_unit="m",
        rotor=run.rotor,
        integrators=list(fits),
        reference=reference,
    )
    speed = 0.0
    if system.turns:  # of the body, and of the nutation that its wheels would give it
        inertia, carried = system.moments(np.zeros(1))
        spin = max(float(np.abs(seen[f"omega_body_{k}"]).max()) for k in (1, 2, 3))
        speed = max(spin, float(np.abs(carried).max() / inertia.max()))
    own = SCHEMES[run.integrator].force_evaluations if run.integrator in SCHEMES else 1
    return subject, RADIANS / speed if speed else AT_REST * run.timestep_s / own
