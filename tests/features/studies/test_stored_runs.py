"""Runs and sweeps that have ended, opened from Python: their results, and folders that stay as they
are."""

import re
import shutil
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT, same_bits, small_scene

import rigidmd
from rigidmd.commands import cli
from rigidmd.errors import OutputError
from rigidmd.io.run_files import TENSOR
from rigidmd.run import Every, Simulation
from rigidmd.scene import Scene

STAGES = [
    {"ensemble": "nvt", "duration_ps": 0.02, "temperature_K": 90.0},
    {"name": "nve", "duration_ps": 0.1},
]


def argon(trajectory="trajectory.xtc", **output):
    output = {
        "log_interval_ps": 0.004,
        "trajectory_interval_ps": 0.004,
        "trajectory": trajectory,
    } | output
    return small_scene({"argon": 20}, 20.0, stages=STAGES, output=output)


def top():
    return Scene.read(
        ROOT / "systems" / "heavy_top_3.toml",
        {"run.duration_s": 0.05, "output.trajectory": "top.xyz"},
    )


def snapshot(folder):
    """Bytes and times of change of everything in a folder, and of the folder itself."""
    paths = [folder, *sorted(folder.rglob("*"))]
    return {
        path: (path.stat().st_mtime_ns, path.is_file() and sha256(path.read_bytes()).digest())
        for path in paths
    }


@pytest.fixture(scope="module", params=["trajectory.xtc", "trajectory.gsd"])
def run(request, tmp_path_factory):
    """A finished run of argon and what it returned."""
    folder = tmp_path_factory.mktemp("runs") / "argon"
    return folder, Simulation(argon(request.param), folder).run()


def test_a_run_is_what_it_returned(run):
    folder, returned = run
    before = snapshot(folder)
    results = rigidmd.read_run(str(folder))
    for name in returned:
        if name not in ("conserved", "stage_name", *TENSOR.keys() - {"time"}):
            np.testing.assert_allclose(results[name], returned[name], rtol=1e-15, atol=1e-9)
    assert (results["stage_name"] == returned["stage_name"]).all()
    assert results.units == returned.units
    assert results.summary == returned.summary
    assert [path.name for path in results.files] == [path.name for path in returned.files]
    assert same_bits(results.state, returned.state)
    assert not results.interrupted
    assert results.to_dataframe().shape == returned.to_dataframe().shape
    frames, expected = results.universe().trajectory, returned.universe().trajectory
    assert [frame.time for frame in frames] == pytest.approx(
        [frame.time for frame in expected], abs=1e-12
    )
    assert frames[-1].positions == pytest.approx(expected[-1].positions)
    last, before_it = results.atoms()[:3], results.atoms(-2)
    assert last.positions == pytest.approx(returned.atoms()[:3].positions, abs=0)
    assert results.atoms().get_potential_energy() == pytest.approx(
        returned.atoms().get_potential_energy()
    )
    assert before_it.positions == pytest.approx(returned.atoms(-2).positions)
    g = rigidmd.analysis.rdf(results, "argon", "argon")
    assert (
        g["g argon-argon"] == rigidmd.analysis.rdf(returned, "argon", "argon")["g argon-argon"]
    ).all()
    assert rigidmd.view.plot(results, "temperature").axes
    assert "nve: 50 steps" in results._repr_html_()
    assert snapshot(folder) == before


def test_columns_of_user_defined_forces_are_read(tmp_path):
    forces = {"cutoff_A": 8.0, "custom": [{"name": "wide", "energy": "1e5/r**12"}]}
    scene = small_scene({"argon": 12}, 20.0, forces=forces)
    returned = Simulation(scene, tmp_path / "run").run()
    results = rigidmd.read_run(tmp_path / "run")
    assert list(results) == list(returned)
    assert results.units == returned.units
    assert results["wide"] == pytest.approx(returned["wide"], rel=1e-15)
    assert (results["wide"] > 0).all()


def test_a_log_with_a_column_twice_is_refused(run, tmp_path):
    folder = Path(shutil.copytree(run[0], tmp_path / "twice"))
    log = folder / "log.csv"
    log.write_text(log.read_text().replace('"T_rot (K)"', '"T_trans (K)"'))
    with pytest.raises(OutputError, match=r"log.csv has the column 'T_trans \(K\)' twice"):
        rigidmd.read_run(folder)


@pytest.mark.usefixtures("reads_here")
def test_a_run_that_was_moved_is_read_where_it_is(run, tmp_path):
    folder, returned = run
    moved = Path(shutil.copytree(folder, tmp_path / "moved"))
    results = rigidmd.read_run(moved)
    assert {path.parent for path in results.files} == {moved}
    assert len(results.universe().trajectory) == len(returned.universe().trajectory)
    (moved / returned.system.scene.output.trajectory).unlink()
    with pytest.raises(OutputError, match=r"its trajectory .* is missing"):
        rigidmd.read_run(moved).universe()


