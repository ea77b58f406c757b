"""Terms of external fields, and a start between walls."""

from math import inf, pi, radians
from typing import NamedTuple

import numpy as np

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

#: The least distance of a lattice's molecules from a Lennard-Jones wall, in sigma: that of its well.
WELL = (2 / 5) ** (1 / 6)


class SystemParts(NamedTuple):
    """The parts of a system that fields depend on."""

    species: list[Molecule]
    model: Model
    space: Space
    cutoff: float  # between sites, Å
    state: State  # the start
    number: np.ndarray  # (n,) numbers by which a scene may select molecules


def field_terms(scene: MolecularScene, parts: SystemParts) -> dict[str, NamedTuple]:
    """The terms of a scene's fields, by name. Raises SceneError with every fault."""
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
    faults += _gap_faults(scene, parts, moves)
    for k in range(len(fields.restraints)):
        if (term := _restraints(scene, k, parts, faults)) is not None:
            terms[f"restraints_{k}"] = term
    if not faults and scene.run.remove_momentum_interval_ps and not conserved_momentum(model, terms).any():
        faults.append(
            "run.remove_momentum_interval_ps: fields or frozen molecules change all components of the total momentum; "
            "leave it out"
        )
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
    chosen = _acted_on(walls, parts.species, moves)
    faults += [
        f"fields.walls.{k}: {m.name} has no site with Lennard-Jones parameters, and would pass the walls; "
        "acts_on = 'centres' holds it"
        for m, own, free in zip(parts.species, chosen, moves, strict=True)
        if free and not len(own)
    ]
    sites = sites_of(parts.model.species, chosen, parts.model.inverse_inertia)
    where = (walls.direction, *walls.positions_A)
    if walls.kind == "harmonic":
        return HarmonicWalls(*where, not_none(walls.stiffness_kJ_mol_A2) * KJ_PER_MOL, sites)
    sigma, epsilon = not_none(walls.sigma_A), not_none(walls.epsilon_kJ_mol) * KJ_PER_MOL
    return LennardJonesWalls(*where, sigma, epsilon, walls.cutoff_A or inf, sites)


def _acted_on(walls: Walls, species: list[Molecule], moves: np.ndarray) -> list[np.ndarray]:
    """Offsets (sites, 3) of the points of each species that walls act on, body frame, Å; none of frozen species."""
    offsets = [np.zeros((1, 3)) if walls.acts_on == "centres" else m.positions_body[m.epsilon > 0] for m in species]
    return [own if free else own[:0] for own, free in zip(offsets, moves, strict=True)]


def _gap_faults(scene: MolecularScene, parts: SystemParts, moves: np.ndarray) -> list[str]:
    """Faults: walls that do not fit into a periodic box, or do not keep molecules apart from their images."""
    fields, space = scene.fields, parts.space
    if not fields.walls or isinstance(space, Unbounded):
        return []
    if not isinstance(space, Orthorhombic):
        return ["fields.walls need a box with right angles, or none"]
    faults = []
    for axis, name in enumerate(AXES):
        if (bounds := fields.bounds(axis)) is None:
            continue
        own = [walls for walls in fields.walls if walls.direction == axis]
        over = min(_protrusion(walls, parts.species, moves) for walls in own)
        apart, edge = bounds[1] - bounds[0], space.edges[axis]
        least = apart + 2 * over + parts.cutoff
        if edge < least:
            beyond = f", {2 * over:.3g} Å by which sites may stand out," if over else ""
            faults.append(
                f"fields.walls: along {name} the box is {edge:g} Å, and must be {least:.6g} Å at least: {apart:g} Å "
                f"between the walls{beyond} and the cutoff of {parts.cutoff:g} Å, so that what is at one wall does "
                "not meet the images of what is at the other"
            )
    return faults


def _protrusion(walls: Walls, species: list[Molecule], moves: np.ndarray) -> float:
    """How far interacting sites may reach beyond the points that walls act on, Å."""
    found = 0.0
    for m, own in zip(species, _acted_on(walls, species, moves), strict=True):
        acting = m.positions_body[(m.epsilon > 0) | (m.charges != 0)]
        if len(own) and len(acting):
            apart = np.linalg.norm(acting[:, None] - own, axis=2).min(axis=1)
            found = max(found, float(apart.max()))
    return found


