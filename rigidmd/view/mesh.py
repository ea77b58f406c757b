"""The surface of a single body for drawings: its solid, its points joined by rods, or a solid of the same inertia."""

from functools import partial
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.body_parts import inertia_at_centre, inertia_of, principal
from rigidmd.engines.body_system import BodySystem
from rigidmd.mechanics.rotation import unit_vector
from rigidmd.mechanics.solids import SOLIDS
from rigidmd.scene.body import EQUAL_MOMENTS, Solid, axis_of_symmetry

#: Corners of a circle; least thickness of a body, as a fraction of its reach.
CIRCLE_CORNERS, MIN_THICKNESS = 24, 0.02
#: Edges of a cuboid in half axes of the ellipsoid of the same inertia; thickness of a stem in its length.
CUBOID_EDGES, STEM_THICKNESS = (12 / 5) ** 0.5, 0.06
EQUAL = "of the same mass and inertia"


class Mesh(NamedTuple):
    """Flat faces in the body's axes, from the pivot or the centre of mass, m."""

    vertices: np.ndarray  # (v, 3)
    faces: list[list[int]]  # corners of each face, in order, seen from outside counterclockwise
    painted: list[bool]  # which faces have a second colour, to show rotation
    about: str  # description
    stem: bool = False  # whether it reaches to the pivot

    @property
    def reach(self) -> float:
        """The largest distance of a vertex from the origin, m."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    @property
    def edges(self) -> list[tuple[int, int]]:
        sides = {tuple(sorted(side)) for face in self.faces for side in pairwise([*face, face[0]])}
        return sorted(sides)  # pyright: ignore[reportReturnType]


def mesh_of(system: BodySystem) -> Mesh:
    """The surface of a body: as the scene asks for, its solid, its points joined, or a body of equal inertia."""
    table, scene = system.scene.body, system.scene
    mass, _, centre, _, _ = inertia_of(scene)
    wanted = scene.output.drawn_as
    if wanted is None and table.points is not None:
        positions = np.array([p.position_m for p in table.points])
        masses = np.array([p.mass_kg for p in table.points])
        return _points_mesh(positions if table.pinned else positions - masses @ positions / mass, masses)
    if isinstance(wanted, Solid):
        stands = wanted.shape == "cone" and table.pinned
        return _solid_mesh(wanted, np.array([0.0, 0.0, 0.75 * (wanted.height_m or 0.0)]) if stands else centre)
    if wanted is None and table.solid is not None:
        return _solid_mesh(table.solid, centre)
    return _equal_inertia_mesh(wanted, mass, inertia_at_centre(scene), centre, table.pinned)


def _solid_mesh(solid: Solid, position: np.ndarray) -> Mesh:
    size = np.zeros(3)
    for name, axes in SOLIDS[solid.shape].dimensions.items():
        size[axes] = solid.dimensions[name]
    size = np.maximum(size, MIN_THICKNESS * size.max())
    unit = UNITS.get(solid.shape, _ball)()
    article = "an" if solid.shape[0] in "aeiou" else "a"
    return Mesh(unit.vertices * size + position, unit.faces, unit.painted, f"{article} {solid.shape}")


def _equal_inertia_mesh(wanted: str | None, mass: float, tensor: np.ndarray, centre: np.ndarray, pinned: bool) -> Mesh:
    """A homogeneous body of this mass and inertia: a solid of revolution if two moments are equal, or else a cuboid."""
    if not tensor.any():
        unit = _ball()
        return Mesh(unit.vertices, unit.faces, unit.painted, "a ball, as it is a point")
    moments, axes = principal(tensor)
    symmetric = axis_of_symmetry(moments)
    if wanted in (None, "top") and symmetric is not None:
        return _top_mesh(mass, moments, axes, symmetric, centre, pinned)
    lengths = np.sqrt(np.maximum(2.5 / mass * (moments.sum() - 2 * moments), 0.0))  # half axes of the ellipsoid
    lengths, unit, shape = np.maximum(lengths, MIN_THICKNESS * lengths.max()), _ball(), "ellipsoid"
    if wanted != "ellipsoid":
        lengths, unit, shape = CUBOID_EDGES * lengths, _cuboid(), "cuboid"
    return Mesh((unit.vertices * lengths) @ axes.T + centre, unit.faces, unit.painted, f"the {shape} {EQUAL}")


def _top_mesh(
    mass: float, moments: np.ndarray, axes: np.ndarray, symmetric: int, centre: np.ndarray, pinned: bool
) -> Mesh:
    """The homogeneous cylinder, or ball, of these moments, on a stem if its pivot lies on the axis outside of it.

    A cylinder has m r²/2 about its axis and m (3 r² + h²)/12 about the others: there is one for any two moments.
    """
    along, across = moments[symmetric], moments[symmetric - 1]
    far = float(np.linalg.norm(centre))
    axis, right = axes[:, symmetric], axes[:, symmetric - 2]
    is_ball = bool(np.ptp(moments) <= EQUAL_MOMENTS * moments.max())
    if is_ball and far:
        axis = centre / far
        right = unit_vector(np.cross(np.eye(3)[np.abs(axis).argmin()], axis))
    elif axis @ centre < 0:
        axis = -axis
    if is_ball:
        radius = float(np.sqrt(2.5 * along / mass))
        half, rings = radius, [(radius * np.sin(a), radius * np.cos(a)) for a in np.linspace(np.pi, 0, 13)]
    else:
        radius, height = float(np.sqrt(2 * along / mass)), float(np.sqrt(max(12 * across - 6 * along, 0.0) / mass))
        radius, half = max(radius, MIN_THICKNESS * height), max(height, MIN_THICKNESS * 2 * radius) / 2
        rings = [(radius, -half), (radius, half)]
    about = f"the {'ball' if is_ball else 'cylinder'} {EQUAL}"
    stem = pinned and far > half and float(axis @ centre) > (1 - EQUAL_MOMENTS) * far
    if stem:
        thick = min(STEM_THICKNESS * far, 0.5 * radius)
        if is_ball:
            rings[0] = (thick, -float(np.sqrt(radius**2 - thick**2)))
        rings = [(0.0, -far), (thick, min(2 * thick - far, rings[0][1])), (thick, rings[0][1]), *rings[is_ball:]]
        about += ", on a stem"
    unit = _revolve(rings)
    frame = np.stack([right, np.cross(axis, right), axis])
    return Mesh(unit.vertices @ frame + centre, unit.faces, unit.painted, about, stem)


def _points_mesh(positions: np.ndarray, masses: np.ndarray) -> Mesh:
    """Balls at the points, with sizes by their masses, and rods between nearest points."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import cdist

    far = cdist(positions, positions)
    size = max(far.max(), np.linalg.norm(positions, axis=1).max())
    parts = []
    for position, mass in zip(positions, masses, strict=True):
        unit = _ball()
        radius = 0.09 * size * (mass / masses.max()) ** (1 / 3) if size > 0 else 1.0
        parts.append((unit.vertices * max(radius, 0.02 * size) + position, unit))
    tree = minimum_spanning_tree(far).tocoo()
    for i, j in zip(tree.row, tree.col, strict=True):
        unit, along = _cylinder(), positions[j] - positions[i]
        right = unit_vector(np.cross(along, np.eye(3)[np.abs(along).argmin()]))
        frame = np.stack([0.02 * size * right, 0.02 * size * unit_vector(np.cross(along, right)), along])
        parts.append((unit.vertices @ frame + (positions[i] + positions[j]) / 2, unit._replace(painted=[False] * 99)))
    faces, painted, start = [], [], 0
    for vertices, unit in parts:
        faces += [[start + corner for corner in face] for face in unit.faces]
        painted += unit.painted[: len(unit.faces)]
        start += len(vertices)
    return Mesh(np.concatenate([vertices for vertices, _ in parts]), faces, painted, "its points, joined")


