"""The report of `rigidmd check`: how a system would run, and what is not compiled for it."""

import re
from importlib import import_module
from math import inf
from textwrap import fill
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.memory_check import bytes_of
from rigidmd.assemble.run_time import expected_seconds, in_words
from rigidmd.assemble.stage_description import describe_stage
from rigidmd.assemble.start import output_errors, rest_errors
from rigidmd.assemble.time_step import MIXED_ERROR, describe_step
from rigidmd.compile.machine import usable_threads
from rigidmd.core.state import edges_and_angles
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.formats.cells import right_angled
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.scene.molecules import name_of
from rigidmd.units import BAR, KJ_PER_MOL

WIDTH = 100  # of lines of the report, columns
#: Precision of forces, for reports. Times: docs/evidence/benchmarks.md.
PRECISIONS = {
    "double": (
        f'double (precision = "mixed" takes half the time; forces have errors of {MIXED_ERROR:.0e})'
    ),
    "mixed": f"single between sites, with errors of forces of {MIXED_ERROR:.0e}, else double",
}


def describe_system(system: System, *, verbose: bool = False) -> str:
    """How the scene of a system would run. Raises SceneError if nothing would move, or if its
    output cannot be written.

    verbose : with what is compiled in and what is omitted, and the reasons
    """
    if errors := [*rest_errors(system), *output_errors(system)]:
        raise SceneError(system.scene.source, errors)
    scene = system.scene
    parts = {
        "stages": _stage_lines(system),
        "system": _system_lines(system),
        "forces": _force_lines(system),
    }
    if verbose:
        parts |= {"compiled in": _compiled_lines(system), "omitted": system.left_out}
    head = f"{scene.name}: {len(system.model.species)} molecules, {system.site_count} sites"
    return report(head, parts)


def report(head: str, parts: dict[str, list[str]]) -> str:
    """A line, and titles with their lines. Those are wrapped, and continue further in."""
    text = [head]
    for title, lines in parts.items():
        text += ["", f"{title}:"] * bool(lines)
        for line in lines:
            margin = " " * (len(line) - len(line.lstrip()) + 2)
            text.append(fill(line, WIDTH, initial_indent="  ", subsequent_indent=f"  {margin}"))
    return "\n".join(text)


def _stage_lines(system: System) -> list[str]:
    scene, lines = system.scene, []
    for k, stage in enumerate(scene.stages):
        steps, sampled = describe_stage(stage)
        lines += [f"{k}: {steps}", f"   {sampled}"]
        if of_step := describe_step(scene, system.species, k):
            lines.append(f"   {of_step}")
    if (seconds := expected_seconds(system)) is not None:
        count = usable_threads(scene.threads)
        threads = f"{count} thread{'s' * (count > 1)}"
        lines.append(
            f"run time: about {in_words(seconds)} on {threads}. The first run also"
            " compiles for up to a minute"
        )
    return lines


def _system_lines(system: System) -> list[str]:
    free, lines = system.last_freedom, []
    for k, m in enumerate(system.species):
        count = int((system.model.species == k).sum())
        if system.model.inverse_mass[k] == 0:
            freely = "frozen"
        else:
            freely = f"{m.degrees_of_freedom} degrees of freedom"
        lines.append(f"{count} {m.name}: {m.description}, {freely}")
    charges = np.array([m.charge for m in system.species])[system.model.species]
    if abs(charges.sum()) > 1e-9 * np.abs(charges).sum():
        lines.append(f"net charge: {charges.sum():+.6g} e")
    lines.append(
        f"degrees of freedom: {free.total} = {free.translation} translation + {free.rotation}"
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
    memory = (
        f"memory: about {bytes_of(system) / 1e6:.1f} MB for state, forces, neighbour lists and"
        " samples"
    )
    return [*lines, box, *system.notes, memory]


def _force_lines(system: System) -> list[str]:
    scene, lines = system.scene, []
    fields = scene.fields.entries
    for name, term in system.terms.items():
        of_field = ""
        if name in fields:
            kind, table, _ = fields[name]
            of_field = import_module(f"rigidmd.forces.fields.{kind.module}").sentence(table, term)
        description = system.user_terms.get(name) or of_field or _describe_term(system, term)
        lines.append(f"{name.replace('_', ' ')}: {description}")
    if system.tail is not None:
        energy = system.tail.energy(system.space.volume) / KJ_PER_MOL / len(system.model.species)
        pressure = system.tail.pressure(system.space.volume) / BAR
        lines.append(
            f"tail correction: {energy:.4g} kJ/mol per molecule and {pressure:.4g} bar at this"
            " volume"
        )
    if not scene.engine.is_external:
        threads = usable_threads(scene.threads)
        lines.append(
            f"computing: {threads} thread{'s' * (threads > 1)}, {scene.precision} precision"
        )
    return lines


def _compiled_lines(system: System) -> list[str]:
    scene, lines = system.scene, []
    if not isinstance(system.model.rotor, NoRotor):
        lines.append(f"rotation: {class_words(system.model.rotor)}")
    if system.thermostat is not None:
        lines.append(f"thermostat: {name_of(system.thermostat)}, from Python, in every stage")
    for what in ("thermostat", "barostat")[system.thermostat is not None :]:
        kinds = dict.fromkeys(getattr(stage, f"{what}_kind") for stage in scene.stages)
        lines += [f"{what}: {kind.replace('_', ' ')}" for kind in kinds if kind]
    if any(stage.ensemble == "nph" for stage in scene.stages):
        lines.append("barostat: piston, in the nph stages only")
    conserved = [
        axis for axis, keeps in zip("xyz", system.model.keeps_momentum, strict=True) if keeps
    ]
    if (interval := system.removes_momentum_every) is not None:
        part = "" if len(conserved) == 3 else f" along {' and '.join(conserved)}"
        lines.append(f"total momentum: removed{part} every {interval:g} ps")
    if (system.external or system.user_terms) and len(conserved) < 3:
        where = f"along {' and '.join(conserved)}" if conserved else "nowhere"
        lines.append(f"total momentum: conserved {where}")
    if not scene.engine.is_external:
        how = PRECISIONS[scene.precision]
        if system.precision_reason:
            how = f"{scene.precision}, chosen because {system.precision_reason}"
        lines.append(f"precision: {how}")
    return lines


def class_words(part: object) -> str:
    """The name of a class as words: "split rotor"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(part).__name__).lower()


def _describe_term(system: System, term: NamedTuple) -> str:
    if not isinstance(term, PairForces):
        return class_words(term)
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
