"""The terms of external fields, and the space between walls."""

from math import inf, pi, radians
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.species import select_by_number
from rigidmd.core.state import State
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.momenta import conserved_momentum
from rigidmd.errors import SceneError
from rigidmd.forces.fields.electric import ElectricField, OscillatingField
from rigidmd.forces.fields.gravity import Gravity
from rigidmd.forces.fields.restraints import Restraints
from rigidmd.forces.fields.walls import HarmonicWalls, LennardJonesWalls
from rigidmd.forces.neighbors.sites import sites_of
from rigidmd.forces.neighbors.space import Orthorhombic, Space, Unbounded
from rigidmd.scene import MolecularScene
from rigidmd.scene.fields import AXES, Walls
from rigidmd.scene.models import Molecule
from rigidmd.scene.validation import not_none
from rigidmd.units import KJ_PER_MOL, METRE_PER_S2, VOLT_PER_NM

#: Distance of the well of a Lennard-Jones wall, in sigma, at which a lattice of molecules begins.
WELL = (2 / 5) ** (1 / 6)


class SystemParts(NamedTuple):
    """The parts of a system on which fields depend."""

    species: list[Molecule]
    model: Model
    space: Space
    cutoff: float  # between sites, Å
    state: State  # the start
    number: np.ndarray  # (n,) residue numbers, by which a scene selects molecules


def field_terms(scene: MolecularScene, parts: SystemParts) -> dict[str, NamedTuple]:
    """The terms of a scene's fields, by name. Raises SceneError with all errors."""
    faults: list[str] = []
    terms: dict[str, NamedTuple] = {}
    fields, model = scene.fields, parts.model
    moves = model.inverse_mass > 0
    if any(fields.electric_V_per_nm or ()):
        terms["electric_field"] = _electric_field(scene, parts, moves, faults)
    if any(fields.gravity_m_s2 or ()):
        mass = np.where(moves, model.mass, 0.0)
        terms["gravity"] = Gravity(model.species, mass, np.array(fields.gravity_m_s2) * METRE_PER_S2)
    for k, walls in enumerate(fields.walls):
        term = terms[f"walls_{k}"] = _walls(walls, k, parts, moves, faults)
        if isinstance(term, LennardJonesWalls) and (behind := term.behind(parts.state)) is not None:
            name = parts.species[model.species[behind.molecule]].name
            faults.append(f"fields.walls.{k}: at the start, molecule {behind.molecule + 1} ({name}) {behind}")
    faults += _gap_errors(scene, parts, moves)
    for k in range(len(fields.restraints)):
        if (term := _restraints(scene, k, parts, faults)) is not None:
            terms[f"restraints_{k}"] = term
    if not faults and scene.run.remove_momentum_interval_ps and not conserved_momentum(model, terms).any():
        why = "fields or frozen molecules change all components of the total momentum; leave it out"
        faults.append(f"run.remove_momentum_interval_ps: {why}")
    if faults:
        raise SceneError(scene.source, faults)
    return terms


def _electric_field(scene: MolecularScene, parts: SystemParts, moves: np.ndarray, faults: list[str]) -> NamedTuple:
    fields, species = scene.fields, parts.species
    charge = np.where(moves, [m.charge for m in species], 0.0)
    dipole = np.where(moves[:, None], [m.charges @ m.positions_body for m in species], 0.0)
    present = np.unique(parts.model.species)
    if not (charge[present].any() or dipole[present].any()):
        faults.append("fields.electric_V_per_nm would do nothing: no molecule that moves has a charge")
    field = np.array(fields.electric_V_per_nm) * VOLT_PER_NM
    steady = ElectricField(parts.model.species, charge, dipole, field)
    if fields.electric_frequency_per_ps is None:
        return steady
    return OscillatingField(*steady, 2 * pi * fields.electric_frequency_per_ps, radians(fields.electric_phase_deg))


