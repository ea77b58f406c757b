"""A start on a lattice."""

import numpy as np


def lattice(n: int, edges: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """n points (n, 3) on a nearly cubic lattice in a rectangular box with edges (3,), drawn at random."""
    shape = np.maximum(1, np.round(edges / np.cbrt(edges.prod() / n))).astype(int)
    while shape.prod() < n:
        shape[np.argmax(edges / shape)] += 1
    points = np.stack(np.meshgrid(*(np.arange(k) for k in shape), indexing="ij"), axis=-1).reshape(-1, 3)
    return (points[rng.permutation(len(points))[:n]] + 0.5) * edges / shape
