"""Structure: pairs, neighbours, density profiles, hydrogen bonds."""

import numpy as np
import pytest
from support.common import history, system_of
from support.frames import TRICLINIC, rotations_about

from rigidmd.features.analysis.built_in.structure import (
    density_profile,
    hydrogen_bonds,
    rdf,
    structure_factor,
)
from rigidmd.features.analysis.pair_histogram import count_pairs, heights


# structure
def pairs_by_hand(first, owner, second, owner_2, cell, edge, bins):
    """Distances to the nearest image, from all 27 of them."""
    images = (
        np.array([[i, j, k] for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)]) @ cell
    )
    fold = np.linalg.inv(cell)
    first, second = ((at @ fold % 1.0) @ cell for at in (first, second))
    ways = second[None, :, None] - first[:, None, None] + images
    gap = np.linalg.norm(ways, axis=-1)
    seen = gap[owner[:, None] != owner_2[None, :]].ravel()
    return np.histogram(seen[seen < edge * bins], edge * np.arange(bins + 1))[0]


@pytest.mark.parametrize("part", [1.0, 0.7, 0.36, 0.1, 0.03])
@pytest.mark.parametrize(
    "cell",
    [np.eye(3) * 20.0, TRICLINIC, np.diag([9.0, 31.0, 70.0])],
    ids=["cube", "triclinic", "long"],
)
def test_pairs_are_counted_once(cell, part):
    """Grids of 1 to many cells; sites outside the box and on its faces; ordered pairs of different
    molecules."""
    rng = np.random.default_rng(5)
    at = rng.normal(0.5, 1.5, (80, 3)) @ cell
    at[:4] = np.array([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [-1e-17, 0.3, 1]]) @ cell
    other, owner, owner_2 = (
        rng.random((30, 3)) @ cell,
        rng.integers(0, 25, 80),
        rng.integers(0, 25, 30),
    )
    bins = 12
    edge = part * 0.5 * heights(cell).min() / bins
    for second, second_owner in ((at, owner), (other, owner_2)):
        counted = count_pairs(at, owner, second, second_owner, cell, edge, bins)
        assert (
            counted.tolist()
            == pairs_by_hand(at, owner, second, second_owner, cell, edge, bins).tolist()
        )


@pytest.mark.parametrize("n", [2, 3, 8, 60])
def test_an_ideal_gas_has_no_structure(n):
    """In a triclinic cell that breathes, g = 1 also for two molecules; each has n - 1 others; S =
    1."""
    system = system_of({"argon": n}, 25.0)
    rng = np.random.default_rng(n)
    cells = TRICLINIC * (1 + 0.05 * rng.standard_normal(200))[:, None, None]
    gas = history(
        system, np.arange(200.0), np.einsum("fni,fij->fnj", rng.random((200, n, 3)), cells), cells
    )
    found = rdf(gas, "Ar", width=0.5)
    r, g, error = (found[name] for name in ("r (A)", "g Ar-Ar", "g Ar-Ar error"))
    shells = 4 / 3 * np.pi * ((r + 0.25) ** 3 - (r - 0.25) ** 3)
    assert np.sum(g * shells) / shells.sum() == pytest.approx(
        1.0, abs=4 * np.sqrt(2 / 200 / n / (n - 1) / (shells.sum() / 9000))
    )
    far = r > 3.0
    assert np.median(error[far]) > 0
    spread = (g - 1)[far] / np.maximum(error[far], np.median(error[far]))
    assert np.abs(spread).max() < 6.0
    density = (n - 1) / gas.volume.mean()
    each = g * shells * density
    assert found["n Ar-Ar"] == pytest.approx(np.cumsum(each) - 0.5 * each, rel=0.01, abs=1e-9)
    assert found["n Ar-Ar"][-1] == pytest.approx(
        density * 4 / 3 * np.pi * r[-1] ** 3, rel=0.35 if n < 8 else 0.1
    )
    waves = structure_factor(gas, largest=3.0)
    assert np.mean(waves["S centres"]) == pytest.approx(1.0, abs=0.05)
    pulls = (waves["S centres"] - 1) / waves["S centres error"]
    assert np.sqrt(np.mean(pulls**2)) < 2.5


def test_two_atoms_at_a_distance_have_one_neighbour():
    system = system_of({"argon": 2}, 25.0)
    positions = np.zeros((10, 2, 3))
    positions[:, 1, 2] = 4.02
    found = rdf(history(system, np.arange(10.0), positions, np.eye(3) * 25.0), "Ar", width=0.1)
    assert found["n Ar-Ar"][-1] == pytest.approx(1.0, abs=1e-12)
    assert np.flatnonzero(found["g Ar-Ar"]).tolist() == [40]
    waves = structure_factor(
        history(system, np.arange(10.0), positions, np.eye(3) * 25.0), largest=1.0
    )
    assert waves["S centres"].max() <= 2.0


