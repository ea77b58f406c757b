"""A scene of molecules with its defaults, and what they follow from: species, start, model.

Two defaults follow from the forces, and `build` adds them: removal of the total momentum and
precision.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.assemble.defaults import with_defaults, with_engine_defaults, without_tail_reason
from rigidmd.assemble.plausibility import scene_errors, scene_warnings
from rigidmd.assemble.species import species_of, split_frozen
from rigidmd.assemble.start import Configuration, residue_numbers, starting_configuration
from rigidmd.assemble.time_step import with_time_steps
from rigidmd.core.state import state_of
from rigidmd.dynamics.model import Model
from rigidmd.errors import SceneError
from rigidmd.features import acting_on
from rigidmd.forces.neighbors.space import Orthorhombic, Space, space_of
from rigidmd.forces.parts import SystemParts
from rigidmd.mechanics.free_rotor import NoRotor, split_rotor
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.units import BOLTZMANN


class ResolvedScene(NamedTuple):
    """The parts of the system of a scene with its defaults."""

    parts: SystemParts  # the scene is among them
    model: Model
    start: Configuration
    temperature: float  # of velocities from a file, K
    without_tail: str  # why the tail correction is left out; empty with one
    notes: list[str]
    warnings: list[str]


def resolve(scene: MolecularScene) -> ResolvedScene:
    """A scene with its defaults. Raises SceneError, StructureError or MoleculeError, with all
    errors found."""
    scene, notes = with_engine_defaults(scene)
    species = species_of(scene)
    start = starting_configuration(scene, species)
    temperature = _temperature_of(scene, species, start)
    scene = with_time_steps(scene, species, temperature)
    space = space_of(start.cell)
    number = residue_numbers(start)
    warnings = scene_warnings(scene, species)
    species, index, frozen, errors = split_frozen(scene, species, start.species, number)
    counts = np.bincount(index, minlength=len(species))
    if implausible := scene_errors(scene, species, counts, space):
        raise SceneError(scene.source, implausible)
    state = state_of(
        position=wrapped_between_walls(scene, space, start.position),
        rotation=start.rotation if any(m.inertia.any() for m in species) else None,
        cell=start.cell,
    )
    model = model_of(species, index, frozen)
    parts = SystemParts(scene, species, model, space, state, number, start.basis, None)
    resolved = with_defaults(scene, parts)
    complete, errors = resolved.scene, [*errors, *resolved.errors]
    for feature in acting_on(complete):
        complete, more = feature.resolve(complete, species)
        errors += more
    if errors:
        raise SceneError(scene.source, errors)
    return ResolvedScene(
        parts._replace(scene=complete, grid=resolved.pme_grid),
        model,
        start,
        temperature,
        _without_tail(scene, complete, parts),
        notes,
        warnings,
    )


def _temperature_of(scene: MolecularScene, species: list[Molecule], start: Configuration) -> float:
    """The temperature of the velocities of a structure file, K. 0 without them."""
    if scene.structure is None or not scene.structure.velocities or start.velocity is None:
        return 0.0
    mass = np.array([m.mass for m in species])
    squares = mass[start.species] @ (start.velocity**2).sum(axis=1)
    return float(squares) / (3 * len(start.species)) / BOLTZMANN


def model_of(species: list[Molecule], index: np.ndarray, frozen: np.ndarray) -> Model:
    """The model of molecules (n,) of these species, of which some are frozen."""
    mass = np.array([m.mass for m in species])
    inertia = np.where(frozen[:, None], 0.0, [m.inertia for m in species])
    rotor = split_rotor(inertia)
    return Model(
        index.astype(np.int32),
        mass,
        np.where(frozen, 0.0, 1 / mass),
        inertia,
        rotor.inverse_inertia,
        rotor if inertia.any() else NoRotor(),
    )


def _without_tail(written: MolecularScene, complete: MolecularScene, parts: SystemParts) -> str:
    """Why a scene has no tail correction. Empty with one, or with a sum of dispersion."""
    if complete.forces.dispersion != "cutoff" or complete.forces.tail_correction:
        return ""
    if written.forces.tail_correction is False:
        return "forces.tail_correction is false"
    return without_tail_reason(written, parts)


def wrapped_between_walls(scene: MolecularScene, space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) wrapped to between the walls. Unchanged without walls or box."""
    if not isinstance(space, Orthorhombic):
        return position
    moved = position.copy()
    for axis, edge in enumerate(space.edges):
        if (bounds := scene.fields.bounds(axis)) is not None:
            moved[:, axis] -= edge * np.rint((moved[:, axis] - sum(bounds) / 2) / edge)
    return moved
