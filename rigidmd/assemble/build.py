"""The system of a scene of molecules: species, model, start, terms. All errors are collected and
raised together.

The integrator of a stage: its scheme with the flows of the thermostat and the barostat.
"""

from importlib import import_module
from math import inf
from typing import NamedTuple, cast

from rigidmd.assemble.defaults import with_momentum_removal
from rigidmd.assemble.memory_check import check_memory
from rigidmd.assemble.resolve import ResolvedScene, resolve
from rigidmd.assemble.stage_description import stage_notes
from rigidmd.assemble.start import Configuration, overlaps, set_momenta
from rigidmd.assemble.time_step import with_precision
from rigidmd.core.integrators import Scheme
from rigidmd.dynamics import noise
from rigidmd.dynamics.barostats import Confinement, Pressure
from rigidmd.dynamics.model import Model, conserved_momentum, count_degrees_of_freedom, mobile
from rigidmd.dynamics.thermostats import Ramp, UserThermostat
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, StructureError
from rigidmd.features import acting_on
from rigidmd.forces.neighbors.space import Space
from rigidmd.forces.parts import Interactions, SystemParts, sum_of_tails
from rigidmd.forces.terms import trait
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.scene import MolecularScene
from rigidmd.scene.fields import FIELDS, field_notes
from rigidmd.scene.forces import ELECTROSTATICS
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import BAR, BOLTZMANN


def build(scene: MolecularScene, user_code: bool = True) -> System:
    """The system of a scene. Raises SceneError, StructureError or MoleculeError, with all errors
    found.

    user_code : whether to run the code of users. Without it their terms are missing, which analyses
        do not need
    """
    resolved = resolve(scene)
    parts = parts_as_they_act(resolved.parts)
    system = _system_of(resolved, parts, acting_in(parts))
    for feature in acting_on(system.scene):
        system = feature.extend(system, resolved.parts, user_code=user_code)
    if errors := _ensemble_errors(system):
        raise SceneError(system.scene.source, errors)
    check_memory(system)
    system.notes.extend(system.scene.rounded_times())
    system.notes.extend(set_momenta(system.scene, system.model, system.state, resolved.start))
    system.notes.extend(_system_notes(system))
    system.notes.extend(_start_notes(system, resolved.start))
    return system


def _system_of(resolved: ResolvedScene, parts: SystemParts, acting: Interactions) -> System:
    """The system of a resolved scene with the terms of the core, at rest. Raises SceneError.

    parts : as they act
    """
    scene, species = parts.scene, [*parts.species]
    model = resolved.model._replace(keeps_momentum=conserved_momentum(resolved.model, acting.terms))
    scene = with_momentum_removal(scene, model.keeps_momentum)
    free = [m for m, moves in zip(species, parts.moves, strict=True) if moves]
    scene, precision_reason = with_precision(scene, free, resolved.temperature, acting.force_error)
    return System(
        scene=scene,
        species=species,
        model=model,
        space=parts.space,
        state=parts.state,
        terms=acting.terms,
        freedom=count_degrees_of_freedom(model),
        constants=acting.constants,
        constant_pressure=acting.pressure,
        tail=acting.tail,
        residue_number=parts.number,
        from_lattice=scene.structure is None,
        left_out=left_out(
            scene,
            acting.terms,
            model,
            parts.space,
            charged=any(m.charges.any() for m in species),
            without_tail=resolved.without_tail,
        ),
        precision_reason=precision_reason,
        force_error=acting.force_error,
        notes=[*resolved.notes, *acting.notes, *field_notes(scene), *stage_notes(scene.stages)],
        warnings=resolved.warnings,
    )


def _ensemble_errors(system: System) -> list[str]:
    """Messages on stages whose ensemble the terms of a system do not allow."""
    stages = list(enumerate(system.scene.stages))
    if names := ", ".join(name.replace("_", " ") for name in system.position_dependent):
        why = f"changes the box, and {names} depend on absolute positions in it: keep the volume"
        errors = [f"stages.{k}: {stage.ensemble} {why}" for k, stage in stages if stage.changes_box]
        if errors:
            return errors
    driven = [name for name, term in system.terms.items() if trait(type(term), "time_dependent")]
    why = (
        f"needs an energy that does not depend on time, and {', '.join(driven)} do: choose another"
        " thermostat"
    )
    return [
        f"stages.{k}: {stage.thermostat_kind} {why}"
        for k, stage in stages
        if stage.in_trajectories and driven
    ]


