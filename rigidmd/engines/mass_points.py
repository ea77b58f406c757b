"""Rigid molecules for engines without rigid bodies: mass points at constrained distances, and virtual sites.

Rigid bodies with the same mass, centre of mass and inertia move alike (textbook: equimomental systems). So 1, 2, 3 or 4
mass points represent a molecule for OpenMM and GROMACS, and every other site is a virtual site.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.scene.models import Molecule

#: A molecule is planar if its second moment across a plane is below this fraction of the largest one.
FLAT = 1e-13
#: A site is off the line or plane of the mass points beyond this fraction of the molecule's radius.
OFF = 1e-9
#: Relative difference of equal numbers, so that water is isosceles in spite of rounding.
SAME = 1e-12
#: The same for sides of triangles in OpenMM, which compares distances in single precision.
ISOSCELES = 1e-6
TRIANGLE = np.array([[0, 1, 0], [-sqrt(0.75), -0.5, 0], [sqrt(0.75), -0.5, 0]]) * sqrt(2)
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])


class VirtualSite(NamedTuple):
    """A site at sum(weight * point) + cross * (second - first) x (third - first)."""

    weight: np.ndarray  # (p,) with sum 1
    cross: float  # 1/Å; not 0 only for a site off the plane of three points


class MassPoints(NamedTuple):
    """The p points that represent a rigid molecule, and its virtual sites."""

    mass: np.ndarray  # (p,) u
    position_body: np.ndarray  # (p, 3) Å
    site: np.ndarray  # (p,) index of the site at the point; -1 without one
    virtual_sites: dict[int, VirtualSite]  # all sites that are not at mass points

    @property
    def distances(self) -> list[tuple[int, int, float]]:
        """All pairs of points and their distances, Å."""
        found: list[tuple[int, int, float]] = []
        for i in range(len(self.mass)):
            for j in range(i):
                d = float(np.linalg.norm(self.position_body[i] - self.position_body[j]))
                found.append((j, i, next((other for *_, other in found if abs(d - other) <= SAME * d), d)))
        return found

    def positions(self, point: np.ndarray) -> dict[int, np.ndarray]:
        """Positions of the virtual sites for points (p, 3)."""
        normal = np.cross(point[1] - point[0], point[2] - point[0]) if len(point) == 3 else np.zeros(3)
        return {k: site.weight @ point + site.cross * normal for k, site in self.virtual_sites.items()}


def mass_points(molecule: Molecule, frozen: bool = False, sites: bool = True) -> MassPoints:
    """The mass points of a molecule; all its sites if it is frozen. `sites`: whether sites may be the points if just
    enough of them have mass."""
    if frozen:
        return MassPoints(molecule.masses, molecule.positions_body, np.arange(len(molecule.masses)), {})
    mass, position, site = _points(molecule, sites)
    others = [k for k in range(len(molecule.masses)) if k not in site]
    limit = OFF * molecule.radius
    return MassPoints(
        mass, position, site, {k: _virtual_site(position, molecule.positions_body[k], limit) for k in others}
    )


def _points(molecule: Molecule, sites: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses, positions and sites of the points: the sites if just enough of them have mass, else a simplex."""
    heavy = np.flatnonzero(molecule.masses > 0)
    total, inertia = molecule.mass, molecule.inertia
    second = np.maximum(inertia.sum() / 2 - inertia, 0.0)  # sum of m x² along each axis
    if not inertia.any():
        return np.array([total]), np.zeros((1, 3)), heavy[:1]
    if sites and _can_be_points(molecule, heavy):
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


def _can_be_points(molecule: Molecule, heavy: np.ndarray) -> bool:
    """Whether the sites with mass can be the points. The sites of HDO cannot: SETTLE, by which OpenMM and GROMACS
    constrain isosceles triangles, assumes equal masses at the base, and OpenMM's then gives NaN."""
    if molecule.kind == "linear" or len(heavy) != 3:
        return molecule.kind == "linear" and len(heavy) == 2
    mass, where = molecule.masses[heavy], molecule.positions_body[heavy]
    side = [float(np.linalg.norm(where[k - 1] - where[k - 2])) for k in range(3)]  # opposite to point k
    return all(
        abs(side[k - 1] - side[k - 2]) > ISOSCELES * side[k - 1] or abs(mass[k - 1] - mass[k - 2]) <= SAME * mass[k - 1]
        for k in range(3)
    )


def _virtual_site(points: np.ndarray, where: np.ndarray, limit: float) -> VirtualSite:
    if len(points) == 1:
        return VirtualSite(np.ones(1), 0.0)
    edges = (points[1:] - points[0]).T
    weight = np.linalg.lstsq(edges, where - points[0], rcond=None)[0]
    cross = 0.0
    if len(points) == 3:
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        height = float((where - points[0]) @ normal) / float(np.linalg.norm(normal))
        cross = height / float(np.linalg.norm(normal)) if abs(height) > limit else 0.0
    return VirtualSite(np.append(1 - weight.sum(), weight), cross)
