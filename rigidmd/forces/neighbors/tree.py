"""A tree of bounding boxes of clusters. It finds clusters within reach of one another in O(N log N)
for any shape.

A node has as many children as a vector of float64 has lanes, so one vector comparison tests all of
them. The tree is searched once for some clusters near one another, down to families. Each of the
clusters then tests their boxes.
"""

from math import ceil, inf
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel, load_arguments, task
from rigidmd.compile.simd import lane_count, lanes_of, load, lowest_bit, mask_bits


class BoxTree(NamedTuple):
    """Boxes around clusters (level 0), around groups of such boxes, called families (level 1), and
    so on up to one family."""

    low: np.ndarray  # (3, nodes) the levels one after the other, each padded with empty boxes
    high: np.ndarray  # (3, nodes)
    level: np.ndarray  # (levels + 1,) first node of each level


def empty_tree(count: int) -> BoxTree:
    """A tree for `count` clusters, with empty boxes."""
    arity = lane_count(np.float64)
    level = [0]
    while len(level) == 1 or count > 1:
        count = ceil(count / arity)
        level.append(level[-1] + count * arity)
    nodes = (3, level[-1])
    return BoxTree(np.full(nodes, inf), np.full(nodes, -inf), np.array(level))


@task(count_references=False)
def fit_boxes(arguments, block):
    """Set the corners (3, boxes) of the box of each cluster, and of each box of boxes above, Å."""
    pairs = load_arguments(arguments)
    tree, clusters = pairs.tree, pairs.clusters
    arity = lanes_of(tree.low)
    width = lanes_of(clusters.local)
    tree.low[:] = inf
    tree.high[:] = -inf
    for c in range(len(clusters.origin) // 4):
        for k in range(3):
            for at in range(3 * width * c + k * width, 3 * width * c + (k + 1) * width):
                x = clusters.origin[4 * c + k] + clusters.reference[at]
                tree.low[k, c] = min(tree.low[k, c], x)
                tree.high[k, c] = max(tree.high[k, c], x)
    for upper in range(1, len(tree.level) - 1):
        for child in range(tree.level[upper - 1], tree.level[upper]):
            node = tree.level[upper] + (child - tree.level[upper - 1]) // arity
            for k in range(3):
                tree.low[k, node] = min(tree.low[k, node], tree.low[k, child])
                tree.high[k, node] = max(tree.high[k, node], tree.high[k, child])


@kernel(inline=True, count_references=False)
def families_within_reach(tree, low, high, radius2, first, end, clusters, stack, found, count):
    """Write to found[count:], ascending, families that may have clusters closer than a radius to a
    box (3,), (3,).

    Family f has clusters arity * f ... arity * (f + 1) - 1. Only those are taken that have a
    cluster at most half way round the ring ahead of one of clusters first ... end - 1. Returns the
    new count, which may exceed len(found). Stack (levels, 2) is scratch.
    """
    arity = lanes_of(tree.low)
    top = len(tree.level) - 2
    half = clusters // 2
    depth = 0
    size = arity ** (top + 1)  # clusters under the node
    stack[0, 0] = 0  # node
    stack[0, 1] = 1  # its siblings that are left, and itself, as bits; the root has none
    while depth >= 0:
        if stack[depth, 1] == 0:
            depth -= 1
            size *= arity
            continue
        node = stack[depth, 0] + lowest_bit(stack[depth, 1])
        stack[depth, 1] &= stack[depth, 1] - 1
        begin = node * size
        if not ((begin < end + half and begin + size > first) or begin < end + half - clusters):
            continue
        if depth == top:
            if count < len(found):
                found[count] = node
            count += 1
        else:
            depth += 1
            size //= arity
            stack[depth, 0] = node * arity
            stack[depth, 1] = near(
                tree, tree.level[top + 1 - depth] + node * arity, low, high, radius2
            )
    return count


@kernel(inline=True)
def near(tree, node, low, high, radius2):
    """Which of the boxes from a node on, as many as its siblings, are closer than a radius to a
    box, as bits."""
    dx = max(max(load(tree.low[0], node) - high[0], low[0] - load(tree.high[0], node)), 0.0)
    dy = max(max(load(tree.low[1], node) - high[1], low[1] - load(tree.high[1], node)), 0.0)
    dz = max(max(load(tree.low[2], node) - high[2], low[2] - load(tree.high[2], node)), 0.0)
    return mask_bits(dx * dx + dy * dy + dz * dz < radius2)


@kernel(inline=True)
def ahead(c, clusters, first, arity):
    """Which of clusters first ... first + arity - 1 are at most half way round the ring ahead of
    cluster c, as bits. Of two clusters opposite one another the second is ahead of the first."""
    passed = _bits_below(c - first, arity)
    beyond = _bits_below(c + clusters // 2 + 1 - first, arity)
    around = _bits_below(c + (clusters - 1) // 2 + 1 - clusters - first, arity)
    return (beyond & ~passed) | around


@kernel(inline=True)
def _bits_below(k, count):
    """The lowest k of `count` bits."""
    return (1 << min(max(k, 0), count)) - 1
