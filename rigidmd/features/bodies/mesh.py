"""The surface of a single body for drawings: its solids, its points joined by rods, or a solid of
the same inertia."""

from itertools import product
from typing import NamedTuple

import numpy as np

from rigidmd.features.bodies.assemble import assembled, inertia_at_centre, inertia_of, principal
from rigidmd.features.bodies.keys.body import EQUAL_MOMENTS, Solid, axis_of_symmetry
from rigidmd.features.bodies.keys.solids import SOLIDS
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.view.figures.space import camera
from rigidmd.formats.bonds import shortest_links

#: Corners of a circle; least thickness of a body, as a fraction of its reach.
CIRCLE_CORNERS, MIN_THICKNESS = 24, 0.02
#: Longest side of a face of joined solids, as a fraction of the body's reach.
LONGEST_FACE = 0.15
#: Edges of a cuboid in half axes of the ellipsoid of the same inertia; thickness of a stem in its
#: length.
CUBOID_EDGES = (12 / 5) ** 0.5
STEM_THICKNESS = 0.06
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


def mesh_of(system: BodySystem) -> Mesh:
    """The surface of a body: as the scene requests, its solids, its points joined, or a body of
    equal inertia."""
    scene = system.scene
    table = scene.body
    mass, _, centre, _, _ = inertia_of(scene)
    wanted = scene.output.drawn_as
    if wanted is None and table.points is not None:
        positions, masses = (
            np.array([getattr(p, key) for p in table.points]) for key in ("position_m", "mass_kg")
        )
        return _points_mesh(
            positions if table.pinned else positions - masses @ positions / mass, masses
        )
    if isinstance(wanted, Solid):
        stands = wanted.shape == "cone" and table.pinned
        return _solid_mesh(
            wanted, np.array([0.0, 0.0, 0.75 * (wanted.height_m or 0.0)]) if stands else centre
        )
    if wanted is None and table.solid is not None:
        return _solid_mesh(table.solid, centre)
    if wanted is None and table.solids is not None:
        origin = np.zeros(3) if table.pinned else assembled(table.solids).centre
        surfaces = [_solid_mesh(part, np.zeros(3)) for part in table.solids]
        placed = [
            surface._replace(vertices=surface.vertices @ part.rotation.T + part.position_m - origin)
            for surface, part in zip(surfaces, table.solids, strict=True)
        ]
        return _cut(_joined(placed, "its solids"))
    # a homogeneous body of this mass and inertia: a solid of revolution if two moments are equal,
    # or else a cuboid
    tensor = inertia_at_centre(scene)
    if not tensor.any():
        return BALL._replace(about="a ball, as it is a point")
    moments, axes = principal(tensor)
    symmetric = axis_of_symmetry(moments)
    if wanted in (None, "top") and symmetric is not None:
        return _top_mesh(mass, moments, axes, symmetric, centre, pinned=table.pinned)
    # half axes of the ellipsoid
    lengths = np.sqrt(np.maximum(2.5 / mass * (moments.sum() - 2 * moments), 0.0))
    lengths = np.maximum(lengths, MIN_THICKNESS * lengths.max())
    unit = BALL
    shape = "ellipsoid"
    if wanted != "ellipsoid":
        lengths = CUBOID_EDGES * lengths
        unit = CUBOID
        shape = "cuboid"
    return unit._replace(
        vertices=(unit.vertices * lengths) @ axes.T + centre, about=f"the {shape} {EQUAL}"
    )


def _solid_mesh(solid: Solid, position: np.ndarray) -> Mesh:
    size = SOLIDS[solid.shape].scale(solid.dimensions)
    unit = UNITS.get(solid.shape, BALL)
    about = f"{'an' if solid.shape[0] in 'aeiou' else 'a'} {solid.shape}"
    return unit._replace(
        vertices=unit.vertices * np.maximum(size, MIN_THICKNESS * size.max()) + position,
        about=about,
    )


def _top_mesh(
    mass: float,
    moments: np.ndarray,
    axes: np.ndarray,
    symmetric: int,
    centre: np.ndarray,
    *,
    pinned: bool,
) -> Mesh:
    """The homogeneous cylinder, or ball, of these moments, on a stem if its pivot lies on the axis
    outside of it.

    A cylinder has m r²/2 about its axis and m (3 r² + h²)/12 about the others: there is one for any
    two moments.
    """
    along = moments[symmetric]
    across = moments[symmetric - 1]
    far = float(np.linalg.norm(centre))
    axis = axes[:, symmetric]
    right = axes[:, symmetric - 2]
    is_ball = bool(np.ptp(moments) <= EQUAL_MOMENTS * moments.max())
    if is_ball and far:
        right, _, axis = camera(centre, np.eye(3)[np.abs(centre).argmin()])
    elif axis @ centre < 0:
        axis = -axis
    if is_ball:
        radius = float(np.sqrt(2.5 * along / mass))
        half = radius
        rings = [(radius * np.sin(a), radius * np.cos(a)) for a in np.linspace(np.pi, 0, 13)]
    else:
        radius = float(np.sqrt(2 * along / mass))
        height = float(np.sqrt(max(12 * across - 6 * along, 0.0) / mass))
        radius, half = (
            max(radius, MIN_THICKNESS * height),
            max(height, MIN_THICKNESS * 2 * radius) / 2,
        )
        rings = [(radius, -half), (radius, half)]
    about = f"the {'ball' if is_ball else 'cylinder'} {EQUAL}"
    stem = pinned and far > half and float(axis @ centre) > (1 - EQUAL_MOMENTS) * far
    if stem:
        thick = min(STEM_THICKNESS * far, 0.5 * radius)
        if is_ball:
            rings[0] = (thick, -float(np.sqrt(radius**2 - thick**2)))
        rings = [
            (0.0, -far),
            (thick, min(2 * thick - far, rings[0][1])),
            (thick, rings[0][1]),
            *rings[is_ball:],
        ]
        about += ", on a stem"
    unit = _revolve(rings)
    frame = np.stack([right, np.cross(axis, right), axis])
    return unit._replace(vertices=unit.vertices @ frame + centre, about=about, stem=stem)