def _walls(walls: Walls, k: int, parts: SystemParts, moves: np.ndarray, faults: list[str]) -> NamedTuple:
    points = _acted_on(walls, parts.species, moves)
    faults += [
        f"fields.walls.{k}: {m.name} has no site with Lennard-Jones parameters, and would pass the walls; "
        "use acts_on = 'centres'"
        for m, offsets, free in zip(parts.species, points, moves, strict=True)
        if free and not len(offsets)
    ]
    sites = sites_of(parts.model.species, points, parts.model.inverse_inertia)
    where = (walls.direction, *walls.positions_A)
    if walls.kind == "harmonic":
        return HarmonicWalls(*where, not_none(walls.stiffness_kJ_mol_A2) * KJ_PER_MOL, sites)
    sigma, epsilon = not_none(walls.sigma_A), not_none(walls.epsilon_kJ_mol) * KJ_PER_MOL
    return LennardJonesWalls(*where, sigma, epsilon, walls.cutoff_A or inf, sites)


def _acted_on(walls: Walls, species: list[Molecule], moves: np.ndarray) -> list[np.ndarray]:
    """Points (k, 3) of each species on which walls act, body frame, Å; none of frozen species."""
    offsets = [np.zeros((1, 3)) if walls.acts_on == "centres" else m.positions_body[m.epsilon > 0] for m in species]
    return [points if free else points[:0] for points, free in zip(offsets, moves, strict=True)]


def _gap_errors(scene: MolecularScene, parts: SystemParts, moves: np.ndarray) -> list[str]:
    """Messages on walls that do not fit into a periodic box, or too close to their periodic images."""
    fields, space = scene.fields, parts.space
    if not fields.walls or isinstance(space, Unbounded):
        return []
    if not isinstance(space, Orthorhombic):
        return ["fields.walls need a box with right angles, or none"]
    faults = []
    for axis, name in enumerate(AXES):
        if (bounds := fields.bounds(axis)) is None:
            continue
        across = [walls for walls in fields.walls if walls.direction == axis]
        protrusion = min(_protrusion(walls, parts.species, moves) for walls in across)
        width, edge = bounds[1] - bounds[0], space.edges[axis]
        least = width + 2 * protrusion + parts.cutoff
        if edge < least:
            sites = f", {2 * protrusion:.3g} Å by which sites may protrude," if protrusion else ""
            faults.append(
                f"fields.walls: along {name} the box is {edge:g} Å, and must be {least:.6g} Å at least: {width:g} Å "
                f"between the walls{sites} and the cutoff of {parts.cutoff:g} Å, so that molecules at one wall do not "
                "interact with periodic images of molecules at the other"
            )
    return faults


def _protrusion(walls: Walls, species: list[Molecule], moves: np.ndarray) -> float:
    """Largest distance of interacting sites from the points on which walls act, Å."""
    found = 0.0
    for m, points in zip(species, _acted_on(walls, species, moves), strict=True):
        acting = m.positions_body[(m.epsilon > 0) | (m.charges != 0)]
        if len(points) and len(acting):
            distance = np.linalg.norm(acting[:, None] - points, axis=2).min(axis=1)
            found = max(found, float(distance.max()))
    return found


def _restraints(scene: MolecularScene, k: int, parts: SystemParts, faults: list[str]) -> Restraints | None:
    entry, index, number = scene.fields.restraints[k], parts.model.species, parts.number
    names = list(dict.fromkeys(m.name for m in parts.species))
    key = f"fields.restraints.{k}"
    if entry.species is None and len(names) > 1:
        faults.append(f"{key}.species is required: there are {', '.join(names)}")
        return None
    if entry.species is not None and entry.species not in names:
        faults.append(f"{key}.species: there is no {entry.species!r}; there are {', '.join(names)}")
        return None
    name = entry.species or names[0]
    of_species = np.array([m.name == name for m in parts.species])[index]
    if not of_species.any():
        faults.append(f"{key}.species: the structure file has no {name}")
        return None
    moves = parts.model.inverse_mass[index] > 0
    restrained = of_species & moves if entry.molecules is None else np.zeros(len(index), bool)
    for numbers, mask, fault in select_by_number(entry.spans, name, of_species, number):
        if fault:
            faults.append(f"{key}.molecules: {fault}")
        elif not moves[mask].all():
            faults.append(f"{key}.molecules: {numbers} includes frozen molecules, which do not move")
        restrained |= mask
    if not restrained.any():
        if entry.molecules is None:
            faults.append(f"{key} would do nothing: all {name} are frozen")
        return None
    molecule = np.flatnonzero(restrained)
    position = parts.state.position[molecule] if entry.position_A is None else [entry.position_A] * len(molecule)
    return Restraints(molecule, np.array(position, float), np.array(entry.stiffness) * KJ_PER_MOL)


