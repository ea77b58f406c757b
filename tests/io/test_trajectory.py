"""Trajectories that runs write: positions, cells, times and velocities of their frames."""

import MDAnalysis as mda
import numpy as np
import pytest
from MDAnalysis.lib.formats.libmdaxdr import XTCFile
from support.common import ROOT, small_scene

from rigidmd.commands.cli import main
from rigidmd.errors import SimulationError
from rigidmd.run import Every, Simulation
from rigidmd.run.report import summary_text
from rigidmd.scene import Scene


@pytest.mark.parametrize(
    "name", ["t.xtc", "t.trr", "t.gsd", "t.traj", "t.dcd", "t.nc", "t.xyz", "t.pdb"]
)
@pytest.mark.parametrize("topology", ["topology.gro", "topology.pdb"])
def test_trajectories_hold_positions_box_time_and_velocities(name, topology, tmp_path):
    lengths, angles = [20.0, 21.0, 22.0], [80.0, 100.0, 75.0]
    scene = small_scene(
        {"tip4p2005": 6, "nitrogen": 4},
        None,
        stages=[{"duration_ps": 0.04}],
        box={"lengths_A": lengths, "angles_deg": angles},
        output={
            "trajectory": name,
            "trajectory_interval_ps": 0.01,
            "topology": topology,
            "positions": "unwrapped",
        },
    )
    seen = []

    def observe(moment):
        system = simulation.system
        seen.append((moment.time, moment.site_positions, system.site_velocities(moment.state)))

    simulation = Simulation(scene, tmp_path / "out", observers=[Every(0.01, observe)])
    universe = simulation.run().universe()
    assert len(universe.trajectory) == len(seen) == 5
    exact = {".xtc": 6e-3, ".pdb": 6e-4, ".xyz": 6e-5}.get(name[1:], 1e-4)
    for frame, (moment, positions, velocities) in zip(universe.trajectory, seen, strict=True):
        assert frame.positions == pytest.approx(positions, abs=exact)
        assert frame.time == moment
        assert frame.dt == 0.01
        if name != "t.xyz":
            assert frame.dimensions == pytest.approx([*lengths, *angles], abs=2e-3)
        assert frame.has_velocities == (name in ("t.trr", "t.gsd", "t.traj", "t.nc"))
        if frame.has_velocities:
            assert frame.velocities == pytest.approx(velocities, abs=1e-3)
    text = (tmp_path / "out" / name).read_bytes()
    if name == "t.xyz":
        import ase.io

        frames = ase.io.read(tmp_path / "out" / name, index=":", format="extxyz")
        assert frames[2].cell.cellpar() == pytest.approx([*lengths, *angles])
        assert frames[2].info["Time"] == pytest.approx(0.02)
    if name == "t.pdb":
        assert b"TIME 0.020000 PS" in text
    trajectory = universe.trajectory
    assert (trajectory.dt, trajectory.totaltime, trajectory[3].time) == (0.01, 0.04, seen[3][0])
    copy = universe.copy().trajectory
    assert [frame.time for frame in copy[::2]] == [moment for moment, _, _ in seen[::2]]
    if name[1:] not in (
        ".xyz",
        ".pdb",
        ".gsd",
        ".traj",
    ):  # what MDAnalysis reads from the file alone
        alone = mda.Universe(
            str(tmp_path / "out" / topology), str(tmp_path / "out" / name)
        ).trajectory
        assert [frame.time for frame in alone] == pytest.approx(
            [moment for moment, _, _ in seen], abs=1e-5
        )
    assert list(universe.atoms.names[:4]) == ["OW", "HW1", "HW2", "MW"]
    assert universe.residues.n_residues == 10


@pytest.mark.parametrize("angles", [[90.0, 90.0, 90.0], [80.0, 75.0, 100.0]])
def test_wrapped_molecules_are_whole_and_inside(angles, tmp_path):
    box = {"lengths_A": 20.0, "angles_deg": angles}
    simulation = Simulation(
        small_scene({"spce": 30}, None, box=box, output={"trajectory": "t.trr"})
    )
    system, state = simulation.system, simulation.state.copy()
    state.position[:] += 300.0
    x = system.site_positions(state, wrapped=True).reshape(30, 3, 3)
    centre = np.einsum("s,nsk->nk", system.species[0].masses, x) / system.species[0].mass
    part = centre @ np.linalg.inv(simulation.scene.box.cell)
    assert (part >= -1e-9).all()
    assert (part < 1 + 1e-9).all()
    moved = (centre - state.position) @ np.linalg.inv(simulation.scene.box.cell)
    assert moved == pytest.approx(np.rint(moved), abs=1e-9)
    assert np.linalg.norm(x[:, 1] - x[:, 0], axis=1) == pytest.approx(np.ones(30))


def free_flight(name, folder):
    """Two argon atoms far from each other in a large box, which cross its sides."""
    scene = small_scene(
        {"argon": 2},
        60.0,
        stages=[{"duration_ps": 20.0, "timestep_fs": 10.0}],
        start={"temperature_K": 3000.0},
        forces={"cutoff_A": 6.0},
        output={"trajectory": name, "trajectory_interval_ps": 0.1, "log_interval_ps": 10.0},
    )
    return Simulation(scene, folder).run()


