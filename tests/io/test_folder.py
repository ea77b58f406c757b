"""Folders of runs: what `--force` replaces."""

import pytest
from support.scenes import GOOD

from rigidmd.commands.cli import CommandLine, main
from rigidmd.errors import OutputError, worded_by
from rigidmd.io.folder import check_folder


def test_output_folders(capsys, tmp_path):
    full = tmp_path / "mine"
    full.mkdir()
    (full / "thesis.txt").write_text("years of work")
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    for force in ([], ["--force"]):
        assert main(["run", str(scene), "-o", str(full), *force]) == 2
        assert "holds no earlier run" in capsys.readouterr().err
        assert (full / "thesis.txt").read_text() == "years of work"
    assert main(["run", str(scene), "-o", str(scene)]) == 2
    assert "is a file" in capsys.readouterr().err
    assert main(["run", str(scene), "-o", "/proc/here/there"]) == 2
    assert "cannot be" in capsys.readouterr().err


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


def test_force_removes_only_what_a_run_wrote_and_never_its_own_inputs(capsys, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    out = tmp_path / "out"
    assert main(["run", str(scene), "-o", str(out)]) == 0
    (out / "notes.txt").write_text("mine")
    assert main(["run", str(scene), "-o", str(out), "--force"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    kept = {path.name: path.read_bytes() for path in out.iterdir()}
    assert main(["run", str(out / "scene.toml"), "-o", str(out), "--force"]) == 2
    assert "is an input of this run" in capsys.readouterr().err
    restart = ["--set", f"structure.file={out / 'final.npz'}", "--set", "box.lengths_A=20.0"]
    assert main(["run", str(scene), *restart, "-o", str(out), "--force"]) == 2
    assert "is an input of this run" in capsys.readouterr().err
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