def range_of_centres(walls: Walls, species: list[Molecule]) -> tuple[float, float]:
    """Range (lower, upper) of centres of mass that is free for every orientation between walls, Å."""
    reach = max(
        np.linalg.norm(points, axis=1).max(initial=0.0)
        for points in _acted_on(walls, species, np.ones(len(species), bool))
    )
    margin = float(reach) + (WELL * walls.sigma_A if walls.kind == "lj93" else 0.0)
    return walls.positions_A[0] + margin, walls.positions_A[1] - margin


def wrapped_between_walls(scene: MolecularScene, space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) wrapped to between the walls; unchanged without walls or box."""
    if not isinstance(space, Orthorhombic):
        return position
    moved = position.copy()
    for axis, edge in enumerate(space.edges):
        if (bounds := scene.fields.bounds(axis)) is not None:
            moved[:, axis] -= edge * np.rint((moved[:, axis] - sum(bounds) / 2) / edge)
    return moved


def describe_fields(scene: MolecularScene, terms: dict[str, NamedTuple]) -> dict[str, str]:
    """Descriptions of the terms of the fields, by name."""
    fields, found = scene.fields, {}
    if "electric_field" in terms:
        found["electric_field"] = f"{_vector(not_none(fields.electric_V_per_nm))} V/nm"
        if fields.electric_frequency_per_ps is not None:
            frequency = f"f = {fields.electric_frequency_per_ps:g}/ps; its work is in the energy ledger"
            found["electric_field"] += f" cos(2 pi f t + {fields.electric_phase_deg:g}°), {frequency}"
    if "gravity" in terms:
        found["gravity"] = f"{_vector(not_none(fields.gravity_m_s2))} m/s²"
    for k, walls in enumerate(fields.walls):
        lower, upper = walls.positions_A
        kind = f"harmonic, {walls.stiffness_kJ_mol_A2 or 0:g} kJ/mol/Å²"
        if walls.kind == "lj93":
            kind = f"Lennard-Jones 9-3, sigma {walls.sigma_A:g} Å, epsilon {walls.epsilon_kJ_mol:g} kJ/mol, "
            kind += f"cutoff {walls.cutoff_A:g} Å" if walls.cutoff_A else "no cutoff"
        term = terms[f"walls_{k}"]
        assert isinstance(term, HarmonicWalls | LennardJonesWalls)
        what = "centres of mass" if walls.acts_on == "centres" else f"{len(term.sites.molecule)} sites"
        positions = [f"{walls.axis} = {x:g} Å" for x in (lower, upper) if abs(x) < inf]
        found[f"walls_{k}"] = f"at {' and '.join(positions)}, on {what}: {kind}"
    for k, entry in enumerate(fields.restraints):
        stiffness = sorted(set(entry.stiffness))
        size = f"{stiffness[0]:g}" if len(stiffness) == 1 else _vector(entry.stiffness)
        where = "to their starting positions" if entry.position_A is None else f"to {_vector(entry.position_A)} Å"
        term = terms[f"restraints_{k}"]
        assert isinstance(term, Restraints)
        found[f"restraints_{k}"] = f"{len(term.molecule)} molecules restrained {where}, {size} kJ/mol/Å²"
    return found


def _vector(values: tuple[float, ...]) -> str:
    return f"({', '.join(f'{x:g}' for x in values)})"


def fields_left_out(terms: dict[str, NamedTuple]) -> list[str]:
    """The kinds of fields that the scene does not have."""
    kinds = {"electric_field": "electric field", "gravity": "gravity", "walls": "walls", "restraints": "restraints"}
    missing = [kind for name, kind in kinds.items() if not any(term.startswith(name) for term in terms)]
    return [f"{', '.join(missing)}: not in [fields]"] if missing else []


def field_notes(scene: MolecularScene) -> list[str]:
    method = scene.forces.electrostatics
    if not scene.fields.walls or method not in ("ewald", "pme"):
        return []
    return [
        f"fields.walls: {method} includes the periodic images beyond the walls, which act on the layer between the "
        "walls across the empty part of the box; a longer box reduces this effect"
    ]
