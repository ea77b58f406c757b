"""The terms of a resolved scene: interactions between molecules, external fields; what is left out, and why."""

from importlib import import_module
from math import inf
from types import ModuleType
from typing import NamedTuple

import numpy as np

from rigidmd.dynamics.model import Model
from rigidmd.dynamics.momenta import conserved_momentum
from rigidmd.errors import SceneError
from rigidmd.forces.neighbors.space import Orthorhombic, Space
from rigidmd.forces.parts import Interactions, SystemParts, sum_of_tails
from rigidmd.mechanics.free_rotor import NoRotor
from rigidmd.scene import MolecularScene
from rigidmd.scene.fields import FIELDS
from rigidmd.scene.forces import ELECTROSTATICS, POTENTIALS, Forces


def electrostatics_module(forces: Forces) -> ModuleType | None:
    """The module of `forces` with the method of electrostatics; None for electrostatics = "none"."""
    name = ELECTROSTATICS[forces.electrostatics].module
    return import_module(f"rigidmd.forces.{name}") if name else None


def interactions(parts: SystemParts) -> Interactions:
    """The interactions of a resolved scene. Raises SceneError."""
    forces = parts.scene.forces
    modules = [
        import_module(f"rigidmd.forces.potentials.{key}") for key in POTENTIALS if getattr(forces, key) is not None
    ]
    if any(m.charges.any() for m in parts.species):
        modules += [module for module in [electrostatics_module(forces)] if module is not None]
    found = [module.interactions(parts) for module in modules]
    return Interactions(
        {name: term for part in found for name, term in part.terms.items()},
        {name: value for part in found for name, value in part.constants.items()},
        sum(part.pressure for part in found), sum_of_tails([part.tail for part in found if part.tail is not None]),
        next((part.force_error for part in found if part.force_error is not None), None),
        tuple(note for part in found for note in part.notes),
    )  # fmt: skip


def field_terms(parts: SystemParts) -> dict[str, NamedTuple]:
    """The terms of a scene's fields, by name. Raises SceneError with all errors."""
    faults: list[str] = []
    terms: dict[str, NamedTuple] = {}
    for name, (kind, entry, where) in parts.scene.fields.entries.items():
        term = import_module(f"rigidmd.forces.fields.{kind.module}").term(parts, entry, where, faults)
        if term is not None:
            terms[name] = term
    if not faults and parts.scene.run.remove_momentum_interval_ps and not conserved_momentum(parts.model, terms).any():
        why = "fields or frozen molecules change all components of the total momentum; leave it out"
        faults.append(f"run.remove_momentum_interval_ps: {why}")
    if faults:
        raise SceneError(parts.scene.source, faults)
    return terms


def wrapped_between_walls(scene: MolecularScene, space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) wrapped to between the walls; unchanged without walls or box."""
    if not isinstance(space, Orthorhombic):
        return position
    moved = position.copy()
    for axis, edge in enumerate(space.edges):
        if (bounds := scene.fields.bounds(axis)) is not None:
            moved[:, axis] -= edge * np.rint((moved[:, axis] - sum(bounds) / 2) / edge)
    return moved


def left_out(scene: MolecularScene, terms: dict, model: Model, space: Space) -> list[str]:
    """What is not compiled for this scene, and why."""
    forces, has_images = scene.forces, "coulomb_reciprocal" in terms
    method, has_charges = forces.electrostatics, any(getattr(term, "acts_on_charges", False) for term in terms.values())
    no_charges = "electrostatics is none" if method == "none" else "no site has one"
    reasons = {
        f"{title}: {'no site has it' if getattr(forces, key) else without}": key not in terms
        for key, (title, without) in POTENTIALS.items()
    } | {
        f"charges: {no_charges}": not has_charges,
        f"sums over periodic images, Fourier transforms: electrostatics is {method}": has_charges and not has_images,
        "Fourier transforms: electrostatics is ewald, a direct sum over k-vectors": has_images and method == "ewald",
        "rotation and torques: every molecule is a point": isinstance(model.rotor, NoRotor),
        "periodic images: no box": space.volume == inf,
        "thermostat: no NVT or NPT stage": not any(stage.has_thermostat for stage in scene.stages),
        "barostat: no NPT or NPH stage": not any(stage.has_barostat for stage in scene.stages),
        "removal of the total momentum: run.remove_momentum_interval_ps is false": (
            scene.run.remove_momentum_interval_ps is False
        ),
        "tail correction: not requested": not forces.tail_correction,
    }  # fmt: skip
    fields = [kind.title for name, kind in FIELDS.items() if not any(term.startswith(name) for term in terms)]
    return [
        *(reason for reason, applies in reasons.items() if applies),
        *([f"{', '.join(fields)}: not in [fields]"] if fields else []),
    ]  # fmt: skip
