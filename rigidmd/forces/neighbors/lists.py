"""Neighbour lists: for each row of sites of one potential, the clusters that may have a site within
the cutoff.

A row is two sites near one another, so that what is loaded of a cluster serves both. The rows of a
cluster have almost the same neighbours: these are listed once, with the vectors between origins,
and an entry of a row is an index in that list. The clusters of each row are sorted into shells by
distance. The displacements of the sites determine how many shells can matter. See the theory
chapter `interactions` for when a list is valid.

This module has the list and how it is read. `update` decides when it is rebuilt, `rows` fills it.
"""

from math import ceil, inf, nan, pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.compile.simd import lane_count, zeros
from rigidmd.core.state import CELL_CHANGED
from rigidmd.errors import SimulationError
from rigidmd.forces.neighbors.clusters import Clusters, clusters_of, order_of
from rigidmd.forces.neighbors.tree import BoxTree, empty_tree

IMAGE_BITS = 6
IMAGES = 1 << IMAGE_BITS  # largest number of images within reach
MAX_NEIGHBORS = 2**16  # of one cluster
MASK_BITS = 16  # of one site; no vector has more lanes
SHELLS = 15  # the first: inside the cutoff when the list is built; the others divide the skin
MAX_BEYOND = 2**8 - 1
LONGEST_SKIN = 0.45  # of the smallest edge
ROUNDING = 1e-5  # relative; float32 distances are accurate to 1e-6

# Columns of PairList.needed and PairList.counters. WINDOW: number of clusters behind the block that
# its rows reach.
ENTRIES, MASKED, NEIGHBORS, WINDOW, NEIGHBORS_OF_ONE = 0, 1, 2, 3, 4
USABLE, BUILDS, STATUS, IMAGES_FOUND = 0, 1, 2, 3


class PairList(NamedTuple):
    """Rows of clusters for the sites of one potential.

    Cluster c of block b has the neighbours neighbors[b, first:end] with end = neighbor_end[c],
    first = neighbor_end[c - 1], or 0 for the first cluster of a block. A neighbour is an image of a
    cluster, stored as the integer IMAGES * cluster + image number. `shift` has its displacement. An
    entry of a row is an index in these.
    """

    cutoff: float  # Å
    skin: float  # Å
    shells_per_A: float  # beyond the cutoff
    reach2: float  # square of the largest distance between sites of one group, Å²; may be infinite
    group: np.ndarray  # (s,) group of each site; pairs inside one group are excluded
    cell: np.ndarray  # (3, 3) the cell at the last use, Å
    built: np.ndarray  # (3, 3) the cell when the list was built, Å
    clusters: Clusters
    tree: BoxTree
    multiple: np.ndarray  # (IMAGES, 3) int32 edges a, b, c by which each image is displaced
    shift: np.ndarray  # (4 * IMAGES,) x, y, z, 0 of each image, Å
    slack: np.ndarray  # (1,) the largest displacement of an image since the list was built, Å
    # (rows,) int32 end in entries[b] of row r (slots 2 r and 2 r + 1); row r + 1 starts there
    row_end: np.ndarray
    # (rows, SHELLS) uint8 number of entries at the end of a row that are beyond shell k
    beyond: np.ndarray
    entries: np.ndarray  # (blocks, capacity) uint16
    masked_end: np.ndarray  # (rows,) int32 end of each row in masked[b]
    # (blocks, capacity, 2) int32 entry; lanes that interact with each site, MASK_BITS bits each
    masked: np.ndarray
    neighbor_end: np.ndarray  # (clusters,) int32
    neighbors: np.ndarray  # (blocks, capacity) int32
    # (blocks, 3 capacity) to the origin of c from a neighbour, Å; (blocks, 0) in float64
    origin_vector: np.ndarray
    # (blocks, 5) capacity expected or needed: ENTRIES, MASKED, ... NEIGHBORS_OF_ONE
    needed: np.ndarray
    # (4,) valid (0 or 1), number of builds, status of the last update, number of images
    counters: np.ndarray
    # (2,) time of the build, NaN before the first; lead time of the references; ps
    times: np.ndarray


@kernel(inline=True)
def cluster_of(image):
    """The cluster of an image."""
    return image >> IMAGE_BITS


@kernel(inline=True)
def image_number(image):
    """The image number, an index into `shift`."""
    return image & (IMAGES - 1)


@kernel(inline=True)
def behind_block(bounds, block, cluster):
    """Number of clusters on the ring from the end of a block to a cluster. -1 for a cluster of the
    block."""
    first, end = bounds[block], bounds[block + 1]
    if first <= cluster < end:
        return -1
    return cluster - end + (bounds[len(bounds) - 1] if cluster < end else 0)


