"""Edges between the points of a body, for viewers and topology files: outlines of its solids, and
links between them."""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.bodies.keys.solids import SOLIDS
from rigidmd.formats.bonds import shortest_links

if TYPE_CHECKING:
    from rigidmd.features.bodies.system import BodySystem

#: Polygons of the outlines of `SOLIDS`, by their points. Neighbours are joined corner by corner.
_BALL = [0], range(1, 9), range(9, 17), range(17, 25), [25]
POLYGONS: dict[str, Sequence[Sequence[int]]] = {
    "cylinder": (range(1, 13), range(13, 25)),
    "cone": ([0], range(9, 25)),
    "sphere": _BALL,
    "ellipsoid": _BALL,
    "cuboid": ([0, 2, 8, 6], [17, 19, 25, 23]),
    "disk": (range(9, 25),),
    "ring": (range(24),),
    "rod": [[k] for k in range(13)],
}


def edges_of(system: "BodySystem") -> np.ndarray:
    """Pairs (b, 2) of points that are joined: the edges of the hull of each solid, or the shortest
    links between points, with links between solids and from a pinned body to its pivot."""
    first = 0 if system.translates else 1  # the pivot is the first point
    points = system.points[first:]
    body = system.scene.body
    if body.points is not None:
        pairs = first + shortest_links(points)
    elif body.solids is not None:
        pairs = first + _edges_of_solids(points, [part.shape for part in body.solids])
    elif body.solid is not None:
        pairs = first + _outline(POLYGONS[body.solid.shape])
    else:
        pairs = first + _edges_of_ellipsoid(points)
    if first and len(points):
        nearest = int(np.linalg.norm(points - system.centre, axis=1).argmin())
        pairs = np.vstack([[0, first + nearest], pairs])
    return pairs.astype(int)


def _edges_of_solids(points: np.ndarray, shapes: list[str]) -> np.ndarray:
    """Edges (b, 2) of solids, whose points follow one another, and the shortest links that join the
    solids."""
    starts = np.cumsum([0, *(len(SOLIDS[shape].outline) for shape in shapes)])
    edges = [
        start + _outline(POLYGONS[shape])
        for start, shape in zip(starts[:-1].tolist(), shapes, strict=True)
    ]
    joined = np.arange(starts[1])
    free = np.arange(starts[1], len(points))
    while len(free):
        distance = np.linalg.norm(points[joined, None] - points[free], axis=-1)
        i, j = np.unravel_index(distance.argmin(), distance.shape)
        edges.append(np.array([[joined[i], free[j]]]))
        solid = int(np.searchsorted(starts, free[j], side="right")) - 1
        new = np.arange(starts[solid], starts[solid + 1])
        joined = np.concatenate([joined, new])
        free = np.setdiff1d(free, new)
    return np.concatenate(edges)


def _edges_of_ellipsoid(points: np.ndarray) -> np.ndarray:
    """Edges between the tips of an ellipsoid. Points (7, 3) are its centre and its tips."""
    tips = points[:4] - points[0]
    if len(points) == 1:
        return np.zeros((0, 2), int)
    if not tips[2].any():
        return _outline([[1], [0], [4]])
    equator = [1, 2, 4, 5]
    return _outline([[3], equator, [6]] if tips[3].any() else [equator])


def _outline(polygons: Sequence[Sequence[int]]) -> np.ndarray:
    """Edges (b, 2) of polygons, and between neighbouring ones."""
    corners = [np.array(polygon) for polygon in polygons]
    sides = [np.stack([p, np.roll(p, -1)], axis=-1) for p in corners if len(p) > 1]
    links = [np.stack(np.broadcast_arrays(p, q), axis=-1) for p, q in pairwise(corners)]
    return np.concatenate([*sides, *links])