def test_the_profile_of_a_density_is_where_the_mass_is():
    system = system_of({"spce": 4}, 25.0)
    positions = np.zeros((10, 4, 3))
    positions[..., 2] = np.array([0.1, 0.1, 0.6, -24.4])
    Q = np.broadcast_to(np.eye(3), (10, 4, 3, 3))
    found = density_profile(
        history(system, np.arange(10.0), positions, np.eye(3) * 25.0, Q), "z", bins=50
    )
    rho = found["density spce (g/cm3)"]
    assert np.flatnonzero(rho).tolist() == [0, 1]
    assert rho[0] == pytest.approx(rho[1])
    mass = 4 * system.species[0].mass
    assert rho.mean() == pytest.approx(mass * 1.66053906660 / 25.0**3)
    assert found["z (A)"][[0, -1]] == pytest.approx([0.25, 24.75])


def test_a_uniform_density_has_few_bins_and_a_slab_many():
    system = system_of({"argon": 64}, 25.0)
    rng = np.random.default_rng(3)
    for height, bins in ((25.0, 20), (10.0, 100)):
        positions = rng.uniform(0, 25.0, (10, 64, 3))
        positions[..., 2] *= height / 25.0
        found = density_profile(history(system, np.arange(10.0), positions, np.eye(3) * 25.0), "z")
        assert len(found["z (A)"]) == bins


def test_hydrogen_bonds_are_those_of_the_geometry():
    """A bond that points at its neighbour through the wall; one that is 25° off, and one that is
    35° off."""
    system = system_of({"spce": 2}, 25.0)
    body = system.species[0].positions_body
    arm = body[1] - body[0]
    arm = arm / np.linalg.norm(arm)
    for off, gap, expected in (
        (0.0, 2.8, 1.0),
        (25.0, 2.8, 1.0),
        (35.0, 2.8, 0.0),
        (0.0, 3.6, 0.0),
    ):
        way = rotations_about(np.array([0.0, 0.0, np.radians(off)])) @ arm
        positions = np.zeros((40, 2, 3))
        positions[:, 1] = gap * way + np.array([25.0, -50.0, 0.0])
        # the second rotates its hydrogens away, and its oxygen is where the first one's bond points
        flip = np.eye(3)
        Q = np.broadcast_to(np.stack([np.eye(3), flip]), (40, 2, 3, 3))
        found = hydrogen_bonds(history(system, np.arange(40.0), positions, np.eye(3) * 25.0, Q))
        assert found.value().value == pytest.approx(expected), off


def pairs_of(rng, edge, gaps):
    """Molecules (f, 60, 3) in pairs far apart from each other, at distances (f, 30)."""
    centres = 25.0 * np.array(
        [[i, j, k] for i in range(4) for j in range(4) for k in range(2)][:30], float
    )
    away = rng.standard_normal((*gaps.shape, 3))
    second = centres + away * (gaps / np.linalg.norm(away, axis=2))[..., None]
    return np.concatenate([np.broadcast_to(centres, second.shape), second], axis=1)


def test_neighbours_up_to_the_first_minimum_follow_it_and_have_an_honest_error():
    """Distances of two peaks: exactly so, with the minimum anywhere between two bins; then drawn at
    random."""
    system, edge, frames = system_of({"argon": 60}, 100.0), 100.0, 250
    r, rng, name = (
        np.linspace(2.0, 7.5, 5501),
        np.random.default_rng(0),
        "g AR-AR: neighbours up to the first minimum",
    )

    def seen(gaps):
        at = pairs_of(rng, edge, gaps.reshape(-1, 30))
        return rdf(history(system, np.arange(float(len(at))), at, np.eye(3) * edge), "AR").value(
            name
        )

    def distances(moved, level):
        """For fractions of all pairs; and the fraction within the minimum."""
        g = sum(
            h * np.exp(-0.5 * ((r - moved - at) / wide) ** 2)
            for h, at, wide in ((2, 3.2, 0.25), (0.8, 5.2, 0.7))
        )
        partners = r**2 * (g + 0.4 * (r > 2.5))
        partners /= np.trapezoid(partners, r)
        between = (r > 3.5) & (r < 4.5)
        minimum = r[between][np.argmin((partners / r**2)[between])]
        inside = float(np.trapezoid(partners[r <= minimum], r[r <= minimum]))
        return (
            np.interp(level, np.cumsum(partners) / partners.sum(), r),
            inside,
            np.interp(minimum, r, partners),
        )

    even = rng.permutation((np.arange(frames * 30) + 0.5) / (frames * 30))
    for moved in (0.0, 0.01, 0.02, 0.03, 0.04):
        gaps, inside, rate = distances(moved, even)
        assert seen(gaps).value == pytest.approx(
            inside, abs=0.3 * 0.05 * rate
        )  # a third of what is in a bin
    found = []
    for _ in range(20):
        gaps, inside, _ = distances(0.02, rng.random(frames * 30))
        found.append(seen(gaps)[2:4])
    values, errors = np.array(found, float).T
    assert 0.5 < np.sqrt(np.mean(((values - inside) / errors) ** 2)) < 1.4
    assert np.median(errors) < 0.03
    assert errors.max() < 0.08
