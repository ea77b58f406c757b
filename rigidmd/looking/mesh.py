"""The surface of a single body, to be drawn: its solid, its points joined, or the cuboid of the same inertia."""

from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.body import BodySystem
from rigidmd.assemble.body_parts import inertia_of, principal
from rigidmd.mechanics.inertia import shifted
from rigidmd.mechanics.rotation import direction
from rigidmd.mechanics.solids import SOLIDS

#: Corners of a circle; a body that has no thickness gets this share of its reach.
ROUND, THIN = 24, 0.02


class Mesh(NamedTuple):
    """Flat faces in the body's axes, from the pivot or the centre of mass, m."""

    vertices: np.ndarray  # (v, 3)
    faces: list[list[int]]  # corners of each face, in order, seen from outside counterclockwise
    painted: list[bool]  # which faces show how the body turns
    about: str  # what it is, in words

    @property
    def reach(self) -> float:
        """The largest distance of a vertex from the origin, m."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def edges(self) -> list[tuple[int, int]]:
        """Pairs of vertices that a face joins."""
        sides = {tuple(sorted(side)) for face in self.faces for side in pairwise([*face, face[0]])}
        return sorted(sides)  # pyright: ignore[reportReturnType]


def mesh_of(system: BodySystem) -> Mesh:
    """The surface of a body."""
    table, scene = system.scene.body, system.scene
    mass, tensor, centre, _, _ = inertia_of(scene)
    if table.points is not None:
        places = np.array([p.position_m for p in table.points])
        masses = np.array([p.mass_kg for p in table.points])
        return _of_points(places if table.pinned else places - masses @ places / mass, masses)
    if table.solid is not None:
        shape = SOLIDS[table.solid.shape]
        stretch = np.zeros(3)
        for name, axes in shape.dimensions.items():
            stretch[axes] = table.solid.dimensions[name]
        stretch = np.maximum(stretch, THIN * stretch.max())
        unit = UNITS.get(table.solid.shape, _ball)()
        return Mesh(
            unit.vertices * stretch + centre,
            unit.faces,
            unit.painted,
            _with_article(table.solid.shape),
        )
    if scene.changing_inertia is not None:
        tensor = np.diag(system.inertia)
    if table.pinned:
        tensor = shifted(tensor, -mass, centre)
    return _equal_cuboid(mass, tensor, centre)


def _with_article(shape: str) -> str:
    return f"an {shape}" if shape[0] in "aeiou" else f"a {shape}"


def _equal_cuboid(mass: float, tensor: np.ndarray, centre: np.ndarray) -> Mesh:
    """The homogeneous cuboid of this mass and inertia about its centre; a ball for a point."""
    if not tensor.any():
        unit = _ball()
        return Mesh(unit.vertices, unit.faces, unit.painted, "a ball, as it is a point")
    moments, axes = principal(tensor)
    lengths = np.sqrt(np.maximum(6 / mass * (moments.sum() - 2 * moments), 0.0))
    lengths = np.maximum(lengths, THIN * lengths.max())
    unit = _cuboid()
    told = "the cuboid of the same mass and inertia"
    return Mesh((unit.vertices * lengths) @ axes.T + centre, unit.faces, unit.painted, told)


def _of_points(places: np.ndarray, masses: np.ndarray) -> Mesh:
    """Balls at the points, as large as their masses tell, and rods between the nearest of them."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import cdist

    far = cdist(places, places)
    size = max(far.max(), np.linalg.norm(places, axis=1).max())
    parts = []
    for place, mass in zip(places, masses, strict=True):
        unit = _ball()
        radius = 0.09 * size * (mass / masses.max()) ** (1 / 3) if size > 0 else 1.0
        parts.append((unit.vertices * max(radius, 0.02 * size) + place, unit))
    tree = minimum_spanning_tree(far).tocoo()
    for i, j in zip(tree.row, tree.col, strict=True):
        unit, along = _cylinder(), places[j] - places[i]
        right = direction(np.cross(along, np.eye(3)[np.abs(along).argmin()]))
        frame = np.stack([0.02 * size * right, 0.02 * size * direction(np.cross(along, right)), along])
        parts.append((unit.vertices @ frame + (places[i] + places[j]) / 2, unit._replace(painted=[False] * 99)))
    faces, painted, start = [], [], 0
    for vertices, unit in parts:
        faces += [[start + corner for corner in face] for face in unit.faces]
        painted += unit.painted[: len(unit.faces)]
        start += len(vertices)
    return Mesh(np.concatenate([vertices for vertices, _ in parts]), faces, painted, "its points, joined")


def _stack(rings: list[tuple[float, float]]) -> Mesh:
    """A solid of revolution about axis 3 from circles (radius, z), from below; a quarter of its side is painted."""
    angle = 2 * np.pi * np.arange(ROUND) / ROUND
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([np.column_stack([r * circle, np.full(ROUND, z)]) for r, z in rings])
    faces, painted = [], []
    for k in range(len(rings) - 1):
        for i in range(ROUND):
            j = (i + 1) % ROUND
            faces.append([k * ROUND + i, k * ROUND + j, (k + 1) * ROUND + j, (k + 1) * ROUND + i])
            painted.append(i < ROUND // 4)
    for k, order in ((0, -1), (len(rings) - 1, 1)):
        if rings[k][0] > 0:
            ends = list(range(k * ROUND, (k + 1) * ROUND))
            wedge = ends[: ROUND // 4 + 1]
            middle = len(vertices)
            vertices = np.vstack([vertices, [0.0, 0.0, rings[k][1]]])
            faces += [[middle, *wedge][::order], [middle, *ends[ROUND // 4 :], ends[0]][::order]]
            painted += [True, False]
    return Mesh(vertices, faces, painted, "")


def _ball() -> Mesh:
    polar = np.linspace(np.pi, 0, 13)
    return _stack([(np.sin(a), np.cos(a)) for a in polar])


def _cylinder() -> Mesh:
    return _stack([(1.0, -0.5), (1.0, 0.5)])


def _cone() -> Mesh:
    return _stack([(0.0, -0.75), (1.0, 0.25)])


def _rod() -> Mesh:
    return _stack([(0.5, -0.5), (0.5, 0.5)])


def _ring() -> Mesh:
    """A ring of unit radius about axis 3, as a tube whose thickness the body's own, THIN, sets along axis 3."""
    turn = np.linspace(0, 2 * np.pi, 9)[:-1]
    tube = _stack([(1 + 0.06 * np.cos(a), 0.5 * np.sin(a)) for a in [*turn, turn[0]]])
    sides = ROUND * (len(turn))
    return Mesh(tube.vertices, tube.faces[:sides], tube.painted[:sides], "")


def _cuboid() -> Mesh:
    vertices = np.array(list(product([-0.5, 0.5], repeat=3)))
    faces = [[4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1], [1, 5, 7, 3], [0, 2, 6, 4]]
    return Mesh(vertices, faces, [True] + [False] * 5, "")


#: Surfaces of unit size, as `SOLIDS` has them; a sphere and an ellipsoid are balls.
UNITS = {"cylinder": _cylinder, "disk": _cylinder, "cone": _cone, "rod": _rod, "ring": _ring, "cuboid": _cuboid}
