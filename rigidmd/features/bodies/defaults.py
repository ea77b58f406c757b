"""The defaults of scenes of a single body, and checks of its numbers: other units, memory."""

from math import degrees, pi

from rigidmd.assemble.memory_check import require_memory
from rigidmd.assemble.plausibility import gravity_warnings, in_radians
from rigidmd.core.integrators import RK4, SOLVERS
from rigidmd.features.bodies.keys.body import FORMULATION, SAMPLES, BodyScene
from rigidmd.formats import BODY_TOPOLOGY, TOPOLOGY
from rigidmd.scene.validation import not_none

#: Bytes per sample of a body; measured: a snapshot of its state 1.9 kB, its columns at the end 0.85
#: kB.
BYTES_PER_SAMPLE = 2700
TOLERANCE = 1e-10  # of DOP853 and RADAU
TRAJECTORY_RADIUS = 10.0  # Å, of a body
#: Å, of a body in BODY_TOPOLOGY, whose columns are too narrow for coordinates below -999.
FARTHEST = 900.0
#: Largest entry of abs(QᵀQ - 1) of a body with schemes, which preserve it, and with ODE solvers,
#: which do not.
ORTHOGONALITY, ORTHOGONALITY_OF_SOLVERS = 1e-9, 0.1


def body_with_defaults(scene: BodyScene, *, rotates: bool, radius: float) -> BodyScene:
    """A scene of a single body with all defaults; rotates: it has an orientation; radius: of its
    trajectory, m."""
    run, watch = scene.run, scene.watch
    solver = run.integrator in SOLVERS
    if solver:
        numbers: dict[str, object] = {
            "formulation": (run.formulation or FORMULATION) if rotates else None
        }
        if run.integrator != RK4:
            numbers["relative_tolerance"] = run.relative_tolerance or TOLERANCE
            numbers["absolute_tolerance"] = run.absolute_tolerance or TOLERANCE
        run = run.model_copy(update=numbers)
    scale = scene.output.trajectory_A_per_m or (TRAJECTORY_RADIUS / radius if radius > 0 else 1.0)
    reach = scale * (radius + max(map(abs, scene.start.position_m or (0.0,))))
    output = {
        "interval_s": scene.output.interval_s or run.duration_s / SAMPLES,
        "trajectory_A_per_m": scale,
        "topology": scene.output.topology or (BODY_TOPOLOGY if reach < FARTHEST else TOPOLOGY),
    }
    if watch.orthogonality is None:
        watch = watch.model_copy(
            update={"orthogonality": ORTHOGONALITY_OF_SOLVERS if solver else ORTHOGONALITY}
        )
    return scene.model_copy(
        update={"run": run, "output": scene.output.model_copy(update=output), "watch": watch}
    )


def body_warnings(scene: BodyScene) -> list[str]:
    """Warnings of numbers of a single body that are probably in another unit."""
    if scene.gravity is None:
        warnings = []
    else:
        warnings = gravity_warnings("gravity.acceleration_m_s2", scene.gravity.acceleration_m_s2)
    for key in ("euler_angles_deg", "yaw_pitch_roll_deg"):
        angles = getattr(scene.start, key)
        if angles is not None and any(map(in_radians, angles)) and max(map(abs, angles)) <= 2 * pi:
            shown = ", ".join(f"{x:g}" for x in angles)
            inside = ", ".join(f"{degrees(x):.4g}" for x in angles)
            warnings.append(
                f"start.{key} is [{shown}]°: are these radians? They would be [{inside}]°"
            )
    return warnings


def check_memory_of_samples(scene: BodyScene) -> None:
    """Raise SceneError if the samples of a resolved scene of a body exceed the memory."""
    run = scene.run
    interval = not_none(scene.output.interval_s)
    count = run.duration_s / (interval if run.is_auto else max(interval, run.timestep_s))
    require_memory(
        scene.source,
        BYTES_PER_SAMPLE * count,
        f"a run with {count:.3g} samples",
        "lengthen output.interval_s",
    )
