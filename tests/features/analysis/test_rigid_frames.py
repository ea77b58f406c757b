"""Frames of rigid molecules: bodies from sites, unwrapped paths, torn molecules."""

import numpy as np
import pytest
from support.common import history, small_scene, system_of
from support.frames import TRICLINIC, brownian

from rigidmd.assemble.build import build
from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.transport import msd
from rigidmd.features.analysis.rigid_frames import fit_frames
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run.rigid_fit import kinds_of

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
    cells = TRICLINIC * (1 + 0.1 * np.sin(np.arange(30)))[:, None, None]
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
