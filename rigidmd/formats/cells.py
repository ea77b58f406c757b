"""Periodic cells of any shape and orientation, as in structure files. Rows a, b, c, lab frame,
Å."""

import contextlib
from itertools import permutations, product

import numpy as np

from rigidmd.core.state import edges_and_angles

#: Largest cosine of right angles: files have angles to 0.01 degrees, vectors to 1e-5 or better.
RIGHT = np.radians(1e-3)
#: A cell is in the standard orientation within this fraction of its longest edge.
ORIENTED = 1e-6

#: Tolerated tilt beyond half an edge, as a fraction of the edge: 36 cos 60° is 18.000000000000004,
#: and vectors in files have 1e-3 Å at best, angles 0.01 degrees. Neighbour lists are correct for
#: any tilt.
HALF_AS_PRINTED = 4e-4
#: The cell is rotated for another choice of edges if that raises the longest possible cutoff by
#: this factor. In rhombic dodecahedra (fcc lattices), of which programs use several cells, the
#: factor is 2/sqrt(3) = 1.155 at most.
CUTOFF_GAIN = 1.25
#: Heights of cells that differ by less than this fraction are equal.
SAME_HEIGHT = 2e-3
#: Smallest thickness and longest edge of a cell, Å: half an atom, a tenth of a metre.
THINNEST, LONGEST = 0.5, 1e9


def cell_error(cell: np.ndarray) -> str:
    """Why a cell (3, 3) of finite numbers cannot hold molecules, or an empty text if it can."""
    if np.abs(cell).max() > LONGEST:
        return f"it must not be longer than {LONGEST:g} Å"
    edges = np.linalg.norm(cell, axis=1)
    areas = np.linalg.norm(np.cross(np.roll(cell, -1, axis=0), np.roll(cell, 1, axis=0)), axis=1)
    thickness = np.abs(np.linalg.det(cell)) / areas.max() if areas.max() > 0 else 0.0
    if thickness < THINNEST:
        lengths = ", ".join(f"{edge:.4g}" for edge in edges)
        return (
            f"with its edges of {lengths} Å it is {thickness:.3g} Å thick, must be {THINNEST:g} Å"
            " at least"
        )
    return ""


