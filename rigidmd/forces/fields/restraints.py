"""Harmonic restraints that hold the centres of mass of some molecules at reference positions in the
lab."""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.plain_text import vector_text
from rigidmd.core.state import OK
from rigidmd.forces.fields.distances import DistanceRestraint, distance_restraint
from rigidmd.forces.parts import SystemParts, select_by_number
from rigidmd.forces.terms import add_forces
from rigidmd.scene.fields import Restraint
from rigidmd.units import KJ_PER_MOL


class Restraints(NamedTuple):
    """U = sum over restrained molecules and axes of stiffness/2 (R - reference)². R is never
    wrapped."""

    molecule: np.ndarray  # (r,) int64, each once
    reference: np.ndarray  # (r, 3) lab frame, Å
    stiffness: np.ndarray  # (3,) along x, y, z, u/ps²

    absolute_positions = True

    @property
    def changes_momentum(self) -> np.ndarray:
        """Components (3,) of the total momentum that they change."""
        return self.stiffness != 0


def term(
    parts: SystemParts, entry: Restraint, where: str, errors: list[str]
) -> "Restraints | DistanceRestraint | None":
    """The term of one of fields.restraints."""
    if entry.between is not None:
        return distance_restraint(parts, entry, where, errors)
    index = parts.model.species
    names = list(dict.fromkeys(m.name for m in parts.species))
    name = entry.species or names[0]
    of_species = np.array([m.name == name for m in parts.species])[index]
    wrong = (
        f" is required: there are {', '.join(names)}"
        if entry.species is None and len(names) > 1
        else f": there is no {name!r}; there are {', '.join(names)}"
        if name not in names
        else f": the structure file has no {name}"
        if not of_species.any()
        else ""
    )
    if wrong:
        errors.append(f"{where}.species{wrong}")
        return None
    moves = parts.moves[index]
    restrained = of_species & moves if entry.molecules is None else np.zeros(len(moves), bool)
    for numbers, mask, error in select_by_number(entry.spans, name, of_species, parts.number):
        if error:
            errors.append(f"{where}.molecules: {error}")
        elif not moves[mask].all():
            errors.append(
                f"{where}.molecules: {numbers} includes frozen molecules, which do not move"
            )
        restrained |= mask
    if not restrained.any():
        if entry.molecules is None:
            errors.append(f"{where} would have no effect: all {name} are frozen")
        return None
    molecule = np.flatnonzero(restrained)
    position = (
        parts.state.position[molecule]
        if entry.position_A is None
        else [entry.position_A] * len(molecule)
    )
    return Restraints(molecule, np.array(position, float), np.array(entry.stiffness) * KJ_PER_MOL)


def sentence(entry: Restraint, term: Restraints) -> str:
    """What `rigidmd check` prints of it."""
    if entry.between is not None:
        one, other = (_text_of_group(group) for group in entry.groups)
        spring = f"restrained to {entry.distance_A:g} Å, {entry.stiffness[0]:g} kJ/mol/Å²"
        return f"distance of {one} and {other} {spring}"
    stiffness = entry.stiffness
    size = f"{stiffness[0]:g}" if len(set(stiffness)) == 1 else vector_text(stiffness)
    if entry.position_A is None:
        where = "to their starting positions"
    else:
        where = f"to {vector_text(entry.position_A)} Å"
    return f"{len(term.molecule)} molecules restrained {where}, {size} kJ/mol/Å²"


def _text_of_group(group: list[int]) -> str:
    """A group of molecules, for messages."""
    if len(group) == 1:
        return f"molecule {group[0]}"
    return f"the centre of {len(group)} molecules ({group[0]}, ...)"


@implements(add_forces, Restraints)
def _add_restraints(term, state, load, tally):
    for r in range(len(term.molecule)):
        m = term.molecule[r]
        for k in range(3):
            away = state.position[m, k] - term.reference[r, k]
            load.force[m, k] -= term.stiffness[k] * away
            if tally is not None:
                tally[0] += 0.5 * term.stiffness[k] * away * away
    return OK
