"""A sweep from end to end: its folder, what has finished, its manifest."""

import csv
import json
import re
import shlex
import shutil

import numpy as np
import pytest
from support.sweeps import ARGON, GRID, states, table, written

import rigidmd
from rigidmd.commands import cli
from rigidmd.errors import OutputError, RigidMDWarning
from rigidmd.features.analysis import registry
from rigidmd.features.studies.sweep import sweeping
from rigidmd.features.studies.sweep.folder import read_manifest
from rigidmd.features.studies.sweep.plan import Axis
from rigidmd.io.folder import FolderLock


def test_a_sweep_is_a_folder_a_point_a_table_and_a_figure(finished):
    names = [f"temperature_K={t}_seed={s}" for t in (90, 120) for s in (1, 2)]
    assert states(finished) == dict.fromkeys(names, "finished")
    rows = table(finished)
    assert [(row["start.temperature_K"], row["runs"]) for row in rows] == [
        ("90", "2"),
        ("120", "2"),
    ]
    for row, temperature in zip(rows, (90, 120), strict=True):
        found = []
        for seed in (1, 2):
            with (finished / f"temperature_K={temperature}_seed={seed}" / "log.csv").open() as file:
                log = list(csv.DictReader(file))
            found.append(np.mean([float(line["Temperature (K)"]) for line in log]))
        assert float(row["Temperature (K)"]) == pytest.approx(np.mean(found), rel=1e-8)
        error = abs(found[0] - found[1]) / 2  # standard deviation over the root of 2
        assert float(row["Temperature (K) error"]) == pytest.approx(error, rel=1e-6)
        assert "Box Volume (nm^3) error" not in row  # a constant has no error
    assert (finished / "sweep.png").read_bytes().startswith(b"\x89PNG")


def test_a_point_has_the_bits_of_a_run(finished, argon, tmp_path, capsys):
    """In a process of its own."""
    changes = ["--set", "start.temperature_K=120", "--set", "seed=2..2"]
    assert cli.main(["sweep", str(argon), *changes, "-o", str(tmp_path / "s")]) == 0
    point = finished / "temperature_K=120_seed=2"
    assert cli.main(["compare", str(point), str(tmp_path / "s" / "seed=2")]) == 0
    for command in (["report"], ["analyse", "--only", "rdf"]):
        copy = shutil.copytree(point, tmp_path / command[0])
        assert cli.main([*command, str(copy)]) == 0


def test_what_has_finished_is_not_run_again(copied, argon, capsys, printed):
    before = written(copied)
    assert (
        cli.main(["sweep", str(argon), *GRID[2:], *GRID[:2], "-o", str(copied)]) == 0
    )  # keys in any order
    assert "4 skipped" in capsys.readouterr().out
    assert written(copied) == before
    # one value more, of a key that is varied
    more = ["--set", "start.temperature_K=90", "--set", "seed=3"]
    assert (
        "1 finished, 0 failed, 4 skipped"
        in printed("sweep", argon, *more, "-o", copied, "--jobs", "1").out
    )
    assert {name: time for name, time in written(copied).items() if name in before} == before
    assert [row["runs"] for row in table(copied)] == ["3", "2"]


def test_a_point_with_a_longer_last_stage_counts_with_a_note(copied, argon, capsys):
    def lines_of(*command):
        code = cli.main([*command])
        output = capsys.readouterr()
        return code, output.out, output.err

    names = [point.folder for point in read_manifest(copied).points]
    before = written(copied)
    assert lines_of("resume", str(copied / names[0]), "--until", "0.7ps")[0] == 0
    note = f"the last stage of {names[0]} has another duration than in the sweep"
    for command in (
        ["sweep", str(argon), "-o", str(copied), "--collect"],
        ["sweep", str(argon), "-o", str(copied), *GRID],
        ["analyse", str(copied), "--only", "rdf"],
    ):
        code, out, err = lines_of(*command)
        assert code == 0 and err.count(note) == 1
        assert "4 of them finished" in out or "2 runs" in out
    assert set(states(copied).values()) == {"finished"}
    assert {name for name, at in written(copied).items() if at != before[name]} == {names[0]}
    with pytest.warns(RigidMDWarning, match=note):
        assert [len(row.runs) for row in rigidmd.read_run(copied).rows] == [2, 2]


def test_another_scene_is_refused(copied, argon, tmp_path, printed):
    for changes, expected in (
        ([*GRID, "--set", "forces.cutoff_A=7.5"], "forces.cutoff_A is 7.5, there 8.0"),
        (GRID[:2], "it varies start.temperature_K and seed, not start.temperature_K"),
        ([*GRID, "--set", "stages.0.duration_ps=2"], "stages.0.duration_ps is 2.0, there 0.5"),
    ):
        said = printed("sweep", argon, *changes, "-o", copied, code=2).err
        assert expected in said
        assert "--force starts it again" in said
    assert (copied / "temperature_K=90_seed=1" / "log.csv").exists()


