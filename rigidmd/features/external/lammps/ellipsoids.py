"""Gay-Berne potentials in LAMMPS: each body gets an atom at its reference point, an ellipsoid
without mass, which is fixed in it as its sites are."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.features.external.force_field import ForceFieldView
from rigidmd.features.external.rigid_bodies import Points
from rigidmd.features.potentials.poses.bodies import bodies_of_potentials
from rigidmd.features.potentials.poses.potential import BodyPairPotential


class Ellipsoids(NamedTuple):
    """The ellipsoids of a species in a potential: one type of atoms, k of them."""

    potential: str  # name of the term
    species: str
    molecule: np.ndarray  # (k,)
    offset_body: np.ndarray  # (3,) from the centre of mass, Å
    frame: np.ndarray  # (3, 3) from the axes of the ellipsoid to the body frame
    diameters: np.ndarray  # (3,) Å
    wells: np.ndarray  # (3,) relative depths

    @property
    def name(self) -> str:
        return f"{self.species}.{self.potential}"


def limits(potential: BodyPairPotential, system: System) -> Iterator[str]:
    """Messages on what LAMMPS lacks of a Gay-Berne potential."""
    if potential.truncation != "plain":
        why = "LAMMPS' gayberne has plain"
        yield f"truncation = {potential.truncation!r}: {why}"
    for pair, values in potential.pairs.items():
        if other := [key for key in values if key != "epsilon_kJ_mol"]:
            why = "LAMMPS has shapes and wells of species, and epsilon_kJ_mol of pairs"
            yield f"{other[0]} of the pair {', '.join(pair)}: {why}"
    for molecule in system.species:
        if molecule.name in potential.parameters and not molecule.inertia.any():
            yield f"{molecule.name} does not rotate: LAMMPS has ellipsoids on bodies that do"


def ellipsoids(view: ForceFieldView) -> list[Ellipsoids]:
    """All ellipsoids of a system."""
    kinds = []
    for bodies in bodies_of_potentials(view.system):
        values = bodies.potential.parameters[bodies.species.name]
        along = np.arange(3) == "xyz".index(str(bodies.potential.axis))
        kinds.append(
            Ellipsoids(
                bodies.name,
                bodies.species.name,
                bodies.molecule,
                bodies.reference,
                bodies.frame,
                np.where(along, values["length_A"], values["width_A"]),
                np.where(along, values["end"], values["side"]),
            )
        )
    return kinds


def atoms(view: ForceFieldView) -> Points:
    """The sites of a system, and behind them its ellipsoids."""
    sites = view.system.sites
    added = ellipsoids(view)
    count = sum(len(kind.molecule) for kind in added)
    offsets = [np.tile(kind.offset_body, (len(kind.molecule), 1)) for kind in added]
    return Points(
        np.concatenate([sites.molecule, *(kind.molecule for kind in added)]),
        np.concatenate([sites.offset_body, *offsets]),
        np.append(sites.mass, np.zeros(count)),
    )


def orientations(view: ForceFieldView, state: State) -> np.ndarray:
    """Quaternions wxyz of the ellipsoids (k, 4)."""
    matrices = [state.rotation[kind.molecule] @ kind.frame for kind in ellipsoids(view)]
    return Rotation.from_matrix(np.concatenate(matrices)).as_quat(scalar_first=True)