@pytest.mark.parametrize("name", ["t.xtc", "t.trr", "t.dcd", "t.nc", "t.xyz", "t.pdb", "memory"])
def test_displacements_over_time_are_speeds(name, tmp_path):
    """What a diffusion coefficient rests on: times of frames, and positions that do not jump at the
    sides of the box."""
    results = free_flight(*(("t.xtc", None) if name == "memory" else (name, tmp_path / "out")))
    universe = results.universe()
    path = universe.trajectory.timeseries(order="fac")
    speed = np.diff(path, axis=0) / universe.trajectory.dt
    assert np.abs(path).max() > 60
    assert speed == pytest.approx(
        np.broadcast_to(results.state.velocity, speed.shape), abs=0.2
    )  # of some 10 Å/ps
    assert universe.trajectory.dt == pytest.approx(0.1)
    assert universe.trajectory.totaltime == pytest.approx(20)
    assert results.summary["positions"] == "unwrapped"
    assert "unwrapped: molecules follow continuous paths" in summary_text(results.summary)


def test_the_summary_states_when_positions_are_wrapped():
    scene = small_scene({"argon": 20}, 20.0, output={"positions": "wrapped"})
    assert "Displacements need unwrapped frames" in summary_text(Simulation(scene).run().summary)
    for without in (
        {"output": {"trajectory": False}},
        {"box": {"lengths_A": 20.0, "periodic": False}},
    ):
        assert "positions" not in summary_text(
            Simulation(small_scene({"argon": 20}, 20.0, **without)).run().summary
        )


def test_a_format_too_narrow_for_a_long_way_is_reported(tmp_path):
    scene = small_scene(
        {"argon": 2}, 60.0, output={"trajectory": "t.pdb", "trajectory_interval_ps": 0.002}
    )
    simulation = Simulation(scene, tmp_path / "out")
    state = simulation.system.state.copy()
    state.velocity[:] = [[-1e6, 0, 0], [1e6, 0, 0]]
    simulation.start_from(state)
    with pytest.raises(
        SimulationError,
        match=r"beyond the -999.99 Å that .pdb .output.trajectory. can hold: use .nc or .trr or .xyz, output.pos",
    ):
        simulation.run()


def test_the_topology_is_the_first_frame_overlap_removal_included(tmp_path):
    short = {
        "stages.0.duration_ps": 0.004,
        "stages.1.duration_ps": 0.004,
        "output.positions": "unwrapped",
        "forces.pme_order": 6,
    }
    results = Simulation(
        Scene.read(ROOT / "systems" / "water_nitrogen.toml", short), tmp_path / "out"
    ).run()
    assert results.summary["overlap_removal_steps"] > 0
    universe = results.universe()
    first = mda.Universe(str(tmp_path / "out" / "topology.gro")).atoms.positions
    assert first == pytest.approx(universe.trajectory[0].positions, abs=0.011)
    assert main(["energy", str(ROOT / "systems" / "water_nitrogen.toml"), "--json"]) == 0


@pytest.mark.filterwarnings("ignore:Reload offsets")  # MDAnalysis reads a file that has grown since
@pytest.mark.parametrize("name", ["t.xtc", "t.trr", "t.gsd", "t.pdb", "t.xyz", "t.nc", "t.dcd"])
def test_every_frame_is_on_the_disk_at_once(name, tmp_path):
    """What a kill would leave: the file is read back while the run still holds it open."""
    seen = []

    def observe(moment):
        if moment.step and moment.step % 4 == 0:
            universe = mda.Universe(
                str(tmp_path / "out" / "topology.gro"), str(tmp_path / "out" / name)
            )
            seen.append(sum(1 for _ in universe.trajectory))

    scene = small_scene(
        {"argon": 300},
        40.0,
        stages=[{"duration_ps": 0.04}],
        output={"trajectory": name, "trajectory_interval_ps": 0.008},
    )
    Simulation(scene, tmp_path / "out", observers=[Every(0.008, observe)]).run()
    assert seen == [2, 3, 4, 5, 6]


@pytest.mark.parametrize("box", [{"lengths_A": [20, 21, 22], "angles_deg": [80, 75, 70]}, None])
def test_frames_of_xtc_are_those_that_mdanalysis_writes(box, tmp_path):
    scene = {
        "molecules": [{"model": "spce", "count": 30 if box else 1}],
        "stages": [{"duration_ps": 0.04}],
    }
    structure = {"box": {"periodic": False}, "structure": {"file": "one.xyz"}}
    scene |= {"box": box, "forces": {"cutoff_A": 7.0}} if box else structure
    (tmp_path / "one.xyz").write_text("3\n\nO 0 0 0\nH 0.8 0.6 0\nH -0.8 0.6 0\n")
    scene |= {
        "name": "cell",
        "output": {"trajectory_interval_ps": 0.008},
        "start": {"temperature_K": 300},
    }
    scene = Scene.from_dict(scene, tmp_path)
    Simulation(scene, tmp_path / "out").run()
    own, other = tmp_path / "out" / "trajectory.xtc", tmp_path / "other.xtc"
    Simulation(scene).run().universe().atoms.write(str(other), frames="all")
    with XTCFile(str(own)) as found, XTCFile(str(other)) as expected:
        frames = list(zip(found, expected, strict=True))
        assert len(frames) == 6
        for frame, its in frames:
            assert (frame.x == its.x).all() and frame.prec == its.prec
            assert frame.time == its.time
            assert frame.box == pytest.approx(its.box, abs=1e-6)
