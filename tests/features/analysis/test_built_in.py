"""Analyses of frames that are made up: rigid molecules rebuilt, and values that are known
beforehand."""

import re
from math import inf

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter
from support.common import history, noise_with_memory, small_scene, system_of

from rigidmd.analysis.built_in import transport
from rigidmd.analysis.built_in.order import nematic
from rigidmd.analysis.built_in.rotation import PER_CM, dielectric, orientation, spectrum
from rigidmd.analysis.built_in.structure import (
    density_profile,
    hydrogen_bonds,
    rdf,
    structure_factor,
)
from rigidmd.analysis.built_in.transport import (
    MPA_S,
    NM2_PER_S,
    correlation,
    diffusion,
    msd,
    squared_displacement,
    viscosity,
)
from rigidmd.analysis.pair_histogram import count_pairs, heights
from rigidmd.analysis.result import converged_value
from rigidmd.analysis.rigid_frames import fit_frames
from rigidmd.analysis.runs import Runs
from rigidmd.assemble.build import build
from rigidmd.core.statistics import steady_from
from rigidmd.errors import OutputError
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run.rigid_fit import kinds_of
from rigidmd.units import BAR, BOLTZMANN, COULOMB

MIXTURE = {
    "argon": 4,
    "nitrogen": 5,
    "co2_epm2": 5,
    "spce": 6,
    "tip4p2005": 6,
    "benzene_opls": 4,
    "ccl4": 4,
    "tip5p": 3,
}
SLANTED = np.array([[21.0, 0.0, 0.0], [6.0, 19.0, 0.0], [-7.0, 5.0, 23.0]])


def brownian(rng, frames, n, D, interval, drift=0.0):
    """Paths (f, n, 3) of walkers with a diffusion coefficient D, Å²/ps."""
    steps = np.sqrt(2 * D * interval) * rng.standard_normal((frames, n, 3)) + drift * interval
    return np.cumsum(steps, axis=0)


