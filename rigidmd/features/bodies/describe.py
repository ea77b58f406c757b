"""The report of `rigidmd check` on a body: how it would run, and what is not compiled for it."""

import numpy as np

from rigidmd.assemble.describe import class_words
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.features.bodies.system import BodySystem
from rigidmd.mechanics.rotation import to_euler_angles
from rigidmd.scene.validation import not_none, number_of_steps


def describe_body(system: BodySystem) -> str:
    """How the scene of a body would run."""
    scene = system.scene
    run = system.scene.run
    pinned = "" if system.translates else ", pinned"
    moments = " ".join(f"{x:.9g}" for x in system.inertia)
    about = "the centre of mass" if system.translates else "the pivot"
    freedom = f"{system.degrees_of_freedom} degrees of freedom"
    lines = [f"{scene.name}: one body, {system.kind}{pinned}, {system.mass:g} kg, {freedom}"]
    if system.rotates:
        lines.append(f"  principal moments about {about}: {moments} kg m²")
    if not np.array_equal(system.axes, np.eye(3)):
        lines.append(
            f"  principal axes (columns, body's axes): {np.array2string(system.axes, precision=6)}"
        )
    if system.centre.any():
        lines.append(
            f"  centre of mass from the pivot: {' '.join(f'{x:g}' for x in system.centre)} m"
        )
    if system.rotates:
        pose = system.pose(0.0, system.state)
        angles = " ".join(f"{x:.6g}" for x in np.degrees(to_euler_angles(pose.rotation)))
        spin = float(np.linalg.norm(pose.angular_velocity_body))
        if spin:
            period = (
                f": period {2 * np.pi / spin:.4g} s, {2 * np.pi / spin / run.timestep_s:.4g} steps"
            )
        else:
            period = ""
        lines.append(
            f"  starts at phi theta psi = {angles} degrees, rotating at {spin:.6g} rad/s{period}"
        )
    if isinstance(system.method, Scheme):
        body = system.engine().model_for(system.method)
    else:
        body = system.body
    parts = [words for part in body if part and not (words := class_words(part)).startswith("no ")]
    lines.append(f"\ncompiled in: {', '.join(parts)}")
    lines += [
        f"  {name.replace('_', ' ')}: {class_words(term)}" for name, term in system.terms.items()
    ]
    lines += ["omitted:", *(f"  {reason}" for reason in system.left_out)]
    how = f"{run.integrator}" + (
        f", {system.method.formulation}" if isinstance(system.method, Solver) else ""
    )
    lines.append(
        f"\n{run.steps} steps of {run.timestep_s:g} s = {run.steps * run.timestep_s:g} s, {how}"
    )
    every = number_of_steps(not_none(scene.output.interval_s), run.timestep_s)
    lines += [f"a sample every {every * run.timestep_s:g} s", *system.notes]
    if run.is_auto:
        lines.append("the integrator and its step, at most this step, are chosen before the run")
    return "\n".join(lines)
