"""The system of a scene of molecules: species, model, start, terms. All errors are collected and raised together."""

from dataclasses import replace

import numpy as np

from rigidmd.assemble.defaults import with_defaults, with_engine_defaults, with_momentum_removal
from rigidmd.assemble.memory_check import check_memory
from rigidmd.assemble.overlaps import overlaps
from rigidmd.assemble.species import species_of, split_frozen
from rigidmd.assemble.stage_description import stage_notes
from rigidmd.assemble.start import residue_numbers, set_momenta, starting_configuration
from rigidmd.assemble.terms import field_terms, interactions, left_out, wrapped_between_walls
from rigidmd.core.state import state_of
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.momenta import conserved_momentum, count_degrees_of_freedom, mobile
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, StructureError
from rigidmd.forces.neighbors.space import cell_of, space_of
from rigidmd.forces.parts import Composition, SystemParts, sum_of_tails
from rigidmd.io.formats.cells import describe_basis, describe_cell
from rigidmd.mechanics.free_rotor import NoRotor, split_rotor
from rigidmd.scene import MolecularScene
from rigidmd.scene.fields import field_notes
from rigidmd.scene.models import Molecule
from rigidmd.scene.molecules import missing_user_code


def build(scene: MolecularScene, user_code: bool = True) -> System:
    """The system of a scene. Raises SceneError, StructureError or MoleculeError, with all errors found.

    user_code : whether to run the code of users; without it their terms are missing, which analyses do not need
    """
    scene, engine_notes = with_engine_defaults(scene)
    species = species_of(scene)
    start = starting_configuration(scene, species)
    space, number = space_of(start.cell), residue_numbers(start)
    species, index, frozen, faults = split_frozen(scene, species, start.species, number)
    counts = np.bincount(index, minlength=len(species))
    cell = "" if start.cell is None else f"{describe_cell(cell_of(space))}, {describe_basis(start.basis)}"
    resolved = with_defaults(scene, Composition(species, counts, space, start.basis, cell))
    if faults := [*faults, *resolved.errors]:
        raise SceneError(scene.source, faults)
    scene = resolved.scene
    model = _model(species, index, frozen)
    state = state_of(
        position=wrapped_between_walls(scene, space, start.position),
        rotation=start.rotation if any(m.inertia.any() for m in species) else None,
        cell=start.cell,
    )
    parts = SystemParts(scene, species, model, space, state, number, start.basis, resolved.pme_grid)
    acting = interactions(parts)
    acting.terms.update(field_terms(parts))
    model = model._replace(keeps_momentum=conserved_momentum(model, acting.terms))
    scene = with_momentum_removal(scene, model.keeps_momentum)
    system = System(
        scene=scene, species=species, model=model, space=space, state=state, terms=acting.terms,
        freedom=count_degrees_of_freedom(model), constants=acting.constants, constant_pressure=acting.pressure,
        tail=acting.tail, residue_number=number, from_lattice=scene.structure is None,
        left_out=left_out(scene, acting.terms, model, space),
        force_error=acting.force_error,
        notes=[*engine_notes, *acting.notes, *field_notes(scene), *stage_notes(scene.stages)],
    )  # fmt: skip
    if user_code:
        if scene.from_python != scene.user_code.names:
            raise SceneError(scene.source, [missing_user_code(scene.from_python, scene.user_code.names)])
        if scene.forces.custom or scene.from_python:
            system = with_user_code(system)
            scene, model = system.scene, system.model
    if names := ", ".join(name.replace("_", " ") for name in system.position_dependent):
        why = f"changes the box, and {names} depend on absolute positions in it: keep the volume"
        faults = [f"stages.{k}: {stage.ensemble} {why}" for k, stage in enumerate(scene.stages) if stage.changes_box]
        if faults:
            raise SceneError(scene.source, faults)
    check_memory(system)
    system.notes.extend(scene.rounded_times())
    system.notes.extend(
        f"stages.{k}: the total momentum is conserved and zero, so that nothing moves and no temperature is defined; "
        "use thermostat = 'langevin'"
        for k, stage in enumerate(scene.stages)
        if not stage.is_minimisation and len(index) and system.freedom_in(k).total == 0 and mobile(model).any()
    )
    system.notes.extend(set_momenta(scene, model, state, start))
    system.notes.extend(
        f"{m.name} was developed with {m.mixing} mixing, forces.mixing is {scene.forces.mixing}"
        for m in {m.name: m for m in species}.values()
        if m.mixing not in (None, scene.forces.mixing)
    )
    if scene.structure is not None:
        system.notes.append(
            f"{len(index)} molecules read from {scene.structure.file}; distances of atoms from rigid templates: "
            f"rms {start.residual_rms:.4f} Å, largest {start.residual_max:.4f} Å"
        )
        system.notes.extend(f"{scene.structure.file}: {note}" for note in start.notes)
        if faults := overlaps(system):
            if not scene.stages[0].is_minimisation:
                raise StructureError(scene.structure_source, faults)
            system.notes.append(f"{scene.structure.file}: {'; '.join(faults)}: the minimisation separates them")
    else:
        system.notes.extend(f"box: {note}" for note in start.notes)
    return system


def with_user_code(system: System) -> System:
    """The system with the terms and the thermostat of users. Raises SceneError with all errors."""
    from rigidmd.assemble.user_code.binding import user_terms

    added = user_terms(system)
    model = system.model._replace(keeps_momentum=system.model.keeps_momentum & ~added.changes_momentum)
    # Forces computed by Python come first: as long as they are missing, no other need be computed.
    terms = {name: added.terms[name] for name in added.python_forces} | system.terms | added.terms
    return replace(
        system, scene=with_momentum_removal(system.scene, model.keeps_momentum), terms=terms, model=model,
        freedom=count_degrees_of_freedom(model), python_forces=added.python_forces, thermostat=added.thermostat,
        tail=sum_of_tails([*([system.tail] if system.tail is not None else []), *added.tails]),
        user_terms=added.descriptions, notes=[*system.notes, *added.notes],
    )  # fmt: skip


def _model(species: list[Molecule], index: np.ndarray, frozen: np.ndarray) -> Model:
    inertia = np.where(frozen[:, None], 0.0, [m.inertia for m in species])
    rotor = split_rotor(inertia)
    mass = np.array([m.mass for m in species])
    return Model(
        index.astype(np.int32), mass, np.where(frozen, 0.0, 1 / mass), inertia, rotor.inverse_inertia,
        rotor if inertia.any() else NoRotor(),
    )  # fmt: skip