def _points_mesh(positions: np.ndarray, masses: np.ndarray) -> Mesh:
    """Balls at the points, with sizes by their masses, and rods between nearest points."""
    from scipy.spatial.distance import pdist

    size = max(pdist(positions).max(initial=0.0), np.linalg.norm(positions, axis=1).max())
    parts = []
    for position, mass in zip(positions, masses, strict=True):
        radius = 0.09 * size * (mass / masses.max()) ** (1 / 3) if size > 0 else 1.0
        parts.append(BALL._replace(vertices=BALL.vertices * max(radius, 0.02 * size) + position))
    for i, j in shortest_links(positions):
        along = positions[j] - positions[i]
        frame = camera(along, np.eye(3)[np.abs(along).argmin()])
        frame *= [[0.02 * size], [0.02 * size], [np.linalg.norm(along)]]
        vertices = CYLINDER.vertices @ frame + (positions[i] + positions[j]) / 2
        parts.append(CYLINDER._replace(vertices=vertices, painted=[False] * len(CYLINDER.faces)))
    return _joined(parts, "its points, joined")


def _joined(parts: list[Mesh], about: str) -> Mesh:
    """Several surfaces as one."""
    faces = []
    painted = []
    start = 0
    for part in parts:
        faces += [[start + corner for corner in face] for face in part.faces]
        painted += part.painted
        start += len(part.vertices)
    return Mesh(np.concatenate([part.vertices for part in parts]), faces, painted, about)


def _cut(mesh: Mesh) -> Mesh:
    """The same surface with long faces of four corners in pieces. Faces are drawn from the furthest
    to the nearest, which is right where solids meet only if they are short."""
    longest = LONGEST_FACE * mesh.reach
    vertices = [*mesh.vertices]
    faces = []
    painted = []
    for face, color in zip(mesh.faces, mesh.painted, strict=True):
        corners = mesh.vertices[face]
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        along, across = (max(1, int(np.ceil(max(sides[k::2]) / longest))) for k in (0, 1))
        if len(face) != 4 or along * across == 1:
            faces.append(face)
            painted.append(color)
            continue
        u, v = np.meshgrid(
            np.linspace(0, 1, along + 1), np.linspace(0, 1, across + 1), indexing="ij"
        )
        weights = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], axis=-1)
        first = len(vertices)
        row = across + 1
        vertices += [*(weights @ corners).reshape(-1, 3)]
        for i, j in product(range(along), range(across)):
            corner = first + row * i + j
            faces.append([corner, corner + row, corner + row + 1, corner + 1])
            painted.append(color)
    return mesh._replace(vertices=np.array(vertices), faces=faces, painted=painted)


def _revolve(rings: list[tuple[float, float]], *, closed: bool = False) -> Mesh:
    """A solid of revolution about axis 3 from circles (radius, z), from below. A quarter of its
    side is painted. A `closed` one is a ring, without discs at its ends."""
    n = CIRCLE_CORNERS
    corner = np.arange(n)
    angle = 2 * np.pi * corner / n
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    vertices = np.concatenate([np.column_stack([r * circle, np.full(n, z)]) for r, z in rings])
    # the first corner of each strip between two circles
    below = n * np.arange(len(rings) - 1)[:, None]
    i, j = below + corner, below + (corner + 1) % n
    faces = np.stack([i, j, j + n, i + n], axis=-1).reshape(-1, 4).tolist()
    painted = (corner < n // 4).tolist() * (len(rings) - 1)
    for k, order in ((0, -1), (len(rings) - 1, 1)):
        if rings[k][0] > 0 and not closed:
            ends = list(range(k * n, (k + 1) * n))
            middle = len(vertices)
            vertices = np.vstack([vertices, [0.0, 0.0, rings[k][1]]])
            faces += [
                [middle, *ends[: n // 4 + 1]][::order],
                [middle, *ends[n // 4 :], ends[0]][::order],
            ]
            painted += [True, False]
    return Mesh(vertices, faces, painted, "")


#: Surfaces of unit size, as `SOLIDS` has them; a sphere and an ellipsoid are balls, and a ring is a
#: thin tube.
BALL = _revolve([(np.sin(a), np.cos(a)) for a in np.linspace(np.pi, 0, 13)])
CYLINDER = _revolve([(1.0, -0.5), (1.0, 0.5)])
CUBOID = Mesh(
    np.array(list(product([-0.5, 0.5], repeat=3))),
    [[4, 6, 7, 5], [0, 1, 3, 2], [2, 3, 7, 6], [0, 4, 5, 1], [1, 5, 7, 3], [0, 2, 6, 4]],
    [True] + [False] * 5,
    "",
)
UNITS = {
    "cylinder": CYLINDER,
    "disk": CYLINDER,
    "cuboid": CUBOID,
    "rod": _revolve([(0.5, -0.5), (0.5, 0.5)]),
    "cone": _revolve([(0.0, -0.75), (1.0, 0.25)]),
    "ring": _revolve(
        [(1 + 0.06 * np.cos(a), 0.5 * np.sin(a)) for a in [*np.linspace(0, 2 * np.pi, 9)[:8], 0]],
        closed=True,
    ),
}