def _system_notes(system: System) -> list[str]:
    """Notes on stages in which nothing moves, on mixing rules and on files of models."""
    scene, kinds = system.scene, {m.name: m for m in system.species}.values()
    stuck = "nothing moves and no temperature is defined. Use thermostat = 'langevin'"
    notes = [
        f"stages.{k}: the total momentum is conserved and zero, so that {stuck}"
        for k, stage in enumerate(scene.stages)
        if not stage.is_minimisation
        and len(system.model.species)
        and system.freedom_in(k).total == 0
        and mobile(system.model).any()
    ]
    notes += [
        f"{m.name} was developed with {m.mixing} mixing, forces.mixing is {scene.forces.mixing}"
        for m in kinds
        if m.mixing not in (None, scene.forces.mixing)
    ]
    return [*notes, *(f"{m.name}: {note}" for m in kinds for note in m.reading)]


def _start_notes(system: System, start: Configuration) -> list[str]:
    """Notes on the start. Raises StructureError if molecules of a structure file overlap and
    nothing separates them."""
    scene = system.scene
    if scene.structure is None:
        return [f"box: {note}" for note in start.notes]
    file = scene.structure.file
    off = f"rms {start.residual_rms:.4f} Å, largest {start.residual_max:.4f} Å"
    notes = [
        f"{len(system.model.species)} molecules read from {file}. Distances of atoms from rigid"
        f" templates: {off}",
        *(f"{file}: {note}" for note in start.notes),
    ]
    if errors := overlaps(system):
        if not scene.stages[0].is_minimisation:
            raise StructureError(scene.structure_source, errors)
        notes.append(f"{file}: {'; '.join(errors)}: the minimisation separates them")
    return notes


def parts_as_they_act(parts: SystemParts) -> SystemParts:
    """The parts of a system with the changes by features, such as scaled charges."""
    for feature in acting_on(parts.scene):
        parts = feature.acting(parts)
    return parts


def acting_in(parts: SystemParts) -> Interactions:
    """The interactions and fields of the parts of a system. Raises SceneError."""
    acting = interactions(parts)
    acting.terms.update(field_terms(parts.scene, parts))
    return acting


def interactions(parts: SystemParts) -> Interactions:
    """The interactions of the parts of a system. Raises SceneError."""
    scene, forces = parts.scene, parts.scene.forces
    modules = {"lennard_jones": "potentials.lennard_jones"}
    if any(m.charges.any() for m in parts.species):
        modules["charges"] = ELECTROSTATICS[not_none(forces.electrostatics)].module
    if forces.dispersion != "cutoff":
        modules["dispersion"] = "ewald.dispersion"
    replaced = {
        key: f for feature in acting_on(scene) for key, f in feature.potentials(scene).items()
    }
    contributions = [
        (replaced.get(key) or import_module(f"rigidmd.forces.{module}").interactions)(parts)
        for key, module in modules.items()
        if module
    ]
    return Interactions(
        {name: term for part in contributions for name, term in part.terms.items()},
        {name: value for part in contributions for name, value in part.constants.items()},
        sum(part.pressure for part in contributions),
        sum_of_tails([part.tail for part in contributions if part.tail is not None]),
        next((part.force_error for part in contributions if part.force_error is not None), None),
        tuple(note for part in contributions for note in part.notes),
    )


def field_terms(scene: MolecularScene, parts: SystemParts) -> dict[str, NamedTuple]:
    """The terms of a scene's fields, by name. Raises SceneError with all errors."""
    errors: list[str] = []
    terms: dict[str, NamedTuple] = {}
    for name, (kind, entry, where) in scene.fields.entries.items():
        term = import_module(f"rigidmd.forces.fields.{kind.module}").term(
            parts, entry, where, errors
        )
        if term is not None:
            terms[name] = term
    if (
        not errors
        and scene.run.remove_momentum_interval_ps
        and not conserved_momentum(parts.model, terms).any()
    ):
        why = "fields or frozen molecules change all components of the total momentum. Leave it out"
        errors.append(f"run.remove_momentum_interval_ps: {why}")
    if errors:
        raise SceneError(scene.source, errors)
    return terms


