"""Edges between the points of a body, for viewers and topology files: outlines of its solids, and
links between them."""

from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.features.bodies.keys.solids import SOLIDS
from rigidmd.formats.bonds import shortest_links

if TYPE_CHECKING:
    from rigidmd.features.bodies.system import BodySystem

#: Distance from a flat side of a hull, relative to its size, of points on it. Thickness relative to
#: the size below which points lie in a plane or on a line.
FLAT, THIN = 1e-6, 1e-9


def edges_of(system: "BodySystem") -> np.ndarray:
    """Pairs (b, 2) of points that are joined: the edges of the hull of each solid, or the shortest
    links between points, with links between solids and from a pinned body to its pivot."""
    first = 0 if system.translates else 1  # the pivot is the first point
    points = system.points[first:]
    body = system.scene.body
    if body.points is not None:
        pairs = first + shortest_links(points)
    elif body.solids is not None:
        pairs = first + _edges_of_solids(
            points, [len(SOLIDS[part.shape].outline) for part in body.solids]
        )
    else:
        pairs = first + _hull(points)
    if first and len(points):
        nearest = int(np.linalg.norm(points - system.centre, axis=1).argmin())
        pairs = np.vstack([[0, first + nearest], pairs])
    return pairs.astype(int)


def _edges_of_solids(points: np.ndarray, counts: list[int]) -> np.ndarray:
    """Edges (b, 2) of the hulls of solids, whose points follow one another, and the shortest links
    that join the solids.

    counts : number of points of each solid
    """
    starts = np.cumsum([0, *counts])
    edges = [start + _hull(points[start:end]) for start, end in pairwise(starts.tolist())]
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


def _hull(points: np.ndarray) -> np.ndarray:
    """Convex-hull edges for points in space, in a plane or on a line: the outline of a solid.
    Points inside, and those between the corners of a side, have none."""
    if len(points) < 2:
        return np.zeros((0, 2), int)
    flat = _flattened(points)
    if flat.shape[1] == 1:
        order = flat[:, 0].argsort()
        return np.stack([order[:-1], order[1:]], axis=-1)
    sides = [np.arange(len(points))] if flat.shape[1] == 2 else _sides(flat)
    edges: dict[tuple[int, int], None] = {}
    for side in sides:
        outline = _flattened(points[side])
        for ends in _sides(outline):
            along = _flattened(outline[ends])[:, 0]
            corners = int(side[ends[along.argmin()]]), int(side[ends[along.argmax()]])
            edges[min(corners), max(corners)] = None
    return np.array(list(edges))


def _flattened(points: np.ndarray) -> np.ndarray:
    """Coordinates (n, d) of points along the axes in which they extend, d of them."""
    centred = points - points.mean(axis=0)
    _, spread, axes = np.linalg.svd(centred)
    return centred @ axes[: int((spread > THIN * spread[0]).sum())].T


def _sides(points: np.ndarray) -> list[np.ndarray]:
    """Indices of the points on each side of a hull, a line in a plane or a plane in space: all
    points lie on it or behind it."""
    chosen = np.array(list(combinations(range(len(points)), points.shape[1])))
    first = points[chosen[:, 0]]
    one, other = points[chosen[:, 1]] - first, points[chosen[:, -1]] - first
    normals = one[:, ::-1] * [-1, 1] if points.shape[1] == 2 else np.cross(one, other)
    size = np.linalg.norm(normals, axis=1)
    spans = size > THIN * size.max()
    normals = normals[spans] / size[spans, None]
    first = first[spans]
    heights = normals @ points.T - np.einsum("ti,ti->t", normals, first)[:, None]
    tolerance = FLAT * np.abs(points).max()
    supports = (heights.min(axis=1) > -tolerance) | (heights.max(axis=1) < tolerance)
    masks = np.unique(np.abs(heights[supports]) < tolerance, axis=0)
    return [np.flatnonzero(mask) for mask in masks]
