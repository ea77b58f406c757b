"""A uniform gravitational field on molecules."""

from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.core.plain_text import vector_text
from rigidmd.core.state import OK
from rigidmd.forces.parts import SystemParts
from rigidmd.forces.terms import add_forces
from rigidmd.scene.fields import Fields
from rigidmd.scene.validation import not_none
from rigidmd.units import METRE_PER_S2


class Gravity(NamedTuple):
    """U = -sum m g . R: the force m g at each centre of mass R, which is never wrapped."""

    species: np.ndarray  # (n,) int32
    mass: np.ndarray  # (species,) u; 0 for a frozen species
    acceleration: np.ndarray  # (3,) lab frame, Å/ps²

    absolute_positions = True

    @property
    def changes_momentum(self) -> np.ndarray:
        """Components (3,) of the total momentum that it changes."""
        return self.acceleration != 0


def term(parts: SystemParts, fields: Fields, where: str, errors: list[str]) -> Gravity | None:
    """The term of fields.gravity_m_s2."""
    if not any(fields.gravity_m_s2 or ()):
        return None
    mass = np.where(parts.moves, parts.model.mass, 0.0)
    return Gravity(parts.model.species, mass, np.array(fields.gravity_m_s2) * METRE_PER_S2)


def sentence(fields: Fields, term: object) -> str:
    """What `rigidmd check` prints of it."""
    return f"{vector_text(not_none(fields.gravity_m_s2))} m/s²"


@implements(add_forces, Gravity)
def _add_weight(term, state, load, tally):
    for m in range(len(state.position)):
        mass = term.mass[term.species[m]]
        for k in range(3):
            load.force[m, k] += mass * term.acceleration[k]
            if tally is not None:
                tally[0] -= mass * term.acceleration[k] * state.position[m, k]
    return OK