def rotations_about(turns):
    """Rotation matrices (..., 3, 3) of vectors (..., 3), rad."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(turns, -1, 0)
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*turns.shape, 3)
    return (
        np.eye(3)
        + np.sinc(angle / np.pi) * cross
        + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross
    )


# rebuilding


@pytest.fixture(scope="module")
def mixture():
    molecules = [{"model": name, "count": count} for name, count in MIXTURE.items()]
    molecules += [{"model": "spce", "name": "wall", "count": 2, "frozen": True}]
    return build(small_scene({}, 40.0, molecules=molecules, forces={"cutoff_A": 9.0}))


def states(system, frames, seed=0):
    """Random states of a system, one for each frame."""
    rng = np.random.default_rng(seed)
    moves = system.model.inverse_mass[system.model.species] > 0
    found = []
    for _ in range(frames):
        state = system.state.copy()
        n = len(state.position)
        state.position[:] += 30.0 * rng.standard_normal((n, 3))
        state.rotation[:] = random_rotations(rng, n)
        state.velocity[:] = moves[:, None] * rng.standard_normal((n, 3))
        freely = system.model.inverse_inertia[system.model.species] > 0
        state.angular_momentum_body[:] = freely * rng.standard_normal((n, 3))
        found.append(state)
    return found


def test_rigid_bodies_come_back_from_their_sites(mixture):
    told = states(mixture, 3)
    sites = np.array([mixture.site_positions(state) for state in told])
    velocities = np.array([mixture.site_velocities(state) for state in told])
    cells = np.array([state.cell for state in told])
    found, notes = fit_frames(mixture, sites, velocities, cells, wrapped=False)
    assert notes == []
    position, Q, V, L = (
        np.array([getattr(state, name) for state in told])
        for name in ("position", "rotation", "velocity", "angular_momentum_body")
    )
    assert np.abs(found.position - position).max() < 1e-12
    assert np.abs(found.velocity - V).max() < 1e-12
    assert np.abs(np.linalg.det(found.Q) - 1).max() < 1e-12
    kinds = {kind.molecule.kind for kind in kinds_of(mixture)}
    assert kinds == {"point", "linear", "asymmetric", "symmetric", "spherical"}
    for kind in kinds_of(mixture):
        own = found.Q[:, kind.index], Q[:, kind.index]
        arms = [np.einsum("fnij,sj->fnsi", turn, kind.molecule.positions_body) for turn in own]
        assert np.abs(arms[0] - arms[1]).max() < 1e-12
        lab = [
            np.einsum("fnij,fnj->fni", turn, own_l[:, kind.index])
            for turn, own_l in zip(own, (found.L, L), strict=True)
        ]
        assert np.abs(lab[0] - lab[1]).max() < 1e-10
        if kind.molecule.kind not in ("point", "linear"):
            assert np.abs(own[0] - own[1]).max() < 1e-12
            assert np.abs(found.L[:, kind.index] - L[:, kind.index]).max() < 1e-10


def test_wrapped_paths_become_continuous(mixture):
    rng = np.random.default_rng(3)
    state = mixture.state.copy()
    steps = np.cumsum(2.0 * rng.standard_normal((40, len(state.position), 3)), axis=0)
    state.rotation[:] = random_rotations(rng, len(state.position))
    moved = []
    for step in steps:
        now = state.copy()
        now.position[:] += step
        moved.append(now)
    cells = np.array([now.cell for now in moved])
    whole, wrapped = (
        fit_frames(
            mixture,
            np.array([mixture.site_positions(now, put) for now in moved]),
            None,
            cells,
            wrapped=put,
        )
        for put in (False, True)
    )
    assert (
        np.abs(np.diff(whole[0].position, axis=0) - np.diff(wrapped[0].position, axis=0)).max()
        < 1e-10
    )
    assert np.ptp(whole[0].position, axis=0).max() > 30.0
    assert wrapped[1] == ["molecules are wrapped in the frames. Their paths were made continuous"]
    assert wrapped[0].velocity is None and wrapped[0].L is None
    far = np.array([mixture.site_positions(now, True) for now in moved[::12]])
    with pytest.raises(
        OutputError, match=r"move by 0\.\d\d of the box between two frames, .* wrapped"
    ):
        fit_frames(mixture, far, None, cells[:4], wrapped=True)


def test_paths_are_unwrapped_by_the_cell_of_each_frame(mixture):
    """Molecules that move with a cell which grows by a half, and are wrapped into it, go through no
    wall."""
    (state,) = states(mixture, 1)
    state.position[:] += 5 * mixture.state.cell[0]
    moved = [
        state._replace(position=growth * state.position, cell=growth * state.cell)
        for growth in np.linspace(1, 1.5, 9)
    ]
    cells = np.array([now.cell for now in moved])
    sites = np.array([mixture.site_positions(now, True) for now in moved])
    found, _ = fit_frames(mixture, sites, None, cells, wrapped=True)
    inside = np.einsum("fni,fij->fnj", found.position, np.linalg.inv(cells))
    assert np.abs(inside - inside[0]).max() < 1e-12
    assert np.ptp(found.position, axis=0).max() > 10.0


def test_torn_molecules_are_found(mixture):
    (state,) = states(mixture, 1)
    sites = np.array([mixture.site_positions(state)] * 2)
    torn = int(np.flatnonzero(mixture.sites.molecule == 15)[1])
    sites[1, torn, 0] += 40.0
    with pytest.raises(
        OutputError,
        match=r"frame 2: a site of molecule 16 is \d+ Å away from its position in the rigid spce",
    ):
        fit_frames(mixture, sites, None, np.array([state.cell] * 2), wrapped=False)


def test_rounding_of_files_leaves_molecules_whole(mixture):
    (state,) = states(mixture, 1)
    rough = np.round(mixture.site_positions(state), 2)
    found, _ = fit_frames(mixture, rough[None], None, state.cell[None], wrapped=False)
    assert np.abs(found.position[0] - state.position).max() < 0.01


def test_scaling_the_box_moves_nothing():
    system = system_of({"argon": 8})
    rng = np.random.default_rng(1)
    inside, walk = rng.random((8, 3)) + 5.0, brownian(rng, 30, 8, 0.01, 1.0) / 30.0
    cells = SLANTED * (1 + 0.1 * np.sin(np.arange(30)))[:, None, None]
    time = np.arange(30.0)
    scaled = history(system, time, np.einsum("ni,fij->fnj", inside, cells), cells)
    assert np.abs(scaled.paths - scaled.positions[0]).max() < 1e-11
    assert msd(scaled)["MSD argon (A^2)"].max() < 1e-20
    moving = history(system, time, np.einsum("fni,fij->fnj", inside + walk, cells), cells)
    steps = np.einsum("fni,fij->fnj", np.diff(walk, axis=0), cells[1:])
    assert np.abs(np.diff(moving.paths, axis=0) - steps).max() < 1e-11


def test_times_of_files_are_even_though_rounded():
    """Single precision at 10 ns cannot show 4 fs better than to a quarter."""
    system = system_of({"argon": 2})
    time = (10_000 + 0.004 * np.arange(50)).astype(np.float32).astype(float)
    assert history(system, time, None).interval == pytest.approx(0.004, rel=0.01)
    assert history(system, [0.0, 1.0, 3.0], None).interval is None
    with pytest.raises(OutputError, match=r"needs frames at equal intervals. These are 1 to 2 ps"):
        msd(history(system, [0.0, 1.0, 3.0], None))
    with pytest.raises(OutputError, match="needs at least 20 frames; there are 19"):
        msd(history(system, np.arange(19.0), None))


# correlation functions


def test_correlations_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    series = rng.standard_normal((23, 3, 2))
    direct = [np.mean(series[: 23 - k] * series[k:]) for k in range(11)]
    assert correlation(series, 11) == pytest.approx(direct, abs=1e-14)
    path = np.cumsum(rng.standard_normal((23, 4, 3)), axis=0) + 1000.0
    direct = [np.mean(np.sum((path[k:] - path[: 23 - k]) ** 2, axis=2)) for k in range(11)]
    assert squared_displacement(path, 11) == pytest.approx(direct, abs=1e-10)


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
    "cell", [np.eye(3) * 20.0, SLANTED, np.diag([9.0, 31.0, 70.0])], ids=["cube", "slanted", "long"]
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
    """In a slanted cell that breathes, g = 1 also for two molecules; each has n - 1 others; S =
    1."""
    system = system_of({"argon": n}, 25.0)
    rng = np.random.default_rng(n)
    cells = SLANTED * (1 + 0.05 * rng.standard_normal(200))[:, None, None]
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


# motion


def test_diffusion_is_that_of_a_random_walk_and_its_error_honest():
    """Scatter over seeds against the error that is given."""
    system = system_of({"argon": 16}, 25.0)
    D, found = 0.25, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        walk = history(
            system, 4.0 * np.arange(400), brownian(rng, 400, 16, D, 4.0), np.eye(3) * 25.0
        )
        told = diffusion(walk, viscosity_mPa_s=0.85).value("D of argon")
        found += [] if told.value is None else [(told.value, told.error)]
    assert len(found) >= 55  # few are rejected for what is chance
    values, errors = np.array(found).T
    assert values.mean() == pytest.approx(D / NM2_PER_S, abs=4 * values.std() / np.sqrt(len(found)))
    assert 0.7 < np.sqrt(np.mean(((values - D / NM2_PER_S) / errors) ** 2)) < 1.3


@pytest.mark.parametrize("change", [0.9, 1.1])
def test_diffusion_needs_a_straight_displacement(change, monkeypatch):
    """The slope of a made-up displacement changes from one half of the fit to the other by this
    multiple of the largest change."""
    frames, interval = 400, 4.0
    first, last = 8, 40  # lags of the fit
    middle = (first + last) // 2
    ends = np.array([first, middle - 1, middle, last])
    # of t²: the slope of the line of least squares over equal steps is the sum of its two ends
    bend, slope = (ends[2] + ends[3]) - (ends[0] + ends[1]), ends[0] + ends[3]
    share = change * transport.BEND
    square = share / (bend - share * slope)
    t = np.arange(last + 1)
    displacement = interval * (t + square * t**2)
    monkeypatch.setattr(transport, "squared_displacement", lambda paths, lags: displacement[:lags])
    system = system_of({"argon": 16}, 25.0)
    path = brownian(np.random.default_rng(0), frames, 16, 0.25, interval)
    walk = history(system, interval * np.arange(frames), path, np.eye(3) * 25.0)
    found = diffusion(walk, viscosity_mPa_s=0.85).value("D of argon")
    D = (1 + square * slope) / 6 / NM2_PER_S
    if change < 1:
        assert found.value == pytest.approx(D, rel=1e-9)
    else:
        assert found.value is None
        assert "the slope of its displacement changes" in found.note


def test_the_correction_for_the_size_of_the_box_is_that_of_yeh_and_hummer():
    """2.837297 kT/(6 pi eta L): 298.15 K, 0.896 mPa s and 24.86 Å give 0.279e-9 m²/s."""
    system = system_of({"argon": 16}, 24.86)
    rng = np.random.default_rng(0)
    time, path = 4.0 * np.arange(400), brownian(rng, 400, 16, 0.25, 4.0)
    found = diffusion(
        history(system, time, path, np.eye(3) * 24.86, temperature=298.15), viscosity_mPa_s=0.896
    )
    own, infinite = found.value("D of argon"), found.value("D of argon in an infinite box")
    by_hand = 2.837297 * 1.380649e-23 * 298.15 / (6 * np.pi * 0.896e-3 * 24.86e-10) / 1e-9
    assert infinite.value - own.value == pytest.approx(by_hand, rel=1e-6)
    assert infinite.error == own.error
    alone = diffusion(history(system, time, path, np.eye(3) * 24.86))
    assert "without a viscosity" in alone.value("D of argon in an infinite box").note
    slanted = diffusion(history(system, time, path, SLANTED), viscosity_mPa_s=0.896)
    assert "for cubic boxes" in slanted.notes[-1] and len(slanted.values) == 1
    for wrong in (0.0, -1.0, inf, np.nan):
        with pytest.raises(OutputError, match=r"viscosity_mPa_s is .*, must be from 1e-06"):
            diffusion(history(system, time, path, np.eye(3) * 24.86), viscosity_mPa_s=wrong)


def test_what_does_not_diffuse_gives_no_value():
    """Free flight bends upwards, a cage downwards; a walk too short for neighbours to change is
    given as that."""
    system = system_of({"argon": 16}, 25.0)
    rng = np.random.default_rng(0)
    time, box = 0.5 * np.arange(400), np.eye(3) * 25.0
    flight = time[:, None, None] * rng.standard_normal((16, 3))
    cage = noise_with_memory(rng, 400, (16, 3), 1.0, 5.0, 0.5)
    for path in (flight, cage):
        (told,) = diffusion(history(system, time, path, SLANTED)).values
        assert (
            told.value is None and "too short for a value. A run of 798 ps follows it" in told.note
        )
        assert re.search(r"So far: -?\d.* 1e-9 m²/s$", told.note)
    (told,) = diffusion(history(system, time, brownian(rng, 400, 16, 0.25, 0.5), SLANTED)).values
    assert told.value is None and "correlation times" in told.note
    assert re.search(r"5 of them are \d+ ps. So far: [\d.]+ ± [\d.]+ 1e-9 m²/s$", told.note)
    with pytest.raises(OutputError, match="needs at least 40 frames; there are 39"):
        diffusion(history(system, time[:39], flight[:39], box))
    assert diffusion(history(system, time[:40], flight[:40], box)).values


# rotating


def test_free_rotational_diffusion_decays_as_it_must():
    """C1 = exp(-2 D t), C2 = exp(-6 D t) of a sphere that rotates at random."""
    system = system_of({"ccl4": 60}, 60.0, 9.0)
    D, interval, frames, rng = 0.05, 0.4, 600, np.random.default_rng(2)
    turns = rotations_about(np.sqrt(2 * D * interval) * rng.standard_normal((frames, 60, 3)))
    Q = np.empty((frames, 60, 3, 3))
    Q[0] = random_rotations(rng, 60)
    for k in range(1, frames):
        Q[k] = Q[k - 1] @ turns[k]
    found = orientation(history(system, interval * np.arange(frames), None, np.eye(3) * 60, Q))
    # mean cosine and P2 of one rotation, exact for steps of a finite size
    angle = np.linalg.norm(np.sqrt(2 * D * interval) * rng.standard_normal((400_000, 3)), axis=1)
    once = [
        (1 + 2 * np.cos(angle)).mean() / 3,
        (1 + 2 * np.cos(angle) + 2 * np.cos(2 * angle)).mean() / 5,
    ]
    time = found["Time (ps)"]
    for axis in (1, 2, 3):
        for l in (1, 2):  # noqa: E741
            title = f"C{l} ccl4 axis {axis}"
            rate = -np.log(once[l - 1]) / interval
            expected, error = np.exp(-rate * time), found[f"{title} error"]
            assert found[title][0] == pytest.approx(1.0, abs=1e-12)
            assert np.all(np.abs(found[title] - expected) < 5 * np.maximum(error, np.median(error)))
            tau = found.value(f"tau{l} of ccl4, axis {axis}")
            assert abs(tau.value - 1 / rate) < 4 * tau.error + 0.02 / rate
            assert rate == pytest.approx((2, 6)[l - 1] * D, rel=0.05)
        told = found.value(f"D_rot of ccl4, axis {axis}")
        assert abs(told.value - D) < 4 * told.error
        assert told.error < 0.1 * D


def test_errors_of_a_gas_are_those_of_its_molecules():
    """Free rotors in free flight: all blocks of a run are alike, and show nothing of the scatter
    over molecules."""
    system, n, time = system_of({"nitrogen": 100}, 60.0), 100, 0.01 * np.arange(200)
    rate, speed = np.sqrt(BOLTZMANN * 300 / system.species[0].inertia[1]), 3.0
    many = rate * np.hypot(*np.random.default_rng(0).standard_normal((2, 200_000)))
    pulls, doubts = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        frame, omega = random_rotations(rng, n), rate * np.hypot(*rng.standard_normal((2, n)))
        angle = omega * time[:, None]
        plane = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        along, beside = (
            np.einsum("fni,nij->fnj", plane @ turn, frame[:, :2])
            for turn in ([[1, 0], [0, 1]], [[0, 1], [-1, 0]])
        )
        Q = np.stack([along, beside, np.broadcast_to(frame[:, 2], along.shape)], axis=-1)
        flight = speed * time[:, None, None] * rng.standard_normal((n, 3))
        gas = history(system, time, flight, np.eye(3) * 60, Q)
        turned, moved = orientation(gas), msd(gas)
        late = slice(3, None)
        lag = turned["Time (ps)"][late]
        for found, title, truth in (
            (turned, "C1 nitrogen axis 1", np.cos(many[:, None] * lag).mean(axis=0)),
            (moved, "MSD nitrogen (A^2)", 3 * (speed * lag) ** 2),
        ):
            pulls.append((found[title][late] - truth) / found[f"{title} error"][late])
        doubts.append(
            turned["C1 nitrogen axis 1 error"][late][-1]
            / np.std(np.cos(many * lag[-1]))
            * np.sqrt(n)
        )
    for which in (0, 1):
        assert 0.6 < np.sqrt(np.mean(np.array(pulls[which::2]) ** 2)) < 1.3
    assert np.mean(doubts) == pytest.approx(1.0, abs=0.25)


def test_what_hardly_turns_or_turns_too_fast_gives_no_time():
    system = system_of({"ccl4": 8}, 40.0, 9.0)
    rng, time = np.random.default_rng(0), np.arange(100.0)
    still = np.broadcast_to(random_rotations(rng, 8), (100, 8, 3, 3))
    told = orientation(history(system, time, None, np.eye(3) * 40, still)).value(
        "tau1 of ccl4, axis 1"
    )
    assert told.value is None and told.note == (
        "C1 is still 1.00 after 10 ps, too short for a value. It needs more than 8e+03 ps. So far: 10 ps"
    )
    wild = random_rotations(rng, 800).reshape(100, 8, 3, 3)
    told = orientation(history(system, time, None, np.eye(3) * 40, wild)).value(
        "D_rot of ccl4, axis 1"
    )
    assert told.value is None and "between frames, every 1 ps: write more of them" in told.note
    with pytest.raises(OutputError, match="no molecule of this run rotates"):
        orientation(history(system_of({"argon": 2}), time, None, np.eye(3) * 40))


@pytest.mark.parametrize("frames", [2, 9])
def test_peaks_of_few_frames_have_no_value(frames):
    system = system_of({"spce": 125}, 15.5)
    rng = np.random.default_rng(1)
    lattice = 3.1 * np.array([*np.ndindex(5, 5, 5)])
    positions = lattice + 0.2 * rng.standard_normal((frames, 125, 3))
    Q = random_rotations(rng, frames * 125).reshape(frames, 125, 3, 3)
    made = history(system, 0.01 * np.arange(frames), positions, np.eye(3) * 15.5, Q)
    for name in ("first peak", "height of that peak", "neighbours up to the first minimum"):
        found = rdf(made, "O").value(f"g O-O: {name}")
        assert found.value is None
        assert found.note.startswith("too short for an error. So far: ")


def test_one_sentence_tells_what_is_too_short():
    assert converged_value("x", "D", 1.0, 0.1, 11.0, 1.0).note == (
        "11 ps are 11 correlation times of 1 ps, too short for a value; 20 of them are 20 ps. So far: 1.00 ± 0.10 D"
    )
    assert (
        converged_value("x", "", 1.0, None, 40.0, 1.0).note == "too short for an error. So far: 1"
    )
    assert converged_value("x", "", 1.0, 0.1, 20.0, 1.0).value == 1.0
    assert converged_value("x", "", 1.0, 0.1, 5.0, 1.0, least=5.0).value == 1.0
    assert converged_value("x", "", 1.0, 0.1, 4.9, 1.0, least=5.0).value is None
    assert converged_value("x", "", np.nan, 0.1, 5.0, 1.0).value is None
    assert converged_value("x", "", 1.0, 0.1, 5.0, 0.0).value is None


def test_an_oscillation_has_its_wave_number_and_its_degrees_of_freedom():
    """Springs at 120/cm and librations at 300, 500 and 700/cm, with energies of kT each on the
    average."""
    system = system_of({"spce": 40}, 30.0)
    rng, frames, interval = np.random.default_rng(0), 2000, 0.004
    time, m = interval * np.arange(frames), system.species[0]

    def swing(wave_number, weight, shape):
        size = np.sqrt(rng.exponential(2 * BOLTZMANN * 300 / weight, shape))
        size *= np.sqrt(2 * BOLTZMANN * 300 / weight / np.mean(size**2))
        return size * np.cos(
            2 * np.pi * PER_CM * wave_number * time[:, None, None] + 2 * np.pi * rng.random(shape)
        )

    velocities = swing(120.0, m.mass, (40, 3))
    L = np.concatenate(
        [swing(c, i, (40, 1)) * i for c, i in zip((300, 500, 700), m.inertia, strict=True)], axis=2
    )
    Q = np.broadcast_to(random_rotations(rng, 40), (frames, 40, 3, 3))
    found = spectrum(history(system, time, None, np.eye(3) * 30, Q, velocities, L))
    step = found["wave number (1/cm)"][1]
    expected = {
        "V spce": (120, 3),
        **{f"omega spce axis {k}": (200 + 100 * k + 100 * (k - 1), 1) for k in (1, 2, 3)},
    }
    for title, (wave_number, freedom) in expected.items():
        assert found.value(f"highest peak of {title}").value == pytest.approx(
            wave_number, abs=0.6 * step
        )
        assert np.sum(found[title]) * step == pytest.approx(freedom, rel=0.03)
        memory = found[f"correlation {title}"]
        assert memory[0] == pytest.approx(1.0)
        assert memory[5] == pytest.approx(
            np.cos(2 * np.pi * PER_CM * wave_number * 5 * interval), abs=0.02
        )
    with pytest.raises(OutputError, match="needs velocities"):
        spectrum(history(system, time, None, np.eye(3) * 30, Q))
    with pytest.raises(OutputError, match=r"frames every 0\.016 ps .* spce axis 2 decays"):
        every = slice(None, None, 4)  # V and one of three angular velocities would do
        spectrum(
            history(
                system, time[every], None, np.eye(3) * 30, Q[every], velocities[every], L[every]
            )
        )


# electric


def dipoles(rng, system, frames, time, interval):
    """Q (f, n, 3, 3) of molecules that keep their dipoles along or against the axes of the lab,
    each a telegraph."""
    n = len(system.model.species)
    change = 0.5 * (1 - np.exp(-interval / time))
    signs = np.cumprod(np.where(rng.random((frames, n)) < change, -1, 1), axis=0) * rng.choice(
        [-1, 1], n
    )
    dipole = system.species[0].charges @ system.species[0].positions_body
    along = int(np.abs(dipole).argmax())
    Q = np.zeros((frames, n, 3, 3))
    for k in range(n):
        Q[:, k, k % 3, along] = signs[:, k] * np.sign(dipole[along])
        Q[:, k, (k + 1) % 3, (along + 1) % 3] = signs[:, k]
        Q[:, k, (k + 2) % 3, (along + 2) % 3] = 1.0
    return Q, float(np.linalg.norm(dipole))


FORCES = {
    "tin foil": {"electrostatics": "pme"},
    "vacuum": {"electrostatics": "ewald", "ewald_surface_permittivity": 1.0},
    "water around": {"electrostatics": "ewald", "ewald_surface_permittivity": 80.0},
    "reaction field": {"electrostatics": "reaction_field", "reaction_field_permittivity": 78.5},
    "conducting": {"electrostatics": "reaction_field", "reaction_field_permittivity": inf},
}


@pytest.mark.parametrize("name", FORCES)
def test_the_dielectric_constant_of_independent_dipoles(name):
    """<M²> = n mu², in a box that makes epsilon 2.3 with tin foil and 3.2 in vacuum; time of the
    dipole 2 ps."""
    scene = {"forces": {"cutoff_A": 7.0} | FORCES[name]}
    system = build(small_scene({"spce": 30}, 24.0, **scene))
    Q, mu = dipoles(np.random.default_rng(4), system, 4000, 2.0, 0.5)
    found = dielectric(history(system, 0.5 * np.arange(4000), None, np.eye(3) * 24.0, Q)).value()
    y = 4 * np.pi * COULOMB * 30 * mu**2 / (3 * 24.0**3 * BOLTZMANN * 300)
    around = {"vacuum": 1.0, "water around": 80.0, "reaction field": 78.5}.get(name)
    epsilon = found.value
    if around is None:
        assert abs(epsilon - 1 - y) < 4 * found.error
        back = epsilon - 1
    else:
        back = (epsilon - 1) * (2 * around + 1) / (2 * around + epsilon)
    assert found.correlation_ps == pytest.approx(2.0, rel=0.3)
    assert 0.005 < found.error / epsilon < 0.1
    M = np.einsum("fnij,j->fi", Q, system.species[0].charges @ system.species[0].positions_body)
    seen = np.mean(np.sum(M**2, axis=1)) / (30 * mu**2)  # <M> is 0
    assert back == pytest.approx(y * seen, rel=1e-9)
    assert seen == pytest.approx(1.0, abs=0.2)


def test_the_error_of_a_dielectric_constant_is_honest():
    system = build(
        small_scene({"spce": 30}, 14.5, forces={"cutoff_A": 7.0, "electrostatics": "pme"})
    )
    found = []
    for seed in range(60):
        Q, _ = dipoles(np.random.default_rng(seed), system, 600, 2.0, 0.5)
        told = dielectric(history(system, 0.5 * np.arange(600), None, np.eye(3) * 14.5, Q)).value()
        found.append((told.value, told.error))
    values, errors = np.array(found, float).T
    assert 0.6 < values.std() / np.sqrt(np.mean(errors**2)) < 1.6


@pytest.mark.parametrize(("runs", "frames"), [(1, 300), (8, 60)])
def test_a_dielectric_constant_has_no_bias_of_short_runs(runs, frames):
    """Runs of 15 correlation times, and eight of three that are too short by themselves: <M> is 0,
    and is not subtracted as a mean of each run would be."""
    system = build(
        small_scene({"spce": 30}, 14.5, forces={"cutoff_A": 7.0, "electrostatics": "pme"})
    )
    found, time, box = [], 0.5 * np.arange(frames), np.eye(3) * 14.5
    for seed in range(60):
        rng = np.random.default_rng(seed)
        every = [dipoles(rng, system, frames, 10.0 if runs == 1 else 5.0, 0.5) for _ in range(runs)]
        told = dielectric(Runs(tuple(history(system, time, None, box, Q) for Q, _ in every)))
        value = told.value()
        if runs == 1:
            so_far = re.search(r"too short for a value; .* So far: ([\d.]+) ± ([\d.]+)", value.note)
            found.append(
                [float(text) for text in so_far.groups()] if so_far else value[2:4]
            )  # 15 of 20 are
        else:
            found.append((value.value, value.error))
    mu = every[0][1]
    truth = 1 + 4 * np.pi * COULOMB * 30 * mu**2 / (3 * 14.5**3 * BOLTZMANN * 300)
    values, errors = np.array(found, float).T
    assert values.mean() == pytest.approx(truth, abs=3 * values.std() / np.sqrt(60))
    assert 3 * values.std() / np.sqrt(60) < 0.13 * truth
    assert 0.7 < np.sqrt(np.mean(((values - truth) / errors) ** 2)) < 1.6
    mean = [told.value(f"mean total dipole along {axis}") for axis in "xyz"]
    assert all(abs(value.value) < 5 * value.error for value in mean)


def test_the_error_of_a_dielectric_constant_in_a_reaction_field_follows_its_slope():
    """By differences of the formula, from the error that the same dipoles have with tin foil, which
    is that of y."""
    around, found = 4.0, {}
    fields = {"tin foil": inf, "field": around}
    for name, permittivity in fields.items():
        forces = {
            "cutoff_A": 7.0,
            "electrostatics": "reaction_field",
            "reaction_field_permittivity": permittivity,
        }
        system = build(small_scene({"spce": 30}, 21.0, forces=forces))
        Q, _ = dipoles(np.random.default_rng(4), system, 4000, 2.0, 0.5)
        found[name] = dielectric(
            history(system, 0.5 * np.arange(4000), None, np.eye(3) * 21.0, Q)
        ).value()

    def epsilon(y: float) -> float:
        """The root of (epsilon - 1)(2 around + 1) = y (2 around + epsilon)."""
        return (2 * around + 1 + 2 * around * y) / (2 * around + 1 - y)

    y, doubt = found["tin foil"].value - 1, found["tin foil"].error
    assert found["field"].value == pytest.approx(epsilon(y), rel=1e-9)
    slope = (epsilon(y + 1e-4) - epsilon(y - 1e-4)) / 2e-4
    assert slope > 1.5
    assert found["field"].error == pytest.approx(slope * doubt, rel=1e-6)


def test_dipoles_without_a_dielectric_constant():
    time, box = np.arange(100.0), np.eye(3) * 14.5
    still = np.broadcast_to(np.eye(3), (100, 30, 3, 3))
    forces = {"cutoff_A": 7.0}
    for scene, words in (
        ({"spce": 30}, "an electric field acts"),
        ({"spce": 30}, "has no known boundary"),
        ({"na_spce": 2, "cl_spce": 2}, "has a net charge"),
        ({"argon": 30}, "needs molecules with charges"),
        ({"co2_epm2": 30}, "no molecule has a dipole"),
    ):
        more = {"fields": {"electric_V_per_nm": [0, 0, 0.1]}} if "field" in words else {}
        kind = "damped_shifted_force" if "boundary" in words else "pme"
        if "argon" not in scene:
            more["forces"] = forces | {"electrostatics": kind}
        system = build(small_scene(scene, 14.5, **{"forces": forces} | more))
        n = len(system.model.species)
        with pytest.raises(OutputError, match=words):
            dielectric(
                history(
                    system, time, None, box, still[:, :n] if len(system.state.rotation) else None
                )
            )
    system = build(small_scene({"spce": 30}, 14.5, forces=forces | {"electrostatics": "pme"}))
    Q, _ = dipoles(np.random.default_rng(0), system, 100, 10.0, 0.5)
    told = dielectric(history(system, 0.5 * time, None, box, Q)).value()
    vacuum = build(small_scene({"spce": 30}, 14.5, forces=forces | FORCES["vacuum"]))
    with pytest.raises(
        OutputError, match="fluctuates more than it can with a permittivity of 1 around"
    ):
        dielectric(
            history(
                vacuum,
                0.5 * np.arange(4000),
                None,
                box,
                dipoles(np.random.default_rng(4), vacuum, 4000, 2.0, 0.5)[0],
            )
        )
    assert told.value is None
    assert re.search(
        r"too short for a value; 20 of them are [\d.]+ ps. So far: [\d.]+ ± [\d.]+$", told.note
    )


# flow


def stresses(rng, frames, eta, forget, interval, volume):
    """A pressure tensor (f, 7), bar, whose five components decay within `forget` ps to a viscosity
    eta (mPa s)."""
    variance = eta * MPA_S * BOLTZMANN * 300 / volume / forget / BAR**2
    tensor = noise_with_memory(rng, frames, (6,), variance, forget, interval)
    tensor[:, :3] *= np.sqrt(2)  # so that half the difference of two has that variance
    return np.column_stack([interval * np.arange(frames), tensor])


def relaxing(rng, frames, interval, parts):
    """Series (f, 5) whose correlation has the integrals and times (ps) of parts, in sum 1."""
    found = np.zeros((frames, 5))
    for part, time in parts:
        keep = np.exp(-interval / time)
        noise = np.sqrt(1 - keep**2) * rng.standard_normal((frames, 5))
        noise[0] /= np.sqrt(1 - keep**2)
        found += np.sqrt(part / time) * lfilter([1], [1, -keep], noise, axis=0)
    return found


def tensor_of(stress, eta, interval, volume):
    """A pressure tensor (f, 7), bar, with these five components, for a viscosity eta (mPa s) at 300
    K."""
    unit = np.sqrt(eta * MPA_S * BOLTZMANN * 300 / volume) / BAR
    tensor = np.zeros((len(stress), 7))
    tensor[:, 0] = interval * np.arange(len(stress))
    tensor[:, 1], tensor[:, 3] = 2 * unit * stress[:, 3], -2 * unit * stress[:, 4]
    tensor[:, 4:] = unit * stress[:, :3]
    return tensor


RELAXATIONS = {
    "one": [(1.0, 0.1)],
    "water": [(0.25, 0.03), (0.45, 0.4), (0.30, 1.2)],
    "slow": [(0.3, 0.05), (0.35, 0.5), (0.35, 2.5)],
}
FEW, MANY = 10, pytest.param(60, marks=pytest.mark.soak)


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize(
    ("name", "runs", "length"), [("one", 1, 100.0), ("water", 1, 100.0), ("slow", 8, 40.0)]
)
def test_the_viscosity_is_the_integral_of_the_stress_and_its_error_honest(
    name, runs, length, seeds
):
    """Also where a part of it relaxes slowly, beyond the time at which an integral is lost in
    noise."""
    system, found, interval = system_of({"argon": 8}, 25.0), [], 0.02
    frames = int(length / interval)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        series = [relaxing(rng, frames, interval, RELAXATIONS[name]) for _ in range(runs)]
        members = [
            history(
                system,
                [0.0, length],
                None,
                np.eye(3) * 25.0,
                tensor=tensor_of(x, 0.85, interval, 25.0**3),
            )
            for x in series
        ]
        told = viscosity(Runs(tuple(members))).value()
        if told.value is not None:
            found.append((told.value, told.error))
    values, errors = np.array(found).T
    assert len(found) > 0.8 * seeds
    assert values.mean() == pytest.approx(0.85, abs=4 * values.std(ddof=1) / np.sqrt(len(found)))
    assert 0.4 < np.sqrt(np.mean(((values - 0.85) / errors) ** 2)) < 1.7
    assert np.median(errors) < (0.15 if name == "one" else 0.35) * 0.85


def test_a_viscosity_has_the_correlation_time_of_the_stress():
    system, box = system_of({"argon": 8}, 25.0), np.eye(3) * 25.0
    stress = relaxing(np.random.default_rng(1), 20_000, 0.02, [(1.0, 0.1)])
    tensor = tensor_of(stress, 0.85, 0.02, 25.0**3)
    found = viscosity(history(system, [0.0, 400.0], None, box, tensor=tensor))
    assert found.value().correlation_ps == pytest.approx(0.1, rel=0.2)
    assert found["fit (mPa s)"][-1] == pytest.approx(
        found["integral (mPa s)"][-1], abs=3 * found["integral (mPa s) error"][-1]
    )
    integral = found["integral (mPa s)"]
    expected = cumulative_trapezoid(found["correlation"], initial=0)
    assert integral / integral[1] == pytest.approx(expected / expected[1], rel=1e-9)


def test_a_viscosity_needs_stresses_long_enough_and_close_enough():
    system, time, box = system_of({"argon": 8}, 25.0), [0.0, 400.0], np.eye(3) * 25.0
    tensor = stresses(np.random.default_rng(0), 2000, 0.85, 0.1, 0.02, 25.0**3)
    for lines, words in (
        (None, "needs the pressure tensor"),
        (tensor[:1], "needs the pressure tensor"),
        (tensor[:990], r"tensor; there are 19.8 ps"),
        (tensor[np.r_[:500, 600:2000]], "at equal intervals"),
        (tensor[::10], "an interval of 0.2 ps of the pressure tensor is too long"),
        (tensor[::100], "an interval of 2 ps of the pressure tensor is too long"),
    ):
        with pytest.raises(OutputError, match=words):
            viscosity(history(system, time, None, box, tensor=lines))
    with pytest.raises(OutputError, match="needs a box"):
        viscosity(history(system, time, None, tensor=tensor))
    slow = stresses(np.random.default_rng(0), 2000, 0.85, 20.0, 0.02, 25.0**3)
    told = viscosity(history(system, time, None, box, tensor=slow)).value()
    assert told.value is None and "too short for a value. A run of 160 ps follows it" in told.note
    assert re.search(r"So far: [\d.]+ ± [\d.]+ mPa s$", told.note)


# several runs together


def test_analyses_of_several_runs_are_over_their_sum():
    """Four short runs of a liquid: the limits apply to all of them, the means are those of all
    frames."""
    system, rng, box = system_of({"spce": 40}, 20.0), np.random.default_rng(0), np.eye(3) * 20.0
    members = []
    for _ in range(4):
        Q = random_rotations(rng, 60 * 40).reshape(60, 40, 3, 3)
        paths = brownian(rng, 60, 40, 0.25, 4.0) + 20.0 * rng.random((40, 3))
        members.append(history(system, 4.0 * np.arange(60), paths, box, Q))
    together = Runs(tuple(members))
    for analysis, title in (
        (rdf, "g O-O"),
        (structure_factor, "S centres"),
        (density_profile, "density spce (g/cm3)"),
    ):
        each, both = [analysis(run)[title] for run in members], analysis(together)
        assert both[title] == pytest.approx(np.mean(each, axis=0), abs=1e-12), title
        assert both[f"{title} error"] == pytest.approx(
            np.std(each, axis=0, ddof=1) / 2, abs=1e-12
        ), title
    each, both = [hydrogen_bonds(run).value() for run in members], hydrogen_bonds(together).value()
    assert both.value == pytest.approx(np.mean([value.value for value in each]))
    assert both.error == pytest.approx(np.std([value.value for value in each], ddof=1) / 2)
    single, both = diffusion(members[0], 0.85), diffusion(together, 0.85)
    assert both["Time (ps)"][-1] == pytest.approx(4.0 * 24)  # a tenth of all frames
    assert single["Time (ps)"][-1] == pytest.approx(4.0 * 6)
    assert abs(both.value("D of spce").value - 0.25 / NM2_PER_S) < 4 * both.value("D of spce").error
    lags = len(msd(together)["Time (ps)"])
    each = [squared_displacement(run.paths, lags) for run in members]
    assert msd(together)["MSD spce (A^2)"] == pytest.approx(np.mean(each, axis=0))


def test_runs_that_are_too_short_alone_have_a_value_together():
    system, rng, box = system_of({"argon": 16}, 25.0), np.random.default_rng(1), np.eye(3) * 25.0
    members = [
        history(system, 0.5 * np.arange(400), brownian(rng, 400, 16, 0.25, 0.5), box)
        for _ in range(8)
    ]
    alone = [diffusion(run, 0.85).value("D of argon") for run in members]
    assert all(value.value is None and "too short" in value.note for value in alone)
    together = diffusion(Runs(tuple(members)), 0.85).value("D of argon")
    assert abs(together.value - 0.25 / NM2_PER_S) < 4 * together.error < 1.0


@pytest.mark.parametrize("counts", [(50, 50, 50), (20, 60, 100)])
def test_the_error_over_runs_is_that_of_leaving_one_out(counts):
    """Of the mean it is the standard error; of a function of it the same times the slope; long runs
    count more."""
    system, rng = system_of({"argon": 2}, 25.0), np.random.default_rng(4)
    runs = Runs(tuple(history(system, np.arange(float(count)), None) for count in counts))
    found, told = [], []
    for _ in range(400):
        values = [2 + rng.standard_normal() / np.sqrt(count) for count in counts]
        value, error = runs.estimate(values, lambda mean: mean**2)
        found.append(float(value))
        told.append(float(error))
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(np.std(found), rel=0.2)
    assert np.std(found) == pytest.approx(4 / np.sqrt(sum(counts)), rel=0.1)


# production


def test_a_transient_is_left_out():
    rng = np.random.default_rng(0)
    for shift in (200, 300):
        values = rng.standard_normal(1000) + 30 * np.exp(-np.arange(1000) / (shift / 5))
        assert 0.4 * shift < steady_from(values) < 1.7 * shift
    assert steady_from(np.ones(100)) == 0
    assert max(steady_from(np.cumsum(rng.standard_normal(1000))) for _ in range(10)) <= 500
    assert np.median([steady_from(rng.standard_normal(1000)) for _ in range(50)]) < 150


# nematic order


def axes_of(u, generator):
    """Rotations with the first column u (..., 3), and any about it."""
    other = generator.standard_normal(u.shape)
    v = np.cross(u, other)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    return np.stack([u, v, np.cross(u, v)], axis=-1)


def test_nematic_order_of_parallel_and_of_random_axes():
    """Random axes have S = 0.803/sqrt(N), the mean of the largest of three eigenvalues."""
    generator, n, f = np.random.default_rng(4), 100, 400
    system = system_of({"nitrogen": n}, 60.0)
    director = np.array([0.48, -0.6, 0.64])
    sign = generator.choice([-1.0, 1.0], (f, n, 1))
    parallel = axes_of(sign * director, generator)
    found = nematic(history(system, np.arange(float(f)), None, np.eye(3) * 60.0, parallel))
    assert found.value("S of nitrogen").value == pytest.approx(1.0, abs=1e-12)
    assert found.value("S of nitrogen about the mean director").value == pytest.approx(1.0)
    shown = np.stack([found[f"n_{name} nitrogen"] for name in "xyz"], axis=1)
    assert np.abs(shown @ director) == pytest.approx(np.ones(f))
    random = random_rotations(generator, f * n).reshape(f, n, 3, 3)
    found = nematic(history(system, np.arange(float(f)), None, np.eye(3) * 60.0, random))
    S = found.value("S of nitrogen")
    expected = mean_of_largest(n)
    assert S.value == pytest.approx(expected, abs=4 * S.error) and S.error < 0.03 * expected
    assert "0.08 without order" in S.note
    middle = found["-2 x middle nitrogen"]
    assert middle.mean() == pytest.approx(0.0, abs=4 * middle.std() / np.sqrt(f))
    whole = found.value("S of nitrogen about the mean director").value
    axes = random[..., 0].reshape(-1, 3)
    tensor = 1.5 * axes.T @ axes / len(axes) - 0.5 * np.eye(3)
    assert whole == pytest.approx(np.linalg.eigvalsh(tensor)[2], rel=1e-9)


def mean_of_largest(n):
    """sqrt(2/3) 27/32 <r> of a length r with five normal components of the variance 0.3/n."""
    mean_chi = np.sqrt(2.0) * 2.0 / (0.75 * np.sqrt(np.pi))
    return np.sqrt(2 / 3) * 27 / 32 * np.sqrt(0.3 / n) * mean_chi


def test_nematic_order_of_tilted_axes_and_of_a_named_axis():
    """Axes on a cone of 30° about z have S = (3 cos² - 1)/2; waters by the axis z of their file."""
    generator, n, f = np.random.default_rng(5), 60, 40
    azimuth = 2 * np.pi * (np.arange(n) / n + generator.random((f, 1)))
    cone = [np.cos(azimuth) / 2, np.sin(azimuth) / 2, np.full_like(azimuth, np.sqrt(0.75))]
    Q = axes_of(np.stack(cone, axis=-1), generator)
    frames = history(system_of({"nitrogen": n}, 40.0), np.arange(float(f)), None, None, Q)
    assert nematic(frames).value().value == pytest.approx((3 * 0.75 - 1) / 2)
    water = system_of({"spce": n}, 40.0)
    along = water.species[0].axes[2]
    aligned = np.stack([along, *np.linalg.svd(along[None])[2][1:]])[[1, 2, 0]]
    aligned *= np.sign(np.linalg.det(aligned))
    frames = history(water, np.arange(float(f)), None, None, np.broadcast_to(aligned, Q.shape))
    assert nematic(frames, axis="z").value().value == pytest.approx(1.0)
    assert "(0.000, 0.000, 1.000)" in nematic(frames, axis="z").notes[0]
    with pytest.raises(OutputError, match="no molecule of this run is linear"):
        nematic(frames)
