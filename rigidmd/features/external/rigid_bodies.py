"""Rigid bodies for external engines, which give positions, velocities and forces of sites or mass
points.

For engines without rigid bodies, molecules are mass points at constrained distances, and virtual
sites. Rigid bodies with the same mass, centre of mass and inertia move alike (textbook:
equimomental systems). So 1, 2, 3 or 4 mass points represent a molecule for OpenMM and GROMACS, and
every other site is a virtual site.
"""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.engines.system import System
from rigidmd.mechanics.rotation import hat, nearest_rotation
from rigidmd.scene.models import Molecule


class Points(NamedTuple):
    """Points that represent the molecules of a system, each fixed in a molecule."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3) from the centre of mass, Å
    mass: np.ndarray  # (s,) u


class RigidBodies:
    """Converts states and loads between bodies and their sites, or other points with the same mass
    and centre."""

    def __init__(self, system: System, points: Points | None = None):
        model = system.model
        sites = system.sites if points is None else points
        self._inverse = model.inverse_inertia[model.species]
        self._molecule, self._body, self._weight = sites.molecule, sites.offset_body, sites.mass
        self._count = len(model.species)
        self._mass = model.mass[model.species]
        self._inertia = model.inertia[model.species]
        self._frozen = (model.inverse_mass == 0)[model.species]
        spread = np.zeros((self._count, 3, 3))
        np.add.at(spread, self._molecule, np.einsum("si,sj->sij", self._body, self._body))
        extent = np.linalg.norm(np.linalg.eigvalsh(spread), axis=1)
        # a linear body has one moment of inertia that is 0, a point has no extent
        self._linear = (self._inertia == 0).any(axis=1) & (extent > 0)
        self._has_no_rotation = self._frozen | (extent == 0)

    def state(
        self, before: State, position: np.ndarray, velocity: np.ndarray, cell: np.ndarray
    ) -> State:
        """The state with sites (s, 3) at these positions, molecules whole and not wrapped. All else
        as in `before`. Frozen molecules do not move. The spin of a linear body about its axis has
        no meaning, so its rotation is the one nearest to `before`."""
        centre, drift = self._mean(position), self._mean(velocity)
        arm = position - centre[self._molecule]
        rotation, spin = before.rotation.copy(), before.angular_momentum_body.copy()
        if len(rotation):
            rotates = ~self._has_no_rotation
            rotation[rotates] = self._rotations(before.rotation, arm)[rotates]
            of_sites = np.cross(arm, velocity - drift[self._molecule]) * self._weight[:, None]
            spin[rotates] = np.einsum("nij,ni->nj", rotation, self._sum(of_sites))[rotates]
            spin[self._inertia == 0] = 0.0
        held = self._frozen[:, None]
        return before._replace(
            position=np.where(held, before.position, centre),
            velocity=np.where(held, before.velocity, drift),
            rotation=np.ascontiguousarray(rotation),
            angular_momentum_body=spin,
            cell=np.ascontiguousarray(cell),
        )

    def points(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (s, 3) of the sites, lab frame."""
        centre, drift = state.position[self._molecule], state.velocity[self._molecule]
        if not len(state.rotation):
            return centre + self._body, drift
        arm = np.einsum("sij,sj->si", state.rotation[self._molecule], self._body)
        omega = np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body * self._inverse)
        return centre + arm, drift + np.cross(omega[self._molecule], arm)

    def load(
        self,
        state: State,
        position: np.ndarray,
        force: np.ndarray,
        torque: np.ndarray | None = None,
    ) -> Load:
        """Forces and torques on bodies from forces, and torques if there are any, on sites
        (s, 3)."""
        arm = position - self._mean(position)[self._molecule]
        if not len(state.rotation):
            return Load(self._sum(force), np.zeros((0, 3)))
        moment = np.cross(arm, force) + (0.0 if torque is None else torque)
        return Load(self._sum(force), np.einsum("nij,ni->nj", state.rotation, self._sum(moment)))

    def intramolecular_virial(self, position: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Sum (3, 3) of F (x) d, d from the centre of mass. The atomic virial less this is the
        molecular one."""
        return force.T @ (position - self._mean(position)[self._molecule])

    def _sum(self, of_sites: np.ndarray) -> np.ndarray:
        return np.stack(
            [np.bincount(self._molecule, part, self._count) for part in of_sites.T], axis=1
        )

    def _mean(self, of_sites: np.ndarray) -> np.ndarray:
        return self._sum(of_sites * self._weight[:, None]) / self._mass[:, None]

    def _rotations(self, before: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Rotations (n, 3, 3) that bring the body-frame offsets nearest to the offsets (s, 3) in
        the lab."""
        products = np.einsum("si,sj->sij", arm, self._body).reshape(-1, 9)
        rotation = nearest_rotation(self._sum(products).reshape(-1, 3, 3))
        if (line := self._linear).any():
            axis_body = (self._inertia[line] == 0).astype(float)
            rotation[line] = _tilted(
                before[line],
                *(np.einsum("nij,nj->ni", q[line], axis_body) for q in (before, rotation)),
            )
        return rotation


def _tilted(rotation: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Rotations followed by the shortest ones that bring unit vectors old (n, 3) to new (n, 3).

    Source: Rodrigues' formula, about the cross product. For more than a right angle it follows a
    rotation by 180° about a perpendicular axis, so that opposite vectors are no exception. The
    result is made orthogonal, or rounding would grow from call to call.
    """
    across = np.cross(old, np.eye(3)[np.abs(old).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    back = (np.einsum("ni,ni->n", old, new) < 0)[:, None]
    by_180 = np.where(
        back[:, None], 2 * np.einsum("ni,nj->nij", across, across) - np.eye(3), np.eye(3)
    )
    old = np.where(back, -old, old)
    cross = hat(np.cross(old, new))
    cosine = np.einsum("ni,ni->n", old, new)
    step = np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]
    return nearest_rotation(step @ by_180 @ rotation)


#: A molecule is planar if its second moment across a plane is below this fraction of the largest
#: one.
FLAT = 1e-13
#: A site is off the line or plane of the mass points beyond this fraction of the molecule's radius.
OFF = 1e-9
#: Relative difference of equal numbers, so that water is isosceles in spite of rounding.
SAME = 1e-12
#: The same for sides of triangles in OpenMM, which compares distances in single precision.
ISOSCELES = 1e-6
TRIANGLE = np.array([[0, 1], [-sqrt(0.75), -0.5], [sqrt(0.75), -0.5]]) * sqrt(2)
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
    def extra(self) -> int:
        """Number of points without a site."""
        return int((self.site < 0).sum())

    def particles(self, sites: int) -> tuple[np.ndarray, np.ndarray]:
        """The particle of each point (p,), and the masses of all particles: `sites` sites, then the
        other points."""
        at = np.where(self.site < 0, sites + np.cumsum(self.site < 0) - 1, self.site)
        mass = np.zeros(sites + self.extra)
        mass[at] = self.mass
        return at, mass

    @property
    def distances(self) -> list[tuple[int, int, float]]:
        """All pairs of points and their distances, Å."""
        distances: list[tuple[int, int, float]] = []
        for i in range(len(self.mass)):
            for j in range(i):
                d = float(np.linalg.norm(self.position_body[i] - self.position_body[j]))
                same = (other for *_, other in distances if abs(d - other) <= SAME * d)
                distances.append((j, i, next(same, d)))
        return distances


def mass_points(molecule: Molecule, *, frozen: bool = False, sites: bool = True) -> MassPoints:
    """The mass points of a molecule. All sites of a frozen one. `sites`: they may be sites, if
    enough have mass."""
    if frozen:
        return MassPoints(
            molecule.masses, molecule.positions_body, np.arange(len(molecule.masses)), {}
        )
    mass, position, site = _points(molecule, sites=sites)
    limit = OFF * molecule.radius
    others = np.setdiff1d(np.arange(len(molecule.masses)), site).tolist()
    virtual = {k: _virtual_site(position, molecule.positions_body[k], limit) for k in others}
    return MassPoints(mass, position, site, virtual)


def _points(molecule: Molecule, *, sites: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses, positions and sites of the points: the sites if just enough of them have mass, else a
    simplex."""
    heavy = np.flatnonzero(molecule.masses > 0)
    total = molecule.mass
    inertia = molecule.inertia
    if not inertia.any():
        return np.array([total]), np.zeros((1, 3)), heavy[:1]
    if sites and _can_be_points(molecule, heavy):
        return molecule.masses[heavy], molecule.positions_body[heavy], heavy
    second = np.maximum(inertia.sum() / 2 - inertia, 0.0)  # sum of m x² along each axis
    reach = np.sqrt(second / total)
    if molecule.kind == "linear":
        points = np.array([[-1.0, 0, 0], [1, 0, 0]])
        reach[1:] = 0.0
    elif second.min() <= FLAT * second.max():
        points = np.insert(TRIANGLE, int(second.argmin()), 0.0, axis=1)
    else:
        points = TETRAHEDRON
    count = len(points)
    return np.full(count, total / count), points * reach, np.full(count, -1)


def _can_be_points(molecule: Molecule, heavy: np.ndarray) -> bool:
    """Whether the sites with mass can be the points. The sites of HDO cannot: SETTLE, by which
    OpenMM and GROMACS constrain isosceles triangles, assumes equal masses at the base, and OpenMM's
    then gives NaN."""
    if molecule.kind == "linear" or len(heavy) != 3:
        return molecule.kind == "linear" and len(heavy) == 2
    mass, where = molecule.masses[heavy], molecule.positions_body[heavy]
    # opposite to point k
    side = [float(np.linalg.norm(where[k - 1] - where[k - 2])) for k in range(3)]
    return all(
        abs(side[k - 1] - side[k - 2]) > ISOSCELES * side[k - 1]
        or abs(mass[k - 1] - mass[k - 2]) <= SAME * mass[k - 1]
        for k in range(3)
    )


def _virtual_site(points: np.ndarray, where: np.ndarray, limit: float) -> VirtualSite:
    if len(points) == 1:
        return VirtualSite(np.ones(1), 0.0)
    weight = np.linalg.lstsq((points[1:] - points[0]).T, where - points[0], rcond=None)[0]
    cross = 0.0
    if len(points) == 3:
        normal = np.cross(points[1] - points[0], points[2] - points[0])
        length = float(np.linalg.norm(normal))
        height = float((where - points[0]) @ normal) / length
        cross = height / length if abs(height) > limit else 0.0
    return VirtualSite(np.append(1 - weight.sum(), weight), cross)