def left_out(
    scene: MolecularScene,
    terms: dict,
    model: Model,
    space: Space,
    *,
    charged: bool,
    without_tail: str,
) -> list[str]:
    """What is not compiled for this scene, and why.

    charged : whether a site has a charge
    without_tail : why the tail correction is omitted. Empty if it is included
    """
    forces = scene.forces
    removal = scene.run.remove_momentum_interval_ps
    has_sums = any(name.endswith("_reciprocal") for name in terms)
    direct = has_sums and forces.electrostatics == "ewald" and forces.dispersion != "pme"
    method = forces.electrostatics
    has_charges = any(trait(term, "acts_on_charges") for term in terms.values())
    why = "no site has it" if forces.lennard_jones else "lennard_jones is false"
    reasons = {
        f"Lennard-Jones: {why}": "lennard_jones" not in terms,
        f"charges: {'electrostatics is none' if charged else 'no site has one'}": not has_charges,
        f"sums over periodic images, Fourier transforms: electrostatics is {method}": (
            has_charges and not has_sums
        ),
        "Fourier transforms: electrostatics is ewald, a direct sum over k-vectors": direct,
        "rotation and torques: every molecule is a point": isinstance(model.rotor, NoRotor),
        "periodic images: no box": space.volume == inf,
        "thermostat: no NVT or NPT stage": not any(stage.has_thermostat for stage in scene.stages),
        "barostat: no NPT or NPH stage": not any(stage.has_barostat for stage in scene.stages),
        "removal of the total momentum: run.remove_momentum_interval_ps is false": removal is False,
        f"tail correction: {without_tail}": bool(without_tail),
    }
    fields = [
        kind.title
        for name, kind in FIELDS.items()
        if not any(term.startswith(name) for term in terms)
    ]
    return [
        *(reason for reason, applies in reasons.items() if applies),
        *([f"{', '.join(fields)}: not in [fields]"] if fields else []),
    ]


def integrator_of_stage(system: System, k: int) -> Scheme:
    """The scheme of stage k, with its thermostat, its barostat and the removal of total
    momentum."""
    stage = system.scene.stages[k]
    scheme = stage.scheme
    if system.thermostat is not None:
        if (user := system.user_thermostat(k)) is not None:
            scheme = scheme.with_thermostat(user, halved=cast("UserThermostat", user).halved)
    elif stage.has_thermostat:
        scheme = stage.thermostat_method.joined(scheme, thermostat_of(system, k), stage)
    if stage.has_barostat:
        scheme = stage.barostat_method.joined(scheme, barostat_of(system, k), stage)
    if system.keeps_momentum_in(k) and (interval := system.removes_momentum_every) is not None:
        scheme = scheme.with_momentum_removal(stage.steps_of(interval))
    return scheme


def thermostat_of(system: System, k: int) -> NamedTuple:
    """The record of the thermostat of stage k."""
    stage = system.scene.stages[k]
    thermal = _thermal(stage)
    key = noise.key_of(system.scene.seed, noise.THERMOSTAT, k)
    module = import_module(stage.thermostat_method.flow)
    return module.thermostat(stage, thermal, system.freedom_in(k), key)


def barostat_of(system: System, k: int) -> NamedTuple:
    """The record of the barostat of stage k."""
    stage = system.scene.stages[k]
    key = noise.key_of(system.scene.seed, noise.BAROSTAT, k)
    # the scene lists xy, xz, yz: components (1, 0), (2, 0), (2, 1) of the lower triangle
    first, last = (tuple(x * BAR for x in ends) for ends in stage.pressures)
    pressure = Pressure(first, last, float(stage.steps))  # pyright: ignore[reportArgumentType]
    x, y, z = map(float, system.at_rest_in(k))
    confinement = Confinement(
        _thermal(stage),
        pressure,
        stage.compressibility / BAR,
        system.state.volume,
        float(mobile(system.model).sum()),
        (x, y, z),
        (0.0, 0.0) if system.tail is None else system.tail[:2],
        key,
    )
    module = import_module(stage.barostat_method.flow)
    return module.barostat(stage, confinement)


def _thermal(stage: Stage) -> Ramp:
    first, last = stage.temperatures
    return Ramp(BOLTZMANN * first, BOLTZMANN * last, float(stage.steps))
