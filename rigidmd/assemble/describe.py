"""The report of `rigidmd check`: how a system would run, and what is not compiled for it."""

import re
from importlib import import_module
from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.assemble.memory_check import bytes_of
from rigidmd.assemble.stage_description import describe_stage
from rigidmd.assemble.start import output_errors, rest_errors
from rigidmd.assemble.time_step import MIXED_ERROR, describe_step
from rigidmd.compile.machine import usable_threads
from rigidmd.core.integrators import Scheme, Solver
from rigidmd.core.state import edges_and_angles
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.system import BodySystem
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.formats.cells import right_angled
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.mechanics.rotation import to_euler_angles
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.molecules import name_of
from rigidmd.scene.validation import not_none, number_of_steps
from rigidmd.units import BAR, KJ_PER_MOL

#: Precision of forces, for reports. Times: docs/evidence/benchmarks.md.
PRECISIONS = {
    "double": (
        'double precision (precision = "mixed" takes half the time; forces have errors of'
        f" {MIXED_ERROR:.0e})"
    ),
    "mixed": (
        f"mixed precision: single between sites, with errors of forces of {MIXED_ERROR:.0e}, else"
        " double"
    ),
}


def describe(scene: MolecularScene | BodyScene, user_code: bool = True) -> str:
    """How a scene would run. Raises the errors of `build` or `build_body`; user_code: see
    `build`."""
    return describe_system(
        build(scene, user_code) if isinstance(scene, MolecularScene) else build_body(scene)
    )


def describe_system(system: System | BodySystem) -> str:
    """How the scene of a system would run. Raises SceneError if nothing would move, or if its
    output cannot be written."""
    if isinstance(system, System):
        if faults := [*rest_errors(system), *output_errors(system)]:
            raise SceneError(system.scene.source, faults)
        return _describe_molecules(system)
    text = _describe_body(system)
    if system.scene.run.is_auto:
        text += "\nthe integrator and its step, at most this step, are chosen before the run"
    return text


def _describe_body(system: BodySystem) -> str:
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
    parts = [words for part in body if part and not (words := _words(part)).startswith("no ")]
    lines.append(f"\ncompiled in: {', '.join(parts)}")
    lines += [f"  {name.replace('_', ' ')}: {_words(term)}" for name, term in system.terms.items()]
    lines += ["omitted:", *(f"  {reason}" for reason in system.left_out)]
    how = f"{run.integrator}" + (
        f", {system.method.formulation}" if isinstance(system.method, Solver) else ""
    )
    lines.append(
        f"\n{run.steps} steps of {run.timestep_s:g} s = {run.steps * run.timestep_s:g} s, {how}"
    )
    every = number_of_steps(not_none(scene.output.interval_s), run.timestep_s)
    lines += [f"a sample every {every * run.timestep_s:g} s", *system.notes]
    return "\n".join(lines)