def empty_list(
    cell: np.ndarray, group: np.ndarray, reach: float, cutoff: float, skin: float, dtype: type
) -> PairList:
    """A list that is built at its first use, with the capacity that evenly distributed sites need.
    cell : (3, 3). reach : largest distance between sites of one group, Å. Infinite if it is not
    known"""
    clusters = clusters_of(len(group), dtype)
    blocks, slots = len(clusters.largest_displacement), len(clusters.order)
    rows = slots // 2
    count = len(clusters.origin) // 4
    most_rows = rows // count * int(np.diff(clusters.bounds).max())  # of a block
    capacity = ceil(_expected_neighbors(cell, count, cutoff + skin, 1.0) * most_rows)
    size = 1.75 if rows > count else 1.0  # of two lanes a cluster is one row
    neighbors = ceil(
        _expected_neighbors(cell, count, cutoff + skin, size) * most_rows * count / rows
    )
    needed = np.zeros((blocks, 5), np.int64)
    needed[:, WINDOW] = _expected_window(cell, count, blocks, cutoff + skin)
    skin = _fitting_skin(cell, cutoff, skin)
    # masked entries per row, measured: argon 1.1, water 1.5
    return PairList(
        cutoff=cutoff,
        skin=skin,
        shells_per_A=(SHELLS - 1) / skin,
        reach2=(reach + ROUNDING * (cutoff + skin)) ** 2,
        group=group,
        cell=cell.copy(),
        built=cell.copy(),
        clusters=clusters,
        tree=empty_tree(count),
        multiple=np.zeros((IMAGES, 3), np.int32),
        shift=zeros(4 * IMAGES, np.float64),
        slack=np.zeros(1),
        row_end=np.zeros(rows, np.int32),
        beyond=np.zeros((rows, SHELLS), np.uint8),
        entries=np.empty((blocks, capacity), np.uint16),
        masked_end=np.zeros(rows, np.int32),
        masked=np.empty((blocks, ceil(1.5 * most_rows), 2), np.int32),
        neighbor_end=np.zeros(count, np.int32),
        neighbors=np.empty((blocks, neighbors), np.int32),
        origin_vector=_origin_vector_buffer(blocks, neighbors, dtype),
        needed=needed,
        counters=np.zeros(4, np.int64),
        times=np.array([nan, 0.0]),
    )


def _origin_vector_buffer(blocks: int, neighbors: int, dtype: type) -> np.ndarray:
    """An array for `PairList.origin_vector`. Empty in float64, where it would need much memory and
    save no time."""
    return np.empty((blocks, 3 * neighbors if dtype == np.float32 else 0), dtype)


def _fitting_skin(cell: np.ndarray, cutoff: float, skin: float) -> float:
    """The skin, shortened if second images could come within reach between builds, for which IMAGES
    is too small."""
    return min(skin, LONGEST_SKIN * cell.diagonal().min()) if cutoff < inf else inf


def _expected_neighbors(cell: np.ndarray, count: int, radius: float, size: float) -> float:
    """Half the expected number of clusters within a radius of sites, 0 if the density is not known.
    size : 1 for a row, which is small, 1.75 for a whole cluster: water needs 1.6 to 1.7"""
    if radius == inf:
        return count / 2 + 1
    volume = cell.diagonal().prod()
    if volume == inf:
        return 0.0
    cluster = volume / count
    edge = size * np.cbrt(cluster)
    # Steiner's formula
    near = edge**3 + 6 * edge**2 * radius + 3 * pi * edge * radius**2 + 4 / 3 * pi * radius**3
    # a sixth less than half: measured, cubes have corners
    return min(0.42 * near / cluster, count / 2) + 1