def test_a_run_that_continues_is_read_so_far(tmp_path):
    """Within a run, which holds its lock, and after it was killed: the results so far."""
    folder, seen = tmp_path / "run", []

    def look(moment):
        seen.append((moment.time, rigidmd.read_run(folder)))

    stages = [STAGES[0] | {"duration_ps": 0.05}]
    scene = small_scene(
        {"argon": 20},
        20.0,
        stages=stages,
        output={"log_interval_ps": 0.01, "checkpoint_minutes": 0},
    )
    Simulation(scene, folder, observers=Every(0.03, look)).run()
    time, results = seen[1]
    assert 0 <= results["time"][-1] <= time
    assert results.interrupted
    assert results.summary["stages"] == []
    assert "This run has not ended" in results.summary["notes"][0]
    assert "is not available" in results.summary["notes"][1]
    with pytest.raises(
        OutputError, match=r"the final state is not available: .* holds no checkpoint"
    ):
        _ = results.state
    assert "This run has not ended" in results._repr_html_()


def test_the_state_of_a_run_that_was_killed_is_that_of_its_checkpoint(tmp_path):
    folder = tmp_path / "run"
    with Simulation(argon(), folder) as simulation:
        simulation.step(20)  # in the second stage, which began with a checkpoint
        killed = Path(shutil.copytree(folder, tmp_path / "killed"))
    before = snapshot(killed)
    assert rigidmd.read_run(killed).state.step[0] == 10
    assert snapshot(killed) == before
    stopped = rigidmd.read_run(folder)
    assert stopped.interrupted
    assert stopped.state.step[0] == simulation.state.step[0] == 20
    assert "interrupted" in stopped.summary["notes"][0]


def test_a_body_is_read(tmp_path):
    folder = tmp_path / "top"
    returned = Simulation(top(), folder).run()
    before = snapshot(folder)
    results = rigidmd.read_run(folder)
    for name in returned:
        np.testing.assert_allclose(results[name], returned[name], rtol=1e-15)
    assert results.samples.invariants == returned.samples.invariants
    assert results.summary == returned.summary
    assert same_bits(results.state, returned.state)
    assert (results.rotation == returned.rotation).all()
    assert len(results.universe().trajectory) == len(returned.universe().trajectory)
    assert "heavy_top_3" in results._repr_html_()
    assert rigidmd.view.show(results).page == rigidmd.view.show(returned).page
    with pytest.raises(OutputError, match="analyses are for molecules"):
        rigidmd.analysis.rdf(results)
    assert snapshot(folder) == before


def test_a_sweep_is_read(tmp_path):
    folder = tmp_path / "sweep"
    scene = tmp_path / "argon.toml"
    scene.write_text(
        "[box]\nlengths_A = 20\n[[molecules]]\nmodel = 'argon'\ncount = 20\n[[stages]]\nduration_ps = 0.1\n"
        "[start]\ntemperature_K = 90\n[output]\nlog_interval_ps = 0.01\nfigures = false\n"
    )
    table = rigidmd.sweep(scene, {"start.temperature_K": [80, 90]}, folder)
    before = snapshot(folder)
    found = rigidmd.read_run(folder)
    assert found.to_dataframe().equals(table.to_dataframe())
    assert list(found.runs) == list(table.runs) == ["temperature_K=80", "temperature_K=90"]
    first, second = (rigidmd.read_run(path) for path in found.runs.values())
    assert first["temperature"][0] < second["temperature"][0]
    with pytest.raises(
        TypeError, match=r"takes the results of a run, or a list of them, not <Table.*table\.runs"
    ):
        rigidmd.analysis.rdf(found)
    assert snapshot(folder) == before


def test_what_is_not_a_run(tmp_path, run):
    with pytest.raises(OutputError, match="does not exist"):
        rigidmd.read_run(tmp_path / "nothing")
    with pytest.raises(OutputError, match="is not the folder of a run"):
        rigidmd.read_run(tmp_path)
    with pytest.raises(OutputError, match="is a file"):
        rigidmd.read_run(run[0] / "log.csv")
    for name in ("summary.json", "final.npz", "log.csv"):
        damaged = Path(shutil.copytree(run[0], tmp_path / name))
        (damaged / name).write_bytes((damaged / name).read_bytes()[:40])
        if name == "final.npz":
            with pytest.raises(
                OutputError, match=r"the final state is not available: .*final\.npz"
            ):
                _ = rigidmd.read_run(damaged).state
        else:
            with pytest.raises(OutputError, match=re.escape(name)) as error:
                rigidmd.read_run(damaged)
            assert "--force" not in str(error.value)
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep" / "sweep.json").write_text('{"schema": 1, "name": ')
    with pytest.raises(OutputError, match=r"sweep\.json cannot be read"):
        rigidmd.read_run(tmp_path / "sweep")


def test_an_analysis_of_a_path_names_read_run(run):
    folder = run[0]
    for path in (folder, str(folder)):
        with pytest.raises(
            TypeError,
            match=rf"rigidmd\.analysis\.rdf\(rigidmd\.read_run\('{re.escape(str(folder))}'\)\)",
        ):
            rigidmd.analysis.rdf(path)
    with pytest.raises(TypeError, match="not None"):
        rigidmd.analysis.analyse(None, "msd")


@pytest.mark.usefixtures("reads_here")
def test_the_command_writes_no_offsets(run, capsys):
    folder = run[0]
    assert cli.main(["analyse", str(folder), "--only", "msd"]) == 0
    assert not [path for path in folder.iterdir() if "offsets" in path.name]