def _describe_molecules(system: System) -> str:
    scene, free = system.scene, system.last_freedom
    lines = [f"{scene.name}: {len(system.model.species)} molecules, {system.site_count} sites"]
    for k, m in enumerate(system.species):
        count = int((system.model.species == k).sum())
        if system.model.inverse_mass[k] == 0:
            freely = "frozen"
        else:
            freely = f"{m.degrees_of_freedom} degrees of freedom each"
        lines.append(f"  {count} {m.name}: {m.description}, {freely}")
    charges = np.array([m.charge for m in system.species])[system.model.species]
    if abs(charges.sum()) > 1e-9 * np.abs(charges).sum():
        lines.append(f"  net charge: {charges.sum():+.6g} e")
    lines.append(
        f"  degrees of freedom: {free.total} = {free.translation} translation + {free.rotation}"
        " rotation"
    )
    box = "no box"
    if system.space.volume < inf:
        cell = cell_of(system.space)
        edges = " x ".join(f"{edge:.4f}" for edge in np.linalg.norm(cell, axis=1))
        if right_angled(cell):
            angles = ""
        else:
            angles = f", angles {', '.join(f'{x:.4g}' for x in edges_and_angles(cell)[3:])}°"
        box = f"box: {edges} Å{angles}, {system.density:.4f} g/cm³"
    lines += [f"  {box}", *(f"  {note}" for note in system.notes), "\ncompiled in:"]
    fields = scene.fields.entries
    for name, term in system.terms.items():
        of_field = ""
        if name in fields:
            kind, table, _ = fields[name]
            of_field = import_module(f"rigidmd.forces.fields.{kind.module}").sentence(table, term)
        description = system.user_terms.get(name) or of_field or _describe_term(system, term)
        lines.append(f"  {name.replace('_', ' ')}: {description}")
    if system.tail is not None:
        energy = system.tail.energy(system.space.volume) / KJ_PER_MOL / len(system.model.species)
        pressure = system.tail.pressure(system.space.volume) / BAR
        lines.append(
            f"  tail correction: {energy:.4g} kJ/mol per molecule and {pressure:.4g} bar at this"
            " volume"
        )
    if not isinstance(system.model.rotor, NoRotor):
        lines.append(f"  rotation: {_words(system.model.rotor)}")
    if system.thermostat is not None:
        lines.append(f"  thermostat: {name_of(system.thermostat)}, from Python, in every stage")
    for what in ("thermostat", "barostat")[system.thermostat is not None :]:
        kinds = dict.fromkeys(getattr(stage, f"{what}_kind") for stage in scene.stages)
        lines += [f"  {what}: {kind.replace('_', ' ')}" for kind in kinds if kind]
    if any(stage.ensemble == "nph" for stage in scene.stages):
        lines.append("  barostat: piston, in the nph stages only")
    conserved = [
        axis for axis, keeps in zip("xyz", system.model.keeps_momentum, strict=True) if keeps
    ]
    if (interval := system.removes_momentum_every) is not None:
        part = "" if len(conserved) == 3 else f" along {' and '.join(conserved)}"
        lines.append(f"  total momentum: removed{part} every {interval:g} ps")
    if (system.external or system.user_terms) and len(conserved) < 3:
        where = f"along {' and '.join(conserved)}" if conserved else "nowhere"
        lines.append(f"  total momentum: conserved {where}")
    lines += ["omitted:", *(f"  {reason}" for reason in system.left_out), "\nstages:"]
    for k, stage in enumerate(scene.stages):
        steps, sampled = describe_stage(stage)
        lines += [f"  {k}: {steps}", f"     {sampled}"]
        if of_step := describe_step(scene, system.species, k):
            lines.append(f"     {of_step}")
    lines.append(
        f"\nmemory: about {bytes_of(system) / 1e6:.1f} MB for state, forces, neighbour lists and"
        " samples"
    )
    if not scene.engine.is_external:
        threads = usable_threads(scene.threads)
        how = PRECISIONS[scene.precision]
        if system.precision_reason:
            how = f"{scene.precision} precision, chosen because {system.precision_reason}"
        lines.append(f"computing: {threads} thread{'s' * (threads > 1)}, {how}")
    return "\n".join(lines)


def _words(part: object) -> str:
    """The name of a class as words: "split rotor"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(part).__name__).lower()


def _describe_term(system: System, term: NamedTuple) -> str:
    if not isinstance(term, PairForces):
        return _words(term)
    cutoff: float = term.potential.cutoff  # type: ignore[attr-defined]  # every pair potential has a cutoff
    reach = f"cutoff {cutoff:g} Å" if cutoff < inf else "no cutoff"
    if cutoff < inf and hasattr(term.potential, "truncation"):
        forces = system.scene.forces
        of_charges = isinstance(term.potential, ReactionField)
        reach += f", {forces.reaction_field_truncation if of_charges else forces.truncation}"
    return (
        f"{len(term.group)} sites, {reach}, neighbour list with a skin of"
        f" {system.scene.forces.skin_A:g} Å"
    )
