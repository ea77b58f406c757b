"""Cells: the standard orientation, equal cells of a lattice, distances of nearest images."""

import numpy as np
import pytest
from support.common import built
from support.structures import ROUND_CELLS

from rigidmd.assemble.start import close_pairs, every_site
from rigidmd.formats.cells import (
    basis_of,
    describe_basis,
    least_skewed_cell,
    nearest_images,
    pairs_within,
    reduced_cell,
    standard_rotation,
)
from rigidmd.scene.species import Box


def test_the_standard_orientation_keeps_the_lattice():
    rng = np.random.default_rng(0)
    for _ in range(50):
        cell = rng.standard_normal((3, 3))
        turned, rotation = standard_rotation(cell)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert np.array_equal(turned, np.tril(turned))
        assert (np.diag(turned) > 0).all()
        whole = turned @ np.linalg.inv(cell @ rotation.T)  # of old vectors in new ones
        assert whole == pytest.approx(np.diag([1, 1, np.sign(np.linalg.det(cell))]))
    same, rotation = standard_rotation(np.diag([3.0, 4.0, 5.0]))
    assert np.array_equal(same, np.diag([3.0, 4.0, 5.0]))
    assert np.array_equal(rotation, np.eye(3))


@pytest.mark.parametrize(
    ("angles", "told"),
    [
        ((90.0, 60.0, 90.0), ""),  # 36 cos 60° is 18.000000000000004
        ((60.0, 60.0, 60.0), ""),
        ((90.0, 59.995, 90.0), ""),  # 60.00 as files print it
        ((90.0, 120.0, 90.0), ""),
        ((90.0, 59.0, 90.0), "c' = c - a"),
        ((90.0, 120.5, 90.0), "c' = c + a"),
        ((60.0, 59.0, 58.0), "b' = b - a, c' = c - a"),
        ((25.0, 30.0, 30.0), "b' = b - a, c' = c - b"),
    ],
)
def test_a_cell_tilts_by_half_an_edge_as_far_as_files_state(angles, told):
    cell = Box(lengths_A=36.0, angles_deg=angles).cell
    other = reduced_cell(cell)
    basis = basis_of(other, cell)
    assert describe_basis(basis) == told
    assert np.array_equal(other, cell) == (not told)
    assert basis @ cell == pytest.approx(other, abs=1e-12)
    assert abs(np.linalg.det(basis)) == pytest.approx(1)
    assert (np.abs(other - np.diag(np.diag(other))) <= 0.5005 * np.diag(other)).all()


@pytest.mark.parametrize("kind", ROUND_CELLS)
def test_another_cell_of_a_lattice_does_not_depend_on_digits(kind):
    """Cells with long edges are replaced by one of many that are equally good, always by the same
    one."""
    rng, edges = np.random.default_rng(7), 16.0 * np.array(ROUND_CELLS[kind])
    for _ in range(15):
        basis = np.eye(3, dtype=int)
        for _ in range(4):
            i, j = rng.permutation(3)[:2]
            basis[i] += rng.integers(-2, 3) * basis[j]
        cell, _ = standard_rotation(basis @ edges)
        wanted, turned = least_skewed_cell(cell)
        assert np.diag(wanted).min() >= 0.7 * 16.0
        for _ in range(4):
            rounded = cell + 5e-5 * np.tril(rng.uniform(-1, 1, (3, 3)))
            found, rotation = least_skewed_cell(rounded)
            assert found == pytest.approx(wanted, abs=0.02)
            assert rotation == pytest.approx(turned, abs=0.01)


def test_pairs_within_a_radius_in_any_cell():
    rng = np.random.default_rng(0)
    for _ in range(20):
        cell = np.tril(rng.uniform(-10, 10, (3, 3)), -1) + np.diag(rng.uniform(6, 12, 3))
        points = rng.random((15, 3)) @ cell
        radius = rng.uniform(2, 4)
        images = np.stack(np.meshgrid(*[np.arange(-10, 11)] * 3), -1).reshape(-1, 3) @ cell
        step = points[:, None] - points
        wanted = {
            (i, j)
            for i in range(15)
            for j in range(i)
            if np.linalg.norm(step[i, j] + images, axis=1).min() <= radius
        }
        assert 0 < len(wanted) < 105
        i, j, step = pairs_within(points + rng.integers(-5, 6, (15, 3)) @ cell, cell, radius)
        assert {(max(a, b), min(a, b)) for a, b in zip(i, j, strict=True) if a != b} == wanted
        assert np.linalg.norm(step, axis=1).max(initial=0.0) <= radius
        images = (step - points[j] + points[i]) @ np.linalg.inv(cell)
        assert images == pytest.approx(np.round(images), abs=1e-9)


def test_nearest_images_in_any_cell():
    """Also in a cell whose edges lie so near to each other that rounded fractions give another
    image."""
    rng = np.random.default_rng(1)
    images = np.stack(np.meshgrid(*[np.arange(-25, 26)] * 3), -1).reshape(-1, 3)
    for cell in (
        np.diag([4.0, 5.0, 6.0]),
        [[10.0, 0, 0], [9.9, 2.0, 0], [3.0, 1.5, 7.0]],
        [[5.0, 0, 0], [4.0, 5.0, 0], [-8.0, 7.0, 5.0]],
    ):
        vectors = rng.uniform(-12, 12, (10, 3))
        shortest = np.linalg.norm(vectors[:, None] + images @ np.array(cell), axis=2).min(axis=1)
        found = nearest_images(vectors, np.array(cell))
        assert np.linalg.norm(found, axis=1) == pytest.approx(shortest)
        whole = (found - vectors) @ np.linalg.inv(cell)
        assert whole == pytest.approx(np.round(whole), abs=1e-9)


@pytest.mark.parametrize(
    "counts",
    [{"spce": 40}, {"spce": 30, "argon": 15}, {"benzene_trappe": 15}, {"hf_jorgensen": 40}],
)
def test_close_sites_are_those_of_all_pairs(counts):
    """Benzene is larger than its sites: there all sites are searched, of water those of molecules
    that are close."""
    system, _, state = built(counts, 14.0, 1, spread=1.2, forces={"cutoff_A": 6.0})
    wanted = (0.9, every_site), (2.4, lambda m: np.flatnonzero(m.epsilon > 0))
    at, owner = system.site_positions(state), system.sites.molecule
    repels = system.of_sites(lambda m: m.epsilon > 0)
    step = at[:, None] - at
    apart = np.linalg.norm(step - 14.0 * np.rint(step / 14.0), axis=2)
    close = (apart <= 0.9) | (apart <= 2.4) & (repels & repels[:, None])
    close &= np.triu(owner != owner[:, None])
    found = close_pairs(system, state, *wanted)
    assert len(found) > 5
    assert [pair[:2] for pair in found] == [tuple(pair) for pair in np.argwhere(close).tolist()]
    assert [pair[2] for pair in found] == pytest.approx(apart[close].tolist())
