"""Rigid molecules for engines that know only points, distances that are kept, and sites that follow points.

A rigid body moves as any other with its mass, centre and inertia does (textbook: equimomental systems). So 1, 2, 3 or 4
mass points stand for it, and every other site is placed by those.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.scene.models import Molecule

#: A distribution whose second moment across a plane is less than this part of the largest one is planar: its inertia
#: is that of the plane to rounding.
FLAT = 1e-13
#: A site further than this part of a molecule's radius from the line or plane of its mass points is off it.
OFF = 1e-9
#: Two numbers that differ by less than this part are the same: then water is isosceles whatever rounding did.
SAME = 1e-12
#: OpenMM compares distances in single precision.
ISOSCELES = 1e-6
TRIANGLE = np.array([[0, 1, 0], [-sqrt(0.75), -0.5, 0], [sqrt(0.75), -0.5, 0]]) * sqrt(2)
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


class Place(NamedTuple):
    """Where a site is: sum of weight times point, and cross times (second - first) x (third - first)."""

    weight: np.ndarray  # (p,) their sum is 1
    cross: float  # 1/Å; 0 unless the site is off the plane of three points


class MassPoints(NamedTuple):
    """The p points that stand for a rigid molecule, and where its other sites are."""

    mass: np.ndarray  # (p,) u
    position_body: np.ndarray  # (p, 3) Å
    site: np.ndarray  # (p,) the site that a point is; -1 for none
    placed: dict[int, Place]  # of all sites that are no mass points

    @property
    def distances(self) -> list[tuple[int, int, float]]:
        """Pairs of points and their distances, Å, which together make a rigid body."""
        found: list[tuple[int, int, float]] = []
        for i in range(len(self.mass)):
            for j in range(i):
                d = float(np.linalg.norm(self.position_body[i] - self.position_body[j]))
                found.append((j, i, next((other for *_, other in found if abs(d - other) <= SAME * d), d)))
        return found

    def positions(self, point: np.ndarray) -> dict[int, np.ndarray]:
        """Positions of the placed sites for points (p, 3)."""
        normal = np.cross(point[1] - point[0], point[2] - point[0]) if len(point) == 3 else np.zeros(3)
        return {site: place.weight @ point + place.cross * normal for site, place in self.placed.items()}


def mass_points(molecule: Molecule, frozen: bool = False, sites: bool = True) -> MassPoints:
    """The points for a molecule; all its sites where it is frozen, which nothing moves.

    sites : whether its sites may be the points, where just enough of them have mass
    """
    if frozen:
        every = np.arange(len(molecule.masses))
        return MassPoints(molecule.masses, molecule.positions_body, every, {})
    mass, position, site = _points(molecule, sites)
    others = [k for k in range(len(molecule.masses)) if k not in site]
    limit = OFF * molecule.radius
    return MassPoints(mass, position, site, {k: _place(position, molecule.positions_body[k], limit) for k in others})


def _points(molecule: Molecule, sites: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses, positions and sites of the points: sites themselves if just enough have mass, else a simplex."""
    heavy = np.flatnonzero(molecule.masses > 0)
    total, inertia = molecule.mass, molecule.inertia
    second = np.maximum(inertia.sum() / 2 - inertia, 0.0)  # sum of m x² along each axis
    if not inertia.any():
        return np.array([total]), np.zeros((1, 3)), heavy[:1]
    if sites and _serve(molecule, heavy):
        return molecule.masses[heavy], molecule.positions_body[heavy], heavy
    reach = np.sqrt(second / total)
    if molecule.kind == "linear":
        points = np.array([[-1.0, 0, 0], [1, 0, 0]])
        reach[1:] = 0.0
    elif second.min() <= FLAT * second.max():
        points = np.zeros((3, 3))
        across = int(second.argmin())
        points[:, [k for k in range(3) if k != across]] = TRIANGLE[:, :2]
    else:
        points = TETRAHEDRON
    count = len(points)
    return np.full(count, total / count), points * reach, np.full(count, -1)


def _serve(molecule: Molecule, heavy: np.ndarray) -> bool:
    """Whether the sites with mass are themselves the points. HDO's are not: SETTLE, by which OpenMM and GROMACS keep
    isosceles triangles, takes the two masses of the base for equal, and OpenMM's then ends in numbers that are none."""
    if molecule.kind == "linear" or len(heavy) != 3:
        return molecule.kind == "linear" and len(heavy) == 2
    mass, where = molecule.masses[heavy], molecule.positions_body[heavy]
    side = [float(np.linalg.norm(where[k - 1] - where[k - 2])) for k in range(3)]  # opposite to point k
    return all(
        abs(side[k - 1] - side[k - 2]) > ISOSCELES * side[k - 1] or abs(mass[k - 1] - mass[k - 2]) <= SAME * mass[k - 1]
        for k in range(3)
    )


def _place(points: np.ndarray, where: np.ndarray, limit: float) -> Place:
    """How points (p, 3) place a site at `where` (3,)."""
    if len(points) == 1:
        return Place(np.ones(1), 0.0)
    edges = (points[1:] - points[0]).T
    part = np.linalg.lstsq(edges, where - points[0], rcond=None)[0]
    cross = 0.0
    if len(points) == 3:
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        height = float((where - points[0]) @ normal) / float(np.linalg.norm(normal))
        cross = height / float(np.linalg.norm(normal)) if abs(height) > limit else 0.0
    return Place(np.append(1 - part.sum(), part), cross)
