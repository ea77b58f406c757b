"""Trajectories of ASE: every digit, resumed runs, damaged files."""

import contextlib
import subprocess
import sys
import tomllib
from importlib.metadata import EntryPoint

import ase.io
import numpy as np
import pytest
from support.ase_atoms import FORCES, NVE, OUTPUT, same_state
from support.common import ROOT, small_scene
from support.scenes import FORTY_WATERS, forty_waters
from support.stops import same_after_stops

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.errors import OutputError
from rigidmd.formats.through_ase import EV, TrajFile, TrajReader
from rigidmd.io.trajectory import read_frames
from rigidmd.run import Every
from rigidmd.units import KJ_PER_MOL


@pytest.fixture(scope="module")
def traj(tmp_path_factory):
    """A run whose trajectory is ASE's: the folder, its results and the states of its frames."""
    folder, states, present = tmp_path_factory.mktemp("traj") / "run", [], []
    output = OUTPUT | {"trajectory": "trajectory.traj"}
    made = small_scene(
        {"tip4p2005": 4}, 14.0, forces=FORCES, stages=[{"duration_ps": 0.06}], output=output
    )
    seen = []

    def look(moment):
        states.append(moment.state.copy())
        present.append(simulation.atoms())
        seen.append(len(ase.io.read(folder / "trajectory.traj", ":")))  # what a kill would leave

    simulation = Simulation(made, folder, observers=[Every(0.02, look)])
    run = simulation.run()
    assert seen == [1, 2, 3, 4]
    return folder, run, states, present


def test_a_trajectory_of_ase_holds_every_digit(traj):
    folder, results, states, present = traj
    frames = ase.io.read(folder / "trajectory.traj", ":")
    system, heavy = results.system, results.system.sites.mass > 0
    assert str(frames[0].symbols) == "OH2OH2OH2OH2"
    for frame, other, state in zip(frames, results.atoms(":"), states, strict=True):
        assert frame.info["time_ps"] == state.time[0]
        assert (frame.positions == system.site_positions(state)[heavy]).all()
        assert (frame.positions == other.positions).all()
        assert np.abs(frame.get_velocities() - other.get_velocities()).max() < 1e-15
        assert frame.cell.array == pytest.approx(state.cell)
    with contextlib.closing(TrajReader(folder / "trajectory.traj")) as reader:
        positions, velocities, _ = reader.frame(2).sites
    assert (positions == system.site_positions(states[2])).all()
    assert np.abs(velocities - system.site_velocities(states[2])).max() < 1e-12
    assert np.abs(results.rotation[3] - states[3].rotation).max() < 1e-5
    assert all(
        (now.positions == frame.positions).all() for now, frame in zip(present, frames, strict=True)
    )
    again = build(rigidmd.scene_from_atoms(frames[3], "tip4p2005", forces=FORCES, stages=[NVE]))
    same_state(again.state, results.state)
    data = {"structure": {"file": "trajectory.traj", "velocities": True}, "stages": [NVE]}
    data |= {"molecules": [{"model": "tip4p2005"}], "forces": FORCES}
    same_state(build(Scene.from_dict(data, folder)).state, results.state)  # the last frame


def test_ase_opens_it(traj, tmp_path):
    folder, results, *_ = traj
    command = [sys.executable, "-m", "ase", "gui", "--terminal", "-n", ":", "-g", "i,d(0,1),ekin"]
    told = subprocess.run(
        [*command, str(folder / "trajectory.traj")], capture_output=True, text=True, check=True
    )
    rows = np.array([line.split() for line in told.stdout.strip().splitlines()], float)
    assert rows[:, 1] == pytest.approx(0.9572, abs=1e-12)
    assert rows[-1, 2] == pytest.approx(results.atoms().get_kinetic_energy(), rel=1e-9)
    from ase.db import connect

    with connect(tmp_path / "runs.db") as base:
        for frame in results.atoms(":"):
            base.write(frame, time_ps=frame.info["time_ps"])
    assert [row.energy for row in base.select()] == pytest.approx(
        results["potential"] * KJ_PER_MOL / EV
    )
    ase.io.write(tmp_path / "all.traj", results.atoms(":"))
    assert ase.io.read(tmp_path / "all.traj", -1).get_stress() == pytest.approx(
        results.atoms().get_stress()
    )


