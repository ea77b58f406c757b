"""The report of `rigidmd check` on a body: how it would run, and what is not compiled for it."""

import numpy as np

from rigidmd.assemble.describe import class_words, report
from rigidmd.assemble.run_time import in_words
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.features.bodies.system import BodySystem
from rigidmd.mechanics.rotation import to_euler_angles
from rigidmd.scene.validation import not_none, number_of_steps

#: Run times, s, on an AMD EPYC: of the start with figures, a force evaluation, a sample.
START_S, FORCES_S, SAMPLE_S = 3.0, 1e-6, 4e-4


def describe_body(system: BodySystem, *, verbose: bool = False) -> str:
    """How the scene of a body would run; verbose : with what is compiled in and what is omitted."""
    parts = {
        "run": _run_lines(system),
        "body": _body_lines(system),
        "forces": [
            f"{name.replace('_', ' ')}: {class_words(term)}" for name, term in system.terms.items()
        ],
    }
    if verbose:
        method = system.method
        is_scheme = isinstance(method, Scheme)
        body = system.engine().model_for(method) if is_scheme else system.body
        words = [class_words(part) for part in body if part]
        compiled = [name for name in words if not name.startswith("no ")]
        parts |= {"compiled in": [", ".join(compiled)], "omitted": system.left_out}
    pinned = "" if system.translates else ", pinned"
    freedom = f"{system.degrees_of_freedom} degrees of freedom"
    name = system.scene.name
    return report(f"{name}: one body, {system.kind}{pinned}, {system.mass:g} kg, {freedom}", parts)


def _run_lines(system: BodySystem) -> list[str]:
    scene, run = system.scene, system.scene.run
    how = f"{run.integrator}" + (
        f", {system.method.formulation}" if isinstance(system.method, Solver) else ""
    )
    every = number_of_steps(not_none(scene.output.interval_s), run.timestep_s)
    lines = [
        f"{run.steps} steps of {run.timestep_s:g} s = {run.steps * run.timestep_s:g} s, {how}",
        f"a sample every {every * run.timestep_s:g} s",
        *system.notes,
    ]
    if run.is_auto:
        lines.append("the integrator and its step, at most this step, are chosen before the run")
    elif isinstance(system.method, Scheme):
        forces = run.steps * system.method.force_evaluations
        seconds = START_S + FORCES_S * forces + SAMPLE_S * run.steps / every
        lines.append(
            f"run time: about {in_words(seconds)}. The first run also compiles for ten seconds"
        )
    return lines


def _body_lines(system: BodySystem) -> list[str]:
    lines = []
    if system.rotates:
        moments = " ".join(f"{x:.9g}" for x in system.inertia)
        about = "the centre of mass" if system.translates else "the pivot"
        lines.append(f"principal moments about {about}: {moments} kg m²")
    if not np.array_equal(system.axes, np.eye(3)):
        axes = np.array2string(system.axes, precision=6).replace("\n", "")
        lines.append(f"principal axes (columns, body's axes): {axes}")
    if system.centre.any():
        centre = " ".join(f"{x:g}" for x in system.centre)
        lines.append(f"centre of mass from the pivot: {centre} m")
    if system.rotates:
        pose = system.pose(0.0, system.state)
        angles = " ".join(f"{x:.6g}" for x in np.degrees(to_euler_angles(pose.rotation)))
        spin = float(np.linalg.norm(pose.angular_velocity_body))
        period = ""
        if spin:
            turn = 2 * np.pi / spin
            period = f": period {turn:.4g} s, {turn / system.scene.run.timestep_s:.4g} steps"
        lines.append(
            f"starts at phi theta psi = {angles} degrees, rotating at {spin:.6g} rad/s{period}"
        )
    return lines
