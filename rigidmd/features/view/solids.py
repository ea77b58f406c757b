"""Molecules as solids: ellipsoids and spheres, where a feature gives them shapes."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.features import providers
from rigidmd.features.view.molecule_figure import color_of
from rigidmd.formats.bonds import COVALENT
from rigidmd.run.rigid_fit import Bodies

#: Colours of ellipsoids along x, y and z; in between they are mixed.
DIRECTIONS = np.array([[0.80, 0.32, 0.22], [0.20, 0.60, 0.36], [0.20, 0.42, 0.76]])
#: Radius of a sphere in covalent radii, by which bonded spheres touch; default radius, Å.
SPHERE_SCALE, DEFAULT_RADIUS = 1.15, 1.2


class Solids(NamedTuple):
    """Ellipsoids (s,), each fixed in a molecule, with the axis of symmetry as their third one."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3) from the centre of mass, Å
    frame: np.ndarray  # (s, 3, 3) from the axes of the ellipsoid to the body frame
    semi_axes: np.ndarray  # (s, 3) Å
    color: np.ndarray  # (s, 3) 0 to 1; NaN for one by the direction of its axis

    def poses(self, bodies: Bodies) -> tuple[np.ndarray, np.ndarray]:
        """Centres (s, 3) and rotations (s, 3, 3) from the axes of the ellipsoids to the lab."""
        Q = bodies.Q[self.molecule]
        arms = np.einsum("sij,sj->si", Q, self.offset_body)
        return bodies.position[self.molecule] + arms, Q @ self.frame

    def colors(self, rotation: np.ndarray) -> np.ndarray:
        """Colours (s, 3) at rotations (s, 3, 3)."""
        of_direction = rotation[:, :, 2] ** 2 @ DIRECTIONS
        return np.where(np.isnan(self.color), of_direction, self.color)


def sphere_radius(element: str) -> float:
    """The radius, Å, of the sphere of an element."""
    return SPHERE_SCALE * COVALENT.get(element, 0.0) or DEFAULT_RADIUS


def solids_of(system: System) -> Solids | None:
    """The solids of a system, and its other sites with mass as spheres; None if no potential has a
    shape."""
    rows: list[tuple] = []
    drawn: set[str] = set()
    for feature in providers("shapes"):
        for name, shapes in feature.shapes(system):
            drawn.add(name)
            rows += shapes
    if not rows:
        return None
    sites = system.sites
    for s in np.flatnonzero(sites.mass > 0).tolist():
        species = system.species[system.model.species[sites.molecule[s]]]
        if species.name not in drawn:
            element = str(sites.element[s])
            place = (sites.molecule[s], sites.offset_body[s], np.eye(3))
            rows.append((*place, [sphere_radius(element)] * 3, color_of(element)))
    return Solids(*(np.array(column) for column in zip(*rows, strict=True)))
