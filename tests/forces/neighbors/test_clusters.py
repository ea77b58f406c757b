"""Clusters of sites and blocks of their lists."""

import numpy as np
import pytest

from rigidmd.compile import kernel
from rigidmd.compile.simd import lane_count
from rigidmd.forces.neighbors.clusters import clusters_of
from rigidmd.forces.neighbors.tree import ahead


@kernel(from_python=True)
def _ahead(c, clusters, first, arity):
    return ahead(c, clusters, first, arity)


@pytest.mark.parametrize("clusters", [1, 2, 3, 7, 8, 9, 16, 21])
def test_of_two_clusters_one_is_ahead_of_the_other(clusters):
    """Each pair is then listed once."""
    found = []
    for c in range(clusters):
        for first in range(0, clusters, 4):
            bits = _ahead(c, clusters, first, 4)
            found += [(c, first + k) for k in range(4) if bits >> k & 1 and first + k < clusters]
    once = {tuple(sorted(pair)) for pair in found}
    assert len(found) == len(once) == clusters * (clusters + 1) // 2
    assert all((b - a) % clusters <= clusters // 2 for a, b in found)


def test_blocks_of_lists_grow_in_number_with_the_edge_of_the_box():
    for sites, blocks in ((100, 1), (900, 16), (12_288, 16), (1_000_000, 20), (2_000_000, 25)):
        bounds = clusters_of(sites, np.float64).bounds
        assert len(bounds) == blocks + 1
        assert (
            bounds[0] == 0
            and bounds[-1] * lane_count(np.float64) >= sites
            and (np.diff(bounds) > 0).all()
        )
