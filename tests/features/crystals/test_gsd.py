"""Trajectories as GSD: rigid bodies as HOOMD has them, and back."""

import shutil

import gsd.hoomd
import numpy as np
import pytest
from support.common import small_scene
from support.scenes import FORTY_WATERS, NPT, NVT, forty_waters
from support.stops import same_after_stops

from rigidmd.assemble.build import build
from rigidmd.errors import OutputError, SceneError
from rigidmd.features.crystals.gsd import GsdFile, GsdReader
from rigidmd.io.trajectory import read_frames
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run import Every, Simulation
from rigidmd.scene import Scene

COUNTS = {"tip4p2005": 6, "argon": 3, "nitrogen": 4}
BOX = {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 100.0, 75.0]}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of a mixture in a triclinic box: the folder, its results and the states of its
    frames."""
    folder = tmp_path_factory.mktemp("gsd") / "run"
    output = {"trajectory": "t.gsd", "trajectory_interval_ps": 0.01}
    states = []
    simulation = Simulation(
        small_scene(COUNTS, None, box=BOX, stages=[{"duration_ps": 0.04}], output=output),
        folder,
        observers=[Every(0.01, lambda moment: states.append(moment.state.copy()))],
    )
    return folder, simulation.run(), states


def test_frames_come_back(run):
    folder, results, states = run
    reader = GsdReader(folder / "t.gsd")
    assert reader.count == len(states) == 5
    for k, state in enumerate(states):
        found = reader.read(k)
        centres = found.centres
        assert found.time == state.time[0]
        assert found.step == state.step[0]
        assert np.abs(found.rotation() - state.rotation).max() < 2e-7
        assert np.abs(found.position[centres] - state.position).max() < 5e-6
        assert np.allclose(found.velocity[centres], state.velocity, rtol=1e-6, atol=1e-6)
        scale = np.abs(state.angular_momentum_body).max()
        assert (
            np.abs(found.angular_momentum_body[centres] - state.angular_momentum_body).max()
            < 3e-7 * scale
        )
        assert np.allclose(found.cell, state.cell, rtol=1e-6, atol=1e-5)
        assert (
            np.abs(found.position[found.sites] - results.system.site_positions(state)).max() < 5e-6
        )
        off = found.site_velocities() - results.system.site_velocities(state)
        assert np.abs(off).max() < 1e-5 * np.abs(state.velocity).max()
    assert np.array_equal(results.rotation[3], reader.read(3).rotation())


def test_it_is_what_hoomd_has(run):
    """Every rule that HOOMD checks of rigid bodies, and its formulas for them."""
    folder, results, states = run
    with gsd.hoomd.open(folder / "t.gsd") as file:
        first, last = file[0].particles, file[4].particles
        box = file[4].configuration.box.astype(float)
        bonds = file[0].bonds
    n = 13
    types = np.array(first.types)[first.typeid]
    assert list(types[:n]) == ["tip4p2005"] * 6 + ["Ar"] * 3 + ["nitrogen"] * 4
    assert list(types[n : n + 4]) == ["O", "H", "H", "MW"]
    assert list(first.body[:n]) == [
        0,
        1,
        2,
        3,
        4,
        5,
        -1,
        -1,
        -1,
        9,
        10,
        11,
        12,
    ]  # its own number, or none
    assert list(first.body[n:]) == [k for k in range(6) for _ in range(4)] + [
        k for k in range(9, 13) for _ in range(2)
    ]
    assert first.mass[:n] == pytest.approx(
        [results.system.species[k].mass for k in results.system.model.species]
    )
    assert first.mass[n : n + 4].sum() == pytest.approx(first.mass[0])
    assert first.charge.sum() == pytest.approx(0.0, abs=1e-6)
    assert len(bonds.group) == 2 * 6 + 4
    assert all(first.body[i] == first.body[j] for i, j in bonds.group)
    rows = np.array(
        [[box[0], 0, 0], [box[3] * box[1], box[1], 0], [box[4] * box[2], box[5] * box[2], box[2]]]
    )
    inside = last.position @ np.linalg.inv(rows)
    assert np.abs(inside).max() <= 0.5 + 1e-6
    whole = last.position + last.image @ rows
    # a constituent is at X + Q x, and a momentum p = 2 q (0, L): (q* p) / 2 has no real part
    turned = from_quaternion(last.orientation[:n])
    offset = results.system.sites.offset_body
    assert np.allclose(whole[n : n + 4] - whole[0], offset[:4] @ turned[0].T, atol=1e-5)
    q, p = last.orientation[:6].astype(float), last.angmom[:6].astype(float)
    assert np.einsum("ni,ni->n", q, p) == pytest.approx(0.0, abs=1e-4)
    inertia = first.moment_inertia[:6].astype(float)
    energy = 0.0
    for k, (unit, sign) in enumerate(
        [
            ([1, 0, 3, 2], [-1, 1, 1, -1]),
            ([2, 3, 0, 1], [-1, -1, 1, 1]),
            ([3, 2, 1, 0], [-1, 1, -1, 1]),
        ]
    ):
        part = (p * (q[:, unit] * sign)).sum(
            axis=1
        ) / 2  # p . P_k q, as in Miller et al. 2002, J. Chem. Phys. 116, 8649
        energy += (part**2 / (2 * inertia[:, k])).sum()
    state = states[-1]
    own = (state.angular_momentum_body[:6] ** 2 / (2 * inertia)).sum()
    assert energy == pytest.approx(own, rel=1e-5)


def test_a_run_continues_to_the_same_bytes(tmp_path):
    same_after_stops(
        forty_waters(NVT, NPT, output=FORTY_WATERS["output"] | {"trajectory": "trajectory.gsd"}),
        [3, 61, 133],
        tmp_path,
    )


def test_wrapped_centres_and_no_box(tmp_path):
    path = tmp_path / "t.gsd"
    for box in ({"lengths_A": 20.0}, {"lengths_A": 20.0, "periodic": False}):
        system = build(small_scene({"tip4p2005": 3}, None, box=box))
        system.state.position[:] += [30.0, 0.0, -70.0]
        file = GsdFile(path, system, velocities=False, wrapped=True)
        file.write(system.state, 0.5, 7)
        file.close()
        frames = read_frames(path, 12, 100)
        assert (
            np.abs(frames.positions[0] - system.site_positions(system.state, wrapped=True)).max()
            < 1e-5
        )
        assert (frames.cells is None) == ("periodic" in box)
        assert frames.time[0] == 0.5
        assert GsdReader(path).read(0).velocity is None


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("shorter", "2 frames of"),
        ("changed", "its checksum is not that"),
        ("noise", "Not a GSD file"),
        ("missing", "there is no such file"),
        ("other", "2 frames of"),
    ],
)
def test_a_file_that_changed_is_not_continued_with(fault, said, run, tmp_path):
    _, results, states = run
    path = tmp_path / "t.gsd"
    file = GsdFile(path, results.system, True, False)
    for state in states[:3]:
        file.write(state, state.time[0], state.step[0])
        if state is states[1]:
            kept, content = file.kept, path.read_bytes()
    file.close()
    longer = path.read_bytes()
    again = GsdFile(path, results.system, True, False, kept)
    assert path.read_bytes() == longer
    again.cut()
    again.close()
    assert path.read_bytes() == content
    if fault == "shorter":
        kept_file = GsdFile(path, results.system, True, False)
        kept_file.write(states[0], 0.0, 0)
        kept_file.close()
    elif fault == "changed":
        at = content.index(states[1].velocity[0, 0].astype(np.float32).tobytes())
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    elif fault == "noise":
        path.write_bytes(np.random.default_rng(1).bytes(5000))
    elif fault == "missing":
        path.unlink()
    else:
        with gsd.hoomd.open(path, "w") as other:
            for _ in range(3):
                frame = gsd.hoomd.Frame()
                frame.particles.N, frame.particles.position = 1, [[0, 0, 0]]
                other.append(frame)
    before = path.read_bytes() if path.exists() else b""
    with pytest.raises(OutputError, match=said):
        GsdFile(path, results.system, True, False, kept)
    assert (path.read_bytes() if path.exists() else b"") == before


def test_damaged_files_are_reported(run, tmp_path):
    """Bytes changed anywhere: frames or a sentence, never anything else."""
    content = (run[0] / "t.gsd").read_bytes()
    path, rng = tmp_path / "t.gsd", np.random.default_rng(5)
    sites = len(run[1].system.sites.name)
    for k in range(300):
        damaged = bytearray(content)
        where = rng.integers(0, 5000 if k % 2 else len(content), 3)
        for at in where:
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(content))] if k % 5 == 0 else damaged)
        try:
            read_frames(path, sites, 100)
        except OutputError as error:
            assert "\n" not in str(error)


def test_a_body_has_none():
    with pytest.raises(SceneError, match=r"\.xtc"):
        Scene.from_dict(
            {
                "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 1.0]},
                "run": {"duration_s": 1.0, "timestep_s": 0.1},
                "output": {"trajectory": "t.gsd"},
            }
        )


def test_it_can_be_looked_at_after_a_kill(run, tmp_path):
    """A frame whose chunks are there without their table is not counted."""
    shutil.copyfile(run[0] / "t.gsd", tmp_path / "t.gsd")
    with (tmp_path / "t.gsd").open("ab") as file:
        file.write(b"x" * 1000)
    assert read_frames(tmp_path / "t.gsd", len(run[1].system.sites.name), 100).count == 5