def _expected_window(cell: np.ndarray, count: int, blocks: int, radius: float) -> int:
    """Expected number of clusters behind a block that its rows reach."""
    volume = cell.diagonal().prod()
    if volume == inf or radius == inf:
        return 0
    # clusters are sorted along x first
    layers = (radius + 2 * np.cbrt(volume / count)) / cell[0, 0]
    return min(count - count // blocks, ceil(count * min(layers, 0.5)))


#: Arrays of `Clusters` from which the same list is built again, besides the order of the sites.
CHECKPOINTED = ("boxes", "origin", "reference")


def checkpoint_arrays(pairs: PairList) -> dict[str, np.ndarray]:
    """The arrays from which `restored` makes this list again, bit for bit, although sites have
    moved since."""
    arrays = {"skin": np.array(pairs.skin)}
    if pairs.counters[USABLE] == 1:
        arrays |= {name: getattr(pairs.clusters, name) for name in CHECKPOINTED}
        arrays |= {"order": order_of(pairs.clusters), "built": pairs.built, "times": pairs.times}
    return arrays


def restored(pairs: PairList, arrays: dict[str, np.ndarray], requested_skin: float) -> PairList:
    """The new list with the clusters and the skin of a checkpoint. `update.refill` must follow if
    there are clusters.
    requested_skin : in Å. Raises ValueError if the arrays do not fit such a list."""
    clusters, cell = pairs.clusters, pairs.cell
    like = {name: getattr(clusters, name) for name in (*CHECKPOINTED, "order")}
    like |= {"built": pairs.built, "times": pairs.times}
    if arrays.keys() not in ({"skin"}, {"skin", *like}):
        raise ValueError(f"a neighbour list has {', '.join(arrays) or 'no arrays'}")
    for name, array in ({"skin": np.array(pairs.skin)} | like).items():
        stored = arrays.get(name, array)
        if (stored.shape, stored.dtype) != (array.shape, array.dtype):
            raise ValueError(f"{name} of a neighbour list has another shape or type")
        if name in arrays and name not in ("skin", "built") and not np.isfinite(stored).all():
            raise ValueError(f"{name} of a neighbour list is not finite")
    skin = float(arrays["skin"])
    if not (
        min(pairs.skin, 2 * LONGEST_SKIN * pairs.cutoff) <= skin <= max(pairs.skin, requested_skin)
    ):
        raise ValueError(f"a neighbour list has the skin {skin:g} Å")
    pairs = pairs._replace(skin=skin, shells_per_A=(SHELLS - 1) / skin)
    if "order" not in arrays:
        return pairs
    sites = len(clusters.slot)
    if not np.array_equal(np.sort(arrays["order"][:sites]), np.arange(sites)):
        raise ValueError("order of a neighbour list is none of its sites")
    for name, array in like.items():
        array[:] = arrays[name]
    clusters.order[sites:] = clusters.order[sites - 1]
    clusters.slot[clusters.order[:sites]] = np.arange(sites)
    clusters.group[:] = pairs.group[clusters.order]
    cell[:] = pairs.built  # the update of the list then follows the cell of the state
    return pairs


def with_capacity(pairs: PairList, cell: np.ndarray) -> PairList:
    """The list with the capacity that its last build needed and a tenth more, and a skin that fits
    into the cell. Raises SimulationError if the cell has become too small for the cutoff, or too
    many sites are within it."""
    if pairs.counters[STATUS] == CELL_CHANGED:
        if 2 * pairs.cutoff > cell.diagonal().min():
            raise SimulationError(
                f"the box has become too small for the cutoff of {pairs.cutoff:g} Å: half its"
                f" smallest edge is {cell.diagonal().min() / 2:.4g} Å. Begin with a larger box, or"
                " take a shorter cutoff"
            )
        skin = _fitting_skin(cell, pairs.cutoff, pairs.skin)
        pairs = pairs._replace(skin=skin, shells_per_A=(SHELLS - 1) / skin)
    blocks = len(pairs.needed)
    entries, masked, neighbors, _, of_one = pairs.needed.max(axis=0)
    if of_one > MAX_NEIGHBORS:
        sites = MAX_NEIGHBORS * lane_count(pairs.origin_vector.dtype)
        why = f"more than {sites} sites are within the cutoff of {pairs.cutoff:g} Å"
        raise SimulationError(f"{why}: take a shorter one, or fewer molecules")
    if entries > pairs.entries.shape[1]:
        pairs = pairs._replace(entries=np.empty((blocks, int(1.1 * entries) + 16), np.uint16))
    if masked > pairs.masked.shape[1]:
        pairs = pairs._replace(masked=np.empty((blocks, int(1.1 * masked) + 16, 2), np.int32))
    if neighbors > pairs.neighbors.shape[1]:
        capacity = int(1.1 * neighbors) + 16
        origin_vector = _origin_vector_buffer(blocks, capacity, pairs.origin_vector.dtype)
        pairs = pairs._replace(
            neighbors=np.empty((blocks, capacity), np.int32), origin_vector=origin_vector
        )
    return pairs


@kernel
def most_needed(pairs, k):
    """The largest of `needed[:, k]` over the blocks."""
    most = 0
    for block in range(len(pairs.needed)):
        most = max(most, pairs.needed[block, k])
    return most


@kernel(inline=True)
def largest_displacement(pairs):
    """The largest displacement of an image of a site from its reference, Å. Infinite if the list is
    not valid."""
    found = 0.0
    for block in range(len(pairs.needed)):
        found = max(found, pairs.clusters.largest_displacement[block])
    return found + pairs.slack[0]


@kernel(inline=True)
def end_of_row(pairs, r, displacement):
    """End of the entries of row r that can have a site inside the cutoff. `displacement` as above,
    Å."""
    moved = max(pairs.clusters.moved[2 * r], pairs.clusters.moved[2 * r + 1])
    shell = min(SHELLS - 1, ceil((moved + displacement) * pairs.shells_per_A))
    return pairs.row_end[r] - pairs.beyond[r, shell]
