"""A tree of boxes around clusters, to find those within reach of one another in O(N log N), whatever the shape.

A node holds as many children as a vector of float64 has lanes; one look tells which of them are within reach.
"""

from math import inf
from typing import NamedTuple

import numpy as np

from rigidmd.forces.lanes import bits, larger, load, lowest_bit, width_of
from rigidmd.jit import PAIR_FLAGS, kernel


class BoxTree(NamedTuple):
    """Boxes of clusters (level 0), of families of those (level 1), and so on up to one family."""

    low: np.ndarray  # (3, nodes) all levels one after the other, each filled up with boxes that are nowhere
    high: np.ndarray  # (3, nodes)
    level: np.ndarray  # (levels + 1,) where each level begins


@kernel
def box_tree(clusters):
    """The tree of clusters as they are."""
    arity = width_of(clusters.origin)
    width = width_of(clusters.local)
    count = len(clusters.origin) // 4
    level = np.zeros(64, np.int64)
    levels = 0
    families = count
    while levels == 0 or families > 1:
        families = (families + arity - 1) // arity
        level[levels + 1] = level[levels] + families * arity
        levels += 1
    low = np.full((3, level[levels]), inf)
    high = np.full((3, level[levels]), -inf)
    for c in range(count):
        for k in range(3):
            for at in range(3 * width * c + k * width, 3 * width * c + (k + 1) * width):
                x = clusters.origin[4 * c + k] + clusters.local[at]
                low[k, c] = min(low[k, c], x)
                high[k, c] = max(high[k, c], x)
    for upper in range(1, levels):
        for child in range(level[upper - 1], level[upper]):
            node = level[upper] + (child - level[upper - 1]) // arity
            for k in range(3):
                low[k, node] = min(low[k, node], low[k, child])
                high[k, node] = max(high[k, node], high[k, child])
    return BoxTree(low, high, level[: levels + 1])


@kernel(fastmath=PAIR_FLAGS, counted=False)
def within_reach(tree, low, high, radius2, stack, found, count):
    """Append to found[count:] the clusters whose boxes are closer than a radius to a box (3,), (3,), in ascending order.

    Returns the new count, which may exceed the room; stack (levels, 2) is scratch.
    """
    arity = width_of(tree.low)
    top = len(tree.level) - 2
    depth = 0
    stack[0, 0] = 0  # family
    stack[0, 1] = _near(tree, tree.level[top], low, high, radius2)
    while depth >= 0:
        if stack[depth, 1] == 0:
            depth -= 1
            continue
        child = lowest_bit(stack[depth, 1])
        stack[depth, 1] &= stack[depth, 1] - 1
        node = stack[depth, 0] * arity + child
        if depth == top:
            if count < len(found):
                found[count] = node
            count += 1
        else:
            depth += 1
            stack[depth, 0] = node
            stack[depth, 1] = _near(tree, tree.level[top - depth] + node * arity, low, high, radius2)
    return count


@kernel(fastmath=PAIR_FLAGS, inline=True)
def _near(tree, node, low, high, radius2):
    """Which boxes of the family that begins at a node are within reach, as bits."""
    dx = larger(larger(load(tree.low[0], node) - high[0], low[0] - load(tree.high[0], node)), 0.0)
    dy = larger(larger(load(tree.low[1], node) - high[1], low[1] - load(tree.high[1], node)), 0.0)
    dz = larger(larger(load(tree.low[2], node) - high[2], low[2] - load(tree.high[2], node)), 0.0)
    return bits(dx * dx + dy * dy + dz * dz < radius2)
