"""Bonds for viewers and topology files: those of molecules, and the edges between the points of a
single body."""

from itertools import combinations, pairwise
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.formats.systems import MolecularSystem, Shape, System
from rigidmd.mechanics.inertia import SOLIDS

if TYPE_CHECKING:
    from typing_extensions import TypeIs  # of Python 3.13

#: Distance from a flat side of a hull, relative to its size, of points on it. Thickness relative to
#: the size below which points lie in a plane or on a line.
FLAT, THIN = 1e-6, 1e-9


def _is_molecular(system: System) -> "TypeIs[MolecularSystem]":
    return hasattr(system, "species")


def connections(system: System, *, massless: bool = False) -> np.ndarray:
    """Pairs (b, 2) of sites that are joined: bonds of molecules, or of a body the edges of the hull
    of each solid or the shortest links between points, with links between solids and from a pinned
    body to its pivot. `massless`: whether massless sites are joined to their nearest atoms, so that
    each molecule is connected."""
    if _is_molecular(system):
        starts = np.searchsorted(system.sites.molecule, np.arange(len(system.model.species)))
        chosen = [
            [pair for pair in bonds(m) if massless or m.masses[pair[1]] > 0] for m in system.species
        ]
        links = [np.array(pairs, int).reshape(-1, 2) for pairs in chosen]
        return np.concatenate(
            [start + links[kind] for start, kind in zip(starts, system.model.species, strict=True)]
        )
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


def charges(system: System) -> np.ndarray:
    """Charges (s,) of all sites, e, 0 for a single body."""
    if _is_molecular(system):
        return system.of_sites(lambda m: m.charges)
    return np.zeros(len(system.points))


def shortest_links(points: np.ndarray) -> np.ndarray:
    """Pairs (n - 1, 2) of points (n, 3): the shortest links that connect them."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import cdist

    tree = minimum_spanning_tree(cdist(points, points)).tocoo()
    return np.stack([tree.row, tree.col], axis=-1)


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


#: Covalent radii, Å (Cordero et al. 2008, Dalton Trans. 2832), of the elements in rigid models.
COVALENT = {"H": 0.31, "C": 0.76, "N": 0.71, "O": 0.66, "F": 0.57, "S": 1.05, "Cl": 1.02}
#: Factor on the sum of covalent radii up to which two atoms are bonded.
SLACK = 1.25


def bonds(m: Shape) -> list[tuple[int, int]]:
    """Bonds, heavier site first: atoms within bonding distance, shortest links, massless sites to
    nearest atoms."""
    from scipy.spatial.distance import cdist

    x = m.positions_body
    atoms = np.flatnonzero(m.masses > 0)
    massless = np.flatnonzero(m.masses == 0)
    radius = SLACK * np.array([COVALENT.get(m.elements[i], 0.0) for i in atoms.tolist()])
    bonded = cdist(x[atoms], x[atoms]) <= radius[:, None] + radius
    bonded[tuple(shortest_links(x[atoms]).T)] = True
    pairs = atoms[np.argwhere(np.triu(bonded | bonded.T, 1))].tolist()
    links = sorted((i, j) if m.masses[i] >= m.masses[j] else (j, i) for i, j in pairs)
    nearest = atoms[cdist(x[massless], x[atoms]).round(9).argmin(axis=1)]
    return [*links, *zip(nearest.tolist(), massless.tolist(), strict=True)]


def distance(m: Shape, i: int, j: int) -> float:
    return float(np.linalg.norm(m.positions_body[i] - m.positions_body[j]))
