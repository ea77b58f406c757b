"""Folders of runs: what may be replaced, links and files that vanish, one run at a time."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.common import small_scene
from support.scenes import GOOD
from support.stops import change, everything

from rigidmd.commands import cli
from rigidmd.commands.cli import CommandLine, main
from rigidmd.core.files import AppendedFile
from rigidmd.errors import OutputError, RigidMDWarning, worded_by
from rigidmd.io.folder import FolderLock, check_folder
from rigidmd.run import Every, Simulation


def test_output_folders(printed, tmp_path):
    full = tmp_path / "mine"
    full.mkdir()
    (full / "thesis.txt").write_text("years of work")
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    for force in ([], ["--force"]):
        assert "holds no earlier run" in printed("run", scene, "-o", full, *force, code=2).err
        assert (full / "thesis.txt").read_text() == "years of work"
    assert "is a file" in printed("run", scene, "-o", scene, code=2).err
    assert "cannot be" in printed("run", scene, "-o", "/proc/here/there", code=2).err


@pytest.mark.parametrize(
    ("names", "resumes"), [((".rigidmd-run",), False), ((".rigidmd-run", "checkpoint.npz"), True)]
)
def test_a_folder_with_a_checkpoint_names_the_command_that_continues_it(names, resumes, tmp_path):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(
        OutputError, match=r"holds an earlier run; .*force=True replaces it, folder=... names"
    ) as refused:
        check_folder(tmp_path, force=False)
    assert ("resume=True continues it" in str(refused.value)) == resumes
    assert "--" not in str(refused.value)
    with (
        worded_by(CommandLine()),
        pytest.raises(OutputError, match=r"; .*--force replaces it, -o names") as refused,
    ):
        check_folder(tmp_path, force=False)
    assert (f"`rigidmd resume {tmp_path}` continues it" in str(refused.value)) == resumes


def test_force_removes_only_what_a_run_wrote_and_never_its_own_inputs(printed, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    out = tmp_path / "out"
    assert main(["run", str(scene), "-o", str(out)]) == 0
    (out / "notes.txt").write_text("mine")
    assert main(["run", str(scene), "-o", str(out), "--force"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    kept = {path.name: path.read_bytes() for path in out.iterdir()}
    assert (
        "is an input of this run"
        in printed("run", out / "scene.toml", "-o", out, "--force", code=2).err
    )
    restart = ["--set", f"structure.file={out / 'final.npz'}", "--set", "box.lengths_A=20.0"]
    assert (
        "is an input of this run"
        in printed("run", scene, *restart, "-o", out, "--force", code=2).err
    )
    assert {path.name: path.read_bytes() for path in out.iterdir()} == kept
    project = tmp_path / "project"
    project.mkdir()
    (project / "scene.toml").write_text(GOOD)
    assert main(["run", str(project / "scene.toml"), "-o", str(project), "--force"]) == 2
    assert (project / "scene.toml").read_text() == GOOD


def test_an_earlier_run_is_kept_when_the_new_scene_is_bad(capsys, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    assert main(["run", str(scene), "-o", str(tmp_path / "out")]) == 0
    kept = (tmp_path / "out" / "summary.json").read_text()
    assert (
        main(
            [
                "run",
                str(scene),
                "-o",
                str(tmp_path / "out"),
                "--force",
                "--set",
                "forces.cutoff_A=19",
            ]
        )
        == 2
    )
    assert (tmp_path / "out" / "summary.json").read_text() == kept


@pytest.mark.parametrize("command", ["report", "view", "analyse", "sweep", "run", "resume"])
def test_no_command_writes_through_a_link(command, again, capsys):
    """Folders of runs may come from outsiders, with links in the position of any file: what these
    point to stays."""
    run, away = again / "run", again / "away"
    assert cli.main(["analyse", str(run), "--only", "density_profile"]) == 0
    change(run / ".rigidmd-run", "log.csv", "log.csv\nreport.html\nview.html\nanalyses.csv")
    for name in ("report.html", "view.html", "analyses.csv"):
        (run / name).touch()
    files = sorted(path.name for path in run.iterdir() if path.is_file())
    assert not [name for name in files if "offsets" in name] and "density_profile.png" in files
    shutil.copytree(run, again / "kept")
    arguments = {
        "run": [
            "run",
            str(again / "water.toml"),
            "-o",
            str(run),
            "--force",
            "--set",
            "stages.0.duration_ps=0.01",
        ],
        "sweep": ["sweep", str(again / "water.toml"), "--set", "seed=1", "-o", str(run)],
        "analyse": ["analyse", str(run), "--only", "density_profile"],
    }
    # a resumed run is rejected at the first link that it would continue, so each is tried by itself
    for names in [[name] for name in files] if command == "resume" else [files]:
        for folder in (run, away):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(again / "kept", run)
        away.mkdir()
        for name in names:
            if name != ".rigidmd-lock":
                (run / name).rename(away / name)
                (run / name).symlink_to(away / name)
        before = everything(away)
        ended = cli.main(arguments.get(command, [command, str(run)]))
        assert everything(away) == before, names
        refuses = command != "run" and names != [".rigidmd-lock"]
        assert ended == (2 if refuses else 0), (names, capsys.readouterr().err)


def test_a_file_that_grows_replaces_what_has_its_name(tmp_path):
    """A link, a pipe or a file of others: what a link points to stays, and no pipe is waited
    for."""
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "victim")
    (tmp_path / "broken").symlink_to(tmp_path / "nothing")
    os.mkfifo(tmp_path / "pipe")
    for name in ("link", "broken", "pipe", "victim"):
        file = AppendedFile(tmp_path / name)
        file.append(b"mine")
        file.close()
        assert (tmp_path / name).read_bytes() == b"mine" and not (tmp_path / name).is_symlink()
        assert (tmp_path / "victim").read_text() == ("mine" if name == "victim" else "precious")
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize(
    ("name", "setting"),
    [
        ("mine.trr", "output.trajectory=mine.trr"),
        ("mine.gsd", "output.trajectory=mine.gsd"),
        ("mine.pdb", "output.topology=mine.pdb"),
        ("pressure_tensor.csv", "output.pressure_tensor_interval_ps=0.01"),
        ("energy.png", "output.figures=true"),
        ("last_good_state.npz", None),
        ("log.csv", None),
    ],
)
def test_force_replaces_only_what_a_run_has_written(name, setting, again, printed):
    run = again / "run"
    marker = run / ".rigidmd-run"
    marker.write_text(
        "".join(
            line for line in marker.read_text().splitlines(keepends=True) if line.strip() != name
        )
    )
    (run / name).write_text("precious")
    before = everything(run)
    more = ["--set", setting] if setting else []
    for how in (
        ("--force", "--resume")
        if setting
        and "trajectory" not in setting
        and "topology" not in setting
        and "pressure" not in setting
        else ("--force",)
    ):
        said = printed("run", again / "water.toml", "-o", run, how, *more, code=2).err
        assert (
            f"{name} exists, was not written by rigidmd, and would be replaced" in said
            and "compiling" not in said
        )
        assert everything(run) == before


def test_force_replaces_only_what_an_export_has_written(again, capsys):
    made = again / "made"
    command = ["export", str(again / "water.toml"), "--to", "gromacs", "-o", str(made)]
    change(again / "water.toml", "smooth_switch", "shift")
    assert cli.main(command) == 0 and cli.main([*command, "--force"]) == 0
    change(made / ".rigidmd-export", "run.sh\n", "")
    (made / "run.sh").write_text("precious")
    before = everything(made)
    assert cli.main([*command, "--force"]) == 2
    assert (
        "run.sh exists, was not written by rigidmd" in capsys.readouterr().err
        and everything(made) == before
    )


def test_one_run_at_a_time_writes_into_a_folder(again, printed):
    lock = FolderLock(again / "run")
    lock.take()
    command = ["run", str(again / "water.toml"), "-o", str(again / "run")]
    for more in ("--force", "--resume"):
        assert "another run is writing in" in printed(*command, more, code=2).err
    lock.release()


def test_a_failed_write_stops_the_run(stopped, tmp_path):
    """A limit on the size of files stands for a full disk; what was written before is whole."""
    command = f"ulimit -f 40; {sys.executable} -m rigidmd run {stopped / 'water.toml'} -o {tmp_path / 'run'} "
    command += "--set stages.0.duration_ps=20 --set output.log_interval_ps=0.002 --set output.checkpoint_minutes=false"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True)
    assert done.returncode == 1
    assert "cannot be written: File too large" in done.stderr
    assert (tmp_path / "run" / "log.csv").read_bytes().endswith(b"\n")


def taken_away(path: Path, how: str) -> None:
    """Remove a file, cut it, or put another one in its position."""
    if how == "removed":
        path.unlink()
    elif how == "changed by another program":
        os.truncate(path, 0)
    else:
        content = path.read_bytes()
        path.unlink()
        path.write_bytes(content)


def loses(tmp_path: Path, name: str, how: str, stages: int, **output) -> Simulation:
    """A run whose file is removed or replaced after its first step, in stages of two steps."""
    trajectory = name if name.startswith("trajectory") else "trajectory.xtc"
    data = {
        "stages": [{"duration_ps": 0.004}] * stages,
        "output": {"figures": False, "trajectory": trajectory} | output,
    }
    once = [True]

    def act(moment):
        if moment.step == 1 and once.pop():
            taken_away(tmp_path / "run" / name, how)
            once.append(False)

    return Simulation(
        small_scene({"argon": 8}, 20.0, **data), tmp_path / "run", observers=[Every(0.002, act)]
    )


VANISHING = [
    ("log.csv", "removed"),
    ("log.csv", "changed by another program"),
    ("trajectory.xtc", "changed by another program"),
    ("trajectory.xtc", "replaced by another file"),
    ("trajectory.gsd", "removed"),
]


@pytest.mark.parametrize(("name", "how"), VANISHING)
def test_a_file_that_vanishes_stops_the_run_at_the_next_checkpoint(name, how, tmp_path):
    with pytest.raises(
        OutputError, match=rf"stopped at step 2 .*{name} was {how} while the run was writing it"
    ):
        loses(tmp_path, name, how, stages=2).run()
    assert not (tmp_path / "run" / "summary.json").exists()


@pytest.mark.parametrize("checkpoints", [True, False])
@pytest.mark.parametrize(("name", "how"), VANISHING)
def test_a_file_that_vanishes_in_the_last_stage_is_noted_and_not_listed(
    name, how, checkpoints, tmp_path
):
    output = {} if checkpoints else {"checkpoint_minutes": False}
    with pytest.warns(RigidMDWarning, match=f"{name} was {how} while the run was writing it"):
        results = loses(tmp_path, name, how, stages=1, **output).run()
    listed = json.loads((tmp_path / "run" / "summary.json").read_text())["files"]
    assert listed == [str(path) for path in results.files]
    assert all(Path(path).is_file() for path in listed)
    assert (str(tmp_path / "run" / name) in listed) == (how != "removed")
    assert len(results["time"]) == 2