@pytest.mark.parametrize("name", ["trajectory.xtc", "trajectory.trr", "trajectory.gsd"])
@pytest.mark.usefixtures("reads_here")
def test_ase_reads_a_run(name, tmp_path, monkeypatch):
    """By the entry point of pyproject.toml, as ASE does when it is imported."""
    ((group, names),) = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "entry-points"
    ].items()
    monkeypatch.delitem(
        ase.io.formats.ioformats, "rigidmd", raising=False
    )  # of an installed package
    (point,) = (EntryPoint(key, value, group) for key, value in names.items())
    assert (point.name, point.group) == ("rigidmd", "ase.ioformats")
    ase.io.formats.define_external_io_format(point)
    made = small_scene(
        {"tip4p2005": 4}, 14.0, forces=FORCES, stages=[NVE], output=OUTPUT | {"trajectory": name}
    )
    results = Simulation(made, tmp_path / "run").run()
    frames, expected = ase.io.read(tmp_path / "run" / name, ":"), results.atoms(":")
    assert len(frames) == len(expected) == 4
    assert ase.io.read(tmp_path / "run", format="rigidmd") == frames[-1]
    assert ase.io.read(tmp_path / "run" / name, 1) == frames[1]
    for frame, other in zip(frames, expected, strict=True):
        assert frame.info["time_ps"] == pytest.approx(other.info["time_ps"])
        assert frame.positions == pytest.approx(
            other.positions, abs=0.02 if name.endswith("xtc") else 1e-5
        )
        assert frame.has("momenta") == (name != "trajectory.xtc")
        assert frame.cell.array == pytest.approx(other.cell.array) and frame.pbc.all()
        assert (frame.get_masses() == other.get_masses()).all() and str(
            frame.symbols
        ) == "OH2OH2OH2OH2"
    Simulation(
        Scene.read(ROOT / "systems" / "heavy_top_1.toml", {"run.duration_s": 0.01}),
        tmp_path / "top",
    ).run()
    with pytest.raises(TypeError, match="a run of a single body"):
        ase.io.read(tmp_path / "top" / "trajectory.xtc")
    with pytest.raises(OutputError, match="is not the folder of a run"):
        ase.io.read(tmp_path, format="rigidmd")


def test_a_run_with_it_continues_to_the_same_bytes(tmp_path):
    output = FORTY_WATERS["output"] | {
        "trajectory": "trajectory.traj",
        "trajectory_interval_ps": 0.001,
    }
    same_after_stops(forty_waters(NVE | {"duration_ps": 0.1}, output=output), [3, 41, 43], tmp_path)


def test_a_damaged_one_is_reported(traj, tmp_path):
    """Bytes changed anywhere: frames or a sentence, never anything else."""
    content = (traj[0] / "trajectory.traj").read_bytes()
    path, rng, sites = tmp_path / "t.traj", np.random.default_rng(5), len(traj[1].system.sites.name)
    told = 0
    for k in range(300):
        damaged = bytearray(content)
        for at in rng.integers(0, len(content) if k % 2 else 500, 3):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(len(content))] if k % 5 == 0 else damaged)
        try:
            read_frames(path, sites, 100)
        except OutputError as error:
            assert "\n" not in str(error)
            told += 1
    assert told > 100


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("shorter", "2 frames of"),
        ("changed", "its checksum is not that"),
        ("noise", "not a trajectory of ASE"),
    ],
)
def test_one_that_changed_is_not_continued_with(fault, said, traj, tmp_path):
    _, results, states, _ = traj
    path = tmp_path / "t.traj"
    file = TrajFile(path, results.system, True, False)
    for state in states[:3]:
        file.write(state, state.time[0], state.step[0])
        if state is states[1]:
            kept, content = file.kept, path.read_bytes()
    file.close()
    again = TrajFile(path, results.system, True, False, kept)
    again.cut()
    again.close()
    assert path.read_bytes() == content
    if fault == "shorter":
        short = TrajFile(path, results.system, True, False)
        short.write(states[0], 0.0, 0)
        short.close()
    elif fault == "changed":
        at = content.index(
            results.system.site_positions(states[1])[results.system.sites.mass > 0].tobytes()
        )
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
    else:
        path.write_bytes(np.random.default_rng(1).bytes(5000))
    before = path.read_bytes()
    with pytest.raises(OutputError, match=said):
        TrajFile(path, results.system, True, False, kept)
    assert path.read_bytes() == before