def _restraints(scene: MolecularScene, k: int, parts: SystemParts, faults: list[str]) -> Restraints | None:
    entry, index, number = scene.fields.restraints[k], parts.model.species, parts.number
    names = list(dict.fromkeys(m.name for m in parts.species))
    where = f"fields.restraints.{k}"
    if entry.species is None and len(names) > 1:
        faults.append(f"{where}.species is needed: there are {', '.join(names)}")
        return None
    if entry.species is not None and entry.species not in names:
        faults.append(f"{where}.species: there is no {entry.species!r}; there are {', '.join(names)}")
        return None
    name = entry.species or names[0]
    own = np.array([m.name == name for m in parts.species])[index]
    if not own.any():
        faults.append(f"{where}.species: the structure file holds no {name}")
        return None
    moves = parts.model.inverse_mass[index] > 0
    held = own & moves if entry.molecules is None else np.zeros(len(index), bool)
    for first, last in entry.spans:
        here = own & (first <= number) & (number <= last)
        asked = f"{first}" if first == last else f"{first}-{last}"
        if not here.any() or last > number[own].max():
            there = f"they have {number[own].min()} to {number[own].max()}"
            faults.append(f"{where}.molecules: no {name} has the number {asked}; {there}")
        elif not moves[here].all():
            faults.append(f"{where}.molecules: frozen ones are among {asked}, which nothing moves")
        held |= here
    if not held.any():
        if entry.molecules is None:
            faults.append(f"{where} would do nothing: all {name} are frozen")
        return None
    molecule = np.flatnonzero(held)
    place = parts.state.position[molecule] if entry.position_A is None else [entry.position_A] * len(molecule)
    return Restraints(molecule, np.array(place, float), np.array(entry.stiffness) * KJ_PER_MOL)


def _range_of_centres(walls: Walls, species: list[Molecule]) -> tuple[float, float]:
    """Range of positions of centres of mass that is free for every orientation, Å."""
    reach = max(
        np.linalg.norm(own, axis=1).max(initial=0.0) for own in _acted_on(walls, species, np.ones(len(species), bool))
    )
    margin = float(reach) + (WELL * walls.sigma_A if walls.kind == "lj93" else 0.0)
    return walls.positions_A[0] + margin, walls.positions_A[1] - margin


def wrapped_between_walls(scene: MolecularScene, space: Space, position: np.ndarray) -> np.ndarray:
    """Positions (n, 3) moved by whole edges to between the walls; unchanged without walls or box."""
    if not isinstance(space, Orthorhombic):
        return position
    moved = position.copy()
    for axis, edge in enumerate(space.edges):
        if (bounds := scene.fields.bounds(axis)) is not None:
            moved[:, axis] -= edge * np.rint((moved[:, axis] - sum(bounds) / 2) / edge)
    return moved


def describe_fields(scene: MolecularScene, terms: dict[str, NamedTuple]) -> dict[str, str]:
    """Description of each term of the fields, by its name."""
    fields, words = scene.fields, {}
    if "electric_field" in terms:
        words["electric_field"] = f"{_vector(not_none(fields.electric_V_per_nm))} V/nm"
        if fields.electric_frequency_per_ps is not None:
            words["electric_field"] += (
                f" cos(2 pi f t + {fields.electric_phase_deg:g}°), f = {fields.electric_frequency_per_ps:g}/ps; its "
                "work is booked"
            )
    if "gravity" in terms:
        words["gravity"] = f"{_vector(not_none(fields.gravity_m_s2))} m/s²"
    for k, walls in enumerate(fields.walls):
        lower, upper = walls.positions_A
        kind = (
            f"Lennard-Jones 9-3, sigma {walls.sigma_A:g} Å, epsilon {walls.epsilon_kJ_mol:g} kJ/mol, "
            + (f"cutoff {walls.cutoff_A:g} Å" if walls.cutoff_A else "no cutoff")
            if walls.kind == "lj93"
            else f"harmonic, {walls.stiffness_kJ_mol_A2:g} kJ/mol/Å²"
        )
        term = terms[f"walls_{k}"]
        assert isinstance(term, HarmonicWalls | LennardJonesWalls)
        what = "centres of mass" if walls.acts_on == "centres" else f"{len(term.sites.molecule)} sites"
        places = [f"{walls.axis} = {x:g} Å" for x in (lower, upper) if abs(x) < inf]
        words[f"walls_{k}"] = f"at {' and '.join(places)}, on {what}: {kind}"
    for k, entry in enumerate(fields.restraints):
        stiffness = sorted(set(entry.stiffness))
        size = f"{stiffness[0]:g}" if len(stiffness) == 1 else _vector(entry.stiffness)
        place = "where they start" if entry.position_A is None else f"at {_vector(entry.position_A)} Å"
        term = terms[f"restraints_{k}"]
        assert isinstance(term, Restraints)
        words[f"restraints_{k}"] = f"{len(term.molecule)} molecules held {place}, {size} kJ/mol/Å²"
    return words


def _vector(values: tuple[float, ...]) -> str:
    return f"({', '.join(f'{x:g}' for x in values)})"


def fields_left_out(terms: dict[str, NamedTuple]) -> list[str]:
    """Kinds of fields that the scene does not have."""
    kinds = {"electric_field": "electric field", "gravity": "gravity", "walls": "walls", "restraints": "restraints"}
    missing = [words for name, words in kinds.items() if not any(term.startswith(name) for term in terms)]
    return [f"{', '.join(missing)}: not asked for in [fields]"] if missing else []


def field_notes(scene: MolecularScene) -> list[str]:
    """Notes on these fields."""
    if scene.fields.walls and scene.forces.electrostatics in ("ewald", "pme"):
        return [
            f"fields.walls: {scene.forces.electrostatics} sums over the images beyond the walls too, so the layer "
            "between them feels its images across the empty part of the box; a longer box makes that weaker"
        ]
    return []