def _revolve(rings: list[tuple[float, float]]) -> Mesh:
    """A solid of revolution about axis 3 from circles (radius, z), from below; a quarter of its side is painted."""
    angle = 2 * np.pi * np.arange(CIRCLE_CORNERS) / CIRCLE_CORNERS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([np.column_stack([r * circle, np.full(CIRCLE_CORNERS, z)]) for r, z in rings])
    faces, painted = [], []
    for k in range(len(rings) - 1):
        for i in range(CIRCLE_CORNERS):
            j = (i + 1) % CIRCLE_CORNERS
            faces.append(
                [
                    k * CIRCLE_CORNERS + i,
                    k * CIRCLE_CORNERS + j,
                    (k + 1) * CIRCLE_CORNERS + j,
                    (k + 1) * CIRCLE_CORNERS + i,
                ]
            )
            painted.append(i < CIRCLE_CORNERS // 4)
    for k, order in ((0, -1), (len(rings) - 1, 1)):
        if rings[k][0] > 0:
            ends = list(range(k * CIRCLE_CORNERS, (k + 1) * CIRCLE_CORNERS))
            wedge = ends[: CIRCLE_CORNERS // 4 + 1]
            middle = len(vertices)
            vertices = np.vstack([vertices, [0.0, 0.0, rings[k][1]]])
            faces += [[middle, *wedge][::order], [middle, *ends[CIRCLE_CORNERS // 4 :], ends[0]][::order]]
            painted += [True, False]
    return Mesh(vertices, faces, painted, "")


def _ball() -> Mesh:
    polar = np.linspace(np.pi, 0, 13)
    return _revolve([(np.sin(a), np.cos(a)) for a in polar])


_cylinder, _rod = partial(_revolve, [(1.0, -0.5), (1.0, 0.5)]), partial(_revolve, [(0.5, -0.5), (0.5, 0.5)])
_cone = partial(_revolve, [(0.0, -0.75), (1.0, 0.25)])


def _ring() -> Mesh:
    """A ring of unit radius about axis 3, as a tube, whose thickness along the axis is MIN_THICKNESS."""
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    tube = _revolve([(1 + 0.06 * np.cos(a), 0.5 * np.sin(a)) for a in [*angle, angle[0]]])
    sides = CIRCLE_CORNERS * (len(angle))
    return Mesh(tube.vertices, tube.faces[:sides], tube.painted[:sides], "")


def _cuboid() -> Mesh:
    vertices = np.array(list(product([-0.5, 0.5], repeat=3)))
    faces = [[4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1], [1, 5, 7, 3], [0, 2, 6, 4]]
    return Mesh(vertices, faces, [True] + [False] * 5, "")


#: Surfaces of unit size, as `SOLIDS` has them; a sphere and an ellipsoid are balls.
UNITS = {"cylinder": _cylinder, "disk": _cylinder, "cone": _cone, "rod": _rod, "ring": _ring, "cuboid": _cuboid}