def test_analyse_gives_errors_over_replicas(copied, argon, printed):
    assert (
        "temperature_K = 90: 2 runs"
        in printed("analyse", copied, "--only", "rdf,structure_factor").out
    )
    mean = copied / "temperature_K=90"
    own = [
        np.genfromtxt(copied / f"temperature_K=90_seed={k}" / "rdf.csv", delimiter=",", names=True)
        for k in (1, 2)
    ]
    both = np.genfromtxt(mean / "rdf.csv", delimiter=",", names=True)
    g, error = (name for name in both.dtype.names if name.startswith("g_"))
    assert both[g] == pytest.approx((own[0][g] + own[1][g]) / 2, abs=1e-7)
    assert both[error] == pytest.approx(np.abs(own[0][g] - own[1][g]) / 2, abs=1e-7)
    assert json.loads((mean / "analysis.json").read_text())["analyses"].keys() == {
        "rdf",
        "structure_factor",
    }
    with (copied / "analysis.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["runs"] for row in rows] == ["2", "2"]
    assert float(rows[0]["highest peak of S(k) error"]) > 0
    # --force removes what a sweep and its analyses wrote, and no more
    (copied / "notes.txt").write_text("mine")
    (copied / "temperature_K=90_seed=1" / "mine.txt").write_text("mine")
    with sweeping.open_sweep(argon, [Axis(("seed",), (1, 2))], copied, force=True) as manifest:
        assert len(manifest.unfinished) == 2
    assert [path.name for path in copied.iterdir() if path.is_dir()] == ["temperature_K=90_seed=1"]
    assert [path.name for path in (copied / "temperature_K=90_seed=1").iterdir()] == ["mine.txt"]
    assert {
        path.name for path in copied.iterdir() if path.is_file() and not path.name.startswith(".")
    } == {
        "notes.txt",
        "sweep.json",
    }
    assert states(copied) == {"seed=1": "waiting", "seed=2": "waiting"}


def test_a_file_of_one_point_that_changes_is_noticed(tmp_path, monkeypatch):
    """A key whose values are files."""
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b"):
        (tmp_path / f"{name}.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 5\n")
    text = ARGON.replace("count = 20\n", "") + '\n[structure]\nfile = "a.xyz"\n'
    (scene := tmp_path / "argon.toml").write_text(text)
    axes = sweeping.axes_of({"structure.file": ["a.xyz", "b.xyz"]})
    with sweeping.open_sweep(scene, axes, tmp_path / "s") as before:
        pass
    (tmp_path / "b.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 6\n")
    with (
        pytest.raises(
            OutputError, match=r"another scene: a file that file=b.xyz reads has changed"
        ),
        sweeping.open_sweep(scene, axes, tmp_path / "s"),
    ):
        pass
    (tmp_path / "b.xyz").write_text("2\n\nAr 0 0 0\nAr 0 0 5\n")
    with sweeping.open_sweep(scene, axes, tmp_path / "s") as after:
        pass
    assert [point.scene_sha256 for point in after.points] == [
        point.scene_sha256 for point in before.points
    ]


@pytest.mark.parametrize("of_sweep", [["--extrapolate", "stages.0.timestep_fs"], ["pmf"]])
def test_a_sweep_that_is_not_there_is_not_a_run(of_sweep, printed, tmp_path):
    assert "none' does not exist" in printed("analyse", tmp_path / "none", *of_sweep, code=2).err


def test_analyses_of_a_sweep_continue_without_a_damaged_point(copied, printed, monkeypatch):
    """One point cannot be read, one analysis has an error of ours, one is not possible."""
    (copied / "temperature_K=90_seed=1" / "trajectory.trr").write_bytes(b"nothing")
    rdf = registry.KNOWN["rdf"]

    def broken(runs):
        raise ZeroDivisionError("of no use")

    monkeypatch.setitem(registry.KNOWN, "rdf", rdf._replace(function=broken))
    said = printed("analyse", copied, "--only", "rdf,viscosity,structure_factor", code=1).out
    assert re.search(r"temperature_K=90_seed=1: .*cannot be read as a trajectory", said)
    assert (
        "rdf: an error of rigidmd, please report it: ZeroDivisionError: of no use (test_sweeping.py:"
        in said
    )
    assert "viscosity: a viscosity needs the pressure tensor" in said
    with (copied / "analysis.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["runs"] for row in rows] == ["1", "2"]
    assert all(float(row["highest peak of S(k)"]) > 0 for row in rows)
    assert (copied / "analysis.png").read_bytes().startswith(b"\x89PNG")
    assert "analysis.png" in (copied / ".rigidmd-run").read_text()
    assert not (copied / "temperature_K=120" / "rdf.csv").exists()


def test_replicas_that_are_too_short_alone_are_analysed_together(copied, printed):
    assert (
        "needs at least 20 frames"
        in printed("analyse", copied / "temperature_K=90_seed=1", "--only", "msd", code=2).err
    )
    assert cli.main(["analyse", str(copied), "--only", "msd"]) == 0
    assert (copied / "temperature_K=90" / "msd.csv").is_file()


def test_from_python(argon, finished, copied):
    found = rigidmd.sweep(argon, {"start.temperature_K": [90, 120], "seed": range(1, 3)}, copied)
    assert found["start.temperature_K"].tolist() == [90, 120]
    assert found["Temperature (K)"] == pytest.approx(
        [float(row["Temperature (K)"]) for row in table(finished)]
    )
    assert (found.error("Temperature (K)") > 0).all()
    assert list(found.to_dataframe()["runs"]) == [2, 2]
    with pytest.raises(KeyError, match="there are"):
        found["no"]
    shown = found._repr_html_()
    temperatures = [row["Temperature (K)"] for row in table(finished)]
    for text in (
        "start.temperature_K",
        "<td>120</td>",
        "Temperature (K)",
        *(x.split(".")[0] for x in temperatures),
    ):
        assert text in shown
    with pytest.raises(OutputError, match="pmf needs a sweep over the distance of a restraint"):
        rigidmd.pmf(found)


def test_two_sweeps_do_not_share_a_folder(copied, argon, capsys):
    lock = FolderLock(copied)
    lock.take()
    try:
        assert cli.main(["sweep", str(argon), *GRID, "-o", str(copied)]) == 2
    finally:
        lock.release()
    assert "another run is writing" in capsys.readouterr().err


SPRING = """
from typing import NamedTuple

import rigidmd


class Spring(NamedTuple):
    stiffness: float
    absolute_positions = True


@rigidmd.compiled_force(Spring)
def add_spring(term, state, load, tally):
    load.force[0, 0] -= term.stiffness * state.position[0, 0]


def spring():
    return Spring({size})
"""


def test_each_point_trusts_the_file_that_it_runs(argon, tmp_path, capsys, printed):
    """A sweep over modules, each of which has to be trusted."""
    text = argon.read_text() + '[[forces.custom]]\nmodule = "one.py"\nname = "spring"\n'
    (scene := tmp_path / "argon.toml").write_text(text)
    for name, size in (("one.py", 1.0), ("two.py", 2.0), ("three.py", 3.0)):
        (tmp_path / name).write_text(SPRING.format(size=size))
    names = [str(tmp_path / name) for name in ("one.py", "two.py", "three.py")]
    arguments = ["sweep", str(scene), "--set", f"forces.custom.0.module={names[0]},{names[1]}"]
    arguments += ["--to", "commands", "-o", str(tmp_path / "s")]
    trusted = ["--trust", names[0], "--trust", names[1]]
    assert (
        "three.py is not a file that [[forces.custom]]"
        in printed(*arguments, *trusted, "--trust", names[2], code=2).err
    )
    assert cli.main([*arguments, *trusted]) == 0
    for line, name in zip(capsys.readouterr().out.splitlines(), names, strict=False):
        assert shlex.split(line)[-2:] == ["--trust", name]


def test_folders_that_are_none(argon, tmp_path, copied, printed):
    (tmp_path / "file").write_text("")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("")
    for name, expected in (("file", "is a file"), ("full", "holds no sweep")):
        for more in ([], ["--force"]):
            assert (
                expected in printed("sweep", argon, *GRID, "-o", tmp_path / name, *more, code=2).err
            )
    assert (
        "holds no sweep"
        in printed("sweep", argon, "-o", tmp_path / "none", "--collect", code=2).err
    )
    assert (
        "is the folder of a sweep. Name one of the runs in it"
        in printed("report", copied, code=2).err
    )
    for text in (
        "",
        "{}",
        "[]",
        '{"schema": 1}',
        '{"schema": 99}',
        "{",
        '{"schema": 1, "points": [{"folder": "../x"}]}',
    ):
        (copied / "sweep.json").write_text(text)
        assert "sweep.json" in printed("sweep", argon, *GRID, "-o", copied, code=2).err
        assert "sweep.json" in printed("analyse", copied, code=2).err


def test_a_manifest_names_no_folder_outside(copied, argon, printed):
    told = json.loads((copied / "sweep.json").read_text())
    for name in ("../outside", "..", "/tmp/x", ""):
        told["points"][0]["folder"] = name
        (copied / "sweep.json").write_text(json.dumps(told))
        assert (
            "points with invalid names of folders"
            in printed("sweep", argon, *GRID, "-o", copied, code=2).err
        )


def test_an_invalid_manifest_is_refused(copied, argon, capsys):
    whole = json.loads((copied / "sweep.json").read_text())
    for change in (
        {"keys": []},
        {"keys": {"seed": ["other"], "start.temperature_K": ["start.temperature_K"]}},
        {"fixed": "x"},
        {"common": 3},
        {"name": None},
        {"points": 3},
        {"points": [3]},
        {"trust": ["evil.py"]},
        {"points": [whole["points"][0] | {"state": "done"}]},
        {"points": [whole["points"][0] | {"values": {}}]},
        {"points": [whole["points"][0] | {"seconds": "long"}]},
        {"points": whole["points"][:1] * 2},
    ):
        (copied / "sweep.json").write_text(json.dumps(whole | change))
        for command in (["sweep", str(argon), *GRID, "-o"], ["analyse"]):
            assert cli.main([*command, str(copied)]) == 2, change
            said = capsys.readouterr().err
            assert f"{copied / 'sweep.json'}" in said, change
            assert next(iter(change)) in said, change
            assert "--force starts the sweep again" in said, change
