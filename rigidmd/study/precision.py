"""What `rigidmd precision` measures on the start of a scene: sensible integrators at sensible steps."""

from collections.abc import Callable

from rigidmd.core.schemes import SCHEMES
from rigidmd.errors import SceneError
from rigidmd.measure.accuracy import rounding
from rigidmd.measure.subjects import COMPARATORS, SPAN_PS, body_subject, molecular_subject
from rigidmd.measure.trials import Precision, Subject, measure, plan
from rigidmd.run.molecules import MolecularSimulation
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.validation import meant

#: Tried when no others are asked for: the common one, and the best of each kind.
USUAL = (
    "velocity_verlet", "two_stage", "suzuki_4", "pefrl", "chin_4a", "srkn_4", "kahan_li_6", "srkn_6", "kahan_li_8",
    "rk4", "dop853",
)  # fmt: skip
#: Time steps per force evaluation, in those of the scene.
LADDER = (4.0, 2.0, 1.0, 0.5, 0.25, 0.125)
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
        faults = [f"there is no {name}{meant(name, known)} (known: {', '.join(known)})" for name in unknown]
        raise SceneError("--integrators", faults)
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
    subject = molecular_subject(simulation.system, state, last.rotor, span or SPAN_PS)
    subject.rounding = rounding(simulation.system, state)
    own = SCHEMES[last.integrator].force_evaluations if last.integrator in SCHEMES else 1
    return subject, last.timestep_fs / own


def _of_body(scene: BodyScene, span: float | None) -> tuple[Subject, float]:
    """As `_of_molecules`, in s."""
    subject, speed = body_subject(scene, span)
    own = SCHEMES[scene.run.integrator].force_evaluations if scene.run.integrator in SCHEMES else 1
    return subject, RADIANS / speed if speed else AT_REST * scene.run.timestep_s / own
