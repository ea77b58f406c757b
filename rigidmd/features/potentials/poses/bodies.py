"""The bodies on which the potentials of two bodies of a system act."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.features.potentials.poses.potential import BodyPairPotential
from rigidmd.scene.models import Molecule


class BodiesOfPotential(NamedTuple):
    """The bodies of a species with a potential."""

    name: str  # of the potential in the system
    potential: BodyPairPotential
    species: Molecule
    molecule: np.ndarray  # (k,)

    @property
    def reference(self) -> np.ndarray:
        """The reference point (3,) from the centre of mass, body frame, Å."""
        return reference_of(self.potential, self.species)

    @property
    def frame(self) -> np.ndarray:
        """(3, 3) from the coordinates of the model's file to the body frame."""
        return self.species.axes.T


def reference_of(potential: BodyPairPotential, species: Molecule) -> np.ndarray:
    """The reference point (3,) of a species from its centre of mass, body frame, Å."""
    point = potential.references.get(species.name, species.centre)
    return (np.array(point) - species.centre) @ species.axes


def bodies_of_potentials(system: System) -> list[BodiesOfPotential]:
    """All bodies with potentials of two bodies, by potential and species."""
    names = np.array([molecule.name for molecule in system.species])
    bodies = []
    for name, potential in body_pairs_of(system).items():
        for molecule in {molecule.name: molecule for molecule in system.species}.values():
            members = np.flatnonzero((names == molecule.name)[system.model.species])
            if potential.acts_on(molecule.name) and len(members):
                bodies.append(BodiesOfPotential(name, potential, molecule, members))
    return bodies