def standard_rotation(cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell (3, 3) with a along x, b in the xy plane and c above it, and the rotation R (3, 3)
    to that orientation: new rows are R times the old ones. In a left-handed cell c changes sign,
    which does not change the lattice."""
    cell = cell * np.array([1, 1, np.sign(np.linalg.det(cell))])[:, None]
    if (
        np.abs(np.triu(cell, 1)).max() <= ORIENTED * np.abs(cell).max()
        and (np.diag(cell) > 0).all()
    ):
        return np.tril(cell), np.eye(3)
    q, r = np.linalg.qr(cell.T)
    q = q * np.sign(np.diag(r))
    return np.tril(cell @ q), q.T


def reduced_cell(cell: np.ndarray) -> np.ndarray:
    """A cell (3, 3) of the same lattice in standard orientation, with tilts up to half an edge, to
    printed digits."""
    cell = cell.copy()
    for k, along in ((2, 1), (2, 0), (1, 0)):
        edges = cell[k, along] / cell[along, along]
        if abs(edges) > 0.5 + HALF_AS_PRINTED:
            # halves become +0.5, whatever their last digit
            cell[k] -= np.ceil(edges - 0.5 - HALF_AS_PRINTED) * cell[along]
    return cell


def basis_of(cell: np.ndarray, given: np.ndarray) -> np.ndarray:
    """Integers U (3, 3) with cell = U given, for two cells (3, 3) of one lattice."""
    return np.rint(cell @ np.linalg.inv(given)).astype(int)


def same_lattice(cell: np.ndarray, other: np.ndarray, tolerance: float) -> bool:
    """Whether two cells (3, 3) describe one lattice, to a fraction of the largest component of the
    second."""
    basis = basis_of(cell, other)
    equal_volume = round(abs(np.linalg.det(basis))) == 1
    return equal_volume and bool(
        np.abs(basis @ other - cell).max() <= tolerance * np.abs(other).max()
    )


def describe_cell(cell: np.ndarray) -> str:
    """Lengths and angles of a cell (3, 3)."""
    parameters = edges_and_angles(cell)
    lengths = ", ".join(f"{x:.4f}" for x in parameters[:3])
    angles = ", ".join(f"{x:.4g}" for x in parameters[3:])
    return f"edges {lengths} Å, angles {angles}°"


def describe_basis(basis: np.ndarray) -> str:
    """The edges a', b', c' that differ from a, b, c, for example "c' = c - a"."""
    changed = []
    for k, row in enumerate(basis):
        parts = [(n, i) for i, n in enumerate(row) if n]
        parts.sort(key=lambda part: part[1] != k)
        if parts != [(1, k)]:
            sums = " ".join(
                f"{'-' if n < 0 else '+'} {'' if abs(n) == 1 else abs(n)}{'abc'[i]}"
                for n, i in parts
            )
            changed.append(f"{'abc'[k]}' = {sums.removeprefix('+ ')}")
    return ", ".join(changed)


def least_skewed_cell(cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The cell (3, 3) of a lattice that allows the longer cutoff (half the smallest of a_x, b_y,
    c_z), and the rotation (3, 3) to its standard orientation: the given cell with reduced tilts,
    unless another one allows a much longer cutoff. The choice does not depend on the rounding of
    numbers in files."""
    reduced = reduced_cell(cell)
    bases = _short_bases(cell)
    standard = np.abs(np.linalg.qr(np.swapaxes(bases @ cell, 1, 2), mode="r"))  # columns a, b, c
    heights = standard.diagonal(axis1=1, axis2=2)
    height = heights.min(axis=1)
    if height.max() <= CUTOFF_GAIN * np.diag(reduced).min():
        return reduced, np.eye(3)
    # of those that are equally high, without large tilts, and with the fewest changes
    tilt = (standard / heights[:, :, None])[:, [0, 0, 1], [1, 2, 2]].max(axis=1)
    changes = np.abs(bases - np.eye(3, dtype=int)).sum(axis=(1, 2))
    best = np.flatnonzero(height >= (1 - SAME_HEIGHT) * height.max())
    basis = bases[
        min(best, key=lambda k: (tilt[k] > 0.5 + HALF_AS_PRINTED, changes[k], bases[k].tolist()))
    ]
    other, rotation = standard_rotation(basis @ cell)
    return reduced_cell(other), rotation


def _short_bases(cell: np.ndarray) -> np.ndarray:
    """Right-handed bases (k, 3, 3) of a lattice, integers in terms of its cell (3, 3), of its
    shortest vectors: those not longer than the longest of a reduced cell, of which a lattice may
    have several."""
    from ase.geometry import minkowski_reduce

    edges, reduced = minkowski_reduce(cell)
    # without -v
    factors = np.array([v for v in product((-2, -1, 0, 1, 2), repeat=3) if v > (0, 0, 0)])
    vectors = factors @ np.asarray(reduced)
    longest = np.linalg.norm(edges, axis=1).max()
    vectors = vectors[np.linalg.norm(vectors @ cell, axis=1) <= (1 + SAME_HEIGHT) * longest]
    vectors *= np.sign(vectors[np.arange(len(vectors)), (vectors != 0).argmax(axis=1)])[:, None]
    i, j, k = np.array(list(permutations(range(len(vectors)), 3))).T
    volume = (np.cross(vectors[i], vectors[j]) * vectors[k]).sum(axis=1)
    is_basis = np.abs(volume) == 1
    bases = np.stack([vectors[of[is_basis]] for of in (i, j, k)], axis=1)
    signs = np.array([s for s in product((1, -1), repeat=3)])
    bases = (bases[:, None] * signs[:, :, None]).reshape(-1, 3, 3)
    return bases[np.linalg.det(bases) > 0]


def right_angled(cell: np.ndarray) -> bool:
    """Whether the edges of a cell (3, 3) are at right angles, to the digits of files."""
    unit = cell / np.linalg.norm(cell, axis=1)[:, None]
    return bool(np.abs((unit @ unit.T)[np.triu_indices(3, 1)]).max() <= RIGHT)


def cell_of(parameters: list[float]) -> np.ndarray | None:
    """The cell (3, 3) with these edges and angles. None if no cell has them."""
    from ase.geometry import cellpar_to_cell

    edges, angles = np.array(parameters).reshape(2, 3)
    if (
        np.isfinite(edges).all()
        and (edges > 0).all()
        and (angles > 0).all()
        and (angles < 180).all()
    ):
        # raised by ASE if three edges cannot form the angles
        with contextlib.suppress(AssertionError):
            return cellpar_to_cell([*edges, *angles])
    return None


def nearest_image_distance(cell: np.ndarray) -> float:
    """The distance, Å, of a point from its nearest image in a cell (3, 3)."""
    from ase.geometry import minkowski_reduce

    return float(np.linalg.norm(minkowski_reduce(cell)[0], axis=1).min())


def nearest_images(vectors: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """The shortest images of vectors (n, 3) in any cell (3, 3)."""
    from ase.geometry import minkowski_reduce

    cell = np.asarray(minkowski_reduce(cell)[0])
    inverse = np.linalg.inv(cell)
    nearest = vectors - np.rint(vectors @ inverse) @ cell
    thickness = 1 / np.linalg.norm(inverse, axis=0)
    # of a shorter vector no other image is shorter; in a reduced cell the shortest image is next to
    # the rounded one
    far = np.flatnonzero(np.linalg.norm(nearest, axis=1) > 0.5 * thickness.min())
    neighbours = np.array(list(product((0, -1, 1), repeat=3))) @ cell
    images = nearest[far, None] + neighbours
    shortest = np.linalg.norm(images, axis=2).argmin(axis=1)
    nearest[far] = images[np.arange(len(far)), shortest]
    return nearest


def make_whole(points: np.ndarray, cell: np.ndarray | None, reach: np.ndarray) -> np.ndarray:
    """Molecules (m, s, 3) without jumps across the faces of a cell (3, 3), if any. The first atoms
    keep their images.

    Each molecule is walked from its first atom along bonds, to the nearest image at each of them,
    so that it may be longer than the cell. reach (s, s): largest lengths of bonds between atoms, Å,
    0 for atoms that are not bonded. Atoms that no bond connects are joined to the nearest atoms (a
    minimum spanning tree by Prim's algorithm).
    """
    count, size, _ = points.shape
    if cell is None or size == 1:
        return points
    unwrapped = points.copy()
    molecule = np.arange(count)
    outside = np.ones((count, size), bool)
    distance = np.full((count, size), np.inf)  # of an atom outside from the tree
    newest = np.zeros(count, int)
    for _ in range(size - 1):
        outside[molecule, newest] = False
        steps = points - points[molecule, newest][:, None]
        steps = nearest_images(steps.reshape(-1, 3), cell).reshape(points.shape)
        length = np.linalg.norm(steps, axis=2)
        longest = reach[newest]
        bonded = length < longest
        # bonds precede all other pairs, however short these are: hydrogen bonds to images of the
        # same molecule
        rank = np.where(bonded, length / np.where(bonded, longest, 1.0), 1.0 + length)
        closer = outside & (rank < distance)
        distance[closer] = rank[closer]
        unwrapped[closer] = (unwrapped[molecule, newest][:, None] + steps)[closer]
        if (distance[outside] <= 1.0).all():  # each is bonded to an atom of the tree
            break
        newest = np.where(outside, distance, np.inf).argmin(axis=1)
    return unwrapped


def pairs_within(
    position: np.ndarray, cell: np.ndarray | None, radius: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs i, j of points (n, 3) within a radius, with periodic images in any cell (3, 3), and the
    vectors (p, 3) from i to the image of j."""
    from scipy.spatial import KDTree

    points = position
    owner = np.arange(len(position))
    if cell is not None:
        inverse = np.linalg.inv(cell)
        inside = position @ inverse
        inside -= np.floor(inside)
        margin = radius * np.linalg.norm(inverse, axis=0)  # in fractional coordinates
        images = []
        for shift in product(*(range(-n, n + 1) for n in np.ceil(margin).astype(int))):
            image = inside + shift
            near = np.flatnonzero(((image >= -margin) & (image <= 1 + margin)).all(axis=1))
            images.append((near, image[near]))
        owner, points = (np.concatenate(parts) for parts in zip(*images, strict=True))
        points = points @ cell
    i, j = KDTree(points).query_pairs(radius, output_type="ndarray").T
    return owner[i], owner[j], points[j] - points[i]
